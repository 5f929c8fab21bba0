"""Runs whose services are killed or attacked while they are watched."""

import os
import signal
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

from hostile import attack, samples
from running import TINY, digests

from pliant.config import config_yaml, load_config
from pliant.datasets import open_source
from pliant.datasets.source_spec import SourceSpec
from pliant.messages.types import Status
from pliant.results.folder import STATE_FOLDER, prepare
from pliant.results.write import write_results
from pliant_services.profiles import PROFILES
from pliant_services.run.command import service_arguments
from pliant_services.run.request import RunRequest
from pliant_services.runtime.launcher import Fleet

SERVICES = PROFILES["points"]


_HELD_S, _LET_GO_S = 10.0, 0.01


REQUEST = RunRequest(source=SourceSpec(location=TINY))


def run(
    output: Path,
    victims: Callable[[Status, Fleet], Sequence[str]] = lambda status, fleet: (),
    *,
    resume: bool = False,
    settings: Sequence[str] = (),
    request: RunRequest = REQUEST,
) -> dict[str, str]:
    """One run in which the victims of each status are killed; returns the result files."""
    config = load_config(overrides=["bus.checkpoint_frames=6", *settings])
    if not resume:
        prepare(output, config_yaml(config))
    fleet: Fleet | None = None

    def on_status(status: Status) -> None:
        assert fleet is not None
        for name in victims(status, fleet):
            signal_if_there(fleet.pids[name], signal.SIGKILL)

    fleet = Fleet(
        SERVICES,
        log_folder=output / "logs",
        on_status=on_status,
        state=output / STATE_FOLDER,
    )
    try:
        fleet.start(lambda name: service_arguments(name, request, output))
        fleet.wait()
    finally:
        fleet.close()
    write_results(output)
    return digests(output)


def signal_if_there(process: int, number: signal.Signals) -> None:
    with suppress(ProcessLookupError):
        os.kill(process, number)


class TooLateError(Exception):
    """The source of a run had sent its last frame before it could be held up."""


def run_attacked(
    output: Path,
    recording: Path,
    each: int,
    request: RunRequest = REQUEST,
    watch: Callable[[Fleet], None] = lambda fleet: None,
) -> dict[str, str]:
    """A run that meets so many hostile messages on every key; returns the result files.

    Its source is held up meanwhile, not for so long at a time that it would be taken for dead.
    watch: called now and then as long as messages come.
    Raises TooLateError.
    """
    attackers: list[threading.Thread] = []
    failures: list[Exception] = []
    sent, let_go = -1, False

    def hold_and_attack(status: Status, fleet: Fleet) -> Sequence[str]:
        nonlocal sent
        if status.service == "ingest" and not let_go:  # a slow attack may see its end, too
            sent = status.frame
        if not attackers and status.service == "tracking" and status.frame >= 4:
            source = fleet.pids["ingest"]
            signal_if_there(source, signal.SIGSTOP)  # before it is done

            def work() -> None:
                try:
                    attack(fleet.endpoint, fleet.session, SERVICES, samples(recording), each)
                except Exception as error:
                    failures.append(error)

            def hold() -> None:
                nonlocal let_go
                while True:
                    attackers[0].join(_HELD_S)
                    watch(fleet)
                    let_go = True
                    signal_if_there(source, signal.SIGCONT)
                    attackers[0].join(_LET_GO_S)
                    if not attackers[0].is_alive():
                        return
                    signal_if_there(source, signal.SIGSTOP)

            attackers.append(threading.Thread(target=work))
            attackers[0].start()  # no Zenoh call in a callback
            threading.Thread(target=hold).start()
        return ()

    narrow = ["bus.window=4"]  # so it is not done yet
    found = run(output, hold_and_attack, settings=narrow, request=request)
    assert attackers
    attackers[0].join()
    if sent + 1 == open_source(request.source).frame_count:
        raise TooLateError
    assert not failures, failures
    return found

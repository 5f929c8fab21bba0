"""Services killed in the middle of a run: the results are the same bytes as without the fault."""

import os
import signal
from collections.abc import Callable, Sequence
from hashlib import sha256
from pathlib import Path

import pytest

from pliant.config import config_yaml, load_config
from pliant.messages.types import Status
from pliant_services import launcher, warm_up
from pliant_services.launcher import Fleet, ServiceDiedError
from pliant_services.pipeline import (
    STATE_FOLDER,
    RunRequest,
    prepare,
    resumed_config,
    service_arguments,
)
from pliant_services.processes import PROFILES
from pliant_services.results import write_results

pytestmark = pytest.mark.system

SERVICES = PROFILES["points"]
FILES = ("trajectory.txt", "trajectory_causal.txt", "keyframes.txt", "points.ply")
REQUEST = RunRequest(source="built-in:tiny")


def run(
    output: Path,
    victims: Callable[[Status, Fleet], Sequence[str]] = lambda status, fleet: (),
    *,
    resume: bool = False,
) -> dict[str, str]:
    """One run in which the victims of each status are killed; returns the result files."""
    config = load_config(overrides=["bus.checkpoint_frames=6"])
    if not resume:
        prepare(output, config_yaml(config))
    fleet: Fleet | None = None

    def on_status(status: Status) -> None:
        assert fleet is not None
        for name in victims(status, fleet):
            os.kill(fleet.pids[name], signal.SIGKILL)

    fleet = Fleet(
        SERVICES,
        log_folder=output / "logs",
        on_status=on_status,
        state=output / STATE_FOLDER,
    )
    try:
        fleet.start(lambda name: service_arguments(name, REQUEST, output))
        fleet.wait()
    finally:
        fleet.close()
    write_results(output)
    # Digests: thousands of differing bytes tell a reader nothing.
    return {name: sha256((output / name).read_bytes()).hexdigest() for name in FILES}


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    warm_up.compile_kernels(print)
    return run(tmp_path_factory.mktemp("undisturbed"))


def once_at(*when: tuple[int, Sequence[str]]) -> Callable[[Status, Fleet], Sequence[str]]:
    """Kill these when bundle adjustment has told of a frame; frames rise."""
    waiting = list(when)

    def victims(status: Status, _: Fleet) -> Sequence[str]:
        if not waiting or status.service != "bundle_adjustment" or status.frame < waiting[0][0]:
            return ()
        return waiting.pop(0)[1]

    return victims


@pytest.mark.parametrize("first", [2, 16])
def test_killed_services_go_on_where_they_were(
    first: int, tmp_path: Path, undisturbed: dict[str, str]
) -> None:
    """Each in its turn, early, before there is a checkpoint, and late."""
    killed: list[str] = []
    kills = once_at(*((first + 3 * i, (name,)) for i, name in enumerate(SERVICES)))

    def victims(status: Status, fleet: Fleet) -> Sequence[str]:
        chosen = kills(status, fleet)
        killed.extend(chosen)
        return chosen

    assert run(tmp_path, victims) == undisturbed
    assert killed == list(SERVICES)


@pytest.mark.parametrize("look_s", [0.01, 1.0])
def test_all_at_once(
    look_s: float, tmp_path: Path, undisturbed: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whether the launcher sees one dead and others alive, or, looking seldom, all dead."""
    monkeypatch.setattr(launcher, "_POLL_S", look_s)
    assert run(tmp_path, once_at((18, SERVICES))) == undisturbed


def test_a_power_cut_and_resume(tmp_path: Path, undisturbed: dict[str, str]) -> None:
    def cut(status: Status, fleet: Fleet) -> Sequence[str]:
        if status.service == "bundle_adjustment" and status.frame == 22:
            fleet.give_up()
            return SERVICES
        return ()

    with pytest.raises(ServiceDiedError):
        run(tmp_path, cut)
    resumed_config(tmp_path, REQUEST)
    assert run(tmp_path, resume=True) == undisturbed


def test_a_frame_that_kills_again_and_again_ends_the_run_with_its_number(tmp_path: Path) -> None:
    def always(status: Status, _: Fleet) -> Sequence[str]:
        fatal = status.service == "tracking" and status.frame == 11
        return ("tracking",) if fatal else ()

    with pytest.raises(ServiceDiedError, match="frame 12 killed tracking 3 times"):
        run(tmp_path, always)

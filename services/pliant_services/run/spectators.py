"""How a run lets others look on: it says where it is, and starts a viewer where asked to."""

import json
import subprocess
import sys
from collections.abc import Generator
from contextlib import contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path

from pliant.errors import ResultError
from pliant.results.folder import SESSION_NAME
from pliant_services.runtime.launcher import Fleet
from pliant_services.view.command import place

_START_S = 30.0  # a viewer imports Rerun, and may wait for a busy machine
_WAIT_S = 120.0  # services compile before they are up
_LAST_WORDS_S = 20.0
_LEAVE_S = 5.0


@contextmanager
def announced(output: Path, endpoint: str, session: str) -> Generator[None]:
    """Leave ``session.json`` in the result folder while the run goes on."""
    file = output / SESSION_NAME
    with suppress(OSError):  # a full disk has a line of its own
        file.write_text(json.dumps({"endpoint": endpoint, "session": session}), encoding="utf-8")
    try:
        yield
    finally:
        file.unlink(missing_ok=True)


def check_viewer(output: Path, *, web: bool, save: Path | None, force: bool) -> None:
    """Raise ResultError where a run's viewer could not start: before an earlier result is touched.

    output: the result folder, which need not be there yet.
    """
    place(web=web, save=save, force=force)
    folder = save.resolve().parent if save is not None else output.resolve()
    if not folder.is_dir() and folder != output.resolve():
        raise ResultError(f"{save}: there is no such folder: choose another --save")
    if find_spec("rerun") is None:
        raise ResultError("Rerun is not installed: pip install 'pliant[view]'")


@contextmanager
def viewer(fleet: Fleet, *, web: bool, save: Path | None) -> Generator[None]:
    """A ``pliant view`` of its own that is there before the first frame.

    One in a browser stays when the run is over, until Ctrl-C.  Raises ResultError where it does
    not come up.
    """
    command = [
        *(sys.executable, "-m", "pliant_services.cli", "view"),
        *("--connect", fleet.endpoint, "--session", fleet.session, "--patience", str(_WAIT_S)),
        *(["--web"] if web else []),
        *(["--save", str(save), "--force"] if save is not None else []),
    ]
    # In a session of its own: Ctrl-C is for the launcher, and the viewer sees the run to its end.
    process = subprocess.Popen(command, stdin=subprocess.DEVNULL, start_new_session=True)
    try:
        waited = 0.0
        while not fleet.wait_for_viewer(0.2):
            waited += 0.2
            if process.poll() is not None or waited > _START_S:
                raise ResultError("the viewer did not start; what it said stands above")
        yield
        with suppress(subprocess.TimeoutExpired):
            process.wait(None if web else _LAST_WORDS_S)
    finally:
        if process.poll() is None:
            process.terminate()
            with suppress(subprocess.TimeoutExpired):  # one that is stopped would never leave
                process.wait(_LEAVE_S)
            process.kill()
            process.wait()

"""The viewer that a run starts on request."""

import subprocess
import sys
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path

from pliant.errors import ResultError
from pliant.programs import PYTHON
from pliant_services.runtime.launcher import Fleet

_WAIT_S = 120.0  # services compile before they are up; a viewer imports Rerun on a busy machine
_LAST_WORDS_S = 20.0
_LEAVE_S = 5.0


def has_viewer() -> bool:
    """Whether what `pliant view` draws with is installed."""
    return find_spec("rerun") is not None


def check_viewer(output: Path, *, web: bool, save: Path | None, force: bool) -> None:
    """Raise ResultError if a run's viewer could not start: before an earlier result is touched.

    output: the result folder, which need not be there yet.
    """
    from pliant_services.view.command import place  # it loads what draws

    place(web=web, save=save, force=force)
    folder = save.resolve().parent if save is not None else output.resolve()
    if not folder.is_dir() and folder != output.resolve():
        raise ResultError(f"{save}: no such folder: choose another --save")
    if not has_viewer():
        raise ResultError("Rerun is not installed: pip install 'pliant[view]'")


class Viewer:
    """A ``pliant view`` of its own.  A context manager: leaving it ends the viewer."""

    def __init__(self, *, web: bool, save: Path | None) -> None:
        self._web = web
        self._where = ["--web"] if web else []
        self._where += ["--save", str(save), "--force"] if save is not None else []
        self._process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> "Viewer":
        return self

    def start(self, fleet: Fleet) -> None:
        """Start the viewer and wait until it is ready, before the first frame.

        Raises ResultError if it does not start.
        """
        command = [
            *(*PYTHON, "-m", "pliant_services.cli", "view"),
            *("--connect", fleet.endpoint, "--session", fleet.session, "--patience", str(_WAIT_S)),
            *self._where,
        ]
        # In a session of its own: Ctrl-C is for the launcher, and the viewer shows the whole run.
        self._process = subprocess.Popen(command, stdin=subprocess.DEVNULL, start_new_session=True)
        waited = 0.0
        while not fleet.wait_for_viewer(0.2):
            waited += 0.2
            if self._process.poll() is not None or waited > _WAIT_S:
                raise ResultError("the viewer did not start; its messages are above")

    def see_the_end(self, fleet: Fleet) -> None:
        """Wait until it has drawn what the services said last, and has written its file."""
        if self._web:
            fleet.wait_for_last_viewer(_LAST_WORDS_S)
        elif self._process is not None:
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(_LAST_WORDS_S)

    def stay(self) -> None:
        """Leave what a browser shows where it is until Ctrl-C; a window stays by itself."""
        if self._web and self._process is not None and self._process.poll() is None:
            with suppress(KeyboardInterrupt):
                print("the browser view stays open until Ctrl-C", file=sys.stderr, flush=True)
                self._process.wait()

    def __exit__(self, *_: object) -> None:
        if self._process is not None and self._process.poll() is None:
            self._process.terminate()
            with suppress(subprocess.TimeoutExpired):  # one that is stopped would never leave
                self._process.wait(_LEAVE_S)
            self._process.kill()
            self._process.wait()

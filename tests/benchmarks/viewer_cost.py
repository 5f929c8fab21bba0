"""Does a viewer slow a run down?  One that draws, and one that is stopped and takes nothing."""

import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Generator, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from statistics import median

from benchmarks.table import markdown
from benchmarks.whole_runs import FILES, SERVICES, run_once
from pliant.results.write import write_results
from pliant_services.runtime.launcher import Fleet

_STOPPED = """
import os, signal, sys, threading
from pliant.bus.session import open_session
endpoint, session = sys.argv[1:]
def stop(_):
    os.kill(os.getpid(), signal.SIGSTOP)
with open_session([endpoint], None) as connection:
    held = [
        connection.declare_subscriber(f"pliant/{session}/view/**", stop),
        connection.liveliness().declare_token(f"pliant/{session}/viewer/{os.getpid()}"),
    ]
    threading.Event().wait()
"""
KINDS = ("none", "draws", "stopped")


@dataclass(frozen=True)
class Seen:
    """A run that was looked on at.  was_stopped: whether the viewer was when the run was over."""

    frames_per_s: float
    files: dict[str, bytes]
    was_stopped: bool


def run_with(kind: str, source: str) -> Seen:
    """One lossless run with a viewer of this kind: none, one that draws, or one that stops itself
    for good at the first message that it gets."""
    stopped: list[bool] = []
    with tempfile.TemporaryDirectory() as folder:
        output = Path(folder)
        rate = run_once(source, output, SERVICES, beside=_viewer(kind, output, stopped))
        write_results(output)
        files = {name: (output / name).read_bytes() for name in FILES}
    return Seen(rate, files, any(stopped))


def _viewer(
    kind: str, output: Path, stopped: list[bool]
) -> Callable[[Fleet], AbstractContextManager[None]]:
    @contextmanager
    def beside(fleet: Fleet) -> Generator[None]:
        if kind == "none":
            yield
            return
        where = ("--connect", fleet.endpoint, "--session", fleet.session)
        command = [sys.executable, "-m", "pliant_services.cli", "view", *where]
        command += ["--save", str(output / "seen.rrd"), "--patience", "120"]
        if kind == "stopped":
            command = [sys.executable, "-c", _STOPPED, fleet.endpoint, fleet.session]
        process = subprocess.Popen(command, stdin=subprocess.DEVNULL)
        try:
            while not fleet.wait_for_viewer(0.2):
                if process.poll() is not None:
                    raise RuntimeError("the viewer did not start")
            yield
            status = os.waitid(os.P_PID, process.pid, os.WSTOPPED | os.WNOHANG | os.WNOWAIT)
            stopped.append(status is not None and status.si_code == os.CLD_STOPPED)
        finally:
            process.kill()
            process.wait()

    return beside


def measure(source: str, runs: int) -> Iterator[str]:
    """Frames a second of the pipeline without a viewer and with either kind, in turns."""
    seen: dict[str, list[Seen]] = {kind: [] for kind in KINDS}
    for _ in range(runs):
        for kind in KINDS:
            seen[kind].append(run_with(kind, source))
    expected = seen["none"][0].files
    alone = median(run.frames_per_s for run in seen["none"])
    rows: list[tuple[str, ...]] = []
    for kind, found in seen.items():
        rate = median(run.frames_per_s for run in found)
        same = all(run.files == expected for run in found)
        rows.append((kind, f"{rate:.1f}", f"{rate / alone:.2f}", "yes" if same else "NO"))
    yield markdown(("viewer", "frames/s", "of that without", "the same bytes"), rows)

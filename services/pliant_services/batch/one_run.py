"""One clip of a batch: ``pliant run`` in its own process, which can be interrupted and resumed.

It runs where the batch is, or on another machine that sees the same folders (``on_cluster.py``).
"""

import json
import os
import platform
import select
import signal
import subprocess
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pliant import __version__
from pliant.errors import PliantError
from pliant.exit_codes import DONE, FAILED, INCOMPLETE
from pliant.files import create
from pliant.programs import PYTHON
from pliant.results.folder import REPORT_NAME, STATE_FOLDER, is_being_written, settle_killed
from pliant.results.verdict import grade

_LOOK_S = 0.2


@dataclass(frozen=True, kw_only=True)
class Errand:
    """A clip to run.  state: of the clip so far, as in ``batch.json``.

    folder: from which the paths are meant, those of the options, too.  version: of Pliant.
    """

    source: str
    result: str
    log: str
    state: str
    options: list[str]
    folder: str = field(default_factory=os.getcwd)
    version: str = __version__


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """The outcome.  exit_code: None if it was interrupted.  entry: of it in the table."""

    exit_code: int | None
    seconds: float = 0.0
    entry: dict[str, Any] = field(default_factory=dict[str, Any])


def run_clip(errand: Errand, stopped: Callable[[], bool]) -> Outcome:
    """Run it, or continue with it, until its end or until it is to stop."""
    here = Path(errand.folder)
    result, log = here / errand.result, here / errand.log
    if errand.version != __version__:
        return _failed(f"{platform.node()} has pliant {__version__}, the batch {errand.version}")
    if not log.parent.is_dir():
        return _failed(
            f"{platform.node()} has no folder {log.parent}: put clips and results in a folder "
            "with the same name on all machines"
        )
    # A waiting clip with a log was begun by a worker that could no longer report it.
    begun = errand.state == "begun" or (errand.state == "waiting" and log.exists())
    while begun and is_being_written(result):  # by a run that has outlived who began it
        if stopped():
            return Outcome(exit_code=None)
        time.sleep(_LOOK_S)
    with suppress(PliantError):  # the run itself will report it
        settle_killed(result)
    report = _report_of(result) if begun else None
    resumes = (result / STATE_FOLDER).is_dir()
    if report is not None and not resumes:
        return Outcome(exit_code=grade(report), entry=_entry_of(report))
    arguments = ["--output", errand.result]
    if "--on-crash" not in errand.options:
        arguments += ["--on-crash", "restart"]  # it can be taken up again
    if resumes:
        arguments += ["--resume"]
    elif begun or errand.state != "waiting":
        arguments += ["--force"]
    began = time.monotonic()
    run = OneRun([*arguments, *errand.options, "--", errand.source], log, here)
    code = run.wait(stopped)
    seconds = time.monotonic() - began
    if code in (DONE, INCOMPLETE):
        return Outcome(exit_code=code, seconds=seconds, entry=_entry_of(_report_of(result) or {}))
    if code is None:
        return Outcome(exit_code=None, seconds=seconds)
    return Outcome(
        exit_code=code, seconds=seconds, entry={"verdict": "failed", "reason": run.last_words()}
    )


def _failed(why: str) -> Outcome:
    return Outcome(exit_code=FAILED, entry={"verdict": "failed", "reason": why})


def _report_of(result: Path) -> dict[str, Any] | None:
    try:
        return json.loads((result / REPORT_NAME).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None


def _entry_of(report: dict[str, Any]) -> dict[str, Any]:
    """The row of the table for a run that has ended."""
    segments = report.get("segments") or []
    frames = report.get("frames", 0)
    longest = max((segment["frames"] for segment in segments), default=0)
    return {
        "frames": frames,
        "frames_with_pose": report.get("frames_with_pose", 0),
        "segments": len(segments),
        "longest_share": round(longest / max(frames, 1), 4),
        "verdict": report.get("verdict") or ("done" if segments else "bad"),
        "reason": report.get("verdict_reason") or report.get("last_reason", ""),
    }


class OneRun:
    """Its output goes to its log."""

    def __init__(self, arguments: list[str], log: Path, folder: Path) -> None:
        """arguments: of ``pliant run``.  Raises OSError if the log cannot be written."""
        command = [*PYTHON, "-m", "pliant_services.cli", "run", *arguments]
        with create(log) as file:
            self._process = subprocess.Popen(
                command,
                cwd=folder,
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
                start_new_session=True,  # Ctrl-C is the batch's to deal with
            )
        self._log = log

    def wait(self, stopped: Callable[[], bool]) -> int | None:
        """Its exit code; None if it was cut off, as it was to stop."""
        while True:
            try:
                return self._process.wait(_LOOK_S)
            except subprocess.TimeoutExpired:
                if stopped():
                    self._cut_off()
                    return None

    def last_words(self) -> str:
        """The last line of its output."""
        lines = self._log.read_text(encoding="utf-8", errors="replace").split("\n")
        return next((line for line in reversed(lines) if line.strip()), "").removeprefix("pliant: ")

    def _cut_off(self) -> None:
        """Kill it and its services, as a power cut does: ``--resume`` continues exactly there.

        Ctrl-C would end the stream instead: such a recording is complete and cannot be resumed.
        """
        services = self._children()
        self._process.kill()
        for handle in services:
            with suppress(ProcessLookupError):
                signal.pidfd_send_signal(handle, signal.SIGKILL)
        for handle in services:
            select.select([handle], [], [])  # no process writes there any more
            os.close(handle)
        self._process.wait()

    def _children(self) -> list[int]:
        number = self._process.pid
        try:
            listed = Path(f"/proc/{number}/task/{number}/children").read_text()
        except OSError:
            return []
        handles: list[int] = []
        for child in listed.split():
            with suppress(ProcessLookupError):
                handles.append(os.pidfd_open(int(child)))
        return handles

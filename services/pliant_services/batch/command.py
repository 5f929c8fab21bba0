"""Every clip of a folder, a few at a time; what was done is kept, what was begun goes on."""

import json
import sys
import threading
import time
from collections.abc import Generator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from pliant.datasets import sources_in
from pliant.errors import DatasetError, ResultError
from pliant.files import make_folder, write_whole
from pliant.results.folder import REPORT_NAME, STATE_FOLDER, folder_name, keep_apart, written
from pliant.results.verdict import DONE, INCOMPLETE, grade
from pliant_services.batch.one_run import OneRun

SUMMARY_NAME = "batch.json"
_FAILED = 1
_OWN = ("--output", "-o", "--force", "--resume", "--view", "--save", "--port")
"""Options of ``pliant run`` that are for one run, and the batch's to say."""


@dataclass
class Clip:
    """A row of the summary.

    state: waiting, begun, done, failed.   longest_share: of all frames, those with a pose in the
    longest segment.   seconds: of all times that it ran.
    """

    source: str
    result: str
    state: str = "waiting"
    exit_code: int | None = None
    verdict: str = ""
    reason: str = ""
    frames: int = 0
    frames_with_pose: int = 0
    segments: int = 0
    longest_share: float = 0.0
    seconds: float = 0.0

    @property
    def name(self) -> str:
        """What it is called in the table: its result folder."""
        return Path(self.result).name


@dataclass
class _Batch:
    output: Path
    options: list[str]
    clips: list[Clip]
    stopped: threading.Event = field(default_factory=threading.Event)
    lock: threading.Lock = field(default_factory=threading.Lock)
    running: dict[str, OneRun] = field(default_factory=dict[str, OneRun])

    def save(self) -> None:
        content = {"options": self.options, "clips": [asdict(clip) for clip in self.clips]}
        write_whole(self.output / SUMMARY_NAME, json.dumps(content, indent=1) + "\n")


def run_batch(folder: Path, output: Path, *, jobs: int, options: Sequence[str]) -> int:
    """Run all of them; returns the exit code.  Raises PliantError before anything is begun."""
    refused = [each for each in options if each.partition("=")[0] in _OWN]
    if refused:
        raise ResultError(f"{refused[0]} is for one run: leave it, each clip has its own folder")
    sources = sources_in(folder, but=output)
    keep_apart(output, [folder])
    begun = _read(output, list(options))
    known = {clip.source: clip for clip in begun or ()}
    clips = [known.get(str(s)) or Clip(str(s), str(output / n)) for s, n in _named(sources)]
    with written(output, force=begun is not None):
        make_folder(output / "logs")
        batch = _Batch(output, list(options), clips)
        batch.save()
        try:
            _run_all(batch, jobs)
        finally:
            _tell(clips, output)
    codes = {clip.exit_code for clip in clips}
    return _FAILED if codes - {DONE, INCOMPLETE} else max(DONE, *(c or 0 for c in codes))


def _named(sources: Sequence[Path]) -> list[tuple[Path, str]]:
    """Each with the name of its result folder: no two have the same."""
    names: list[str] = []
    for source in sources:
        name, number = folder_name(str(source)), 2
        while name in (*names, "logs", SUMMARY_NAME):
            name, number = f"{folder_name(str(source))}-{number}", number + 1
        names.append(name)
    return list(zip(sources, names, strict=True))


def _read(output: Path, options: list[str]) -> list[Clip] | None:
    """The rows of a batch that was begun there with the same options; None where none was."""
    path = output / SUMMARY_NAME
    if not path.exists():
        if output.exists() and (not output.is_dir() or any(output.iterdir())):
            raise ResultError(f"{output} exists, and holds no batch: choose another --output")
        return None
    try:
        content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        clips = [Clip(**row) for row in content["clips"]]
        before: list[str] = content["options"]
    except (OSError, ValueError, KeyError, TypeError):
        raise ResultError(f"{path}: is no summary of a batch: choose another --output") from None
    if before != options:
        said = " ".join(before) or "none"
        raise ResultError(
            f"{output}: was begun with other options of run ({said}): give those, or another "
            "--output"
        )
    return clips


def _run_all(batch: _Batch, jobs: int) -> None:
    """Ctrl-C cuts off those that run, and begins no more; raises KeyboardInterrupt then."""
    with ThreadPoolExecutor(jobs) as threads:
        futures = [threads.submit(_run_one, batch, clip) for clip in batch.clips]
        try:
            for future in as_completed(futures):
                future.result()  # what is no failure of a clip ends all
        except BaseException:
            with batch.lock:
                batch.stopped.set()
                running = list(batch.running.values())
            for each in running:
                each.cut_off()
            raise


def _run_one(batch: _Batch, clip: Clip) -> None:
    result = Path(clip.result)
    with _running(batch, clip) as run:
        if run is None:
            return
        began = time.monotonic()
        code = run.wait()
        spent = time.monotonic() - began
        words = run.last_words()
    with batch.lock:
        clip.seconds = round(clip.seconds + spent, 1)
        if batch.stopped.is_set() and code < 0:
            batch.save()
            return
        clip.exit_code = code
        clip.state = "done" if code in (DONE, INCOMPLETE) else "failed"
        if clip.state == "done":
            _take(clip, _report_of(result) or {})
        else:
            clip.verdict, clip.reason = "failed", words
        batch.save()
        _say(f"{clip.name}: {clip.verdict}: {clip.reason} ({clip.seconds:.0f} s)")


@contextmanager
def _running(batch: _Batch, clip: Clip) -> Generator[OneRun | None]:
    """Its run, begun or taken up again; None where nothing is left to do, or nothing is begun."""
    result = Path(clip.result)
    with batch.lock:
        report = _report_of(result) if clip.state == "begun" else None
        if report is not None and not (result / STATE_FOLDER).is_dir():
            clip.state, clip.exit_code = "done", grade(report)  # it outlived its batch
            _take(clip, report)
            batch.save()
        if clip.state == "done" or batch.stopped.is_set():
            run = None
        else:
            arguments = [clip.source, "--output", clip.result]
            if "--on-crash" not in batch.options:
                arguments += ["--on-crash", "restart"]  # it can be taken up again
            if (result / STATE_FOLDER).is_dir():
                arguments += ["--resume"]
            elif clip.state != "waiting":
                arguments += ["--force"]
            again = " again" if clip.state != "waiting" else ""
            clip.state, clip.exit_code = "begun", None
            batch.save()
            log = batch.output / "logs" / f"{clip.name}.log"
            run = batch.running[clip.name] = OneRun([*arguments, *batch.options], log)
            _say(f"{clip.name}: begun{again}")
    try:
        yield run
    finally:
        with batch.lock:
            batch.running.pop(clip.name, None)


def _report_of(result: Path) -> dict[str, Any] | None:
    try:
        return json.loads((result / REPORT_NAME).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None


def _take(clip: Clip, report: dict[str, Any]) -> None:
    """What the table says of a run that came to its end."""
    segments = report.get("segments") or []
    clip.frames = report.get("frames", 0)
    clip.frames_with_pose = report.get("frames_with_pose", 0)
    clip.segments = len(segments)
    longest = max((segment["frames"] for segment in segments), default=0)
    clip.longest_share = round(longest / max(clip.frames, 1), 4)
    clip.verdict = report.get("verdict") or ("done" if segments else "bad")
    clip.reason = report.get("verdict_reason") or report.get("last_reason", "")


def _tell(clips: Sequence[Clip], output: Path) -> None:
    """The table, one row a clip."""
    head = ("clip", "verdict", "frames", "posed", "longest", "seconds", "result")
    rows = [
        (
            clip.name,
            clip.verdict or clip.state,
            str(clip.frames or "-"),
            str(clip.frames_with_pose or "-"),
            f"{100.0 * clip.longest_share:.0f} %" if clip.frames else "-",
            f"{clip.seconds:.0f}",
            clip.result if clip.state != "failed" else str(output / "logs" / f"{clip.name}.log"),
        )
        for clip in clips
    ]
    widths = [max(len(row[i]) for row in (head, *rows)) for i in range(len(head))]
    for row in (head, *rows):
        print(
            "  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip()
        )
    done = sum(clip.state == "done" for clip in clips)
    print(f"{done} of {len(clips)} done; all of this is in {output / SUMMARY_NAME}")


def _say(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


def check_options(command: Any, options: Sequence[str]) -> None:
    """Raise the usage error of ``pliant run`` where it would not take the options.

    command: the click command of ``run``.
    """
    command.make_context("run", ["SOURCE", *options])


def check_folder(folder: Path) -> None:
    """Raises DatasetError."""
    if not folder.is_dir():
        raise DatasetError(f"{folder}: no such folder; name it before the options of run")

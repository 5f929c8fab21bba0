"""Runs every clip of a folder, a few at a time; finished ones are kept, interrupted ones resume."""

import json
import sys
import threading
from collections.abc import Callable, Generator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from pliant.datasets import sources_in
from pliant.errors import DatasetError, ResultError
from pliant.exit_codes import DONE, FAILED, INCOMPLETE
from pliant.files import make_folder, write_whole
from pliant.results.folder import folder_name, keep_apart, written
from pliant_services.batch.one_run import Errand, Outcome, run_clip

SUMMARY_NAME = "batch.json"
_OWN = ("--output", "-o", "--force", "--resume", "--view", "--save", "--port")
"""Options of ``pliant run`` that are for one run, and set by the batch."""


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
        """Its name in the table: its result folder."""
        return Path(self.result).name


@dataclass
class _Batch:
    output: Path
    options: list[str]
    clips: list[Clip]
    lock: threading.Lock = field(default_factory=threading.Lock)

    def errands(self) -> dict[str, Errand]:
        """The remaining clips, by name."""
        return {
            clip.name: Errand(
                source=clip.source,
                result=clip.result,
                log=str(self.log_of(clip)),
                state=clip.state,
                options=self.options,
            )
            for clip in self.clips
            if clip.state != "done"
        }

    def begin(self, name: str, where: str) -> None:
        """A clip is run now.  where: on which machine; "": on this one."""
        clip = self._called(name)
        with self.lock:
            again = " again" if clip.state != "waiting" else ""
            clip.state, clip.exit_code = "begun", None
            self.save()
            _say(f"{name}: started{again}{where and f' on {where}'}")

    def end(self, name: str, outcome: Outcome) -> None:
        """The outcome."""
        clip = self._called(name)
        with self.lock:
            clip.seconds = round(clip.seconds + outcome.seconds, 1)
            if outcome.exit_code is not None:
                clip.exit_code = outcome.exit_code
                clip.state = "done" if outcome.exit_code in (DONE, INCOMPLETE) else "failed"
                for key, value in outcome.entry.items():
                    setattr(clip, key, value)
                _say(f"{name}: {clip.verdict}: {clip.reason} ({clip.seconds:.0f} s)")
            self.save()

    def log_of(self, clip: Clip) -> Path:
        """The output of its run."""
        return self.output / "logs" / f"{clip.name}.log"

    def _called(self, name: str) -> Clip:
        return next(clip for clip in self.clips if clip.name == name)

    def save(self) -> None:
        content = {"options": self.options, "clips": [asdict(clip) for clip in self.clips]}
        write_whole(self.output / SUMMARY_NAME, json.dumps(content, indent=1) + "\n")


def run_batch(
    folder: Path, output: Path, *, jobs: int, options: Sequence[str], dask: str | None = None
) -> int:
    """Run all of them; returns the exit code.  Raises PliantError before anything is begun.

    jobs: at a time, on this machine.    dask: address of a scheduler whose workers run them, as
    many at a time as they have threads.
    """
    refused = [each for each in options if each.partition("=")[0] in _OWN]
    if refused:
        raise ResultError(
            f"{refused[0]} applies to a single run: leave it out; each clip has its own folder"
        )
    sources = sources_in(folder, but=output)
    keep_apart(output, [folder])
    begun = _read(output, list(options))
    known = {clip.source: clip for clip in begun or ()}
    clips = [known.get(str(s)) or Clip(str(s), str(output / n)) for s, n in _named(sources)]
    with written(output, force=begun is not None), _engine(dask, jobs) as run:
        make_folder(output / "logs")
        batch = _Batch(output, list(options), clips)
        batch.save()
        try:
            run(batch.errands(), batch.begin, batch.end)
        finally:
            _print_table(batch)
    codes = {clip.exit_code for clip in clips}
    return FAILED if codes - {DONE, INCOMPLETE} else max(DONE, *(c or 0 for c in codes))


@contextmanager
def _engine(dask: str | None, jobs: int) -> Generator[Callable[..., None]]:
    """Return the function that runs a clip: here, or on a cluster."""
    if dask is None:
        yield partial(_run_here, jobs=jobs)
        return
    from pliant_services.batch.on_cluster import Cluster  # others need no Dask

    with closing(Cluster(dask)) as cluster:
        yield cluster.run


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
    """The rows of a batch that was begun there with the same options; None if none was."""
    path = output / SUMMARY_NAME
    if not path.exists():
        if output.exists() and (not output.is_dir() or any(output.iterdir())):
            raise ResultError(f"{output} exists and is no batch folder: choose another --output")
        return None
    try:
        content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        clips = [Clip(**row) for row in content["clips"]]
        before: list[str] = content["options"]
    except (OSError, ValueError, KeyError, TypeError):
        raise ResultError(f"{path}: not a batch summary: choose another --output") from None
    if before != options:
        given = " ".join(before) or "none"
        raise ResultError(
            f"{output}: the batch was started with other options of run ({given}): pass those, or "
            "choose another --output"
        )
    return clips


def _run_here(
    errands: Mapping[str, Errand],
    begun: Callable[[str, str], None],
    over: Callable[[str, Outcome], None],
    *,
    jobs: int,
) -> None:
    """Run this many clips at a time.  Ctrl-C interrupts them and raises KeyboardInterrupt."""
    stopped = threading.Event()

    def run(name: str, errand: Errand) -> None:
        if not stopped.is_set():
            begun(name, "")
            over(name, run_clip(errand, stopped.is_set))

    with ThreadPoolExecutor(jobs) as threads:
        futures = [threads.submit(run, name, errand) for name, errand in errands.items()]
        try:
            for future in as_completed(futures):
                future.result()  # what is no failure of a clip ends all
        except BaseException:
            stopped.set()
            raise


def _print_table(batch: _Batch) -> None:
    """The table, one row a clip."""
    clips, output = batch.clips, batch.output
    head = ("clip", "verdict", "frames", "posed", "longest", "seconds", "result")
    rows = [
        (
            clip.name,
            clip.verdict or clip.state,
            str(clip.frames or "-"),
            str(clip.frames_with_pose or "-"),
            f"{100.0 * clip.longest_share:.0f} %" if clip.frames else "-",
            f"{clip.seconds:.0f}",
            clip.result if clip.state != "failed" else str(batch.log_of(clip)),
        )
        for clip in clips
    ]
    widths = [max(len(row[i]) for row in (head, *rows)) for i in range(len(head))]
    for row in (head, *rows):
        print(
            "  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip()
        )
    done = sum(clip.state == "done" for clip in clips)
    print(f"{done} of {len(clips)} done; summary: {output / SUMMARY_NAME}")


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
        raise DatasetError(f"{folder}: no such folder; put the folder before the options of run")

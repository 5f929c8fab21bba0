"""What a run costs: CPU and memory of every process, its stages, its start, bytes on the bus.

The processes are looked at from outside (``/proc``), so that the recorder counts as the others do
and another commit can be compared that knows nothing of this module.
"""

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median

import numpy as np

import pliant
from benchmarks.table import markdown
from pliant.algorithms.map_delta import TRACKING
from pliant.datasets import open_source
from pliant.datasets.rectifier import Rectifier, rectified
from pliant.datasets.source_spec import SourceSpec
from pliant.errors import PliantError
from pliant.exit_codes import DONE, INCOMPLETE
from pliant.messages import codec, topics
from pliant.messages.types import CameraStream, MapUpdate
from pliant.recording.reader import Recording
from pliant.results.folder import RECORDING_NAME
from pliant_services.processes import BY_NAME, readers_of

_LOOK_S = 0.05
_MEMORY_LOOKS = 20
"""Every so many looks memory is measured: the system adds up all pages for it."""
_TICK_S = 1.0 / os.sysconf("SC_CLK_TCK")
_ROOT = Path(pliant.__file__).parents[2]
_LAUNCHER = "launcher"
_FORK_SERVER = b"pliant_services.runtime.fork_server"
_COPIED = 64 << 20

_KINDS = {
    "rectify": "codec: JPEG to RGB, to grey",
    "curvature and maxima": "arithmetic, rows stay in the cache",
    "dominant flow": "arithmetic: BRIEF, matching",
    "local flow": "memory: pyramids, patches",
    "tracks": "arithmetic: steps that wait for each other, some 12 a track that coasts",
    "upkeep": "arithmetic: structure tensors of all maxima without a track",
    "maxima": "arithmetic, a second time: tracking has found them",
    "corrected view": "memory: table of the lens",
    "places": "arithmetic: features by OpenCV",
    "localisation": "arithmetic",
    "reacquisition": "memory: patches of landmarks",
    "subspace adjustment": "arithmetic",
    "triangulation": "arithmetic",
    "keyframe": "arithmetic",
    "start": "arithmetic",
    "whole map": "waits for its thread",
    "passed frames": "arithmetic",
    "smoothing": "arithmetic: sweeps of NLTGV",
    "rasterisation": "memory",
    "coarse fusion": "memory: blocks of the TSDF",
    "coarse meshing": "memory",
}
_MOVED = {
    "curvature and maxima": (9, 0),  # reads bytes, writes two images of floats
    "local flow": (6, 0),
    "tracks": (8, 768),
}
"""Bytes that a stage must move: for each pixel, and for each track."""

_AT_THE_END = 2
"""A stage that ran so often at most is one of the end."""


@dataclass
class Cost:
    """A process.  start_s, end_s: CPU before the first frame and after the last one.

    frame_ms: CPU of a frame in between.     peak_mib: memory.
    """

    start_s: float = 0.0
    frame_ms: float = 0.0
    end_s: float = 0.0
    peak_mib: float = 0.0


@dataclass
class Budget:
    """One run.  first_image_s, first_pose_s: after the command, when they were recorded.

    stages: of each service, milliseconds a frame.    bus_kb: sent over the bus a frame, to each
    reader.    moved_mb: what stages must move, see ``_MOVED``.
    """

    processes: dict[str, Cost] = field(default_factory=dict[str, Cost])
    stages: dict[str, dict[str, float]] = field(default_factory=dict[str, dict[str, float]])
    frames: int = 0
    frames_per_second: float = 0.0
    resident_mib: float = 0.0
    bus_kb: float = 0.0
    moved_mb: dict[str, float] = field(default_factory=dict[str, float])
    first_image_s: float = 0.0
    first_pose_s: float = 0.0

    @property
    def frame_ms(self) -> float:
        """CPU of a frame in all processes."""
        return sum(cost.frame_ms for cost in self.processes.values())


@dataclass(frozen=True)
class _Look:
    """All processes at a moment: CPU seconds, peak and present memory (MiB).

    now_mib: pages of several processes in equal parts; empty where it was not measured.
    """

    at_ns: int
    cpu_s: Mapping[str, float]
    peak_mib: Mapping[str, float]
    now_mib: Mapping[str, float]


def measure(
    source: str, runs: int, options: Sequence[str], against: str | None, *, short: bool
) -> Iterator[str]:
    """The table of a run, or the ratios to a commit by runs in turns."""
    if against is None:
        _run(_ROOT, source, (*options, "--end", "1"))  # compiles, renders
        budgets = [_run(_ROOT, source, options) for _ in range(runs)]
        yield from _short(budgets) if short else _tables(source, budgets)
        return
    with tempfile.TemporaryDirectory(prefix="pliant-budget-") as folder:
        other = Path(folder) / "other"
        _git("worktree", "add", "--detach", str(other), against)
        try:
            _copy_kernels(other)
            for root in (other, _ROOT):
                _run(root, source, (*options, "--end", "1"))
            pairs = [
                (_run(other, source, options), _run(_ROOT, source, options)) for _ in range(runs)
            ]
        finally:
            _git("worktree", "remove", "--force", str(other))
    yield from _ratios(against, pairs)


def _copy_kernels(other: Path) -> None:
    """Give another tree our compiled kernels: it compiles only those of other sources."""
    for file in (_ROOT / "shared").rglob("*.nb[ci]"):
        place = other / file.relative_to(_ROOT)
        if place.parents[1].is_dir():
            place.parent.mkdir(exist_ok=True)
            shutil.copy(file, place)


def _git(*arguments: str) -> None:
    done = subprocess.run(["git", "-C", str(_ROOT), *arguments], capture_output=True, text=True)
    if done.returncode != 0:
        raise PliantError(done.stderr.strip())


def _run(root: Path, source: str, options: Sequence[str]) -> Budget:
    """Run the code of a tree and look at its processes.  Raises PliantError if it fails."""
    with tempfile.TemporaryDirectory(prefix="pliant-budget-") as folder:
        output = Path(folder) / "run"
        command = (sys.executable, "-m", "pliant_services.cli", "run", source, *options)
        paths = f"{root / 'shared'}:{root / 'services'}"
        began_ns = time.time_ns()
        process = subprocess.Popen(
            (*command, "--output", str(output)),
            env={**os.environ, "PYTHONPATH": paths},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert process.stderr is not None
        said: list[str] = []
        reader = threading.Thread(target=said.extend, args=(process.stderr,))
        reader.start()
        looks: list[_Look] = []
        while process.poll() is None:
            looks.append(_look(process.pid, memory=len(looks) % _MEMORY_LOOKS == 0))
            time.sleep(_LOOK_S)
        reader.join()
        process.stderr.close()
        if process.returncode not in (DONE, INCOMPLETE):
            raise PliantError(f"{source} by {root}: {''.join(said[-5:]).strip()}")
        return _budget(output, looks, began_ns)


def _look(launcher: int, *, memory: bool) -> _Look:
    cpu: dict[str, float] = {}
    peak: dict[str, float] = {}
    now: dict[str, float] = {}
    for pid in (launcher, *_children(launcher)):
        with suppress(OSError, IndexError, KeyError, ValueError):  # it has ended
            place = Path(f"/proc/{pid}")
            words = (place / "cmdline").read_bytes().split(b"\0")
            name = _LAUNCHER
            if _FORK_SERVER in words:
                name = "fork server"
            elif pid != launcher:
                name = words[words.index(b"service") + 1].decode()
            fields = (place / "stat").read_text().rpartition(")")[2].split()
            peak_kb = re.findall(r"VmHWM:\s+(\d+) kB", (place / "status").read_text())[0]
            cpu[name] = (int(fields[11]) + int(fields[12])) * _TICK_S
            peak[name] = int(peak_kb) / 1024
            if memory:
                rollup = (place / "smaps_rollup").read_text()
                now[name] = int(re.findall(r"^Pss:\s+(\d+) kB", rollup, re.MULTILINE)[0]) / 1024
    return _Look(time.time_ns(), cpu, peak, now)


def _children(pid: int) -> Iterator[int]:
    with suppress(OSError):
        for task in Path(f"/proc/{pid}/task").iterdir():
            yield from map(int, (task / "children").read_text().split())


def _budget(output: Path, looks: Sequence[_Look], began_ns: int) -> Budget:
    recording = Recording(output / RECORDING_NAME)
    times: list[int] = []
    pose_ns = 0
    for recorded in recording.messages(topics.MAP_UPDATE):
        times.append(recorded.log_time_ns)
        if not pose_ns:
            update = recorded.decode()
            assert isinstance(update, MapUpdate)
            pose_ns = recorded.log_time_ns if update.state == TRACKING else 0
    image = next(recording.messages(topics.SOURCE))
    report = json.loads((output / "report.json").read_text())
    frames = len(times)
    budget = Budget(
        frames=frames,
        frames_per_second=report["frames_per_second"],
        resident_mib=max(sum(look.now_mib.values()) for look in looks),
        first_image_s=1e-9 * (image.log_time_ns - began_ns),
        first_pose_s=1e-9 * (pose_ns - began_ns),
    )
    first = min(looks, key=lambda look: abs(look.at_ns - times[0]))
    last = min(looks, key=lambda look: abs(look.at_ns - times[-1]))
    spent = max(1, frames - 1)
    for name in dict.fromkeys(name for look in looks for name in look.cpu_s):
        cpu = [look.cpu_s[name] for look in looks if name in look.cpu_s]
        before = [
            each.cpu_s[name] for each in looks if each.at_ns <= first.at_ns and name in each.cpu_s
        ]
        at_first = before[-1] if before else 0.0  # the fork server has left by then
        at_last = last.cpu_s.get(name, cpu[-1])
        budget.processes[name] = Cost(
            start_s=at_first,
            frame_ms=1e3 * (at_last - at_first) / spent,
            end_s=cpu[-1] - at_last,
            peak_mib=max(look.peak_mib.get(name, 0.0) for look in looks),
        )
    for service, stages in report["milliseconds_per_frame"].items():
        budget.stages[service] = {
            stage: figures["mean"] * figures["count"] / frames
            for stage, figures in stages.items()
            if figures["count"] > _AT_THE_END
        }
    stream = next(recording.decoded(topics.STREAM))
    assert isinstance(stream, CameraStream)
    pixels, tracks = stream.width * stream.height, report["median_tracks_per_frame"]
    budget.moved_mb = {
        stage: 1e-6 * (of_pixel * pixels + of_track * tracks)
        for stage, (of_pixel, of_track) in _MOVED.items()
    }
    budget.bus_kb = _sent_kb(output, list(budget.processes), frames) / frames
    return budget


def _sent_kb(output: Path, running: Sequence[str], frames: int) -> float:
    """All messages, once for each of their readers; images are made again."""
    fleet = [name for name in running if name in BY_NAME]
    readers = {
        topic.key: len(names) for name in fleet for topic, names in readers_of(name, fleet).items()
    }
    size = 0
    for recorded in Recording(output / RECORDING_NAME).messages():
        size += readers.get(recorded.topic.key, 1) * len(recorded.data)
    dataset = open_source(SourceSpec(location=str(output / RECORDING_NAME)))
    rectifier = Rectifier(dataset.calibration)
    frame = next(iter(dataset))
    image = len(codec.encode(rectified(frame, rectifier)))
    return 1e-3 * (size + frames * readers[topics.IMAGE.key] * image)


def _bandwidth_gbs() -> float:
    """Of a copy, read and written bytes together."""
    source = np.zeros(_COPIED, np.uint8)
    target = source.copy()
    best = np.inf
    for _ in range(5):
        start = time.perf_counter()
        np.copyto(target, source)
        best = min(best, time.perf_counter() - start)
    return 2e-9 * _COPIED / best


def _middle(budgets: Sequence[Budget]) -> Budget:
    """The run whose CPU of a frame is the median."""
    return sorted(budgets, key=lambda budget: budget.frame_ms)[len(budgets) // 2]


def _short(budgets: Sequence[Budget]) -> Iterator[str]:
    budget = _middle(budgets)
    spent = ", ".join(f"{name} {cost.frame_ms:.1f}" for name, cost in budget.processes.items())
    yield (
        f"{budget.frames} frames: {budget.frame_ms:.1f} ms of CPU each ({spent}); "
        f"{budget.resident_mib:.0f} MiB; first pose after {budget.first_pose_s:.1f} s"
    )


def _tables(source: str, budgets: Sequence[Budget]) -> Iterator[str]:
    budget = _middle(budgets)
    yield (
        f"{Path(source).name}: {budget.frames} frames, {budget.frames_per_second:.1f} frames/s, "
        f"{budget.frame_ms:.1f} ms of CPU a frame, {budget.resident_mib:.0f} MiB at once"
    )
    yield (
        f"first image recorded after {budget.first_image_s:.2f} s, "
        f"first pose after {budget.first_pose_s:.2f} s"
    )
    yield f"over the bus: {budget.bus_kb:.0f} kB a frame, to all readers together"
    rows = [
        [name, f"{c.frame_ms:.1f}", f"{c.start_s:.2f}", f"{c.end_s:.2f}", f"{c.peak_mib:.0f}"]
        for name, c in budget.processes.items()
    ]
    yield markdown(
        (
            *("process", "CPU a frame, ms", "before the first, s", "after the last, s"),
            "peak MiB",
        ),
        rows,
    )
    speed = _bandwidth_gbs()
    stages = [
        [
            f"{service}: {stage}",
            f"{spent:.2f}",
            f"{budget.moved_mb[stage] / speed:.2f}" if stage in budget.moved_mb else "",
            _KINDS.get(stage, ""),
        ]
        for service, named in budget.stages.items()
        for stage, spent in named.items()
    ]
    by_memory = f"ms if {speed:.0f} GB/s of memory were all"
    yield markdown(("stage", "ms a frame, by the clock", by_memory, "kind"), stages)


def _ratios(against: str, pairs: Sequence[tuple[Budget, Budget]]) -> Iterator[str]:
    """Medians over the pairs of what a run of ours takes as a share of the other's."""

    def ratio(of: Callable[[Budget], float]) -> str:
        found = [of(ours) / of(theirs) for theirs, ours in pairs if of(theirs) > 0.0]
        return f"{median(found):.2f} ({min(found):.2f} to {max(found):.2f})" if found else "-"

    def process(name: str) -> list[str]:
        def cost(budget: Budget) -> Cost:
            return budget.processes.get(name, Cost())

        return [
            name,
            ratio(lambda b: cost(b).frame_ms),
            ratio(lambda b: cost(b).start_s),
            ratio(lambda b: cost(b).end_s),
            ratio(lambda b: cost(b).peak_mib),
        ]

    names = dict.fromkeys(name for pair in pairs for budget in pair for name in budget.processes)
    rows = [process(name) for name in names]
    rows.append(
        [
            "**all**",
            ratio(lambda b: b.frame_ms),
            ratio(lambda b: sum(c.start_s for c in b.processes.values())),
            ratio(lambda b: sum(c.end_s for c in b.processes.values())),
            ratio(lambda b: b.resident_mib),
        ]
    )
    yield f"times {against}, median (and range) of {len(pairs)} pairs of runs in turns:"
    yield markdown(("process", "CPU a frame", "before the first", "after the last", "memory"), rows)
    yield f"first pose after: {ratio(lambda b: b.first_pose_s)}"

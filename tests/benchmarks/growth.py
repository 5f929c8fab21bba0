"""What a long, hard clip costs by its length: each stage, the end, places, keyframes, memory."""

import os
import resource
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from itertools import islice
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from benchmarks.stopwatch import Stopwatch
from benchmarks.table import markdown_header, markdown_row
from pliant.algorithms.geometry import matrix_to_pose, so3_exp
from pliant.config import load_config
from pliant.datasets import open_source
from pliant.datasets.base import SourceFrame
from pliant.datasets.source_spec import SourceSpec
from pliant.map_history import MapHistory
from pliant.offline import Pipeline
from pliant.rendering.scenes import SCENES

_HARD_FRAMES, _FPS = 300, 30.0
_SPEED = 2.0
"""Of the camera of the hard built-in clip, times that of the scene's own."""

_ROLL_RAD, _ROLL_HZ = 0.5, 0.5
_NOD_RAD, _NOD_HZ = 0.25, 0.8
"""By which that camera rolls and nods: 10 px a frame at the edge of the image."""

_STAGES = {
    "tracking": ("curvature and maxima", "dominant flow", "local flow", "upkeep", "tracks"),
    "localisation": ("corrected view", "localisation", "reacquisition", "start"),
    "window": ("subspace adjustment", "triangulation"),
    "keyframe": ("keyframe",),
    "places": ("places",),
    "whole map": ("whole map",),
    "skipped frames": ("passed frames",),
}
_END = ("merging", "final adjustment", "skipped frames")
_HEADER = (
    "frames", "keyframes", *(f"{name}, ms" for name in _STAGES), "places a keyframe, ms", "p95",
    *(f"end: {name}, s" for name in _END), "all, s", "points", "peak MiB",
)  # fmt: skip


@dataclass(frozen=True)
class Source:
    """A clip and what is known of its camera; "": the hard built-in one."""

    name: str
    calibration: Path | None


def measure(source: Source, frames: Sequence[int], overrides: Sequence[str]) -> Iterator[str]:
    """One row for each length, each in a process of its own; then by which power of the length each
    column grew from the last but one to the last.

    The frames are those of the source, forth and back, so that the camera never jumps.
    """
    yield markdown_header(_HEADER)
    rows = list[list[float]]()
    for count in frames:
        with ProcessPoolExecutor(1, get_context("spawn")) as alone:
            row = alone.submit(_row, source, count, list(overrides)).result()
        rows.append(row)
        yield markdown_row([_shown(value) for value in row])
    if len(rows) > 1:
        before, last = (np.maximum(row, 1e-9) for row in rows[-2:])
        powers = np.log(last / before) / np.log(last[0] / before[0])
        yield markdown_row(["power", *(f"{each:.2f}" for each in powers[1:])])


def _shown(value: float) -> str:
    return f"{value:.0f}" if value >= 100.0 or value == round(value) else f"{value:.3g}"


def _row(source: Source, count: int, overrides: list[str]) -> list[float]:
    config = load_config(None, overrides)
    spec = SourceSpec(location=source.name or hard_clip(), calibration=source.calibration)
    dataset = open_source(spec, config.ingest)
    watch, at_end = (Stopwatch(time.process_time) for _ in range(2))
    history = MapHistory()
    pipeline = Pipeline(dataset.calibration, config, history, watch)
    for _ in _frames(iter(dataset), min(2, count)):
        pass  # so that neither the decoder nor the kernels begin within the measurement
    known, ahead = set[int](), list[int]()
    start = time.process_time()
    for index, frame in enumerate(_frames(iter(dataset), count)):
        pipeline.take(frame)
        watch.lap()
        if set(history.keyframes) - known:
            ahead.append(index)
        known |= set(history.keyframes)
    pipeline.finish(at_end)
    at_end.lap()
    spent = time.process_time() - start
    places = [1e3 * watch.laps[index].get("places", 0.0) for index in ahead]
    return [
        count, len(known),
        *(sum(watch.mean_ms(each) for each in stages) for stages in _STAGES.values()),
        float(np.mean(places)) if places else 0.0,
        float(np.percentile(places, 95.0)) if places else 0.0,
        *(1e-3 * at_end.mean_ms(stage) for stage in _END),
        spent, len(history.points()), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0,
    ]  # fmt: skip


def _frames(source: Iterator[SourceFrame], count: int) -> Iterator[SourceFrame]:
    """So many frames, those of the source forth and back, each as long after the one before."""
    once = list(islice(source, count))
    step_ns = (once[-1].stamp_ns - once[0].stamp_ns) // max(1, len(once) - 1)
    for index in range(count):
        period = max(1, 2 * (len(once) - 1))
        at = index % period
        frame = once[at if at < len(once) else period - at]
        yield replace(frame, index=index, number=-1, stamp_ns=once[0].stamp_ns + index * step_ns)


def hard_clip() -> str:
    """A camera that is waved through the built-in room: fast, with rolls."""
    path, rows = SCENES["room"]().path, list[str]()
    for number in range(_HARD_FRAMES):
        now = number / _FPS
        along = _SPEED * now / path.duration_s
        T_world_camera = path.T_world_camera(path.duration_s * (1.0 - abs(along % 2.0 - 1.0)))
        turn = np.array([
            _NOD_RAD * np.sin(2.0 * np.pi * _NOD_HZ * now), 0.0,
            _ROLL_RAD * np.sin(2.0 * np.pi * _ROLL_HZ * now),
        ])  # fmt: skip
        T_world_camera[:3, :3] = T_world_camera[:3, :3] @ so3_exp(turn)
        pose = matrix_to_pose(T_world_camera)
        rows.append(" ".join([f"{now:.6f}", *(f"{value:.9f}" for value in pose)]))
    file = Path(tempfile.gettempdir()) / f"pliant-growth-{os.getuid()}.txt"
    file.write_text("\n".join(rows) + "\n")
    return f"built-in:room?path={file}&colour=0"

"""Parts of sequences, driven forwards, backwards, with fewer frames, and mirrored.

What is tuned to a few sequences shows on what they are not: a car that drives backwards sees all
that is near first, and every third frame makes steps three times as large.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.in_process import share_of, spread_of, true_poses
from benchmarks.table import markdown_header, markdown_row
from pliant.config import Config, load_config
from pliant.datasets import open_source
from pliant.datasets.base import SourceFrame
from pliant.datasets.calibration import Calibration
from pliant.datasets.rectifier import decode
from pliant.evaluation.run_evaluation import evaluate_trajectory
from pliant.map_history import MapHistory
from pliant.offline import Pipeline
from pliant.trajectory import Trajectory

_HEADER = ("sequence", "from frame", "how", "frames posed", "segments", "final", "online")


@dataclass(frozen=True)
class Way:
    """How a part is driven.   step: from frame to frame, -1: backwards."""

    name: str
    step: int = 1
    mirrored: bool = False


WAYS = (
    Way("forwards"),
    Way("backwards", step=-1),
    Way("one of 2", step=2),
    Way("one of 3", step=3),
    Way("mirrored", mirrored=True),
)


def measure(
    sources: Sequence[str], overrides: Sequence[str], frames: int, parts: int
) -> Iterator[str]:
    """A row for each part of each source and each way: errors as shares of the spread of the true
    positions, and their geometric means in the end.

    frames: of each part, as many as there are.   parts: of each source, evenly over it.
    """
    yield markdown_header(_HEADER)
    config = load_config(None, overrides)
    found: list[tuple[float, float]] = []
    for source in sources:
        dataset = open_source(source, config.ingest)
        truth = true_poses(dataset)
        given = list(dataset)
        last = max(0, len(given) - frames)
        for first in sorted({round(last * part / max(1, parts - 1)) for part in range(parts)}):
            for way in WAYS:
                part = given[first : first + frames * abs(way.step) : abs(way.step)]
                part = part if way.step > 0 else part[::-1]
                true = _driven(truth, part, way)
                posed, segments, errors = _drive(dataset.calibration, part, true, config, way)
                found += [errors] if np.isfinite(errors).all() else []
                yield markdown_row(
                    [
                        Path(source).name, str(first), way.name, f"{posed} of {len(part)}",
                        str(segments), *(f"{100.0 * each:.3f} %" for each in errors),
                    ]
                )  # fmt: skip
    if found:
        final, online = 100.0 * np.exp(np.log(found).mean(axis=0))
        yield f"geometric means of {len(found)}: final {final:.3f} %, online {online:.3f} %"


def _drive(
    calibration: Calibration, part: list[SourceFrame], true: Trajectory, config: Config, way: Way
) -> tuple[int, int, tuple[float, float]]:
    """Frames with a pose in the longest segment, segments, and both errors; inf without any."""
    history = MapHistory()
    pipeline = Pipeline(_mirror(calibration) if way.mirrored else calibration, config, history)
    for index, frame in enumerate(part):
        seen = _mirrored(frame) if way.mirrored else frame
        stamp_ns = _time(frame.stamp_ns, part, way)
        pipeline.take(replace(seen, index=index, number=-1, stamp_ns=stamp_ns))
    pipeline.finish()
    final, longest = history.final(), history.longest_segment()
    found = [history.trajectory_in(longest, each) for each in (final, history.online)]
    errors = [share_of(spread_of(true), evaluate_trajectory(each, true)) for each in found]
    segments = {segment for segment, _ in final.values()}
    return len(found[0]), len(segments), (errors[0], errors[1])


def _time(stamp_ns: int, part: list[SourceFrame], way: Way) -> int:
    """When a moment comes: as long after the first frame as it was after or before it."""
    passed = stamp_ns - part[0].stamp_ns
    return passed if way.step > 0 else -passed


def _driven(truth: Trajectory, part: list[SourceFrame], way: Way) -> Trajectory:
    """The true poses during a part, as it is driven; of those of a mirror the places alone."""
    stamps_ns = np.array([_time(stamp, part, way) for stamp in truth.stamps_ns.tolist()])
    during = (stamps_ns >= 0) & (stamps_ns <= _time(part[-1].stamp_ns, part, way))
    order = np.flatnonzero(during)[:: 1 if way.step > 0 else -1]
    poses = truth.T_world_camera[order].copy()
    if way.mirrored:
        poses[:, 0, 3] *= -1.0
    return Trajectory(stamps_ns=stamps_ns[order], T_world_camera=poses)


def _mirrored(frame: SourceFrame) -> SourceFrame:
    pixels = np.ascontiguousarray(decode(frame)[:, ::-1])
    encoding = "mono8" if pixels.ndim == 2 else "rgb8"
    height, width = pixels.shape[:2]
    return replace(
        frame, encoding=encoding, data=pixels.tobytes(), width=width, height=height, depth=b"",
        mask=b"", clip_frame=-1,
    )  # fmt: skip


def _mirror(given: Calibration) -> Calibration:
    """The camera of images whose left is right."""
    k = list(given.distortion)
    if len(k) >= 4 and given.model != "fisheye":
        k[3] = -k[3]
    return replace(given, cx=given.width - 1 - given.cx, distortion=tuple(k), depth=None)

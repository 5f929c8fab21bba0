"""Poses with a gyro and without: of all frames, and dark for half a second in the fastest turn."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np
from inertial_motion import Motion, samples_of

from benchmarks.inertial import SENSORS, source_of
from benchmarks.rough import Case, RoughFrames, dark
from benchmarks.table import markdown_header, markdown_row
from pliant.algorithms.geometry import align_umeyama, so3_exp, so3_log
from pliant.algorithms.inertial.samples import ImuSamples
from pliant.config import load_config
from pliant.datasets.base import Dataset
from pliant.evaluation.presentation import metres
from pliant.formats.trajectory_files import read_trajectory
from pliant.map_history import MapHistory
from pliant.offline import Pipeline
from pliant.trajectory import Trajectory, associate

_DARK_S = 0.5
_BEFORE_S = 6.0
"""By then the gyro is aligned."""
_AFTER_S = 0.7
_MOST_OFFSET_S = 1.0


@dataclass(frozen=True, kw_only=True)
class DarkRun:
    """posed: of all frames, in the longest segment.   ate_m: of these.   worst_m: of the dark
    ones; inf where one has no pose."""

    posed: float
    segments: int
    ate_m: float
    worst_m: float


def fastest_turn(truth: Trajectory, frames: int) -> tuple[range, float]:
    """Numbers of the frames of ``_DARK_S`` in which the camera turns the most, and its turn."""
    times = 1e-9 * (truth.stamps_ns[:frames] - truth.stamps_ns[0])
    last = np.searchsorted(times, times + _DARK_S)
    allowed = np.flatnonzero((times > _BEFORE_S) & (times + _DARK_S + _AFTER_S < times[-1]))
    R = truth.T_world_camera[:, :3, :3]
    turns = np.linalg.norm(so3_log(R[allowed].swapaxes(1, 2) @ R[last[allowed]]), axis=1)
    begin = int(allowed[np.argmax(turns)])
    return range(begin, int(last[begin])), float(np.degrees(turns.max()))


def samples(truth: Trajectory, sensor: str, seed: int) -> ImuSamples:
    """Of a motion, by a sensor that is mounted and whose clock is off by chance."""
    rng = np.random.default_rng(100 + seed)
    return samples_of(
        Motion(truth.stamps_ns, truth.T_world_camera), SENSORS[sensor], rng,
        R_camera_imu=so3_exp(2.0 * rng.normal(size=3)), p_camera_imu=0.04 * rng.normal(size=3),
        offset_s=rng.uniform(-_MOST_OFFSET_S, _MOST_OFFSET_S),
    )  # fmt: skip


def run(dataset: Dataset, covered: range, seed: int, given: ImuSamples | None) -> DarkRun:
    """Map a source whose ``covered`` frames are dark."""
    truth = read_trajectory(Path(str(dataset.ground_truth_path)))
    case = Case(source="", spoil=lambda n, pixels: dark(n, pixels) if n in covered else pixels)
    history = MapHistory()
    config = load_config(None, [f"seed={seed}"])
    frames = RoughFrames(dataset, case)
    pipeline = Pipeline(dataset.calibration, config, history)
    if given is not None:
        pipeline.add_samples(given)
    count = 0
    for source in cast(Dataset, frames):
        pipeline.take(source)
        count += 1
    pipeline.finish()
    final, longest = history.placed(), history.longest_segment()
    found = history.trajectory_in(longest, final)
    rows, true_rows = associate(found.stamps_ns, truth.stamps_ns)
    scale, R, t = align_umeyama(found.positions[rows], truth.positions[true_rows], with_scale=True)
    off = scale * found.positions[rows] @ R.T + t - truth.positions[true_rows]
    errors = dict(zip(true_rows.tolist(), np.linalg.norm(off, axis=1).tolist(), strict=True))
    return DarkRun(
        posed=len(found) / count,
        segments=len({segment for segment, _ in final.values()}),
        ate_m=float(np.sqrt(np.mean(np.square(list(errors.values()))))),
        worst_m=max((errors.get(frame, np.inf) for frame in covered), default=0.0),
    )


def compare(motions: Path | None, names: Sequence[str], frames: int, seeds: int) -> Iterator[str]:
    """A row for each source: errors of all seeds without a gyro, and with that of a phone."""
    yield markdown_header(("motion", "without", "with", "change", "spread of seeds without"))
    changes: list[float] = []
    for name in names:
        dataset = source_of(name, motions, frames)
        truth = read_trajectory(Path(str(dataset.ground_truth_path)))
        errors = np.zeros((2, seeds))
        for seed in range(seeds):
            for row, given in enumerate((None, samples(truth, "phone", seed))):
                errors[row, seed] = run(dataset, range(0), seed, given).ate_m
        without, with_gyro = errors.mean(axis=1).tolist()
        changes.append(with_gyro / without)
        spread = (errors[0].max() - errors[0].min()) / without
        told = f"{changes[-1] - 1.0:+.1%}", f"{spread:.1%}"
        yield markdown_row([name, metres(without), metres(with_gyro), *told])
    yield f"geometric mean of the changes {np.exp(np.mean(np.log(changes))) - 1.0:+.1%}"


def measure(motions: Path | None, names: Sequence[str], frames: int, seeds: int) -> Iterator[str]:
    """A row for each source, sensor and seed, where half a second is dark."""
    header = ("motion", "turn", "sensor", "seed", "posed", "segments", "ATE", "dark frames, worst")
    yield markdown_header(header)
    for name in names:
        dataset = source_of(name, motions, frames)
        truth = read_trajectory(Path(str(dataset.ground_truth_path)))
        covered, turn = fastest_turn(truth, dataset.frame_count or len(truth))
        for seed in range(seeds):
            for sensor in ("none", *SENSORS):
                given = None if sensor == "none" else samples(truth, sensor, seed)
                found = run(dataset, covered, seed, given)
                worst = metres(found.worst_m) if np.isfinite(found.worst_m) else "no pose"
                yield markdown_row(
                    [
                        *(name, f"{turn:.0f} degrees", sensor, str(seed), f"{found.posed:.1%}"),
                        *(str(found.segments), metres(found.ate_m), worst),
                    ]
                )

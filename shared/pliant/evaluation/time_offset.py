"""How far the times of a trajectory and of its ground truth lie apart.

Where the clocks of camera and ground truth differ, each pose is compared with a true one of another
moment.  So positions are compared over a range of offsets, ground truth interpolated in between.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pliant.algorithms.arrays import F64, I64, BoolArray
from pliant.algorithms.geometry import align_umeyama
from pliant.errors import ResultError
from pliant.trajectory import Trajectory
from pliant.wording import shown

_RANGE_S, _RANGE_SHARE = 2.0, 0.1
"""Offsets that are tried: up to this many seconds, or this share of the duration."""
_MOST_STEPS = 400
_FAR_BETTER = 0.7
_LEAST_FRAMES = 0.5
_LEAST_POSES = 10
_FITS = 0.1
"""Error, as a share of the spread of true positions, that is a fit where no time is in both."""
_GAP = 3.0
"""No interpolation between true poses more than this many median intervals apart."""
_OFFSET = re.compile(r"([-+]?[0-9]*\.?[0-9]+(?:[eE][-+]?[0-9]+)?)\s*(s|f|frames?)?")


@dataclass(frozen=True, kw_only=True)
class TimeOffset:
    """An offset that fits better: true pose at the pose's time + offset.

    frames: the offset in frames of the trajectory.   rmse_m, before_m: ATE with it and without, of
    the same poses.
    """

    seconds: float
    frames: float
    rmse_m: float
    before_m: float


def offset_ns(text: str, trajectory: Trajectory) -> int:
    """``0.1``, ``0.1s`` or ``3f`` (frames of the trajectory) in ns.  Raises ResultError."""
    found = _OFFSET.fullmatch(text.strip())
    if found is None:
        raise ResultError(f"--offset {shown(text)}: expected seconds (0.1) or frames (3f)")
    number = float(found[1])
    unit_ns = _frame_ns(trajectory.stamps_ns) if (found[2] or "s")[0] == "f" else 1e9
    if not abs(number * unit_ns) < 2.0**62:
        raise ResultError(f"--offset {shown(text)}: is too large")
    return round(number * unit_ns)


def shifted(trajectory: Trajectory, by_ns: int) -> Trajectory:
    """The same poses at other times."""
    return Trajectory(
        stamps_ns=trajectory.stamps_ns + by_ns, T_world_camera=trajectory.T_world_camera
    )


def better_offset(estimate: Trajectory, truth: Trajectory) -> TimeOffset | None:
    """The offset at which ground truth fits far better; None without one, or if undecidable."""
    if min(len(estimate), len(truth)) < _LEAST_POSES:
        return None
    apart_ns = _apart_ns(estimate, truth)
    if apart_ns:
        return _by_their_beginnings(estimate, truth, apart_ns)
    frame_s = 1e-9 * _frame_ns(estimate.stamps_ns)
    origin = int(truth.stamps_ns[0])
    times, true_times = _seconds(estimate.stamps_ns - origin), _seconds(truth.stamps_ns - origin)
    limit = min(_RANGE_S, _RANGE_SHARE * float(times[-1] - times[0]))
    before, best, after = _search(
        times, estimate.positions, true_times, truth.positions, frame_s, limit
    )
    if not after < _FAR_BETTER * before or abs(best) < _LEAST_FRAMES * frame_s:
        return None
    return TimeOffset(seconds=best, frames=best / frame_s, rmse_m=after, before_m=before)


def _apart_ns(estimate: Trajectory, truth: Trajectory) -> int:
    """From the first pose to the first true one, where no time is in both; else 0."""
    begin, true_begin = int(estimate.stamps_ns[0]), int(truth.stamps_ns[0])
    no_time = estimate.stamps_ns[-1] < true_begin or truth.stamps_ns[-1] < begin
    return true_begin - begin if no_time else 0


def _by_their_beginnings(estimate: Trajectory, truth: Trajectory, by_ns: int) -> TimeOffset | None:
    """The offset with which both begin at about the same time, where that fits."""
    frame_ns = _frame_ns(estimate.stamps_ns)
    positions = _at(
        _seconds(estimate.stamps_ns + by_ns - int(truth.stamps_ns[0])),
        _seconds(truth.stamps_ns - truth.stamps_ns[0]),
        truth.positions,
    )
    rmse, spread = _rmse(estimate.positions, positions), np.linalg.norm(positions.std(axis=0))
    if not rmse < _FITS * spread:
        return None
    return TimeOffset(
        seconds=1e-9 * by_ns, frames=by_ns / frame_ns, rmse_m=rmse, before_m=float("inf")
    )


def _search(
    times: F64, positions: F64, true_times: F64, true_positions: F64, frame_s: float, limit: float
) -> tuple[float, float, float]:
    """The error without an offset, the best offset, and the error with it; all 0
    where there are too few poses."""
    unknown = 0.0, 0.0, 0.0
    step = max(0.5 * frame_s, 2.0 * limit / _MOST_STEPS)
    if limit < step:
        return unknown
    there = _covered(times, true_times, limit)
    if np.count_nonzero(there) < max(_LEAST_POSES, 0.5 * len(times)):
        return unknown
    positions, times = positions[there], times[there]

    def rmse(offset: float) -> float:
        return _rmse(positions, _at(times + offset, true_times, true_positions))

    before = rmse(0.0)
    offsets = step * np.arange(-int(limit / step), int(limit / step) + 1)
    best = float(min(offsets, key=lambda each: (rmse(each), abs(each))))
    best = _refined(rmse, best, step)
    return before, best, rmse(best)


def _refined(rmse: Callable[[float], float], best: float, step: float) -> float:
    """The minimum of the parabola through three errors about the best."""
    left, middle, right = rmse(best - step), rmse(best), rmse(best + step)
    bend = left - 2.0 * middle + right
    moved = best + 0.5 * step * (left - right) / bend if bend > 0.0 else best
    return moved if abs(moved - best) <= step and rmse(moved) < middle else best


def _covered(times: F64, true_times: F64, limit: float) -> BoolArray:
    """Which poses have a true position at every offset."""
    gaps = np.diff(true_times) > _GAP * np.median(np.diff(true_times))
    begins, ends = true_times[:-1][gaps], true_times[1:][gaps]
    there = (times - limit >= true_times[0]) & (times + limit <= true_times[-1])
    for begin, end in zip(begins, ends, strict=True):
        there &= (times + limit <= begin) | (times - limit >= end)
    return there


def _at(times: F64, true_times: F64, positions: F64) -> F64:
    return np.stack([np.interp(times, true_times, axis) for axis in positions.T], axis=1)


def _rmse(positions: F64, truth: F64) -> float:
    if min(np.ptp(positions, axis=0).max(), np.ptp(truth, axis=0).max()) <= 0.0:
        return float("inf")  # a static one fits nothing
    scale, R, t = align_umeyama(positions, truth, with_scale=True)
    errors = scale * positions @ R.T + t - truth
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=1))))


def _seconds(times_ns: I64) -> F64:
    return np.asarray(1e-9 * times_ns, np.float64)


def _frame_ns(stamps_ns: I64) -> float:
    return float(np.median(np.diff(stamps_ns))) if len(stamps_ns) > 1 else 1e9

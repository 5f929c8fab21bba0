"""Frames without a pose between two frames with one get theirs by the gyro.

An image that is dark, blurred or covered for a moment has no pose.  The gyro measures how the
camera turned meanwhile, from both sides.  It hardly accelerates in so short a time: its position is
that of the cubic with the positions and velocities of both sides.
"""

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np

from pliant.algorithms.arrays import F64, I64
from pliant.algorithms.geometry import so3_exp, so3_log
from pliant.algorithms.inertial.gyro import Gyro, GyroTurn
from pliant.algorithms.map_delta import BY_GYRO
from pliant.algorithms.slam.adjust.ordinary_frames import EarlierPose

_LONGEST_S = 1.0
"""Of a gap: in longer ones a camera that is carried changes its velocity."""

_BESIDE = 0.5
"""Of the gap: frames so near tell the velocities at its ends, by parabolas."""

_LEAST_BESIDE, _NEAR_S = 3, 0.25
"""This number of frames beside a short gap counts, too, within this number of seconds."""

_POSE_RAD = 2e-3
"""Standard deviation of the poses beside a gap."""

_CONTRADICTION = 4.0
"""Standard deviations between the gyro and the poses on both sides of a gap that it cannot fill."""


def carried_poses(
    placed: Sequence[EarlierPose], stamps_ns: Mapping[int, int], lost: Sequence[int], gyro: Gyro
) -> list[EarlierPose]:
    """Return poses of lost frames, which no image supports.

    placed: all frames of a segment with a pose, ascending.   stamps_ns: of all frames.
    lost: numbers of the frames without one, ascending.
    """
    carried: list[EarlierPose] = []
    times_ns = np.array([stamps_ns[each.frame] for each in placed], np.int64)
    numbers = np.array(lost, np.int64)
    for before, after in pairwise(range(len(placed))):
        a, b = placed[before], placed[after]
        between = numbers[(numbers > a.frame) & (numbers < b.frame)].tolist()
        gap_ns = int(times_ns[after] - times_ns[before])
        if not between or gap_ns > _LONGEST_S * 1e9:
            continue
        whole = gyro.turn(int(times_ns[before]), int(times_ns[after]))
        v_a = _velocity(placed, times_ns, before, -1, gap_ns)
        v_b = _velocity(placed, times_ns, after, 1, gap_ns)
        off = None if whole is None else _difference(whole, a.T_world_camera, b.T_world_camera)
        if whole is None or off is None or v_a is None or v_b is None:
            continue
        for frame in between:
            here = gyro.turn(int(times_ns[before]), stamps_ns[frame])
            if here is None:
                continue
            share = (stamps_ns[frame] - int(times_ns[before])) / gap_ns
            T = np.eye(4)
            rest = here.R.T @ whole.R @ off
            T[:3, :3] = a.T_world_camera[:3, :3] @ here.R @ so3_exp(share * rest)
            ends = a.T_world_camera[:3, 3], b.T_world_camera[:3, 3]
            T[:3, 3] = _cubic(share, *ends, 1e-9 * gap_ns * v_a, 1e-9 * gap_ns * v_b)
            carried.append(
                EarlierPose(frame=frame, keyframe=a.keyframe, T_world_camera=T, inliers=BY_GYRO)
            )
    gyro.carried += len(carried)
    return carried


def _difference(turn: GyroTurn, before: F64, after: F64) -> F64 | None:
    """(3,) from the gyro's turn between two poses (4, 4) to theirs; None if they disagree."""
    off = so3_log(turn.R.T @ before[:3, :3].T @ after[:3, :3])
    covariance = turn.covariance + _POSE_RAD**2 * np.eye(3)
    agrees = off @ np.linalg.solve(covariance, off) < _CONTRADICTION**2
    return off if agrees else None


def _velocity(
    placed: Sequence[EarlierPose], times_ns: I64, row: int, side: int, gap_ns: int
) -> F64 | None:
    """(3,) a second at a frame beside a gap, from those on its side; None of too few."""
    rows = [row]
    while 0 <= rows[-1] + side < len(placed):
        beyond = rows[-1] + side
        limit_ns = _BESIDE * gap_ns if len(rows) >= _LEAST_BESIDE else 1e9 * _NEAR_S
        if abs(int(times_ns[beyond] - times_ns[row])) > limit_ns:
            break
        rows.append(beyond)
    if len(rows) < _LEAST_BESIDE:
        return None
    times_s = 1e-9 * (times_ns[rows] - times_ns[row])
    positions = np.array([placed[each].T_world_camera[:3, 3] for each in rows])
    return np.asarray(np.polynomial.polynomial.polyfit(times_s, positions, 2)[1], np.float64)


def _cubic(share: float, start: F64, end: F64, v_start: F64, v_end: F64) -> F64:
    """Hermite's, between 0 and 1."""
    s2, s3 = share**2, share**3
    h = 2.0 * s3 - 3.0 * s2
    return (1.0 + h) * start - h * end + (s3 - 2.0 * s2 + share) * v_start + (s3 - s2) * v_end

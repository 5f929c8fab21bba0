"""Initial positions of surfels from other motion estimates (not in the paper)."""

import numpy as np

from pliant.algorithms.arrays import F32, F64, I64, U8
from pliant.algorithms.surfels.patch_sampling import X
from pliant.algorithms.surfels.surfel_alignment import Matcher, evaluate_all
from pliant.algorithms.tracks import FrameTracks
from pliant.compiler.kernel import fast_kernel

_NEAREST = 9
_FEWEST = 3
_RADIUS_PX = 30.0
"""Radius around a patch and its margin; farther tracks may move differently."""


def start_at(poses: F64, active: U8, targets_px: F64, matcher: Matcher) -> None:
    """Move each surfel to where it was predicted, at its depth, if it fits better there.

    targets_px: (N, 2) pixels of this level, NaN where there is no prediction.  Both starts are
    rated by Eq. 5 at this level, the coarsest.
    """
    level = matcher.level
    led = active * np.isfinite(targets_px).all(axis=1)
    moved, z = poses.copy(), poses[:, X + 2]
    moved[:, X] = (targets_px[:, 0] - level.cx) / level.fx * z
    moved[:, X + 1] = (targets_px[:, 1] - level.cy) / level.fy * z
    here = evaluate_all(poses, led, matcher).costs
    there = evaluate_all(moved, led, matcher).costs
    # A negative cost is that of a patch behind the camera.
    better = (there >= 0.0) & ((here < 0.0) | (there < here))
    poses[better] = moved[better]


def targets(points_px: F64, displacements_px: F64, scale: float) -> F64:
    """(N, 2) predicted pixels of the level that is ``scale`` times smaller than the image."""
    return np.ascontiguousarray((points_px + displacements_px + 0.5) / scale - 0.5, np.float64)


def predict(points_px: F32, before: FrameTracks, now: FrameTracks) -> F64:
    """(N, 2) predicted displacements in pixels from the last frame to this one.

    points_px: (N, 2) surfels in the last frame.    before, now: tracks of the two frames. A surfel
    follows the median of the nearest surviving tracks; if fewer than three are near, the dominant
    flow (VITAMIN-E, Eq. 4).
    """
    _, old, new = np.intersect1d(before.ids, now.ids, assume_unique=True, return_indices=True)
    order = np.argsort(before.points_px[old, 1], kind="stable")
    start, end = before.points_px[old[order]], now.points_px[new[order]]
    flow = np.ascontiguousarray(now.dominant_flow)
    found = points_px @ flow[:, :2].T + flow[:, 2] - points_px
    first = np.searchsorted(start[:, 1], points_px[:, 1] - np.float32(_RADIUS_PX))
    _follow_nearest(points_px, start, end - start, first, found)
    return found


@fast_kernel
def _follow_nearest(points_px: F32, start_px: F32, moves_px: F32, first: I64, found: F64) -> None:
    """Replace a displacement by the median of the nearest moves, if enough are near.

    start_px: (M, 2) in ascending order of v.    moves_px: (M, 2).    first: (N,) where in
    ``start_px`` to begin.  found: (N, 2), in and out.
    """
    distances = np.empty(_NEAREST)
    nearest = np.empty(_NEAREST, np.int64)
    for s in range(len(points_px)):
        u, v = points_px[s, 0], points_px[s, 1]
        count = 0
        for i in range(first[s], len(start_px)):
            if start_px[i, 1] > v + _RADIUS_PX:
                break
            distance = (start_px[i, 0] - u) ** 2 + (start_px[i, 1] - v) ** 2
            if distance > _RADIUS_PX**2 or (count == _NEAREST and distance >= distances[count - 1]):
                continue
            count = min(count + 1, _NEAREST)
            place = count - 1
            while place > 0 and distances[place - 1] > distance:
                distances[place], nearest[place] = distances[place - 1], nearest[place - 1]
                place -= 1
            distances[place], nearest[place] = distance, i
        if count >= _FEWEST:
            for k in range(2):
                found[s, k] = _median(moves_px[:, k], nearest[:count], distances)


@fast_kernel
def _median(values: F32, rows: I64, ordered: F64) -> float:
    """Of the values of some rows.  ordered: scratch."""
    for n in range(len(rows)):
        value, place = np.float64(values[rows[n]]), n
        while place > 0 and ordered[place - 1] > value:
            ordered[place] = ordered[place - 1]
            place -= 1
        ordered[place] = value
    half = len(rows) // 2
    return 0.5 * (ordered[half] + ordered[len(rows) - 1 - half])

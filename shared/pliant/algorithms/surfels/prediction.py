"""Starting surfels where something else saw them go (not in the paper)."""

import math

import numpy as np

from pliant.algorithms.arrays import F32, F64, U8
from pliant.algorithms.kernel import fast_kernel
from pliant.algorithms.surfels.align import Limits, Templates, Workspace, evaluate
from pliant.algorithms.surfels.sampling import Level, X
from pliant.algorithms.tracks import FrameTracks

_NEAREST = 9
_FEWEST = 3
_RADIUS_PX = 30.0
"""About a patch and its margin: what is farther away may move otherwise."""


@fast_kernel
def start_at(
    poses: F64, active: U8, targets_px: F64, level: Level, templates: Templates, limits: Limits,
    work: Workspace,
) -> int:  # fmt: skip
    """Move each surfel to where it was predicted, at its depth, if it fits better there.

    targets_px: (N, 2) pixels of this level, NaN where there is no prediction.  Both starts are
    rated by Eq. 5 at this level, the coarsest.  Returns how many surfels were moved.
    """
    moved = 0
    start = np.empty(3)
    for s in range(len(poses)):
        u, v = targets_px[s, 0], targets_px[s, 1]
        if not active[s] or not templates.usable[s]:
            continue
        if not (math.isfinite(u) and math.isfinite(v)):
            continue
        pose, images, mean = poses[s], templates.images[s], templates.means[s]
        cost, _ = evaluate(pose, level, images, mean, limits, work, work.sums)
        start[:] = pose[X : X + 3]
        z = pose[X + 2]
        pose[X] = (u - level.cx) / level.fx * z
        pose[X + 1] = (v - level.cy) / level.fy * z
        other, _ = evaluate(pose, level, images, mean, limits, work, work.sums)
        # A negative cost is that of a patch behind the camera.
        if other >= 0.0 and (cost < 0.0 or other < cost):
            moved += 1
        else:
            pose[X : X + 3] = start
    return moved


def targets(points_px: F64, displacements_px: F64, scale: float) -> F64:
    """(N, 2) predicted pixels of the level that is ``scale`` times smaller than the image."""
    return np.ascontiguousarray((points_px + displacements_px + 0.5) / scale - 0.5, np.float64)


def predict(points_px: F32, before: FrameTracks, now: FrameTracks) -> F64:
    """(N, 2) displacements in pixels from the last frame to this one.

    points_px: (N, 2) surfels in the last frame.    before, now: tracks of the two frames.
    A surfel goes with the median of the nearest tracks that live on, and where fewer than three are
    near, with the dominant flow (VITAMIN-E, Eq. 4).
    """
    _, old, new = np.intersect1d(before.ids, now.ids, assume_unique=True, return_indices=True)
    order = np.argsort(before.points_px[old, 1], kind="stable")
    start, end = before.points_px[old[order]], now.points_px[new[order]]
    flow = np.ascontiguousarray(now.dominant_flow)
    found = points_px @ flow[:, :2].T + flow[:, 2] - points_px
    follow_nearest(points_px, start, end - start, found)
    return found


@fast_kernel
def follow_nearest(points_px: F32, start_px: F32, moves_px: F32, found: F64) -> None:
    """Replace a displacement by the median of the nearest moves where enough are near.

    start_px: (M, 2) in ascending order of v.    moves_px: (M, 2).    found: (N, 2), in and out.
    """
    distances = np.empty(_NEAREST)
    nearest = np.empty(_NEAREST, np.int64)
    for s in range(len(points_px)):
        u, v = points_px[s, 0], points_px[s, 1]
        count = 0
        first = np.searchsorted(start_px[:, 1], np.float32(v - _RADIUS_PX))
        for i in range(first, len(start_px)):
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
            found[s, 0] = np.median(moves_px[nearest[:count], 0])
            found[s, 1] = np.median(moves_px[nearest[:count], 1])

"""Starting surfels where something else saw them go (not in the paper)."""

import math

import numpy as np

from pliant.algorithms.arrays import F64, U8
from pliant.algorithms.kernel import fast_kernel
from pliant.algorithms.surfels.align import Limits, Templates, Workspace, evaluate
from pliant.algorithms.surfels.sampling import Level, X


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
        cost, _ = evaluate(pose, level, images, mean, limits, work, work.sums, work.matrix)
        start[:] = pose[X : X + 3]
        z = pose[X + 2]
        pose[X] = (u - level.cx) / level.fx * z
        pose[X + 1] = (v - level.cy) / level.fy * z
        other, _ = evaluate(pose, level, images, mean, limits, work, work.sums, work.matrix)
        # A negative cost is that of a patch behind the camera.
        if other >= 0.0 and (cost < 0.0 or other < cost):
            moved += 1
        else:
            pose[X : X + 3] = start
    return moved


def targets(points_px: F64, displacements_px: F64, scale: float) -> F64:
    """(N, 2) predicted pixels of the level that is ``scale`` times smaller than the image."""
    return np.ascontiguousarray((points_px + displacements_px + 0.5) / scale - 0.5, np.float64)

"""Initial focal length of an adjustment: the best along a line of focal lengths.

A change of the focal length f changes every depth, the rotations and the slope of a plane with it.
So the cost has a long curved valley along f.  Damped Gauss-Newton steps are straight: they stop far
from the minimum, and for a plane seen for a second f stays at its initial value.  With f fixed
there is no such valley.  So the map is adjusted at a sequence of fixed f, in steps of the
logarithm, downhill until the cost increases.
"""

from dataclasses import replace

import numpy as np

from pliant.algorithms.arrays import F64
from pliant.algorithms.slam.estimate.problem import (
    BundleParameters,
    BundleProblem,
    BundleResult,
    CalibrationUncertainty,
)
from pliant.algorithms.slam.estimate.schur import solve_schur

_STEP = 0.2
"""Step of the log focal length: an adjustment finds a minimum within it."""


def best_along_focal(
    problem: BundleProblem,
    parameters: BundleParameters,
    uncertainty: CalibrationUncertainty,
    start: F64,
) -> tuple[BundleProblem, F64]:
    """Return problem and correction (SHARED,) from which to adjust with a free focal length.

    start: (SHARED,) correction that the problem's poses and landmarks were made with.
    """
    held = uncertainty.model_copy(update={"focal": 0.0})

    def at(s: float, begun: BundleProblem, correction: F64) -> tuple[float, BundleProblem, F64]:
        intrinsics = problem.intrinsics.copy()
        intrinsics[:, :2] *= np.exp(s)  # fx, fy
        scaled = replace(begun, intrinsics=intrinsics)
        found = solve_schur(scaled, parameters, uncertainty=held, start=_with(correction, 0.0))
        cost = found.final_cost + 0.5 * (uncertainty.prior_px * s / uncertainty.focal) ** 2
        return cost, _moved(problem, found), _with(found.correction, s)

    best = at(float(start[0]), problem, start)
    for step in (_STEP, -_STEP):
        improved = False
        while (other := at(best[2][0] + step, *best[1:]))[0] < best[0]:
            best, improved = other, True
        if improved:
            break
    return best[1], best[2]


def _with(correction: F64, s: float) -> F64:
    return np.concatenate([[s], correction[1:]])


def _moved(problem: BundleProblem, found: BundleResult) -> BundleProblem:
    return replace(problem, T_world_camera=found.T_world_camera, points_world=found.points_world)

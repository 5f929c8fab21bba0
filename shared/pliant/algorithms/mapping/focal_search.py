"""Where an adjustment with an unknown focal length begins: the best along a line of focal lengths.

A map bends with the focal length f it is made with: with f all depths, turns and, in a plane, its
slope change together.  So the cost has a long curved valley along f, where damped Gauss-Newton
steps, which change f and the map in a straight line, end far from the minimum: of a plane seen for
a second they keep whatever f they begin with.  With f held the map has no such valley.  So f is
stepped along the prior, the map adjusted at each, until both neighbours cost more.
"""

from dataclasses import replace

import numpy as np

from pliant.algorithms.arrays import F64
from pliant.algorithms.bundle.problem import (
    BundleParameters,
    BundleProblem,
    BundleResult,
    CalibrationUncertainty,
)
from pliant.algorithms.bundle.schur import solve_schur

_STEP = 0.2
"""Of the log focal length, from where the minimum is near enough for an adjustment to find it."""


def best_along_focal(
    problem: BundleProblem,
    parameters: BundleParameters,
    uncertainty: CalibrationUncertainty,
    start: F64,
) -> tuple[BundleProblem, F64]:
    """The problem and the correction (6,) to begin from with a free focal length.

    start: (6,) correction that the problem's poses and points were made with.
    """
    held = uncertainty.model_copy(update={"focal": 0.0})

    def at(s: float, begun: BundleProblem, correction: F64) -> tuple[float, BundleProblem, F64]:
        factors = np.where(np.arange(problem.intrinsics.shape[1]) < 2, np.exp(s), 1.0)
        scaled = replace(begun, intrinsics=problem.intrinsics * factors)
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

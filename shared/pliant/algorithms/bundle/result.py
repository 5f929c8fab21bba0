"""From the state of a solver to the answer in the terms of the problem."""

from collections.abc import Callable

import numpy as np

from pliant.algorithms.arrays import F64
from pliant.algorithms.bundle.cost import squared_residuals
from pliant.algorithms.bundle.layout import Layout, points_of, poses_of, residuals_of
from pliant.algorithms.bundle.problem import AnyProblem, BundleParameters, BundleResult

OnIteration = Callable[[float], None]
"""Called with the cost after each iteration, so that a benchmark can note the time."""


def make_result(
    problem: AnyProblem,
    layout: Layout,
    cameras: F64,
    points: F64,
    costs: list[float],
    converged: bool,
    parameters: BundleParameters,
) -> BundleResult:
    """The answer in the terms of the problem."""
    squared = squared_residuals(layout, cameras, points, parameters)
    return BundleResult(
        T_world_camera=poses_of(layout, problem, cameras),
        points_world=points_of(layout, problem, points),
        initial_cost=costs[0],
        final_cost=costs[-1],
        iterations=len(costs) - 1,
        converged=converged,
        squared_residuals=residuals_of(layout, problem, squared),
        costs=np.array(costs),
    )

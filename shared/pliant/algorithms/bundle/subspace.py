"""Bundle adjustment by the subspace Gauss-Newton method (VITAMIN-E section 3.2, Eq. 11-12).

A sweep solves every point for fixed cameras and then every camera for fixed points: blocks of
3 x 3 and 6 x 6 only.  Points do not meet in the Hessian, nor do cameras, so that a sweep is one
exact block Gauss-Seidel pass, linearised afresh for each of its halves.
"""

import numpy as np

from pliant.algorithms.arrays import F64
from pliant.algorithms.bundle.cost import float32_limits, total_cost
from pliant.algorithms.bundle.layout import Layout, build_layout
from pliant.algorithms.bundle.problem import AnyProblem, BundleParameters, BundleResult
from pliant.algorithms.bundle.result import OnIteration, make_result
from pliant.algorithms.bundle.subspace_kernels import sweep_cameras, sweep_points


def solve_subspace(
    problem: AnyProblem,
    parameters: BundleParameters,
    on_iteration: OnIteration | None = None,
) -> BundleResult:
    """Sweep until ``max_sweeps`` or until a sweep lowers the cost by too little.

    The work is done in float32 around the mean of the cameras; steps add up in float64.  Meant
    for a window that is nearly converged: from a bad start use ``solve_schur``.
    """
    layout = build_layout(problem)
    cameras, points, costs, converged = subspace_sweeps(
        layout, layout.cameras, layout.points, parameters, parameters.max_sweeps, on_iteration
    )
    costs[-1] = total_cost(layout, cameras, points, parameters)
    return make_result(problem, layout, cameras, points, costs, converged, parameters)


def subspace_sweeps(
    layout: Layout,
    cameras: F64,
    points: F64,
    parameters: BundleParameters,
    sweeps: int,
    on_iteration: OnIteration | None = None,
) -> tuple[F64, F64, list[float], bool]:
    """The sweeps alone: (cameras, points, cost curve of float32 accuracy, converged)."""
    cameras, points = cameras.copy(), points.copy()
    cameras32, points32 = cameras.astype(np.float32), points.astype(np.float32)
    movable = layout.free >= 0
    limits, damping = float32_limits(parameters), np.float32(parameters.sweep_damping)
    costs: list[float] = []
    for _ in range(sweeps):
        before, after = sweep_points(
            cameras32, layout.pinholes32, layout.lenses32, points32, points, layout.movable,
            layout.u, layout.v, layout.w, layout.seen, limits, damping,
        )  # fmt: skip
        if not costs:
            costs.append(before)
        cost = after - sweep_cameras(
            cameras, cameras32, movable, layout.pinholes32, layout.lenses32, points32,
            layout.u, layout.v, layout.w, layout.seen, limits, parameters.sweep_damping,
        )  # fmt: skip
        costs.append(cost)
        if on_iteration is not None:
            on_iteration(cost)
        if before - cost <= parameters.min_relative_decrease * cost:
            return cameras, points, costs, True
    return (
        cameras,
        points,
        costs or [total_cost(layout, cameras, points, parameters)],
        False,
    )

"""Bundle adjustment by alternation: points for fixed cameras, cameras for fixed points.

The subspace Gauss-Newton method (VITAMIN-E section 3.2, Eq. 11-12) does both in turn.  A sweep
solves every point for fixed cameras and then every camera for fixed points: blocks of 3 x 3 and
6 x 6 only.  The Hessian has no blocks between points, nor between cameras, so a sweep is one exact
block Gauss-Seidel pass, linearised again for each of its halves.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from pliant.algorithms.arrays import F32, F64
from pliant.algorithms.slam.estimate.dense_layout import (
    BLOCK,
    Layout,
    Table,
    build_layout,
    points_of,
    poses_of,
)
from pliant.algorithms.slam.estimate.pose_prior import (
    NO_PRIOR,
    PosePrior,
    prior_cost,
    shifted_motion,
)
from pliant.algorithms.slam.estimate.problem import (
    BundleParameters,
    BundleResult,
    BundleWindow,
)
from pliant.algorithms.slam.estimate.projection import (
    Cameras,
    Limits,
    Seen,
    lens_of,
    limits_of,
    motion_of,
    observe_uncertain,
    pinhole_of,
    residual,
    robust_cost,
)
from pliant.algorithms.slam.estimate.subspace_kernels import sweep_cameras, sweep_points
from pliant.compiler.kernel import fast_kernel

_DAMPING = 1e-3
"""Of a block, relative to its diagonal."""


def solve_subspace(
    problem: BundleWindow,
    parameters: BundleParameters,
    on_iteration: Callable[[float], None] | None = None,
    *,
    prior: PosePrior = NO_PRIOR,
) -> BundleResult:
    """Sweep until ``max_sweeps``, or until a sweep reduces the cost by too little.

    Works in float32 around the mean of the cameras; steps accumulate in float64.  Meant for a
    window near convergence: from a poor initial state use ``solve_schur``.

    prior: of the last camera's pose; costs include it.
    """
    layout = build_layout(problem)
    motion, points = layout.cameras.motion.copy(), layout.points.copy()
    cameras, points32 = layout.cameras.single(), points.astype(np.float32)
    limits, damping = limits_of(parameters, np.float32), np.float32(_DAMPING)
    mean, L = shifted_motion(prior.T_world_camera, layout.origin), prior.information
    costs: list[float] = []
    converged = False
    for _ in range(parameters.max_sweeps):
        held = 0.5 * prior_cost(motion[-1], mean, L)
        before, after = sweep_points(cameras, points32, points, layout.table, limits, damping)
        before, after = before + held, after + held
        if not costs:
            costs.append(before)
        cost = after - sweep_cameras(
            motion, cameras, layout.free, points32, layout.table, limits, _DAMPING, mean, L
        )  # fmt: skip
        costs.append(cost)
        if on_iteration is not None:
            on_iteration(cost)
        converged = before - cost <= parameters.min_relative_decrease * cost
        if converged:
            break
    last = total_cost(layout, motion, points, parameters) + 0.5 * prior_cost(motion[-1], mean, L)
    costs = [*costs[:-1], last] if costs else [last]
    return BundleResult(
        T_world_camera=poses_of(layout, problem, motion),
        points_world=points_of(layout, problem, points),
        initial_cost=costs[0],
        final_cost=costs[-1],
        iterations=len(costs) - 1,
        converged=converged,
        squared_residuals=np.zeros(0, np.float32),
        costs=np.array(costs),
    )


def total_cost(layout: Layout, motion: F64, points: F64, parameters: BundleParameters) -> float:
    """``0.5 sum w rho(r^2)`` in px^2."""
    cameras = layout.cameras._replace(motion=motion)
    return float(_total_cost(cameras, points, layout.table, limits_of(parameters)))


def squared_residuals(
    layout: Layout,
    motion: F64,
    points: F64,
    parameters: BundleParameters,
    spread: tuple[F64, ...] = (),
    shared: float = 0.0,
) -> F32:
    """(M, P) squared residuals, px^2; inf where nothing is seen or the point lies behind.

    spread, shared: as of ``linearise_camera``; with them it is r^T W r.
    """
    cameras, limits = layout.cameras._replace(motion=motion), limits_of(parameters)
    return _squared_residuals(cameras, points, layout.table, limits, spread, shared)


@fast_kernel
def _total_cost(cameras: Cameras, points: F64, table: Table, limits: Limits) -> float:
    total = 0.0
    for m in range(cameras.motion.shape[0]):
        T, K, lens = motion_of(cameras, m), pinhole_of(cameras, m), lens_of(cameras, m)
        for b in range(table.seen.shape[1]):
            if table.seen[m, b] == 0:
                continue
            lo = b * BLOCK
            X, Y, Z = points[0, lo:], points[1, lo:], points[2, lo:]
            um, vm, wm = table.u[m, lo:], table.v[m, lo:], table.w[m, lo:]
            for i in range(BLOCK):
                _, _, _, front, du, dv = residual(
                    1.0, T, K, lens, (X[i], Y[i], Z[i]), um[i], vm[i], limits
                )
                total += robust_cost(1.0, du, dv, wm[i], front, limits)
    return 0.5 * total


@fast_kernel
def _squared_residuals(
    cameras: Cameras, points: F64, table: Table, limits: Limits, spread: Any, shared: float
) -> F32:
    out = np.empty(table.u.shape, np.float32)
    for m in range(cameras.motion.shape[0]):
        T, K, lens = motion_of(cameras, m), pinhole_of(cameras, m), lens_of(cameras, m)
        X, Y, Z = points[0], points[1], points[2]
        um, vm, wm, om = table.u[m], table.v[m], table.w[m], out[m]
        for i in range(X.size):
            point = (X[i], Y[i], Z[i])
            if len(spread) == 0:
                _, _, _, front, du, dv = residual(1.0, T, K, lens, point, um[i], vm[i], limits)
                s = du * du + dv * dv
            else:
                depth = (spread[0][0, i], spread[0][1, i], spread[0][2, i])
                found = observe_uncertain(
                    1.0, T, K, point, depth, shared, Seen(um[i], vm[i], wm[i]), limits
                )
                s, front = found[11], found[12]
            good = front & (wm[i] > 0.0)
            om[i] = np.float32(s) if good else np.float32(np.inf)
    return out

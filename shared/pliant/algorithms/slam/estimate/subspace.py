"""Bundle adjustment by alternation: points for fixed cameras, cameras for fixed points.

The subspace Gauss-Newton method (VITAMIN-E section 3.2, Eq. 11-12) does both in turn.  A sweep
solves every point for fixed cameras and then every camera for fixed points: blocks of 3 x 3 and
6 x 6 only.  The Hessian has no blocks between points, nor between cameras, so a sweep is one exact
block Gauss-Seidel pass, linearised again for each of its halves.
"""

from collections.abc import Callable

import numpy as np

from pliant.algorithms.arrays import F32, F64, BoolArray
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.slam.estimate.dense_layout import (
    BLOCK,
    Layout,
    Table,
    build_layout,
    points_of,
    poses_of,
    residuals_of,
)
from pliant.algorithms.slam.estimate.problem import (
    AnyProblem,
    BundleParameters,
    BundleProblem,
    BundleResult,
)
from pliant.algorithms.slam.estimate.projection import (
    Cameras,
    Limits,
    lens_of,
    limits_of,
    motion_of,
    pinhole_of,
    residual,
    robust_cost,
)
from pliant.algorithms.slam.estimate.subspace_kernels import (
    iterate_pose,
    sweep_cameras,
    sweep_points,
)
from pliant.compiler.kernel import fast_kernel, kernel

_LOWER = np.tril_indices(6)


def solve_subspace(
    problem: AnyProblem,
    parameters: BundleParameters,
    on_iteration: Callable[[float], None] | None = None,
) -> BundleResult:
    """Sweep until ``max_sweeps``, or until a sweep reduces the cost by too little.

    Works in float32 around the mean of the cameras; steps accumulate in float64.  Meant for a
    window near convergence: from a poor initial state use ``solve_schur``.
    """
    layout = build_layout(problem)
    motion, points = layout.cameras.motion.copy(), layout.points.copy()
    cameras, points32 = layout.cameras.single(), points.astype(np.float32)
    limits, damping = limits_of(parameters, np.float32), np.float32(parameters.sweep_damping)
    costs: list[float] = []
    converged = False
    for _ in range(parameters.max_sweeps):
        before, after = sweep_points(cameras, points32, points, layout.table, limits, damping)
        if not costs:
            costs.append(before)
        cost = after - sweep_cameras(
            motion, cameras, layout.free, points32, layout.table, limits, parameters.sweep_damping
        )
        costs.append(cost)
        if on_iteration is not None:
            on_iteration(cost)
        converged = before - cost <= parameters.min_relative_decrease * cost
        if converged:
            break
    last = total_cost(layout, motion, points, parameters)
    costs = [*costs[:-1], last] if costs else [last]
    return make_result(problem, layout, motion, points, costs, converged, parameters)


def refine_pose(
    T_world_camera: F64,
    points_world: F64,
    points_px: F32,
    camera: PinholeCamera,
    parameters: BundleParameters,
    *,
    inlier_px: float = 1.5,
    iterations: int = 10,
    weights: F32 | None = None,
) -> tuple[F64, BoolArray, F64]:
    """Robust Gauss-Newton on one pose, points fixed (Eq. 11 alone).

    T_world_camera: (4, 4) start.  points_world: (N, 3).  points_px: (N, 2), NaN where not seen.
    weights: (N,) of the observations; None: all alike.
    Returns the pose, (N,) whether the reprojection error is under inlier_px with the point in
    front, and the (6, 6) Hessian in px^2 in the order (translation, rotation) of
    ``T_camera_world = (exp(theta), rho) * T_camera_world``.  Without observations the pose stays.
    """
    start = np.ascontiguousarray(T_world_camera, np.float64)
    layout = _one_camera(
        start, np.asarray(points_world, np.float64), np.asarray(points_px, np.float32), camera
    )
    if weights is not None:
        layout.table.w[0, : len(points_px)] *= weights
    before = layout.cameras.motion[0]
    pose = before.copy()
    normal = np.zeros(28)
    iterate_pose(
        pose, layout.cameras.single(), layout.points.astype(np.float32), layout.table,
        limits_of(parameters, np.float32), parameters.initial_damping,
        parameters.min_relative_decrease, iterations, normal,
    )  # fmt: skip
    squared = squared_residuals(layout, pose[None], layout.points, parameters)
    H = np.zeros((6, 6))
    H[_LOWER] = normal[:21]
    H.T[_LOWER] = normal[:21]
    moved = (pose != before).any()
    return (
        _motion(pose, layout.origin) if moved else start.copy(),
        squared[0, : len(points_px)] < np.float32(inlier_px**2),
        H,
    )


def _one_camera(
    T_world_camera: F64, points_world: F64, points_px: F32, camera: PinholeCamera
) -> Layout:
    """The layout of a problem with one camera, without the detour over a ``BundleWindow``."""
    N = len(points_world)
    P = max(1, -(-N // BLOCK)) * BLOCK
    R, origin = T_world_camera[:3, :3], T_world_camera[:3, 3]
    motion = np.zeros((1, 12))
    motion[0, :9] = R.T.reshape(-1)
    pinhole = camera.intrinsics[None]
    u, v, w = np.zeros((3, 1, P), np.float32)
    table = Table(u, v, w, np.zeros((1, P // BLOCK), np.uint8))
    points = np.zeros((3, P))
    _fill(points_world, points_px, origin, table, points)
    return Layout(
        column=np.arange(N), cameras=Cameras(motion, pinhole, np.zeros(0)),
        free=np.ones(1, np.bool_), origin=origin, points=points, table=table,
    )  # fmt: skip


@kernel
def _fill(points_world: F64, points_px: F32, origin: F64, table: Table, points: F64) -> None:
    for n in range(points_px.shape[0]):
        finite = np.isfinite(points_px[n, 0]) and np.isfinite(points_px[n, 1])
        for k in range(3):
            finite = finite and np.isfinite(points_world[n, k])
        if finite:
            table.u[0, n] = points_px[n, 0]
            table.v[0, n] = points_px[n, 1]
            table.w[0, n] = 1.0
            table.seen[0, n // BLOCK] = 1
            for k in range(3):
                points[k, n] = points_world[n, k] - origin[k]


def _motion(camera: F64, origin: F64) -> F64:
    """(4, 4) T_world_camera of a (12,) camera in the shifted world, on SE(3) to rounding.

    Predictions extrapolate: a rotation slightly off SO(3) would grow threefold in every frame.
    """
    rotation = camera[:9].reshape(3, 3)
    for _ in range(2):
        # A Newton step to the polar factor: it is nearly a rotation.
        rotation = 1.5 * rotation - 0.5 * (rotation @ rotation.T @ rotation)
    T_world_camera = np.eye(4)
    T_world_camera[:3, :3] = rotation.T
    T_world_camera[:3, 3] = origin - rotation.T @ camera[9:]
    return T_world_camera


def make_result(
    problem: AnyProblem,
    layout: Layout,
    motion: F64,
    points: F64,
    costs: list[float],
    converged: bool,
    parameters: BundleParameters,
) -> BundleResult:
    """Convert the result to the form of the problem."""
    squared = np.zeros(0, np.float32)
    if isinstance(problem, BundleProblem):
        table = squared_residuals(layout, motion, points, parameters)
        squared = residuals_of(layout, problem, table)
    return BundleResult(
        T_world_camera=poses_of(layout, problem, motion),
        points_world=points_of(layout, problem, points),
        initial_cost=costs[0],
        final_cost=costs[-1],
        iterations=len(costs) - 1,
        converged=converged,
        squared_residuals=squared,
        costs=np.array(costs),
    )


def total_cost(layout: Layout, motion: F64, points: F64, parameters: BundleParameters) -> float:
    """``0.5 sum w rho(r^2)`` in px^2."""
    cameras = layout.cameras._replace(motion=motion)
    return float(_total_cost(cameras, points, layout.table, limits_of(parameters)))


def squared_residuals(
    layout: Layout, motion: F64, points: F64, parameters: BundleParameters
) -> F32:
    """(M, P) squared residuals, px^2; inf where nothing is seen or the point lies behind."""
    cameras = layout.cameras._replace(motion=motion)
    return _squared_residuals(cameras, points, layout.table, limits_of(parameters))


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
def _squared_residuals(cameras: Cameras, points: F64, table: Table, limits: Limits) -> F32:
    out = np.empty(table.u.shape, np.float32)
    for m in range(cameras.motion.shape[0]):
        T, K, lens = motion_of(cameras, m), pinhole_of(cameras, m), lens_of(cameras, m)
        X, Y, Z = points[0], points[1], points[2]
        um, vm, wm, om = table.u[m], table.v[m], table.w[m], out[m]
        for i in range(X.size):
            _, _, _, front, du, dv = residual(
                1.0, T, K, lens, (X[i], Y[i], Z[i]), um[i], vm[i], limits
            )
            good = front & (wm[i] > 0.0)
            om[i] = np.float32(du * du + dv * dv) if good else np.float32(np.inf)
    return out

"""Half problems: one camera against known points, and points against known cameras."""

import dataclasses

import numpy as np

from pliant.algorithms.arrays import F32, F64, U8, BoolArray
from pliant.algorithms.bundle.cost import float32_limits, squared_residuals, total_cost
from pliant.algorithms.bundle.layout import BLOCK, Layout, build_layout
from pliant.algorithms.bundle.problem import (
    AnyProblem,
    BundleParameters,
    BundleResult,
)
from pliant.algorithms.bundle.result import make_result
from pliant.algorithms.bundle.subspace_kernels import iterate_pose, sweep_points
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.kernel import kernel

LOWER = np.tril_indices(6)


def refine_pose(
    T_world_camera: F64,
    points_world: F64,
    points_px: F32,
    camera: PinholeCamera,
    parameters: BundleParameters,
    *,
    inlier_px: float = 1.5,
    iterations: int = 10,
) -> tuple[F64, BoolArray, F64]:
    """Robust Gauss-Newton on one pose, points fixed (Eq. 11 alone).

    T_world_camera: (4, 4) start.  points_world: (N, 3).  points_px: (N, 2), NaN where not seen.
    Returns the pose, (N,) whether the reprojection error is under inlier_px with the point in
    front, and the (6, 6) Hessian in px^2 in the order (translation, rotation) of
    ``T_camera_world = (exp(theta), rho) * T_camera_world``.  Without observations the pose stays.
    """
    start = np.ascontiguousarray(T_world_camera, np.float64)
    layout = _one_camera(
        start, np.asarray(points_world, np.float64), np.asarray(points_px, np.float32), camera
    )
    pose = layout.cameras[0].copy()
    normal = np.zeros(28)
    iterate_pose(
        pose, layout.pinholes32, layout.lenses32, layout.points.astype(np.float32),
        layout.u, layout.v, layout.w, layout.seen, float32_limits(parameters),
        parameters.initial_damping, parameters.min_relative_decrease, iterations, normal,
    )  # fmt: skip
    squared = squared_residuals(layout, pose[None], layout.points, parameters)
    H = np.zeros((6, 6))
    H[LOWER] = normal[:21]
    H.T[LOWER] = normal[:21]
    moved = (pose != layout.cameras[0]).any()
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
    cameras = np.zeros((1, 12))
    cameras[0, :9] = R.T.reshape(-1)
    pinholes = np.array([[camera.fx, camera.fy, camera.cx, camera.cy]])
    table, points = np.zeros((3, 1, P), np.float32), np.zeros((3, P))
    seen = np.zeros((1, P // BLOCK), np.uint8)
    _fill(points_world, points_px, origin, table, points, seen)
    return Layout(
        column=np.arange(N), u=table[0], v=table[1], w=table[2], seen=seen, cameras=cameras,
        pinholes=pinholes, lenses=np.zeros(0), pinholes32=pinholes.astype(np.float32),
        lenses32=np.zeros(0, np.float32), origin=origin, points=points,
        movable=np.zeros(P, np.uint8), free=np.zeros(1, np.int32),
    )  # fmt: skip


@kernel
def _fill(
    points_world: F64, points_px: F32, origin: F64, table: F32, points: F64, seen: U8
) -> None:
    for n in range(points_px.shape[0]):
        finite = np.isfinite(points_px[n, 0]) and np.isfinite(points_px[n, 1])
        for k in range(3):
            finite = finite and np.isfinite(points_world[n, k])
        if finite:
            table[0, 0, n] = points_px[n, 0]
            table[1, 0, n] = points_px[n, 1]
            table[2, 0, n] = 1.0
            seen[0, n // BLOCK] = 1
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


def refine_points(
    problem: AnyProblem, parameters: BundleParameters, *, iterations: int = 10
) -> BundleResult:
    """Gauss-Newton on every point by itself, all cameras fixed (Eq. 12 alone)."""
    problem = dataclasses.replace(
        problem,
        fixed_cameras=np.ones(len(problem.T_world_camera), np.bool_),
    )
    layout = build_layout(problem)
    cameras32 = layout.cameras.astype(np.float32)
    points, points32 = layout.points.copy(), layout.points.astype(np.float32)
    limits, damping = float32_limits(parameters), np.float32(parameters.sweep_damping)
    costs = [total_cost(layout, layout.cameras, points, parameters)]
    converged = False
    for _ in range(iterations):
        before, after = sweep_points(
            cameras32, layout.pinholes32, layout.lenses32, points32, points, layout.movable,
            layout.u, layout.v, layout.w, layout.seen, limits, damping,
        )  # fmt: skip
        costs.append(after)
        converged = before - after <= parameters.min_relative_decrease * after
        if converged:
            break
    costs[-1] = total_cost(layout, layout.cameras, points, parameters)
    return make_result(problem, layout, layout.cameras, points, costs, converged, parameters)

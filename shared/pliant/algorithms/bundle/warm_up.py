"""Compiles every kernel of bundle adjustment by solving a tiny problem."""

import numpy as np

from pliant.algorithms.bundle.packed import solve_packed
from pliant.algorithms.bundle.problem import BundleParameters, BundleProblem, BundleWindow
from pliant.algorithms.bundle.refine import refine_points, refine_pose
from pliant.algorithms.bundle.schur import solve_schur
from pliant.algorithms.bundle.subspace import solve_subspace
from pliant.algorithms.camera import PinholeCamera


def warm_up() -> None:
    """Compile every kernel, or load it from the cache, by solving a tiny problem."""
    camera = PinholeCamera(width=64, height=48, fx=50.0, fy=50.0, cx=32.0, cy=24.0)
    T_world_camera = np.tile(np.eye(4), (3, 1, 1))
    T_world_camera[:, 0, 3] = [0.0, 0.1, 0.2]
    points = np.array([[x, y, 2.0 + 0.1 * x * y] for x in (-1.0, 0.0, 1.0) for y in (-1.0, 1.0)])
    M, N = len(T_world_camera), len(points)
    relative = points[None] - T_world_camera[:, None, :3, 3]
    px = (relative[..., :2] / relative[..., 2:] * 50.0 + (32.0, 24.0)).astype(np.float32)
    intrinsics = np.tile(np.array([50.0, 50.0, 32.0, 24.0, 0.0, 0.0]), (M, 1))
    fixed = np.array([True, False, False])
    problem = BundleProblem(
        T_world_camera=T_world_camera, points_world=points,
        camera_index=np.repeat(np.arange(M, dtype=np.int32), N),
        point_index=np.tile(np.arange(N, dtype=np.int32), M),
        points_px=px.reshape(-1, 2), intrinsics=intrinsics, fixed_cameras=fixed,
    )  # fmt: skip
    window = BundleWindow(
        T_world_camera=T_world_camera, points_world=points,
        u=np.ascontiguousarray(px[..., 0]), v=np.ascontiguousarray(px[..., 1]),
        weights=np.ones((M, N), np.float32), intrinsics=intrinsics, fixed_cameras=fixed,
    )  # fmt: skip
    parameters = BundleParameters(max_iterations=2, max_sweeps=1)
    for each in (problem, window):
        solve_schur(each, parameters)
        solve_packed(each, parameters)
        solve_subspace(each, parameters)
    refine_points(problem, parameters, iterations=1)
    refine_pose(T_world_camera[1], points, px[0], camera, parameters, iterations=2)

"""The combination of the two methods, and the compilation of every kernel."""

import numpy as np

from pliant.algorithms.bundle.information import point_information
from pliant.algorithms.bundle.layout import build_layout
from pliant.algorithms.bundle.packed import solve_packed
from pliant.algorithms.bundle.packed_layout import is_sparse
from pliant.algorithms.bundle.problem import (
    AnyProblem,
    BundleParameters,
    BundleProblem,
    BundleResult,
    BundleWindow,
)
from pliant.algorithms.bundle.refine import refine_points, refine_pose
from pliant.algorithms.bundle.result import OnIteration, make_result
from pliant.algorithms.bundle.schur import schur_iterations
from pliant.algorithms.bundle.subspace import subspace_sweeps
from pliant.algorithms.camera import PinholeCamera


def solve(
    problem: AnyProblem,
    parameters: BundleParameters,
    on_iteration: OnIteration | None = None,
) -> BundleResult:
    """Subspace sweeps before the first and after each Schur complement iteration.

    A sweep undoes local errors at a tenth of an iteration's price; the Schur complement undoes
    what sweeps cannot, the global modes (scale and drift along the window).  Together they need
    half of the iterations.  A prior is obeyed by the iterations alone, so it turns sweeps off.
    Where cameras see few of the points, an iteration costs little more than a sweep: it is
    ``solve_schur`` then.
    """
    if is_sparse(problem):
        return solve_packed(problem, parameters, on_iteration)
    layout = build_layout(problem)
    before = parameters.sweeps_before if problem.prior is None else 0
    between = parameters.sweeps_between if problem.prior is None else 0
    cameras, points, costs, _ = subspace_sweeps(
        layout, layout.cameras, layout.points, parameters, before, on_iteration
    )
    cameras, points, more, converged = schur_iterations(
        layout, cameras, points, parameters, on_iteration, between
    )
    return make_result(problem, layout, cameras, points, costs + more[1:], converged, parameters)


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
    solve(problem, parameters)
    solve(window, parameters)
    solve_packed(problem, parameters)
    solve_packed(window, parameters)
    refine_points(problem, parameters, iterations=1)
    point_information(problem, parameters)
    refine_pose(T_world_camera[1], points, px[0], camera, parameters, iterations=2)

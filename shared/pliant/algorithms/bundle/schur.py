"""Bundle adjustment by Levenberg-Marquardt with an explicit Schur complement (Eq. 9-10)."""

import numpy as np

from pliant.algorithms.arrays import F64
from pliant.algorithms.bundle.camera_step import move_cameras
from pliant.algorithms.bundle.cost import limits_of, total_cost
from pliant.algorithms.bundle.damped import damped_iterations
from pliant.algorithms.bundle.layout import Layout, build_layout
from pliant.algorithms.bundle.packed import solve_packed
from pliant.algorithms.bundle.packed_layout import is_sparse
from pliant.algorithms.bundle.problem import AnyProblem, BundleParameters, BundleResult
from pliant.algorithms.bundle.reduced import add_cameras, solve_reduced
from pliant.algorithms.bundle.result import OnIteration, make_result
from pliant.algorithms.bundle.schur_kernels import back_substitute, reduced_system


def solve_schur(
    problem: AnyProblem,
    parameters: BundleParameters,
    on_iteration: OnIteration | None = None,
) -> BundleResult:
    """Minimise Eq. 6 over all movable cameras and points by damped Gauss-Newton steps.

    Each step eliminates the points exactly.  float64 throughout.  A step is taken only if it
    lowers the cost.
    """
    if is_sparse(problem):
        return solve_packed(problem, parameters, on_iteration)
    layout = build_layout(problem)
    cameras, points, costs, converged = schur_iterations(
        layout, layout.cameras, layout.points, parameters, on_iteration
    )
    return make_result(problem, layout, cameras, points, costs, converged, parameters)


def schur_iterations(
    layout: Layout,
    cameras: F64,
    points: F64,
    parameters: BundleParameters,
    on_iteration: OnIteration | None = None,
) -> tuple[F64, F64, list[float], bool]:
    """The iterations alone: (cameras, points, cost curve, converged)."""
    (cameras, points), costs, converged = damped_iterations(
        (cameras, points),
        lambda state: total_cost(layout, *state, parameters),
        lambda state, damping: _step(layout, *state, parameters, damping),
        parameters,
        on_iteration,
    )
    return cameras, points, costs, converged


def _step(
    layout: Layout,
    cameras: F64,
    points: F64,
    parameters: BundleParameters,
    damping: float,
) -> tuple[F64, F64] | None:
    """Cameras and points after one damped Gauss-Newton step; None where it has no solution."""
    steps = camera_steps(layout, cameras, points, parameters, damping)
    if steps is None:
        return None
    moved = np.empty_like(points)
    back_substitute(
        cameras, layout.pinholes, layout.lenses, points, layout.movable, layout.u, layout.v,
        layout.w, layout.seen, limits_of(parameters), damping, steps, moved,
    )  # fmt: skip
    return move_cameras(cameras, steps), moved


def camera_steps(
    layout: Layout,
    cameras: F64,
    points: F64,
    parameters: BundleParameters,
    damping: float,
) -> F64 | None:
    """(M, 6) damped Gauss-Newton steps of the cameras (Eq. 9), None where there is no solution."""
    moving = np.flatnonzero(layout.free >= 0)
    steps = np.zeros((len(cameras), 6))
    if moving.size == 0:
        return steps
    S = np.zeros((6 * moving.size, 6 * moving.size))
    b = np.zeros(6 * moving.size)
    normal = np.zeros((len(cameras), 27))
    reduced_system(
        cameras, layout.pinholes, layout.lenses, layout.free, points, layout.movable,
        layout.u, layout.v, layout.w, layout.seen, limits_of(parameters), damping, S, b, normal,
    )  # fmt: skip
    diagonal = add_cameras(S, b, normal[moving])
    solution = solve_reduced(S, b, damping * diagonal)
    if solution is None:
        return None
    steps[moving] = solution.reshape(-1, 6)
    return steps

"""Bundle adjustment by Ceres (through pyceres), for comparison: same problem, kernel and start.

pyceres evaluates residuals in Python, which would make Ceres look a hundred times slower than it
is.  So two times are reported.  ``solver_seconds`` is what Ceres spends in its own linear solver
alone (Schur elimination, factorisation, back substitution): residuals, Jacobians and bookkeeping
are free, so whatever beats that beats Ceres with any evaluation code.  ``seconds`` adds, for each
iteration, one pass over all residuals and Jacobians of the same analytic cost function compiled.
"""

import time
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np

from pliant.algorithms.arrays import F64, I32
from pliant.algorithms.geometry import inverse, so3_log
from pliant.algorithms.slam.estimate.problem import BundleParameters, BundleProblem
from pliant.compiler.kernel import fast_kernel
from pliant.errors import PliantError


@dataclass(frozen=True, kw_only=True)
class CostCurve:
    """How the cost of one method fell.

    seconds, costs: (K,) at the start and after each iteration; the cost is 0.5 sum w rho, px^2.
    solver_seconds: (K,) without evaluation, for Ceres; else the same as seconds.
    """

    method: str
    seconds: F64
    solver_seconds: F64
    costs: F64

    def iterations_to(self, cost: float) -> int | None:
        """Index of the first cost no higher than this; None where there is none."""
        reached = np.flatnonzero(self.costs <= cost)
        return int(reached[0]) if reached.size else None


def solve_with_ceres(
    problem: BundleProblem,
    parameters: BundleParameters,
    *,
    linear_solver: str = "DENSE_SCHUR",
    max_iterations: int = 40,
) -> CostCurve:
    """Solve by Ceres' Levenberg-Marquardt with one thread.  Raises PliantError without pyceres.

    Cameras are rotation vector and translation, 6 numbers; observations are residual blocks
    <2, 6, 3> with analytic Jacobians; the kernel is a loss function with all three derivatives.
    Points behind a camera are projected as if they were in front.
    """
    try:
        # By name: the types of an optional tool must not decide whether the library's types check.
        pyceres: Any = import_module("pyceres")
    except ImportError as error:
        raise PliantError("the comparison with Ceres needs: pip install pyceres") from error
    T = inverse(problem.T_world_camera)
    cameras = [np.concatenate([so3_log(each[:3, :3]), each[:3, 3]]) for each in T]
    points = [np.array(each) for each in problem.points_world]
    ceres_problem = pyceres.Problem()
    loss = _loss(pyceres, parameters)
    cost_class = _cost_class(pyceres)
    blocks: list[Any] = []
    for k in range(len(problem.camera_index)):
        m, n = int(problem.camera_index[k]), int(problem.point_index[k])
        block = cost_class(problem.intrinsics[m], problem.points_px[k].astype(np.float64))
        blocks.append(block)
        ceres_problem.add_residual_block(block, loss, [cameras[m], points[n]])
    for m in np.unique(problem.camera_index):
        if problem.fixed_cameras[m]:
            ceres_problem.set_parameter_block_constant(cameras[int(m)])
    progress = _progress(pyceres)
    options = pyceres.SolverOptions()
    options.linear_solver_type = getattr(pyceres.LinearSolverType, linear_solver)
    options.num_threads = 1
    options.max_num_iterations = max_iterations
    options.function_tolerance = 1e-6
    options.logging_type = pyceres.LoggingType.SILENT
    options.callbacks = [progress]
    summary = pyceres.SolverSummary()
    pyceres.solve(options, ceres_problem, summary)
    seen: F64 = np.array(progress.seen)
    seconds: F64 = np.cumsum(seen[:, 0])
    costs: F64 = np.minimum.accumulate(seen[:, 1])
    return CostCurve(
        method=f"Ceres {linear_solver}",
        seconds=seconds + _evaluation_seconds(problem, cameras, points) * np.arange(len(seconds)),
        solver_seconds=seconds,
        costs=costs,
    )


def _evaluation_seconds(problem: BundleProblem, cameras: list[F64], points: list[F64]) -> float:
    """Shortest of five passes over all residuals and Jacobians, compiled, one thread."""
    px = problem.points_px.astype(np.float64)
    times: list[float] = []
    for _ in range(6):
        start = time.perf_counter()
        _evaluate_all(
            np.array(cameras), np.array(points), problem.intrinsics, px,
            problem.camera_index, problem.point_index,
        )  # fmt: skip
        times.append(time.perf_counter() - start)
    return min(times[1:])


@fast_kernel
def _evaluate_all(
    cameras: F64, points: F64, K: F64, px: F64, camera_index: I32, point_index: I32
) -> float:
    residual, J, work = np.empty(2), np.empty((2, 9)), np.empty((2, 3, 3))
    total = 0.0
    for k in range(len(camera_index)):
        m, n = camera_index[k], point_index[k]
        _reproject(cameras[m], points[n], K[m], px[k], residual, J, work)
        total += residual[0] + J[0, 0]
    return total


def _progress(pyceres: Any) -> Any:
    class Progress(pyceres.IterationCallback):
        def __init__(self) -> None:
            super().__init__()
            self.seen: list[tuple[float, float]] = []

        def __call__(self, summary: Any) -> Any:
            self.seen.append((summary.step_solver_time_in_seconds, summary.cost))
            return pyceres.CallbackReturnType.SOLVER_CONTINUE

    return Progress()


def _loss(pyceres: Any, parameters: BundleParameters) -> Any:
    if parameters.kernel_sigma_px <= 0.0:
        return pyceres.TrivialLoss()
    inverse_s2 = 1.0 / parameters.kernel_sigma_px**2

    class GemanMcClure(pyceres.LossFunction):
        def Evaluate(self, s: float, out: Any) -> None:
            k = 1.0 / (1.0 + s * inverse_s2)
            out[0], out[1], out[2] = s * k, k * k, -2.0 * inverse_s2 * k**3

    return GemanMcClure()


def _cost_class(pyceres: Any) -> Any:
    J, work = np.empty((2, 9)), np.empty((2, 3, 3))

    class Reprojection(pyceres.CostFunction):
        def __init__(self, intrinsics: F64, px: F64) -> None:
            super().__init__()
            self.set_num_residuals(2)
            self.set_parameter_block_sizes([6, 3])
            self.intrinsics, self.px = intrinsics, px

        def Evaluate(self, blocks: Any, residuals: Any, jacobians: Any) -> bool:
            _reproject(blocks[0], blocks[1], self.intrinsics, self.px, residuals, J, work)
            if jacobians is not None:
                if jacobians[0] is not None:
                    jacobians[0][:] = J[:, :6].reshape(-1)
                if jacobians[1] is not None:
                    jacobians[1][:] = J[:, 6:].reshape(-1)
            return True

    return Reprojection


@fast_kernel
def _reproject(camera: F64, point: F64, K: F64, px: F64, residual: F64, J: F64, work: F64) -> None:
    """Projection minus observation, and its (2, 9) Jacobian by rotation vector, t and point."""
    a, b, c = camera[0], camera[1], camera[2]
    angle2 = a * a + b * b + c * c
    if angle2 < 1e-10:
        p, q, s = 1.0 - angle2 / 6.0, 0.5 - angle2 / 24.0, 1.0 / 6.0 - angle2 / 120.0
    else:
        angle = np.sqrt(angle2)
        p = np.sin(angle) / angle
        q = (1.0 - np.cos(angle)) / angle2
        s = (1.0 - p) / angle2
    R, left = work[0], work[1]
    for matrix, first, second in ((R, p, q), (left, q, s)):
        matrix[0, 0] = 1.0 - second * (b * b + c * c)
        matrix[1, 1] = 1.0 - second * (a * a + c * c)
        matrix[2, 2] = 1.0 - second * (a * a + b * b)
        matrix[0, 1], matrix[1, 0] = second * a * b - first * c, second * a * b + first * c
        matrix[0, 2], matrix[2, 0] = second * a * c + first * b, second * a * c - first * b
        matrix[1, 2], matrix[2, 1] = second * b * c - first * a, second * b * c + first * a
    t0 = R[0, 0] * point[0] + R[0, 1] * point[1] + R[0, 2] * point[2]
    t1 = R[1, 0] * point[0] + R[1, 1] * point[1] + R[1, 2] * point[2]
    t2 = R[2, 0] * point[0] + R[2, 1] * point[1] + R[2, 2] * point[2]
    X, Y, Z = t0 + camera[3], t1 + camera[4], t2 + camera[5]
    x, y = X / Z, Y / Z
    r2 = x * x + y * y
    d, e = 1.0 + r2 * (K[4] + K[5] * r2), 2.0 * K[4] + 4.0 * K[5] * r2
    residual[0] = K[0] * d * x + K[2] - px[0]
    residual[1] = K[1] * d * y + K[3] - px[1]
    for r in range(2):
        f0 = K[r] * (d + e * x * x) if r == 0 else K[r] * e * x * y
        f1 = K[r] * e * x * y if r == 0 else K[r] * (d + e * y * y)
        g0, g1 = f0 / Z, f1 / Z
        g2 = -(f0 * x + f1 * y) / Z
        # d(R p) = -[R p]x left d(rotation vector).
        h0 = g2 * t1 - g1 * t2
        h1 = g0 * t2 - g2 * t0
        h2 = g1 * t0 - g0 * t1
        for j in range(3):
            J[r, j] = h0 * left[0, j] + h1 * left[1, j] + h2 * left[2, j]
            J[r, 6 + j] = g0 * R[0, j] + g1 * R[1, j] + g2 * R[2, j]
        J[r, 3], J[r, 4], J[r, 5] = g0, g1, g2

"""Bundle adjustment against Ceres and scipy: time to the same cost, and the cost over time.

Everybody gets the same problem, start, kernel and fixed intrinsics, and one thread.  The goal
is a cost within 0.1 % of Ceres' final one.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.bundle_problems import Case, public_cases, synthetic_cases
from benchmarks.ceres import CostCurve, solve_with_ceres
from pliant.algorithms.arrays import F64
from pliant.algorithms.geometry import so3_exp
from pliant.algorithms.slam.estimate.problem import (
    BundleParameters,
    BundleProblem,
    BundleResult,
    BundleWindow,
)
from pliant.algorithms.slam.estimate.schur import solve_schur
from pliant.algorithms.slam.estimate.subspace import solve_subspace
from pliant.errors import PliantError

GOAL = 1.001
"""Share of Ceres' final cost that has to be reached."""
SWEEPS = 100
MAX_SCIPY_OBSERVATIONS = 2000


@dataclass(frozen=True, kw_only=True)
class BundleRow:
    """One method on one problem.

    seconds_to_goal: until the cost was within 0.1 % of Ceres' final cost, from the call on, with
        all conversions; NaN where it never was.  For Ceres: linear solver and compiled evaluation.
    speedup: Ceres' time to the goal over this one.
    speedup_of_solver_alone: the same if Ceres' evaluation were free, the least that can be claimed.
    """

    problem: str
    cameras: int
    points: int
    observations: int
    method: str
    initial_cost: float
    final_cost: float
    iterations_to_goal: int
    seconds_to_goal: float
    speedup: float
    speedup_of_solver_alone: float


@dataclass(frozen=True, kw_only=True)
class BundleComparison:
    """The cost curves of all methods on one problem; the first is Ceres."""

    problem: str
    curves: list[CostCurve]


def compare_bundle_adjustment(
    folder: Path | None = None,
    *,
    repetitions: int = 5,
    ceres_repetitions: int = 2,
    cases: list[Case] | None = None,
) -> tuple[list[BundleRow], list[BundleComparison]]:
    """Run all methods on the synthetic windows and, with a folder, on the public problems in it.

    Of each method the shortest of its repetitions counts.  The public problems of libmv start
    within 0.1 % of the optimum, so that their time to the goal is 0.
    Ten minutes long: pyceres evaluates in Python.  Raises PliantError without pyceres, DatasetError
    for files that cannot be read.
    """
    if cases is None:
        cases = synthetic_cases() + (public_cases(folder) if folder is not None else [])
    rows: list[BundleRow] = []
    comparisons: list[BundleComparison] = []
    for name, problem, parameters in cases:
        runs = [solve_with_ceres(problem, parameters) for _ in range(ceres_repetitions)]
        curves = [min(runs, key=lambda run: float(run.seconds[-1]))]
        for method, solver in _methods():
            curves.append(_measure(method, solver, problem, parameters, repetitions))
        if len(problem.camera_index) <= MAX_SCIPY_OBSERVATIONS:
            curves.append(solve_with_scipy(problem, parameters))
        comparisons.append(BundleComparison(problem=name, curves=curves))
        rows.extend(_row(name, problem, curve, curves[0]) for curve in curves)
    return rows, comparisons


def plot_costs(comparisons: list[BundleComparison], path: Path) -> None:
    """Draw excess cost over time, one panel a problem.  Raises PliantError without matplotlib."""
    try:
        import matplotlib
    except ImportError as error:
        raise PliantError('plots need: pip install "pliant[plot]"') from error
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(
        1, len(comparisons), figsize=(5.0 * len(comparisons), 4.2), squeeze=False
    )
    for axis, comparison in zip(panels[0], comparisons, strict=True):
        lowest = min(float(curve.costs[-1]) for curve in comparison.curves)
        for curve in comparison.curves:
            excess = np.maximum(curve.costs / lowest - 1.0, 1e-6)
            axis.loglog(np.maximum(1e3 * curve.seconds, 0.1), excess, "o-", label=curve.method)
        axis.axhline(GOAL - 1.0, color="0.6", linestyle=":")
        axis.set_title(comparison.problem)
        axis.set_xlabel("time [ms], one thread")
        axis.set_ylabel("cost above the lowest, relative")
    panels[0][0].legend()
    figure.tight_layout()
    figure.savefig(path, dpi=120)
    plt.close(figure)


def solve_with_scipy(problem: BundleProblem, parameters: BundleParameters) -> CostCurve:
    """scipy's trust region solver on the same cost, for small problems.

    Robust residuals are ``r / sqrt(1 + r^2 / sigma^2)``, whose squares are the kernel's cost.
    Raises PliantError without scipy.
    """
    try:
        from scipy.optimize import least_squares
    except ImportError as error:
        raise PliantError("the comparison with scipy needs: pip install scipy") from error
    sigma = parameters.kernel_sigma_px
    moving = np.flatnonzero(~problem.fixed_cameras)

    def residuals(x: F64) -> F64:
        T = problem.T_world_camera.copy()
        steps = x[: 6 * len(moving)].reshape(-1, 6)
        T[moving, :3, :3] = T[moving, :3, :3] @ so3_exp(steps[:, :3])
        T[moving, :3, 3] += steps[:, 3:]
        points = problem.points_world + x[6 * len(moving) :].reshape(-1, 3)
        R, t = T[problem.camera_index, :3, :3], T[problem.camera_index, :3, 3]
        local = np.einsum("oji,oj->oi", R, points[problem.point_index] - t)
        xy = local[:, :2] / local[:, 2:]
        r2 = (xy**2).sum(axis=1, keepdims=True)
        K = problem.intrinsics[problem.camera_index]
        lens = 1.0 + K[:, 4:5] * r2 + K[:, 5:6] * r2**2
        r = K[:, :2] * lens * xy + K[:, 2:4] - problem.points_px
        if sigma > 0.0:
            r = r / np.sqrt(1.0 + (r**2).sum(axis=1, keepdims=True) / sigma**2)
        return r.reshape(-1)

    x0 = np.zeros(6 * len(moving) + problem.points_world.size)
    begin = time.perf_counter()
    answer: Any = least_squares(residuals, x0, x_scale="jac", ftol=1e-6)
    seconds = np.array([0.0, time.perf_counter() - begin])
    start = 0.5 * float((residuals(x0) ** 2).sum())
    return CostCurve(
        method="scipy least_squares", seconds=seconds, solver_seconds=seconds,
        costs=np.array([start, float(answer.cost)]),
    )  # fmt: skip


def _methods() -> list[tuple[str, Callable[..., BundleResult]]]:
    def sweeps(
        problem: BundleProblem, parameters: BundleParameters, on_iteration: Callable[[float], None]
    ) -> BundleResult:
        many = parameters.model_copy(update={"max_sweeps": SWEEPS})
        return solve_subspace(_window_of(problem), many, on_iteration)

    return [("subspace", sweeps), ("Schur LM", solve_schur)]


def _window_of(problem: BundleProblem) -> BundleWindow:
    """The dense form, with points that the same camera sees first next to each other."""
    m, n = problem.camera_index, problem.point_index
    first = np.full(len(problem.points_world), len(problem.T_world_camera))
    np.minimum.at(first, n, m)
    order = np.argsort(first, kind="stable")
    at = m, np.argsort(order)[n]
    u, v, w = np.zeros((3, len(problem.T_world_camera), len(order)), np.float32)
    u[at], v[at] = problem.points_px.T
    w[at] = 1.0 if problem.weights is None else problem.weights
    return BundleWindow(
        T_world_camera=problem.T_world_camera, points_world=problem.points_world[order],
        columns=np.arange(len(order), dtype=np.int32), u=u, v=v, weights=w, seen=w > 0.0,
        intrinsics=problem.intrinsics, fixed_cameras=problem.fixed_cameras,
    )  # fmt: skip


def _measure(
    method: str,
    solver: Callable[..., BundleResult],
    problem: BundleProblem,
    parameters: BundleParameters,
    repetitions: int,
) -> CostCurve:
    """The cost curve of the shortest run.  Every run gives the same costs."""
    best: list[float] = []
    costs: list[float] = []
    for _ in range(repetitions):
        times: list[float] = []
        costs = []

        def note(cost: float, times: list[float] = times, costs: list[float] = costs) -> None:
            times.append(time.perf_counter())
            costs.append(cost)

        begin = time.perf_counter()
        result = solver(problem, parameters, note)
        # What comes after the last iteration (residuals, conversion) belongs to every stop.
        rest = time.perf_counter() - (times[-1] if times else begin)
        seconds = [0.0] + [each - begin + rest for each in times]
        costs = [result.initial_cost, *costs]
        if not best or seconds[-1] < best[-1]:
            best = seconds
    seconds = np.array(best)
    return CostCurve(method=method, seconds=seconds, solver_seconds=seconds, costs=np.array(costs))


def _row(name: str, problem: BundleProblem, curve: CostCurve, ceres: CostCurve) -> BundleRow:
    goal = GOAL * float(ceres.costs[-1])
    own, theirs = curve.iterations_to(goal), ceres.iterations_to(goal)
    assert theirs is not None
    seconds = float("nan") if own is None else float(curve.seconds[own])
    fair, least = float(ceres.seconds[theirs]), float(ceres.solver_seconds[theirs])
    return BundleRow(
        problem=name,
        cameras=len(problem.T_world_camera),
        points=len(problem.points_world),
        observations=len(problem.camera_index),
        method=curve.method,
        initial_cost=float(curve.costs[0]),
        final_cost=float(curve.costs[-1]),
        iterations_to_goal=-1 if own is None else own,
        seconds_to_goal=seconds,
        speedup=fair / seconds if seconds else float("nan"),
        speedup_of_solver_alone=least / seconds if seconds else float("nan"),
    )

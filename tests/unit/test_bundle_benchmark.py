"""The comparison of bundle adjustment with Ceres, on a problem small enough for pyceres."""

import dataclasses

import numpy as np
import pytest
from benchmarks.bundle_problems import WINDOW, synthetic_window
from benchmarks.ceres import CostCurve, solve_with_ceres
from benchmarks.solvers import (
    compare_bundle_adjustment,
    plot_costs,
    solve_with_scipy,
)

from pliant.algorithms.slam.estimate.problem import BundleProblem


def small_window(points: int) -> BundleProblem:
    return synthetic_window(4, points, disturbance=0.5)


def test_synthetic_windows_have_the_given_sizes():
    whole = synthetic_window(5, 200)
    assert np.bincount(whole.camera_index).tolist() == [200] * 5
    short = synthetic_window(8, 300, track_length=3)
    assert np.bincount(short.point_index).max() == 3
    assert short.points_px.tobytes() == synthetic_window(8, 300, track_length=3).points_px.tobytes()


@pytest.mark.slow
def test_ceres_and_all_methods_agree(tmp_path):
    problem = small_window(150)
    tight = WINDOW.model_copy(update={"min_relative_decrease": 1e-9})
    rows, comparisons = compare_bundle_adjustment(
        cases=[("small", problem, tight)], repetitions=1, ceres_repetitions=1
    )
    assert [row.method for row in rows[:3]] == ["Ceres DENSE_SCHUR", "subspace", "Schur LM"]
    ceres = rows[0]
    for row in rows:
        assert row.initial_cost == pytest.approx(ceres.initial_cost, rel=1e-5)
    for row in rows[2:3]:
        assert row.final_cost == pytest.approx(ceres.final_cost, rel=1e-3)
        assert row.iterations_to_goal > 0
        assert row.speedup > 0.0
    assert ceres.speedup == pytest.approx(1.0)
    plot_costs(comparisons, tmp_path / "costs.png")
    assert (tmp_path / "costs.png").stat().st_size > 10_000


def test_ceres_projects_with_distortion_as_we_do():
    problem = small_window(60)
    intrinsics = problem.intrinsics.copy()
    intrinsics[:, 4:] = (-0.05, 0.01)
    distorted = dataclasses.replace(problem, intrinsics=intrinsics)
    theirs = solve_with_ceres(distorted, WINDOW)
    from pliant.algorithms.slam.estimate.schur import solve_schur

    ours = solve_schur(distorted, WINDOW)
    assert theirs.costs[0] == pytest.approx(ours.initial_cost, rel=1e-9)
    assert theirs.costs[-1] == pytest.approx(ours.final_cost, rel=1e-2)


def test_scipy_reaches_the_same_cost():
    problem = small_window(10)
    curve = solve_with_scipy(problem, WINDOW)
    assert curve.costs[1] < curve.costs[0]


def test_curve_knows_when_it_reached_a_cost():
    curve = CostCurve(
        method="m", seconds=np.array([0.0, 1.0, 2.0]), solver_seconds=np.zeros(3),
        costs=np.array([9.0, 5.0, 3.0]),
    )  # fmt: skip
    assert curve.iterations_to(5.0) == 1
    assert curve.iterations_to(1.0) is None

"""Public bundle adjustment problems: loaders."""

from pathlib import Path

import numpy as np
import pytest
from benchmarks.bal import load_bal, load_libmv

from pliant.algorithms.slam.estimate.problem import BundleParameters
from pliant.algorithms.slam.estimate.schur import solve_schur
from pliant.errors import DatasetError

DATA = Path(__file__).resolve().parents[3] / "shared" / "data" / "bundle_adjustment"
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason=f"no public problems in {DATA}")
LEAST_SQUARES = BundleParameters(kernel_sigma_px=0.0, min_depth=-1e9)


def test_bal_of_one_observation(tmp_path):
    # The camera looks along -z: a point at z = -2 is in front, x to the right, y up.
    path = tmp_path / "problem.txt"
    path.write_text("1 1 1\n0 0 60.0 31.0\n0 0 0 0 0 0 100 0.04 0\n1 0.5 -2\n")
    problem = load_bal(path)
    np.testing.assert_allclose(problem.T_world_camera[0], np.diag([1.0, -1.0, -1.0, 1.0]))
    result = solve_schur(problem, LEAST_SQUARES.model_copy(update={"max_iterations": 1}))
    # u = 100 * 0.5 * d, v = 100 * 0.25 * d with d = 1 + 0.04 * (0.25 + 0.0625).
    d = 1.0 + 0.04 * 0.3125
    expected = 0.5 * ((60.0 - 50.0 * d) ** 2 + (31.0 - 25.0 * d) ** 2)
    assert result.initial_cost == pytest.approx(expected)


@pytest.mark.parametrize("text", ["", "1 1", "1 1 1\n0 0 1 2\n", "one 1 1", "0 0 0"])
def test_broken_bal_is_refused(tmp_path, text):
    path = tmp_path / "problem.txt"
    path.write_text(text)
    with pytest.raises(DatasetError, match="not a BAL problem"):
        load_bal(path)


def test_broken_libmv_is_refused(tmp_path):
    path = tmp_path / "problem.npz"
    with pytest.raises(DatasetError, match="not a libmv problem"):
        load_libmv(path)
    np.savez(path, R=np.eye(3)[None])
    with pytest.raises(DatasetError, match="not a libmv problem"):
        load_libmv(path)


@needs_data
def test_ladybug_has_the_cost_of_the_literature():
    problem = load_bal(DATA / "ladybug-problem-49-7776-pre.txt")
    result = solve_schur(problem, LEAST_SQUARES)
    assert result.initial_cost == pytest.approx(8.509125e5, rel=1e-6)
    # With the intrinsics fixed; Ceres ends at 16367.27.
    assert result.final_cost < 1.001 * 16367.27


@needs_data
def test_libmv_starts_near_its_optimum():
    problem = load_libmv(DATA / "libmv" / "problem_03.npz")
    assert (len(problem.T_world_camera), len(problem.points_world)) == (500, 37)
    result = solve_schur(problem, LEAST_SQUARES.model_copy(update={"max_iterations": 1}))
    assert result.initial_cost == pytest.approx(297.9947, rel=1e-5)

"""The bundle adjustment solvers: known answers, other solvers, and bad input."""

import dataclasses

import numpy as np
import pytest
from bundle_scene import cost, make_scene, residuals, sweep, to_window

from pliant.algorithms.geometry import so3_exp
from pliant.algorithms.slam.estimate.problem import BundleParameters
from pliant.algorithms.slam.estimate.schur import solve_schur

EXACT = BundleParameters(kernel_sigma_px=0.0, min_relative_decrease=1e-12)
ROBUST = BundleParameters(kernel_sigma_px=2.0, min_relative_decrease=1e-9)
SWEEPS = BundleParameters(kernel_sigma_px=0.0, max_sweeps=400, min_relative_decrease=1e-7)
SOLVERS = [
    pytest.param(solve_schur, EXACT, id="schur"),
    pytest.param(sweep, SWEEPS, id="subspace"),
]


@pytest.mark.parametrize(("solver", "parameters"), SOLVERS)
@pytest.mark.parametrize("distortion", [(0.0, 0.0), (-0.2, 0.05)])
def test_exact_observations_give_back_the_truth(solver, parameters, distortion):
    scene = make_scene(visible=0.8, distortion=distortion)
    result = solver(scene.problem, parameters)
    assert result.final_cost < 1e-4 * result.initial_cost
    # Sweeps alone crawl along the global modes; the others end at the rounding of the pixels.
    tolerance = 2e-2 if solver is sweep else 1e-5
    np.testing.assert_allclose(result.T_world_camera, scene.T_world_camera, atol=tolerance)
    np.testing.assert_allclose(result.points_world, scene.points_world, atol=10 * tolerance)


@pytest.mark.parametrize(("solver", "parameters"), SOLVERS)
def test_cost_never_rises_and_is_that_of_the_answer(solver, parameters):
    problem = make_scene(noise_px=1.0, visible=0.8).problem
    result = solver(problem, parameters)
    assert (np.diff(result.costs) <= 1e-5 * result.costs[:-1]).all()
    assert result.costs[0] == result.initial_cost
    assert result.costs[-1] == result.final_cost
    found = cost(problem, result.T_world_camera, result.points_world, parameters)
    assert result.final_cost == pytest.approx(found, rel=1e-6)
    squared = (residuals(problem, result.T_world_camera, result.points_world) ** 2).sum(axis=1)
    if solver is solve_schur:
        np.testing.assert_allclose(result.squared_residuals, squared, rtol=1e-3, atol=1e-6)


def test_agrees_with_scipy():
    optimize = pytest.importorskip("scipy.optimize")
    problem = make_scene(cameras=4, points=12, noise_px=1.0).problem
    result = solve_schur(problem, EXACT)
    T, points = problem.T_world_camera, problem.points_world

    def unpack(x):
        poses = T.copy()
        for m in (2, 3):
            step = x[6 * (m - 2) : 6 * (m - 2) + 6]
            poses[m, :3, :3] = T[m, :3, :3] @ so3_exp(step[:3])
            poses[m, :3, 3] += step[3:]
        return poses, points + x[12:].reshape(-1, 3)

    answer = optimize.least_squares(
        lambda x: residuals(problem, *unpack(x)).reshape(-1), np.zeros(12 + points.size), xtol=1e-12
    )
    assert result.final_cost == pytest.approx(answer.cost, rel=1e-6)
    poses, moved = unpack(answer.x)
    np.testing.assert_allclose(result.T_world_camera, poses, atol=1e-4)
    np.testing.assert_allclose(result.points_world, moved, atol=1e-2)


def test_outliers_do_not_move_the_answer():
    clean = make_scene(points=150, noise_px=0.3, disturbance=0.3)
    dirty = make_scene(points=150, noise_px=0.3, disturbance=0.3, outliers=0.1)
    truth = clean.T_world_camera
    plain = solve_schur(dirty.problem, EXACT)
    robust = solve_schur(dirty.problem, ROBUST)
    error = np.abs(robust.T_world_camera - truth).max()
    assert error < 0.02
    assert np.abs(plain.T_world_camera - truth).max() > 5 * error
    wrong = robust.squared_residuals > 15.0**2
    assert 0.05 < wrong.mean() < 0.15


@pytest.mark.parametrize("solver", [solve_schur, sweep])
def test_fixed_cameras_keep_every_bit(solver):
    problem = make_scene(noise_px=1.0).problem
    result = solver(problem, ROBUST)
    fixed = problem.fixed_cameras
    assert (result.T_world_camera[fixed] == problem.T_world_camera[fixed]).all()
    assert (result.T_world_camera[~fixed] != problem.T_world_camera[~fixed]).any(axis=(1, 2)).all()
    assert (result.points_world != problem.points_world).any(axis=1).all()


def test_window_and_list_are_the_same_problem():
    problem = make_scene(noise_px=1.0, visible=0.6).problem
    listed, dense = solve_schur(problem, ROBUST), solve_schur(to_window(problem), ROBUST)
    np.testing.assert_allclose(dense.T_world_camera, listed.T_world_camera, atol=1e-4)
    np.testing.assert_allclose(dense.points_world, listed.points_world, atol=3e-3)
    assert dense.final_cost == pytest.approx(listed.final_cost, rel=1e-4)
    assert len(dense.squared_residuals) == 0


@pytest.mark.parametrize("solver", [solve_schur, sweep])
def test_unobserved_points_and_cameras_stay(solver):
    problem = make_scene(noise_px=0.5).problem
    keep = (problem.camera_index != 3) & (problem.point_index != 7)
    problem = dataclasses.replace(
        problem, camera_index=problem.camera_index[keep], point_index=problem.point_index[keep],
        points_px=problem.points_px[keep],
    )  # fmt: skip
    result = solver(problem, ROBUST)
    assert (result.points_world[7] == problem.points_world[7]).all()
    np.testing.assert_allclose(result.T_world_camera[3], problem.T_world_camera[3], atol=1e-12)
    assert result.final_cost < result.initial_cost


@pytest.mark.parametrize("solver", [solve_schur, sweep])
@pytest.mark.parametrize("sigma", [0.0, 2.0])
def test_points_behind_and_broken_numbers_do_no_harm(solver, sigma):
    scene = make_scene(points=80, noise_px=0.3, disturbance=0.3)
    problem = scene.problem
    points, px = problem.points_world.copy(), problem.points_px.copy()
    points[3] = [0.0, 0.0, -5.0]
    points[4] = np.nan
    points[5] = [np.inf, 0.0, 1.0]
    points[6] = scene.T_world_camera[0, :3, 3]
    px[100] = np.nan
    px[101] = [np.inf, 3.0]
    problem = dataclasses.replace(problem, points_world=points, points_px=px)
    parameters = BundleParameters(kernel_sigma_px=sigma)
    result = solver(problem, parameters)
    assert np.isfinite(result.T_world_camera).all()
    good = np.ones(80, bool)
    good[[4, 5]] = False
    assert np.isfinite(result.points_world[good]).all()
    assert np.array_equal(result.points_world[[4, 5]], points[[4, 5]], equal_nan=True)
    assert np.isfinite(result.final_cost)
    assert result.final_cost <= result.initial_cost
    if solver is sweep:
        return
    assert np.isinf(result.squared_residuals[problem.point_index == 4]).all()
    assert np.isinf(result.squared_residuals[[100, 101]]).all()
    if sigma > 0.0:
        np.testing.assert_allclose(result.T_world_camera, scene.T_world_camera, atol=0.1)


@pytest.mark.parametrize("solver", [solve_schur, sweep])
def test_problems_without_anything_to_do(solver):
    problem = make_scene().problem
    empty = dataclasses.replace(
        problem, camera_index=np.zeros(0, np.int32), point_index=np.zeros(0, np.int32),
        points_px=np.zeros((0, 2), np.float32),
    )  # fmt: skip
    nothing = dataclasses.replace(empty, points_world=np.zeros((0, 3)))
    for each in (empty, nothing):
        result = solver(each, ROBUST)
        assert np.array_equal(result.T_world_camera[:2], each.T_world_camera[:2])
        np.testing.assert_allclose(result.T_world_camera, each.T_world_camera, atol=1e-12)
        assert np.array_equal(result.points_world, each.points_world)
        assert result.final_cost == pytest.approx(result.initial_cost)


def test_weights_scale_the_cost_and_zero_leaves_out():
    problem = make_scene(noise_px=1.0).problem
    count = len(problem.camera_index)
    half = dataclasses.replace(problem, weights=np.full(count, 0.5, np.float32))
    assert solve_schur(half, EXACT).final_cost == pytest.approx(
        0.5 * solve_schur(problem, EXACT).final_cost, rel=1e-5
    )
    weights = np.ones(count, np.float32)
    weights[::4] = 0.0
    spoiled = problem.points_px.copy()
    spoiled[::4] += 300.0
    a = solve_schur(dataclasses.replace(problem, weights=weights), EXACT)
    b = solve_schur(dataclasses.replace(problem, weights=weights, points_px=spoiled), EXACT)
    assert a.final_cost == pytest.approx(b.final_cost, rel=1e-9)


@pytest.mark.parametrize("solver", [solve_schur, sweep])
def test_same_input_same_bytes(solver):
    problem = make_scene(noise_px=1.0, visible=0.7).problem
    a, b = solver(problem, ROBUST), solver(problem, ROBUST)
    assert a.T_world_camera.tobytes() == b.T_world_camera.tobytes()
    assert a.points_world.tobytes() == b.points_world.tobytes()


def test_wrong_sizes_are_refused():
    problem = make_scene().problem
    with pytest.raises(ValueError, match="point_index: out of range"):
        dataclasses.replace(problem, point_index=problem.point_index + 1)
    with pytest.raises(ValueError, match="weights"):
        dataclasses.replace(problem, weights=np.zeros(3, np.float32))

"""Self-calibration: its Jacobians, what it recovers, and what holds it."""

import dataclasses

import numpy as np
import pytest
from bundle_scene import (
    EXACT,
    FREE,
    calibration_jacobian,
    make_scene,
    numeric_jacobian,
    project,
    with_flow,
    with_lens,
)

from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.slam.estimate.calibration import SharedCalibration, ideal_pixels
from pliant.algorithms.slam.estimate.packed_layout import build_packed_layout
from pliant.algorithms.slam.estimate.problem import SHARED, BundleParameters, CalibrationUncertainty
from pliant.algorithms.slam.estimate.schur import SchurSystem, solve_schur, system_at

ROBUST = BundleParameters(kernel_sigma_px=1.0, max_iterations=60, min_relative_decrease=1e-7)


def undistorted(problem):
    """The problem as one believes in it who takes the lens for perfect."""
    return with_lens(problem)


def calibrating_system(problem, parameters, uncertainty):
    layout = build_packed_layout(problem)
    calibration = SharedCalibration(layout, problem.intrinsics[:, 4:], uncertainty)
    return SchurSystem(layout, parameters, calibration)


@pytest.mark.parametrize("calibration", [(0.0,) * 7, (0.03, -0.2, 0.08, 0.4, 0.02, -0.05, 0.07)])
def test_the_blocks_are_those_of_finite_differences(calibration):
    problem = with_flow(make_scene(cameras=4, points=20, noise_px=1.0, visible=0.8).problem)
    q = np.array(calibration)
    system = calibrating_system(problem, EXACT, FREE)
    layout = system.layout
    system.linearise(system.state(layout.cameras.motion, layout.points, q))
    J, r = calibration_jacobian(problem, q)
    H, g, M = J.T @ J, J.T @ r, len(layout.free)
    np.testing.assert_allclose(
        system.shared.own[:SHARED, :SHARED], np.tril(H), rtol=1e-5, atol=1e-6
    )
    np.testing.assert_allclose(system.shared.gradient[:SHARED], g, rtol=1e-5, atol=1e-3)
    other = -numeric_jacobian(with_lens(problem, *q[:3], *q[4:]))
    cross = (J.T @ other[:, : 6 * M]).reshape(SHARED, M, 6).transpose(1, 0, 2).reshape(M, -1)
    near = 1e-5 * np.abs(cross).max()
    np.testing.assert_allclose(system.shared.cameras[:, : 6 * SHARED], cross, rtol=1e-5, atol=near)
    cross = (J.T @ other[:, 6 * M :]).reshape(SHARED, -1, 3).transpose(1, 0, 2)
    found = system.shared.points[layout.column, : 3 * SHARED]
    near = 1e-5 * np.abs(cross).max()
    np.testing.assert_allclose(found, cross.reshape(len(found), -1), rtol=1e-5, atol=near)


@pytest.mark.parametrize("aspect", [0.0, 0.02])
def test_a_step_solves_the_whole_system(aspect):
    """The bordered Eq. 9 and Eq. 10 together are the solution of the damped dense system."""
    problem = with_flow(make_scene(cameras=5, points=30, noise_px=1.0, visible=0.8).problem)
    uncertainty = CalibrationUncertainty(aspect=aspect, prior_px=30.0)
    damping, M = 1e-3, 5
    J = -np.concatenate(
        [numeric_jacobian(problem), -calibration_jacobian(problem, np.zeros(SHARED))[0]], axis=1
    )
    r = calibration_jacobian(problem, np.zeros(SHARED))[1]
    H, g = J.T @ J, J.T @ r
    n = len(H) - SHARED
    unknown = uncertainty.sigmas > 0.0
    prior = np.where(unknown, 30.0 / np.where(unknown, uncertainty.sigmas, 1.0), 0.0) ** 2
    H[n:, n:] += np.diag(prior)
    moving = np.concatenate([np.arange(n) >= 12, unknown])
    damped = H + damping * np.diag(np.diag(H))
    expected = np.zeros(len(H))
    expected[moving] = np.linalg.solve(damped[np.ix_(moving, moving)], g[moving])
    system = calibrating_system(problem, EXACT, uncertainty)
    start = system.start()
    trial = system.step(start, damping)
    assert trial is not None
    np.testing.assert_allclose(trial.calibration, expected[n:], rtol=1e-3, atol=1e-9)
    change = (trial.points - start.points)[:, system.layout.column].T
    np.testing.assert_allclose(change.reshape(-1), expected[6 * M : n], rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize(
    "truth",
    [
        (0.02, 0.0, 0.0, 0.0, 0.0, 0.0),
        (0.0, -0.05, 0.0, 0.0, 0.0, 0.0),
        (-0.03, 0.06, 0.0, 0.03, 0.0, 0.0),
        (0.01, -0.1, 0.05, -0.01, 0.02, -0.03),
    ],
)
def test_a_wrong_calibration_is_recovered_with_the_poses(truth):
    s, k1, k2, a, b, t = truth
    scene = make_scene(cameras=8, points=300, distortion=(k1, k2))
    # One who believes in another pinhole, and in no distortion.
    problem = with_lens(scene.problem, s=-s, a=-a, b=-b * np.exp(t), t=-t)
    result = solve_schur(problem, EXACT, uncertainty=FREE)
    found = result.correction
    np.testing.assert_allclose(np.delete(found, 3), truth, atol=2e-3)
    np.testing.assert_allclose(result.T_world_camera, scene.T_world_camera, atol=2e-3)
    blind = solve_schur(problem, EXACT)
    wrong = np.abs(blind.T_world_camera - scene.T_world_camera).max()
    assert np.abs(result.T_world_camera - scene.T_world_camera).max() < 0.2 * wrong


def test_the_cost_is_that_of_the_answer_with_its_lens():
    problem = undistorted(make_scene(cameras=6, points=200, distortion=(-0.05, 0.0)).problem)
    result = solve_schur(problem, EXACT, uncertainty=FREE)
    found = result.correction
    corrected = dataclasses.replace(
        with_lens(problem, *found[:3], *found[4:]),
        T_world_camera=result.T_world_camera,
        points_world=result.points_world,
    )
    again = solve_schur(corrected, EXACT.model_copy(update={"max_iterations": 1}))
    assert (np.diff(result.costs) <= 0.0).all()
    assert again.initial_cost == pytest.approx(result.final_cost, rel=1e-3, abs=1e-4)


def test_the_readout_of_a_rolling_shutter_is_found():
    scene = make_scene(cameras=6, points=200)
    problem = with_flow(scene.problem)
    moved = problem.points_px + np.float32(0.7) * problem.readout_flow
    problem = dataclasses.replace(problem, points_px=moved)
    result = solve_schur(problem, EXACT, uncertainty=FREE)
    found = result.correction
    np.testing.assert_allclose(found, (0.0, 0.0, 0.0, 0.7, 0.0, 0.0, 0.0), atol=2e-3)
    np.testing.assert_allclose(result.T_world_camera, scene.T_world_camera, atol=2e-3)
    problem = dataclasses.replace(problem, readout_flow=None)
    assert solve_schur(problem, EXACT, uncertainty=FREE).correction[3] == 0.0


def test_a_right_calibration_is_left_alone():
    problem = make_scene(cameras=8, points=1500, noise_px=0.3, outliers=0.03).problem
    found = solve_schur(problem, ROBUST, uncertainty=CalibrationUncertainty()).correction
    assert np.abs(found).max() < 2e-3


def test_the_prior_holds_what_the_motion_leaves_open():
    # One plane that the camera faces, and no rotation: the focal length only scales the depth.
    scene = make_scene(cameras=6, points=300, disturbance=0.0)
    T = np.tile(np.eye(4), (6, 1, 1))
    T[:, 0, 3] = 0.2 * np.arange(6)
    world = scene.points_world.copy()
    world[:, 2] = 5.0
    rng = np.random.default_rng(0)
    px = project(T, world, scene.problem.intrinsics)
    px += rng.normal(0.0, 0.3, px.shape)
    at = (scene.problem.camera_index, scene.problem.point_index)
    problem = dataclasses.replace(
        scene.problem, T_world_camera=T, points_world=world, points_px=px[at].astype(np.float32)
    )
    found = solve_schur(
        problem, EXACT, uncertainty=CalibrationUncertainty(focal=0.01, k1=0.0)
    ).correction
    assert abs(found[0]) < 2e-3
    assert not found[1:].any()


def test_sigmas_of_zero_give_what_is_found_without():
    problem = make_scene(noise_px=0.5).problem
    held = CalibrationUncertainty(focal=0.0, k1=0.0, k2=0.0)
    result = solve_schur(problem, EXACT, uncertainty=held)
    assert not result.correction.any()
    plain = solve_schur(problem, EXACT)
    assert result.final_cost == pytest.approx(plain.final_cost, rel=1e-6)
    np.testing.assert_allclose(result.T_world_camera, plain.T_world_camera, atol=1e-4)


def test_cameras_with_different_lenses_are_refused():
    problem = make_scene().problem
    intrinsics = problem.intrinsics.copy()
    intrinsics[1, 4] = 0.1
    with pytest.raises(ValueError, match="of all cameras"):
        solve_schur(dataclasses.replace(problem, intrinsics=intrinsics), EXACT, uncertainty=FREE)


@pytest.mark.parametrize(
    "correction",
    [
        (0.02, 0.0, 0.0, 0.0, 0.0, 0.0),
        (-0.01, -0.05, 0.0, 0.02, 0.0, 0.03),
        (0.0, 0.1, -0.03, 0.01, -0.02, -0.05),
    ],
)
def test_ideal_pixels_undo_the_correction(correction):
    camera = PinholeCamera(width=640, height=480, fx=500.0, fy=520.0, cx=320.0, cy=240.0)
    xy = np.random.default_rng(0).uniform((-0.6, -0.45), (0.6, 0.45), (200, 2))
    xy[0] = 0.0
    s, k1, k2, a, b, t = correction
    r2 = (xy**2).sum(axis=1, keepdims=True)
    seen = np.exp([s, s + t]) * (xy * (1.0 + k1 * r2 + k2 * r2**2) + (a, b))
    focal, centre = np.array([500.0, 520.0]), np.array([320.0, 240.0])
    px = (seen * focal + centre).astype(np.float32)
    ideal = ideal_pixels(px, camera, np.array([s, k1, k2, 0.0, a, b, t]))
    np.testing.assert_allclose(ideal, xy * focal + centre, atol=2e-3)


@pytest.mark.parametrize("lens", [(0.05, -0.02), (-0.3, 0.9)])
def test_an_ideal_pixel_is_the_same_alone_and_among_many(lens):
    camera = PinholeCamera(width=640, height=480, fx=500.0, fy=520.0, cx=320.0, cy=240.0)
    px = np.random.default_rng(0).uniform((-600, -450), (1240, 930), (300, 2)).astype(np.float32)
    correction = np.array([0.01, *lens, 0.0, 0.01, -0.02, 0.03])
    alone = [ideal_pixels(each, camera, correction) for each in px[:, None]]
    np.testing.assert_array_equal(ideal_pixels(px, camera, correction), np.concatenate(alone))


@pytest.mark.parametrize(
    ("name", "unknowns", "wrong"),
    [
        ("principal_point", slice(4, 6), {"a": 0.01, "b": -0.005}),
        ("aspect", slice(6, 7), {"t": 0.01}),
    ],
)
def test_the_gain_of_an_unknown_is_what_the_cost_falls_by_with_it(name, unknowns, wrong):
    held = FREE.model_copy(update={name: 0.0})
    believed = with_lens(make_scene(cameras=6, points=150, noise_px=0.3).problem, **wrong)
    found = solve_schur(believed, EXACT, uncertainty=held)
    free = solve_schur(believed, EXACT, uncertainty=FREE, start=found.correction)
    gain = system_at(believed, found, EXACT, FREE).gain_of_shared(unknowns)
    assert gain == pytest.approx(2.0 * (found.final_cost - free.final_cost), rel=0.1)
    assert system_at(believed, free, EXACT, FREE).gain_of_shared(unknowns) < 1e-3 * gain

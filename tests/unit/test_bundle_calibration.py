"""Self-calibration: its Jacobians, what it recovers, and what holds it."""

import dataclasses

import numpy as np
import pytest
from bundle_scene import make_scene, numeric_jacobian, project

from pliant.algorithms.bundle import (
    BundleParameters,
    CalibrationUncertainty,
    ideal_pixels,
    solve_calibrating,
    solve_schur,
)
from pliant.algorithms.bundle.calibration_kernels import PAIRS, UNKNOWNS, calibrated_system
from pliant.algorithms.bundle.cost import limits_of
from pliant.algorithms.bundle.layout import build_layout
from pliant.algorithms.camera import PinholeCamera

EXACT = BundleParameters(kernel_sigma_px=0.0, max_iterations=60, min_relative_decrease=1e-10)
ROBUST = BundleParameters(kernel_sigma_px=1.0, max_iterations=60, min_relative_decrease=1e-7)
FREE = CalibrationUncertainty(focal=1.0, k1=1.0, k2=1.0, readout=1.0, prior_px=1e-3)


def with_lens(problem, s=0.0, k1=0.0, k2=0.0):
    """The problem as a camera with this lens is believed to see it."""
    intrinsics = problem.intrinsics.copy()
    intrinsics[:, :2] *= np.exp(s)
    intrinsics[:, 4:] = k1, k2
    return dataclasses.replace(problem, intrinsics=intrinsics)


def undistorted(problem):
    """The problem as one believes in it who takes the lens for perfect."""
    return with_lens(problem)


def random_flow(problem):
    """What a rolling shutter would do, here at random: (2, M, N) px."""
    shape = (2, len(problem.T_world_camera), len(problem.points_world))
    return np.random.default_rng(1).normal(0.0, 3.0, shape).astype(np.float32)


@pytest.mark.parametrize("calibration", [(0.0, 0.0, 0.0, 0.0), (0.03, -0.2, 0.08, 0.4)])
def test_the_blocks_are_those_of_finite_differences(calibration):
    scene = make_scene(cameras=4, points=20, noise_px=1.0)
    problem = with_lens(scene.problem, *calibration[:3])
    layout = build_layout(problem)
    flow = random_flow(scene.problem)
    padded = np.zeros((2, *layout.u.shape), np.float32)
    padded[:, :, layout.column] = flow
    moved = np.float32(calibration[3]) * padded
    lenses = np.ascontiguousarray(problem.intrinsics[:, 4:])
    M, F = len(layout.cameras), int((layout.free >= 0).sum())
    fixed = np.zeros_like(layout.movable)  # no point is eliminated: the plain blocks stand in b
    S, b = np.zeros((6 * F + 6, 6 * F + 6)), np.zeros(6 * F + 6)
    normal, cross = np.zeros((M, 27)), np.zeros((M, 6 * UNKNOWNS))
    shared = np.zeros(PAIRS + UNKNOWNS)
    w = np.concatenate([layout.w, layout.w.max(axis=0, keepdims=True)])
    calibrated_system(
        layout.cameras, layout.pinholes, lenses, layout.free, layout.points, fixed,
        layout.u - moved[0], layout.v - moved[1], padded, w, layout.seen, limits_of(EXACT), 0.0,
        S, b, normal, cross, shared,
    )  # fmt: skip

    def predicted(q):
        lens = with_lens(scene.problem, *q[:3]).intrinsics
        px = project(problem.T_world_camera, problem.points_world, lens)
        return (px + q[3] * flow.transpose(1, 2, 0)).reshape(-1)

    step = 1e-6
    q = np.array(calibration)
    J = np.stack(
        [(predicted(q + d) - predicted(q - d)) / (2.0 * step) for d in step * np.eye(UNKNOWNS)],
        axis=1,
    )
    observed = problem.points_px.astype(np.float64).reshape(-1)
    H = J.T @ J
    np.testing.assert_allclose(shared[:PAIRS], H[np.tril_indices(UNKNOWNS)], rtol=1e-6)
    np.testing.assert_allclose(
        shared[PAIRS:], J.T @ (observed - predicted(q)), rtol=1e-5, atol=1e-3
    )
    B = -numeric_jacobian(problem)[:, : 6 * M]
    expected = (J.T @ B).reshape(UNKNOWNS, M, 6).transpose(1, 0, 2).reshape(M, 6 * UNKNOWNS)
    np.testing.assert_allclose(cross, expected, rtol=1e-5, atol=1e-5 * np.abs(expected).max())


@pytest.mark.parametrize(
    "truth", [(0.02, 0.0, 0.0), (0.0, -0.05, 0.0), (-0.03, 0.06, 0.0), (0.01, -0.1, 0.05)]
)
def test_a_wrong_calibration_is_recovered_with_the_poses(truth):
    s, k1, k2 = truth
    scene = make_scene(cameras=8, points=300, distortion=(k1, k2))
    # One who believes in a focal length that is too short by e^-s, and in no distortion.
    problem = with_lens(scene.problem, s=-s)
    result, found = solve_calibrating(problem, EXACT, FREE)
    np.testing.assert_allclose(found[:3], truth, atol=2e-3)
    np.testing.assert_allclose(result.T_world_camera, scene.T_world_camera, atol=2e-3)
    blind = solve_schur(problem, EXACT)
    wrong = np.abs(blind.T_world_camera - scene.T_world_camera).max()
    assert np.abs(result.T_world_camera - scene.T_world_camera).max() < 0.2 * wrong


def test_the_cost_is_that_of_the_answer_with_its_lens():
    problem = undistorted(make_scene(cameras=6, points=200, distortion=(-0.05, 0.0)).problem)
    result, found = solve_calibrating(problem, EXACT, FREE)
    corrected = dataclasses.replace(
        with_lens(problem, *found[:3]),
        T_world_camera=result.T_world_camera,
        points_world=result.points_world,
    )
    again = solve_schur(corrected, EXACT.model_copy(update={"max_iterations": 1}))
    assert (np.diff(result.costs) <= 0.0).all()
    assert again.initial_cost == pytest.approx(result.final_cost, rel=1e-3, abs=1e-4)


def test_the_readout_of_a_rolling_shutter_is_found():
    scene = make_scene(cameras=6, points=200)
    flow = random_flow(scene.problem)
    camera, point = scene.problem.camera_index, scene.problem.point_index
    px = scene.problem.points_px + np.float32(0.7) * flow[:, camera, point].T
    problem = dataclasses.replace(scene.problem, points_px=px)
    result, found = solve_calibrating(problem, EXACT, FREE, flow=flow)
    np.testing.assert_allclose(found, (0.0, 0.0, 0.0, 0.7), atol=2e-3)
    np.testing.assert_allclose(result.T_world_camera, scene.T_world_camera, atol=2e-3)
    _, without = solve_calibrating(problem, EXACT, FREE)
    assert without[3] == 0.0


def test_a_right_calibration_is_left_alone():
    problem = make_scene(cameras=8, points=1500, noise_px=0.3, outliers=0.03).problem
    _, found = solve_calibrating(problem, ROBUST, CalibrationUncertainty())
    assert np.abs(found).max() < 2e-3


def test_the_prior_holds_what_the_motion_cannot_tell():
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
    _, found = solve_calibrating(problem, EXACT, CalibrationUncertainty(focal=0.01, k1=0.0))
    assert abs(found[0]) < 2e-3
    assert found[1:].tolist() == [0.0, 0.0, 0.0]


def test_sigmas_of_zero_give_what_is_found_without():
    problem = make_scene(noise_px=0.5).problem
    held = CalibrationUncertainty(focal=0.0, k1=0.0, k2=0.0)
    result, found = solve_calibrating(problem, EXACT, held)
    assert found.tolist() == [0.0, 0.0, 0.0, 0.0]
    plain = solve_schur(problem, EXACT)
    assert result.final_cost == pytest.approx(plain.final_cost, rel=1e-6)
    np.testing.assert_allclose(result.T_world_camera, plain.T_world_camera, atol=1e-4)


def test_cameras_with_different_lenses_are_refused():
    problem = make_scene().problem
    intrinsics = problem.intrinsics.copy()
    intrinsics[1, 4] = 0.1
    with pytest.raises(ValueError, match="of all cameras"):
        solve_calibrating(dataclasses.replace(problem, intrinsics=intrinsics), EXACT, FREE)


@pytest.mark.parametrize("correction", [(0.02, 0.0, 0.0), (-0.01, -0.05, 0.0), (0.0, 0.1, -0.03)])
def test_ideal_pixels_undo_the_correction(correction):
    camera = PinholeCamera(width=640, height=480, fx=500.0, fy=520.0, cx=320.0, cy=240.0)
    xy = np.random.default_rng(0).uniform((-0.6, -0.45), (0.6, 0.45), (200, 2))
    xy[0] = 0.0
    s, k1, k2 = correction
    r2 = (xy**2).sum(axis=1, keepdims=True)
    seen = xy * np.exp(s) * (1.0 + k1 * r2 + k2 * r2**2)
    focal, centre = np.array([500.0, 520.0]), np.array([320.0, 240.0])
    px = (seen * focal + centre).astype(np.float32)
    u, v = ideal_pixels(px[:, 0], px[:, 1], camera, np.array(correction))
    np.testing.assert_allclose(np.stack([u, v], axis=1), xy * focal + centre, atol=2e-3)

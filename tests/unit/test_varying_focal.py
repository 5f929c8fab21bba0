"""A focal length of each camera: its Jacobian, what it recovers, and what holds it."""

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
)

from pliant.algorithms.slam.estimate.calibration import SharedCalibration
from pliant.algorithms.slam.estimate.packed_layout import build_packed_layout
from pliant.algorithms.slam.estimate.problem import SHARED, CalibrationUncertainty
from pliant.algorithms.slam.estimate.schur import SchurSystem, solve_schur
from pliant.algorithms.slam.estimate.varying_focal import FocalWalk, VaryingFocal

DAMPING = 1e-3


def zoomed(problem, z):
    """The problem as cameras with these log focal lengths are believed to see it."""
    intrinsics = problem.intrinsics.copy()
    intrinsics[:, :2] *= np.exp(z)[:, None]
    return dataclasses.replace(problem, intrinsics=intrinsics)


def walk(z, rate=0.1, spread=0.3):
    return FocalWalk(gaps_s=np.full(len(z) - 1, 0.4), rate=rate, spread=spread, start=z)


def dense_prior(z, prior_px):
    """H and -g of the walk and the spread."""
    M = len(z)
    D = np.diff(np.eye(M), axis=0)
    H = prior_px**2 * (D.T @ D / (0.1**2 * 0.4) + np.eye(M) / 0.3**2)
    return H, -H @ z


@pytest.mark.parametrize(("cameras", "aspect"), [(5, 0.0), (8, 0.0), (8, 0.02)])
def test_a_step_solves_the_whole_system(cameras, aspect):
    """Poses, shared calibration, focal lengths and points: as the damped dense system."""
    problem = with_flow(make_scene(cameras=cameras, points=30, noise_px=1.0, visible=0.8).problem)
    uncertainty = CalibrationUncertainty(aspect=aspect, prior_px=30.0)
    M, z = cameras, np.linspace(-0.02, 0.03, cameras) ** 2
    seen = zoomed(problem, z)

    def predicted(z):
        intrinsics = zoomed(problem, z).intrinsics
        px = project(problem.T_world_camera, problem.points_world, intrinsics)
        return px[problem.camera_index, problem.point_index].reshape(-1)

    of_focal = np.stack(
        [(predicted(z + d) - predicted(z - d)) / 2e-6 for d in 1e-6 * np.eye(M)], axis=1
    )
    shared, r = calibration_jacobian(seen, np.zeros(SHARED))
    J = np.concatenate([-numeric_jacobian(seen), shared, of_focal], axis=1)
    H, g = J.T @ J, J.T @ r
    n = len(H) - SHARED - M
    unknown = uncertainty.sigmas > 0.0
    precision = np.where(unknown, 30.0 / np.where(unknown, uncertainty.sigmas, 1.0), 0.0) ** 2
    H[n : n + SHARED, n : n + SHARED] += np.diag(precision)
    H_prior, g_prior = dense_prior(z, 30.0)
    H[n + SHARED :, n + SHARED :] += H_prior
    g[n + SHARED :] += g_prior
    moving = np.concatenate([np.arange(n) >= 12, unknown, np.ones(M, bool)])
    damped = H + DAMPING * np.diag(np.diag(H))
    expected = np.zeros(len(H))
    expected[moving] = np.linalg.solve(damped[np.ix_(moving, moving)], g[moving])

    layout = build_packed_layout(problem)
    calibration = SharedCalibration(layout, problem.intrinsics[:, 4:], uncertainty)
    system = SchurSystem(layout, EXACT, calibration, VaryingFocal(layout, walk(z), 30.0))
    start = system.start()
    trial = system.step(start, DAMPING)
    assert trial is not None
    near = {"rtol": 1e-3, "atol": 1e-7}
    np.testing.assert_allclose(trial.calibration, expected[n : n + SHARED], **near)
    np.testing.assert_allclose(trial.focal - z, expected[n + SHARED :], **near)
    change = (trial.points - start.points)[:, layout.column].T
    np.testing.assert_allclose(change.reshape(-1), expected[6 * M : n], rtol=1e-3, atol=1e-6)


def test_a_zoom_is_recovered_with_the_poses():
    scene = make_scene(cameras=9, points=400)
    z = np.linspace(0.0, 0.25, 9) ** 2
    px = project(scene.T_world_camera, scene.points_world, zoomed(scene.problem, z).intrinsics)
    at = (scene.problem.camera_index, scene.problem.point_index)
    problem = dataclasses.replace(scene.problem, points_px=px[at].astype(np.float32))
    found = solve_schur(problem, EXACT, uncertainty=FREE, walk=walk(np.zeros(9), 1e3, 1e3))
    focal = found.log_focal + found.correction[0]
    np.testing.assert_allclose(focal, z, atol=2e-3)
    np.testing.assert_allclose(found.T_world_camera, scene.T_world_camera, atol=2e-3)
    blind = solve_schur(problem, EXACT, uncertainty=FREE)
    wrong = np.abs(blind.T_world_camera - scene.T_world_camera).max()
    assert np.abs(found.T_world_camera - scene.T_world_camera).max() < 0.1 * wrong


def test_a_narrow_walk_keeps_one_focal_length():
    problem = make_scene(cameras=9, points=200, noise_px=0.5).problem
    found = solve_schur(problem, EXACT, uncertainty=FREE, walk=walk(np.zeros(9), 1e-10, 1e-10))
    alone = solve_schur(problem, EXACT, uncertainty=FREE)
    assert np.abs(found.log_focal).max() < 1e-7
    np.testing.assert_allclose(found.correction, alone.correction, rtol=1e-4, atol=1e-7)

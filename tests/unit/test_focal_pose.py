"""Pose and focal length of one frame: the Jacobian, what it recovers, and what holds it."""

import numpy as np
import pytest
from mapping_scene import CAMERA

from pliant.algorithms.geometry import inverse, so3_exp
from pliant.algorithms.slam.estimate.focal_pose import UNKNOWNS, linearise, refine_focal
from pliant.algorithms.slam.estimate.projection import move_cameras

CENTRE = (CAMERA.cx + 3.0, CAMERA.cy - 2.0)


def scene(d, depth=4.0, noise_px=0.0):
    """A pose, points about it and where an image magnified by e^d shows them."""
    generator = np.random.default_rng(3)
    T_world_camera = np.eye(4)
    T_world_camera[:3, :3] = so3_exp(np.array([0.1, -0.2, 0.05]))
    T_world_camera[:3, 3] = 0.3, -0.1, 0.2
    lateral = generator.uniform(-1.0, 1.0, (200, 2))
    local = np.column_stack([lateral, np.ones(200)]) * (2.0 + depth * generator.random((200, 1)))
    world = local @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
    px = CENTRE + np.exp(d) * (CAMERA.project(local) - CENTRE)
    return T_world_camera, world, px + noise_px * generator.normal(size=px.shape)


def test_the_jacobian_is_that_of_finite_differences():
    T_world_camera, world, px = scene(0.02)
    T, d, h = inverse(T_world_camera), 0.03, 1e-6
    motion = np.concatenate([T[:3, :3].ravel(), T[:3, 3]])
    lens = np.array([CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy, *CENTRE])

    def predicted(step):
        (moved,) = move_cameras(motion[None], step[None, :6])
        return px - linearise(moved, d + step[6], world, px, lens)[0]

    _, J = linearise(motion, d, world, px, lens)
    for k, step in enumerate(h * np.eye(UNKNOWNS)):
        expected = (predicted(step) - predicted(-step)) / (2.0 * h)
        np.testing.assert_allclose(J[:, :, k], expected, rtol=1e-5, atol=1e-3)


def test_it_finds_the_magnification_beside_a_wrong_pose_and_outliers():
    T_world_camera, world, px = scene(0.02, noise_px=0.3)
    px[::10] += 40.0
    start = T_world_camera.copy()
    start[:3, 3] += 0.02, -0.01, 0.02
    found, sigma = refine_focal(start, world, px, CAMERA, CENTRE, 0.1)
    assert abs(found - 0.02) < 4.0 * sigma
    assert sigma < 1e-3


def test_a_step_ahead_is_no_magnification_and_without_depth_the_prior_holds_it():
    T_world_camera, world, px = scene(0.0)
    ahead = T_world_camera.copy()
    ahead[:3, 3] -= 0.05 * T_world_camera[:3, 2]
    assert abs(refine_focal(ahead, world, px, CAMERA, CENTRE, 0.1)[0]) < 1e-5
    T_world_camera, world, px = scene(0.02, depth=0.0)
    start = T_world_camera.copy()
    assert abs(refine_focal(start, world, px, CAMERA, CENTRE, 1e-6)[0]) < 1e-5
    assert refine_focal(start, world[:0], px[:0], CAMERA, CENTRE, 0.1) == (0.0, np.inf)


def test_the_deviation_is_that_of_the_normal_equations_and_scaled_to_all_points():
    T_world_camera, world, px = scene(0.02, noise_px=0.3)
    d, sigma = refine_focal(T_world_camera, world, px, CAMERA, CENTRE, 0.1)
    T = inverse(T_world_camera)
    motion = np.concatenate([T[:3, :3].ravel(), T[:3, 3]])
    lens = np.array([CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy, *CENTRE])
    residuals, J = linearise(motion, d, world, px.astype(np.float64), lens)
    squared = (residuals**2).sum(axis=1)
    weights = 1.0 / (1.0 + squared / 4.0) ** 2
    normal = np.einsum("n,nka,nkb->ab", weights, J, J) + np.diag([0.0] * 6 + [100.0])
    expected = np.sqrt(np.median(squared) / 1.386 * np.linalg.inv(normal)[6, 6])
    np.testing.assert_allclose(sigma, expected, rtol=0.05)
    some, of_all = (
        refine_focal(T_world_camera, world[::2], px[::2], CAMERA, CENTRE, 0.1, every)[1]
        for every in (1, 2)
    )
    assert of_all == pytest.approx(some / np.sqrt(2.0))

"""Motion only and structure only refinement."""

import dataclasses

import numpy as np
import pytest
from bundle_scene import make_scene, move, project, sweep

from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.slam.estimate.pose import Correspondences, refine_pose
from pliant.algorithms.slam.estimate.problem import BundleParameters

CAMERA = PinholeCamera(width=640, height=480, fx=500.0, fy=520.0, cx=320.0, cy=240.0)
PARAMETERS = BundleParameters(kernel_sigma_px=2.0, min_relative_decrease=1e-8)


def observe(scene, m):
    return project(scene.T_world_camera, scene.points_world, scene.problem.intrinsics)[m]


def test_pose_is_found_among_outliers():
    scene = make_scene(points=400)
    px = observe(scene, 3).astype(np.float32)
    rng = np.random.default_rng(0)
    wrong = rng.random(400) < 0.25
    px[wrong] += rng.uniform(-80.0, 80.0, (int(wrong.sum()), 2)).astype(np.float32)
    px[5] = np.nan
    start = move(scene.T_world_camera[3], np.array([0.02, -0.01, 0.03, 0.004, -0.003, 0.002]))
    seen = Correspondences(scene.points_world, px)
    T, inliers, H, _ = refine_pose(start, seen, CAMERA, PARAMETERS, iterations=30)
    np.testing.assert_allclose(T, scene.T_world_camera[3], atol=1e-4)
    assert inliers.shape == (400,)
    assert not inliers[5]
    assert inliers[~wrong].sum() >= (~wrong).sum() - 1
    assert inliers[wrong].mean() < 0.05
    np.testing.assert_allclose(H, H.T)
    assert np.linalg.eigvalsh(H)[0] > 0.0


def test_pose_hessian_is_the_curvature_of_the_cost():
    scene = make_scene(points=200)
    px = observe(scene, 2)
    seen = Correspondences(scene.points_world, px.astype(np.float32))
    T, _, H, _ = refine_pose(
        scene.T_world_camera[2], seen, CAMERA, BundleParameters(kernel_sigma_px=0.0)
    )
    J = np.stack(
        [
            (
                project(move(T, e)[None], scene.points_world, scene.problem.intrinsics[:1])
                - project(move(T, -e)[None], scene.points_world, scene.problem.intrinsics[:1])
            ).reshape(-1)
            / 2e-6
            for e in 1e-6 * np.eye(6)
        ],
        axis=1,
    )
    np.testing.assert_allclose(H, J.T @ J, rtol=1e-3, atol=1e-4 * H.max())


def test_pose_without_observations_stays():
    scene = make_scene(points=10)
    start = scene.T_world_camera[3]
    for points, px in (
        (np.zeros((0, 3)), np.zeros((0, 2), np.float32)),
        (scene.points_world, np.full((10, 2), np.nan, np.float32)),
        (scene.points_world * (1.0, 1.0, -1.0), observe(scene, 3).astype(np.float32)),
    ):
        T, inliers, *_ = refine_pose(start, Correspondences(points, px), CAMERA, PARAMETERS)
        assert np.array_equal(T, start)
        assert not inliers.any()


@pytest.mark.parametrize("distortion", [(0.0, 0.0), (-0.2, 0.05)])
def test_points_are_triangulated_with_given_cameras(distortion):
    scene = make_scene(points=300, distortion=distortion)
    problem = dataclasses.replace(
        scene.problem,
        T_world_camera=scene.T_world_camera,
        fixed_cameras=np.ones(len(scene.T_world_camera), np.bool_),
    )
    result = sweep(problem, PARAMETERS.model_copy(update={"max_sweeps": 50}))
    assert np.array_equal(result.T_world_camera, scene.T_world_camera)
    error = np.linalg.norm(result.points_world - scene.points_world, axis=1)
    assert np.median(error) < 1e-3
    assert (error < 0.02).mean() > 0.98
    assert result.final_cost < 1e-3 * result.initial_cost

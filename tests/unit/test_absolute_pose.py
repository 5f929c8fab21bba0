"""P3P and RANSAC recover known poses, and survive degenerate input."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from pliant.algorithms.geometry import so3_exp
from pliant.algorithms.slam.estimate.absolute_pose import p3p, pose_by_ransac


def solutions(points, rays):
    R, t = np.empty((4, 3, 3)), np.empty((4, 3))
    count = p3p(points, rays, R, t)
    return [(R[i], t[i]) for i in range(count)]


@settings(max_examples=200)
@given(st.integers(0, 2**32 - 1))
def test_p3p_finds_the_true_pose(seed):
    generator = np.random.default_rng(seed)
    R, t = so3_exp(generator.normal(size=3)), generator.normal(size=3)
    depths = generator.uniform(1.0, 8.0, (3, 1))
    camera = np.column_stack([generator.uniform(-1.0, 1.0, (3, 2)), np.ones(3)]) * depths
    triangle = np.linalg.norm(np.cross(camera[1] - camera[0], camera[2] - camera[0]))
    if triangle < 0.1:
        return
    rays = camera / np.linalg.norm(camera, axis=1, keepdims=True)
    found = solutions((camera - t) @ R, rays)
    assert min(np.abs(Ri - R).max() + np.abs(ti - t).max() for Ri, ti in found) < 1e-3


def test_every_p3p_solution_is_a_rotation_that_reprojects():
    generator = np.random.default_rng(3)
    for _ in range(50):
        points = generator.uniform((-1.0, -1.0, 3.0), (1.0, 1.0, 5.0), (3, 3))
        rays = points / np.linalg.norm(points, axis=1, keepdims=True)
        for R, t in solutions(points, rays):
            np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)
            camera = points @ R.T + t
            again = camera / np.linalg.norm(camera, axis=1, keepdims=True)
            np.testing.assert_allclose(again, rays, atol=1e-5)


def test_p3p_has_no_solution_for_a_line():
    line = np.array([[0.0, 0.0, 4.0], [1.0, 0.0, 4.0], [2.0, 0.0, 4.0]])
    assert solutions(line, line / np.linalg.norm(line, axis=1, keepdims=True)) == []
    assert solutions(np.ones((3, 3)), np.tile([0.0, 0.0, 1.0], (3, 1))) == []


def scene(outliers):
    generator = np.random.default_rng(5)
    R, t = so3_exp(np.array([0.2, -0.1, 0.3])), np.array([0.3, 0.2, -0.5])
    points = generator.uniform((-2.0, -2.0, 4.0), (2.0, 2.0, 8.0), (600, 3))
    camera = points @ R.T + t
    points_n = camera[:, :2] / camera[:, 2:]
    points_n[: int(outliers * 600)] = generator.uniform(-0.5, 0.5, (int(outliers * 600), 2))
    return R, t, points, points_n


def test_ransac_survives_60_percent_outliers_and_repeats_itself():
    R, t, points, points_n = scene(0.6)
    first = pose_by_ransac(points, points_n, np.random.default_rng(1), gate=0.004, samples=300)
    again = pose_by_ransac(points, points_n, np.random.default_rng(1), gate=0.004, samples=300)
    assert first is not None
    assert again is not None
    T_world_camera, inliers = first
    assert again[0].tobytes() == T_world_camera.tobytes()
    np.testing.assert_allclose(T_world_camera[:3, :3], R.T, atol=1e-6)
    np.testing.assert_allclose(T_world_camera[:3, 3], -R.T @ t, atol=1e-6)
    assert inliers[360:].all()
    assert inliers[:360].mean() < 0.05


def test_ransac_returns_none_for_too_few_points():
    _, _, points, points_n = scene(0.0)
    generator = np.random.default_rng(0)
    assert pose_by_ransac(points[:3], points_n[:3], generator, gate=0.01, samples=10) is None
    same = np.zeros((10, 3))
    assert pose_by_ransac(same, points_n[:10], generator, gate=0.01, samples=10) is None

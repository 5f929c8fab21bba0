"""Relative poses of two views with known answers."""

import cv2
import numpy as np
import pytest

from pliant.algorithms.geometry import hat, so3_exp, so3_log
from pliant.algorithms.slam.estimate.epipolar import (
    decompose_essential,
    likely_pose,
    parallax,
    rays,
    relative_poses,
    rotation_between,
    two_view_depths,
)

R_B_A = so3_exp(np.array([0.01, 0.1, -0.03]))
T_B_A = np.array([0.4, -0.1, 0.2])


def two_views(outliers=0, noise=0.0):
    generator = np.random.default_rng(2)
    a = generator.uniform((-2.0, -2.0, 3.0), (2.0, 2.0, 8.0), (500, 3))
    b = a @ R_B_A.T + T_B_A
    points_a, points_b = a[:, :2] / a[:, 2:], b[:, :2] / b[:, 2:]
    points_b += generator.normal(0.0, noise, points_b.shape)
    points_b[:outliers] = generator.uniform(-0.6, 0.6, (outliers, 2))
    return a, b, points_a, points_b


def test_relative_pose_is_found_among_outliers():
    _, _, points_a, points_b = two_views(outliers=150, noise=0.0002)
    found = relative_poses(points_a, points_b, gate=0.002)[0]
    assert np.degrees(np.linalg.norm(so3_log(found.T_b_a[:3, :3] @ R_B_A.T))) < 0.2
    direction = T_B_A / np.linalg.norm(T_B_A)
    assert found.T_b_a[:3, 3] @ direction > np.cos(np.radians(2.0))
    assert found.inliers[150:].mean() > 0.95


def test_relative_pose_does_not_depend_on_the_random_numbers_of_opencv():
    _, _, points_a, points_b = two_views(outliers=150, noise=0.0002)
    answers = set()
    for seed in range(3):
        cv2.setRNGSeed(seed)
        cv2.randu(np.zeros(100), 0, 1)
        found = relative_poses(points_a, points_b, gate=0.002)
        answers.add(b"".join(each.T_b_a.tobytes() for each in found))
    assert len(answers) == 1


def test_relative_pose_needs_eight_points():
    _, _, points_a, points_b = two_views()
    assert relative_poses(points_a[:7], points_b[:7], gate=0.01) == []
    assert likely_pose(points_a[:7], points_b[:7], gate=0.01) is None


def test_a_motion_estimated_from_some_points_is_verified_by_all():
    """Ten times as many points as motions are found by."""
    _, _, points_a, points_b = two_views(outliers=150, noise=0.0002)
    found = relative_poses(np.tile(points_a, (20, 1)), np.tile(points_b, (20, 1)), gate=0.002)[0]
    assert len(found.inliers) == 20 * len(points_a)
    assert found.inliers.reshape(20, -1)[:, 150:].mean() > 0.95


def test_a_likely_pose_has_about_the_parallax_of_the_best():
    _, _, points_a, points_b = two_views(outliers=150, noise=0.0002)
    likely = likely_pose(points_a, points_b, gate=0.002)
    assert likely is not None
    best = relative_poses(points_a, points_b, gate=0.002)[0]
    angles = [np.median(each.parallax_rad[each.inliers]) for each in (likely, best)]
    assert angles[0] == pytest.approx(angles[1], rel=0.05)


def test_rotations_of_several_pairs_are_those_of_each():
    _, _, points_a, points_b = two_views(outliers=150, noise=0.0002)
    pairs_a, pairs_b = points_a.reshape(5, 100, 2), points_b.reshape(5, 100, 2)
    rotations, residuals = rotation_between(pairs_a, pairs_b, scale=0.002)
    for k in range(5):
        rotation, residual = rotation_between(pairs_a[k], pairs_b[k], scale=0.002)
        np.testing.assert_allclose(rotations[k], rotation, atol=1e-12)
        np.testing.assert_allclose(residuals[k], residual, atol=1e-12)


def test_a_plane_leaves_two_motions():
    """One homography, two motions that explain every point and see it before both cameras."""
    generator = np.random.default_rng(2)
    a = generator.uniform((-1.0, -1.0, 4.0), (1.0, 1.0, 4.0), (300, 3))
    a[:, 2] += 0.4 * a[:, 0]
    b = a @ R_B_A.T + T_B_A
    points_a, points_b = a[:, :2] / a[:, 2:], b[:, :2] / b[:, 2:]
    points_b += generator.normal(0.0, 0.0001, points_b.shape)
    found = relative_poses(points_a, points_b, gate=0.002)
    fitting = [each.T_b_a for each in found if each.inliers.mean() > 0.99]
    errors = [np.linalg.norm(so3_log(T[:3, :3] @ R_B_A.T)) for T in fitting]
    assert min(errors) < np.radians(0.5)
    assert max(errors) > np.radians(2.0)


def test_one_of_four_decompositions_is_true():
    E = hat(T_B_A) @ R_B_A
    direction = T_B_A / np.linalg.norm(T_B_A)
    errors = [
        np.abs(T[:3, :3] - R_B_A).max() + np.abs(T[:3, 3] - direction).max()
        for T in decompose_essential(E)
    ]
    assert sorted(errors)[0] < 1e-9
    assert sorted(errors)[1] > 0.1


def test_depths_are_lengths_along_the_rays():
    a, b, points_a, points_b = two_views()
    T_b_a = np.eye(4)
    T_b_a[:3, :3], T_b_a[:3, 3] = R_B_A, T_B_A
    length_a, length_b = two_view_depths(T_b_a, rays(points_a), rays(points_b))
    angles = parallax(T_b_a, rays(points_a), rays(points_b))
    np.testing.assert_allclose(length_a, np.linalg.norm(a, axis=1), rtol=1e-9)
    np.testing.assert_allclose(length_b, np.linalg.norm(b, axis=1), rtol=1e-9)
    assert ((angles > 0.0) & (angles < 0.3)).all()


def test_parallel_rays_have_no_depth():
    ahead = np.tile([0.0, 0.0, 1.0], (3, 1))
    T_b_a = np.eye(4)
    T_b_a[0, 3] = 1.0
    length_a, length_b = two_view_depths(T_b_a, ahead, ahead)
    assert not length_a.any()
    assert not length_b.any()
    assert not parallax(T_b_a, ahead, ahead).any()


def test_a_pure_rotation_leaves_no_residual_and_a_translation_does():
    a, _, points_a, points_b = two_views()
    turned = a @ R_B_A.T
    rotation, residuals = rotation_between(points_a, turned[:, :2] / turned[:, 2:], scale=0.002)
    np.testing.assert_allclose(rotation, R_B_A, atol=1e-12)
    assert residuals.max() < 1e-9
    _, residuals = rotation_between(points_a, points_b, scale=0.002)
    assert np.median(residuals) > 0.005


def test_rotation_withstands_outliers():
    a, _, points_a, _ = two_views()
    turned = a @ R_B_A.T
    points_b = turned[:, :2] / turned[:, 2:]
    points_b[:120] += 0.2
    rotation, _ = rotation_between(points_a, points_b, scale=0.002)
    assert np.degrees(np.linalg.norm(so3_log(rotation @ R_B_A.T))) == pytest.approx(0.0, abs=0.1)

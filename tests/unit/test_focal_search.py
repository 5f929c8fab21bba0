"""Of a plane, an adjustment keeps whatever focal length it begins with, unless that is searched."""

from dataclasses import replace

import numpy as np
import pytest
from mapping_scene import CAMERA

from pliant.algorithms.geometry import inverse, transform
from pliant.algorithms.slam.calibration.focal_search import best_along_focal
from pliant.algorithms.slam.estimate.problem import (
    BundleParameters,
    BundleProblem,
    CalibrationUncertainty,
    shared_intrinsics,
)
from pliant.algorithms.slam.estimate.schur import solve_schur

UNKNOWN = CalibrationUncertainty(focal=0.3, k1=0.0, k2=0.0, readout=0.0)
ITERATIONS = BundleParameters(max_iterations=20)
CAMERAS, POINTS = 8, 400


def round_a_plane(k):
    """A pose that looks down on the middle of the plane z = 0, a little farther round each time."""
    angle, height = 0.06 * k, np.radians(50.0 + 15.0 * np.sin(0.2 * k))
    flat = np.cos(height)
    centre = np.array([flat * np.cos(angle), flat * np.sin(angle), -np.sin(height)])
    ahead = -centre
    right = np.cross(ahead, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    down = np.cross(ahead, right)
    sign = 1.0 if down[2] > 0.0 else -1.0
    T = np.eye(4)
    T[:3, :3] = np.stack([sign * right, sign * down, ahead], axis=1)
    T[:3, 3] = centre
    return T


@pytest.fixture(scope="module")
def problem():
    generator = np.random.default_rng(0)
    points = np.zeros((POINTS, 3))
    points[:, :2] = generator.uniform(-0.3, 0.3, (POINTS, 2))
    T = np.array([round_a_plane(k) for k in range(CAMERAS)])
    px = np.concatenate([CAMERA.project(transform(inverse(each), points)) for each in T])
    return BundleProblem(
        T_world_camera=T,
        points_world=points,
        camera_index=np.repeat(np.arange(CAMERAS, dtype=np.int32), POINTS),
        point_index=np.tile(np.arange(POINTS, dtype=np.int32), CAMERAS),
        points_px=(px + generator.normal(0.0, 0.1, px.shape)).astype(np.float32),
        intrinsics=shared_intrinsics(CAMERA, CAMERAS),
        fixed_cameras=np.arange(CAMERAS) == 0,
    )


def made_with(problem, s):
    """The map as it comes out with that focal length, in logarithm of its share of the true one."""
    wrong = replace(problem, intrinsics=problem.intrinsics * np.exp([s, s, 0.0, 0.0, 0.0, 0.0]))
    found = solve_schur(wrong, BundleParameters(max_iterations=200))
    return replace(problem, T_world_camera=found.T_world_camera, points_world=found.points_world)


def free(problem, start):
    return solve_schur(problem, ITERATIONS, uncertainty=UNKNOWN, start=start, doubled=True)


@pytest.mark.parametrize("s", [-0.7, -0.4, 0.5])
def test_the_focal_length_of_a_map_of_a_plane_is_found_from_afar(problem, s):
    start = np.array([s, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    bent = made_with(problem, s)
    stuck = free(bent, start)
    found = free(*best_along_focal(bent, ITERATIONS, UNKNOWN, start))
    assert abs(found.correction[0]) < 0.02
    assert abs(stuck.correction[0]) > 0.1
    assert found.final_cost < stuck.final_cost


def test_a_map_that_is_right_stays(problem):
    searched, start = best_along_focal(problem, ITERATIONS, UNKNOWN, np.zeros(7))
    assert start[0] == 0.0
    moved = searched.T_world_camera[:, :3, 3] - problem.T_world_camera[:, :3, 3]
    assert np.abs(moved).max() < 0.01

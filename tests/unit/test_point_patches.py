"""Which points of two maps look alike, seen from elsewhere, turned, closer."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from mapping_scene import looking

from pliant.algorithms.geometry import move_by_similarity, transform
from pliant.algorithms.slam.locate.point_patches import look_alike
from pliant.algorithms.slam.locate.reacquisition import cut_patches
from pliant.algorithms.slam.map.keyframe import Keyframe
from pliant.algorithms.slam.map.landmarks import Landmarks

COUNT, SIDE, FOCAL_PX = 40, 400, 400.0
MIN_ZNCC = 0.8


@pytest.fixture(scope="module")
def wall():
    """A wall 2 units ahead, at 200 px a unit from there, and places on it, in units."""
    generator = np.random.default_rng(3)
    noise = generator.uniform(0.0, 255.0, (SIDE, SIDE)).astype(np.float32)
    picture = cv2.GaussianBlur(noise, (0, 0), 2.0)
    picture = 128.0 + (picture - picture.mean()) * 40.0 / picture.std()
    places = generator.uniform(-0.4, 0.4, (COUNT, 2))
    return np.clip(picture, 0, 255), np.column_stack([places, np.full(COUNT, 2.0)])


def seen_from(T, wall, points, world, id=0):
    """A keyframe of the wall at T, as a map has it whose world lies by a similarity to ours."""
    picture, places = wall
    to_wall = np.array([[0.005, 0.0, -1.0], [0.0, 0.005, -1.0], [0.0, 0.0, 1.0]])
    plane = np.column_stack([*np.eye(3)[:2], (0.0, 0.0, 2.0) - T[:3, 3]])
    K = np.array([[FOCAL_PX, 0.0, SIDE / 2], [0.0, FOCAL_PX, SIDE / 2], [0.0, 0.0, 1.0]])
    H = K @ T[:3, :3].T @ plane @ to_wall
    grey = cv2.warpPerspective(picture, H, (SIDE, SIDE)).astype(np.uint8)
    here = (places - T[:3, 3]) @ T[:3, :3] @ K.T
    points_px = (here[:, :2] / here[:, 2:]).astype(np.float32)
    rows = points.allocate(COUNT)
    points.promote(rows)
    points.xyz[rows] = transform(world, places)
    cut_patches(grey, points_px, rows, points.patches)
    points.patch_keyframe[rows] = id
    return Keyframe(
        id=id, frame=0, segment=0, T_world_camera=move_by_similarity(world, T), rows=rows,
        points_px=points_px, rolled_px=np.zeros((COUNT, 2), np.float32),
    )  # fmt: skip


AHEAD = looking((0.0, 0.0, 0.0))
WORLD = looking((0.3, -1.0, 0.2), (0.3, -0.2, 0.1)) @ np.diag([1.7, 1.7, 1.7, 1.0])


@pytest.mark.parametrize(
    "there",
    [
        AHEAD,
        looking((0.05, -0.1, 0.0), (0.1, -0.1, 0.0)),
        looking((0.0, 0.0, 0.0), (0.0, 0.0, 0.8)),
        looking((0.0, 0.0, 0.0), (0.0, 0.0, np.pi)),
        looking((0.0, 0.0, 0.7)),
        looking((0.0, 0.0, -1.5), (0.0, 0.0, -0.5)),
    ],
    ids=["the same", "aside", "turned", "upside down", "closer", "far and turned"],
)
def test_what_is_the_same_looks_alike_from_elsewhere(wall, there):
    points = Landmarks()
    old = seen_from(AHEAD, wall, points, np.eye(4))
    new = seen_from(there, wall, points, WORLD)
    S_old_new = np.linalg.inv(WORLD)

    def share(of_new):
        rows = np.column_stack([old.rows, of_new])
        return look_alike(S_old_new, rows, [old], [new], points, MIN_ZNCC).mean()

    assert share(new.rows) > 0.9
    assert share(np.roll(new.rows, 1)) < 0.1


def test_a_patch_is_as_the_last_keyframe_saw_it_that_sees_the_point(wall):
    """Also where the place is an earlier one."""
    points, closer = Landmarks(), looking((0.0, 0.0, 0.9), (0.0, 0.0, 0.6))
    first = seen_from(AHEAD, wall, points, np.eye(4))
    seen = seen_from(closer, wall, points, np.eye(4), id=1)
    last = replace(seen, rows=first.rows)
    points.patches[first.rows] = points.patches[seen.rows]
    points.patch_keyframe[first.rows] = seen.id
    new = seen_from(AHEAD, wall, points, WORLD)
    rows = np.column_stack([first.rows, new.rows])
    S_old_new = np.linalg.inv(WORLD)
    found = look_alike(S_old_new, rows, [first, last], [new], points, MIN_ZNCC)
    assert found.mean() > 0.9
    assert look_alike(S_old_new, rows, [first], [new], points, MIN_ZNCC).mean() < 0.5


def test_flat_patches_and_those_at_the_border_match_nothing(wall):
    points = Landmarks()
    old = seen_from(AHEAD, wall, points, np.eye(4))
    rows = np.column_stack([old.rows, old.rows])
    assert look_alike(np.eye(4), rows, [old], [old], points, MIN_ZNCC).all()
    points.patches[old.rows] = 0
    assert not look_alike(np.eye(4), rows, [old], [old], points, MIN_ZNCC).any()


def test_a_wrong_scale_matters_not_where_both_cameras_stand_at_one_place(wall):
    points = Landmarks()
    old, new = (seen_from(AHEAD, wall, points, world) for world in (np.eye(4), WORLD))
    S_old_new = np.linalg.inv(WORLD)
    at = WORLD[:3, 3]  # of the new camera
    wrong = np.eye(4)
    wrong[:3, :3] *= 20.0
    wrong[:3, 3] = at - 20.0 * at
    rows = np.column_stack([old.rows, new.rows])
    assert look_alike(S_old_new @ wrong, rows, [old], [new], points, MIN_ZNCC).mean() > 0.9

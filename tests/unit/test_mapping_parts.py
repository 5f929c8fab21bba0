"""The parts of the mapper, each alone: rows, links, grid, patches, re-acquisition, errors."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mapping_scene import CAMERA, Scene, looking

from pliant.algorithms.geometry import inverse, lengths, transform
from pliant.algorithms.slam.estimate.observation_table import (
    count_in_view,
    forget_outliers,
    reprojection_errors,
)
from pliant.algorithms.slam.estimate.pose import Correspondences
from pliant.algorithms.slam.locate.localisation import locate, refine
from pliant.algorithms.slam.locate.reacquisition import MaximaGrid, cut_patches, reacquire
from pliant.algorithms.slam.map.covisibility import (
    marks_fewer,
    missing_rows,
    near_keyframes,
    rows_of,
)
from pliant.algorithms.slam.map.keyframe import Keyframe
from pliant.algorithms.slam.map.landmarks import (
    CANDIDATE,
    FREE,
    MAPPED,
    MERGED,
    PATCH_SIDE,
    Landmarks,
)
from pliant.algorithms.slam.map.track_links import UNLINKED, TrackLinks
from pliant.algorithms.slam.parameters import (
    LocalisationParameters,
    ReacquisitionParameters,
)


def test_lengths_have_the_bytes_of_the_norm():
    vectors = (
        np.random.default_rng(0).normal(size=(5000, 3)) * np.geomspace(1e-9, 1e9, 5000)[:, None]
    )
    assert lengths(vectors).tobytes() == np.linalg.norm(vectors, axis=1).tobytes()


def test_reused_rows_are_as_clear_as_new_ones():
    points = Landmarks()
    rows = points.allocate(3, keyframe=1)
    points.place(rows, np.ones((3, 3)), 0.5, 0.1)
    points.kappas[rows], points.colours[rows], points.misses[rows] = 7.0, 200, 9
    points.free(rows[:2])
    again = points.allocate(3, keyframe=2)
    assert again.tolist() == [0, 1, 3]
    for values in (v for v in vars(points).values() if isinstance(v, np.ndarray) and v.size):
        np.testing.assert_array_equal(
            values[0], values[3] - 3 if values is points.alias else values[3]
        )


def test_rows_are_reused_and_ids_never():
    points = Landmarks()
    first = points.allocate(3)
    points.promote(first)
    points.free(first[1:2])
    assert points.state[first].tolist() == [MAPPED, FREE, MAPPED]
    second = points.allocate(2)
    assert second.tolist() == [1, 3]
    assert points.state[second].tolist() == [CANDIDATE, CANDIDATE]
    assert points.ids[second].tolist() == [-1, -1]
    points.promote(second)
    assert points.ids[[0, 1, 2, 3]].tolist() == [0, 3, 2, 4]


def test_rows_grow_and_keep_what_they_hold():
    points = Landmarks()
    rows = points.allocate(10)
    points.xyz[rows] = np.arange(30).reshape(10, 3)
    more = points.allocate(5000)
    np.testing.assert_array_equal(points.xyz[:10], np.arange(30).reshape(10, 3))
    assert not points.xyz[more].any()
    assert (points.alias[more] == more).all()


def test_of_a_row_merged_twice_the_last_holds_and_it_goes_once():
    points = Landmarks()
    rows = points.allocate(4)
    points.promote(rows)
    points.first_keyframe[rows] = [5, 3, 9, 1]
    points.merge(rows[[1, 0, 1]], rows[[2, 3, 0]])
    assert points.alias[rows].tolist() == [3, 0, 2, 3]
    assert points.state[rows].tolist() == [MERGED, MERGED, MAPPED, MAPPED]
    gone, ids = points.take_removed()
    assert sorted(zip(gone.tolist(), ids.tolist())) == [(0, 0), (1, 1)]
    assert points.first_keyframe[rows].tolist() == [3, 3, 3, 1]


def test_observations_of_merged_rows_become_one():
    points = Landmarks()
    points.allocate(6)
    points.alias[5] = 2
    keyframe = Keyframe(
        id=0, frame=0, segment=0, T_world_camera=np.eye(4),
        rows=np.array([1, 2, 5], np.int32),
        points_px=np.array([[1, 1], [2, 2], [5, 5]], np.float32),
        rolled_px=np.array([[0, 1], [0, 2], [0, 5]], np.float32),
    )  # fmt: skip
    keyframe.follow_aliases(points)
    assert keyframe.rows.tolist() == [1, 2]
    assert keyframe.points_px.tolist() == [[1, 1], [2, 2]]
    assert keyframe.rolled_px.tolist() == [[0, 1], [0, 2]]


@settings(max_examples=50)
@given(seed=st.integers(0, 2**31), share=st.floats(0.0, 1.0))
def test_merged_rows_are_followed_as_numpy_would(seed, share):
    rng = np.random.default_rng(seed)
    points = Landmarks()
    points.allocate(40)
    merged = rng.random(40) < share
    merged[7] = False
    points.alias[:40][merged] = rng.choice(np.flatnonzero(~merged), int(merged.sum()))
    rows = np.flatnonzero(rng.random(40) < 0.7).astype(np.int32)
    px = rng.normal(size=(len(rows), 2)).astype(np.float32)
    keyframe = Keyframe(
        id=0, frame=0, segment=0, T_world_camera=np.eye(4), rows=rows, points_px=px,
        rolled_px=2.0 * px,
    )  # fmt: skip
    keyframe.follow_aliases(points)
    expected, first = np.unique(points.alias[rows], return_index=True)
    np.testing.assert_array_equal(keyframe.rows, expected)
    np.testing.assert_array_equal(keyframe.points_px, px[first])
    np.testing.assert_array_equal(keyframe.rolled_px, 2.0 * px[first])


@settings(max_examples=50)
@given(st.lists(st.sets(st.integers(0, 40)), min_size=1, max_size=6))
def test_links_follow_living_tracks_and_drop_dead_ones(frames):
    links, points, expected = TrackLinks(), Landmarks(), {}
    points.free(points.allocate(7 * 41))  # tracks come back to nothing
    for alive in frames:
        ids = np.array(sorted(alive), np.int64)
        links.follow(ids, points)
        expected = {i: expected.get(i, UNLINKED) for i in ids.tolist()}
        assert links.rows.tolist() == [expected[i] for i in ids.tolist()]
        for k, i in enumerate(ids.tolist()):
            links.rows[k] = expected[i] = 7 * i


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1), st.floats(0.5, 40.0))
def test_grid_finds_the_nearest_maximum(seed, radius):
    generator = np.random.default_rng(seed)
    maxima = np.column_stack(
        [generator.uniform(0, 99, 200), generator.uniform(0, 59, 200), np.ones(200)]
    ).astype(np.float32)
    points = generator.uniform((0, 0), (99, 59), (50, 2)).astype(np.float32)
    found = MaximaGrid.build(maxima, 100, 60, radius).nearest(points, radius)
    distance = np.linalg.norm(points[:, None] - maxima[None, :, :2], axis=2)
    nearest = distance.argmin(axis=1)
    expected = np.where(distance.min(axis=1) < radius, nearest, -1)
    np.testing.assert_array_equal(found, expected)


def test_grid_takes_no_maxima_at_all():
    grid = MaximaGrid.build(np.zeros((0, 3), np.float32), 100, 60, 3.0)
    assert grid.nearest(np.array([[5.0, 5.0]], np.float32), 3.0).tolist() == [-1]


def texture(seed=0):
    noise = np.random.default_rng(seed).uniform(0, 255, (480, 640)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.0)
    return cv2.normalize(smooth, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


def mapped(xyz, grey):
    """Points at (N, 3), with the patches that an image shows of them."""
    points = Landmarks()
    rows = points.allocate(len(xyz))
    points.xyz[rows], points.kappas[rows] = xyz, 10.0
    cut_patches(grey, CAMERA.project(np.abs(xyz)).astype(np.float32), rows, points.patches)
    return rows, points


def looked_for(shift, grey, min_zncc=0.8, kappa=10.0, kept=None):
    """Re-acquire one point at the image's centre whose maximum is off by ``shift`` px.

    kept: the image that the patch of the point is from, this one where it is None."""
    rows, points = mapped(np.array([[0.0, 0.0, 4.0]]), grey if kept is None else kept)
    maxima = np.array([[CAMERA.cx + shift, CAMERA.cy, kappa]], np.float32)
    parameters = ReacquisitionParameters(min_zncc=min_zncc)
    return reacquire(np.eye(4), rows, points, maxima, maxima, grey, CAMERA, parameters)


def test_reacquisition_refines_the_maximum_by_the_patch():
    found = looked_for(0.7, texture())
    assert found.rows.tolist() == [0]
    np.testing.assert_allclose(found.points_px[0], (CAMERA.cx, CAMERA.cy), atol=0.1)


def test_reacquisition_looks_where_the_image_shows_a_maximum():
    """A lens, or a rolling shutter, has moved the image, and nothing has moved it back."""
    rows, points = mapped(np.array([[0.0, 0.0, 4.0]]), texture())
    grey = np.roll(texture(), (2, 7), axis=(0, 1))
    maxima = np.array([[CAMERA.cx + 0.7, CAMERA.cy, 10.0]], np.float32)
    seen = maxima + np.array([7.0, 2.0, 0.0], np.float32)
    parameters = ReacquisitionParameters()
    found = reacquire(np.eye(4), rows, points, maxima, seen, grey, CAMERA, parameters)
    np.testing.assert_allclose(found.points_px, [(CAMERA.cx, CAMERA.cy)], atol=0.1)
    assert (
        len(reacquire(np.eye(4), rows, points, maxima, maxima, grey, CAMERA, parameters).rows) == 0
    )


@pytest.mark.parametrize("gain", [0.5, 0.7, 1.26, 1.5])
def test_reacquisition_does_not_depend_on_exposure(gain):
    seen = (texture() * 0.6).astype(np.uint8)
    now = (texture() * 0.6 * gain).astype(np.uint8)
    found = looked_for(0.7, now, kappa=10.0 * gain**3, kept=seen)
    np.testing.assert_allclose(found.points_px, [(CAMERA.cx, CAMERA.cy)], atol=0.1)


def test_reacquisition_refuses_far_maxima_the_other_sign_and_other_patches():
    assert len(looked_for(3.0, texture()).rows) == 0
    assert len(looked_for(0.5, texture(), kappa=-10.0).rows) == 0
    assert len(looked_for(0.5, texture(1), kept=texture()).rows) == 0
    assert len(looked_for(0.5, np.full((480, 640), 80, np.uint8)).rows) == 0
    lost = looked_for(3.0, texture())
    assert lost.visible.tolist() == [0]


def test_reacquisition_gives_a_maximum_to_one_point_only():
    grey = texture()
    xyz = np.array([[0.0, 0.0, 4.0], [0.001, 0.0, 4.0], [0.0, 0.0, -4.0]])
    rows, points = mapped(xyz, grey)
    maxima = np.array([[CAMERA.cx, CAMERA.cy, 10.0]], np.float32)
    found = reacquire(
        np.eye(4), rows, points, maxima, maxima, grey, CAMERA, ReacquisitionParameters()
    )
    assert found.rows.tolist() == [0]
    assert found.visible.tolist() == [0, 1]


def test_patches_at_the_border_stay_empty():
    patches = np.ones((2, PATCH_SIDE, PATCH_SIDE), np.uint8)
    px = np.array([[2.0, 100.0], [637.5, 100.0]], np.float32)
    cut_patches(texture(), px, np.arange(2, dtype=np.int32), patches)
    assert not patches.any()


def test_errors_are_distances_to_projections():
    scene = Scene.box(50)
    poses = np.array([looking((0.1, 0.0, 0.0)), looking((0.4, 0.1, 0.2), (0.0, 0.05, 0.0))])
    px = np.array([CAMERA.project(transform(inverse(T), scene.points)) for T in poses])
    observed = (px + np.array([3.0, 4.0])).astype(np.float32)
    errors = reprojection_errors(poses[0], scene.points, observed[0], CAMERA)
    np.testing.assert_allclose(errors, 5.0, atol=1e-3)
    behind = reprojection_errors(np.eye(4), np.array([[0.0, 0.0, -1.0]]), observed[0, :1], CAMERA)
    assert np.isinf(behind[0])


def test_points_in_view_are_those_of_projections():
    generator = np.random.default_rng(2)
    xyz = generator.uniform((-6.0, -6.0, -4.0), (6.0, 6.0, 8.0), (900, 3))
    rows = generator.choice(900, 400, replace=False).astype(np.int32)
    T_camera_world = inverse(looking((0.3, -0.2, 0.5), (0.1, -0.3, 0.05)))
    lens = np.array([CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy], np.float32)
    here = transform(T_camera_world, xyz[rows])
    px = CAMERA.project(here[here[:, 2] > 0.0])
    expected = ((px >= 0.0) & (px < (CAMERA.width, CAMERA.height))).all(axis=1).sum()
    assert 20 < expected < 380
    found = count_in_view(T_camera_world, rows, xyz, lens, CAMERA.width, CAMERA.height)
    assert found == expected


def test_cameras_forget_what_they_miss_and_what_lies_behind_them():
    scene = Scene.box(50)
    poses = np.array([looking((0.1, 0.0, 0.0)), looking((0.4, 0.1, 0.2), (0.0, 0.05, 0.0))])
    px = np.array([CAMERA.project(transform(inverse(T), scene.points)) for T in poses])
    px[0, 3] += (3.0, 4.0)
    u, v = (np.ascontiguousarray(px[..., k], np.float32) for k in range(2))
    seen = np.ones((2, 50), np.bool_)
    seen[1, 7] = False
    expected = seen.copy()
    expected[0, 3] = expected[:, 9] = False
    columns = np.array([3, 7, 9], np.int32)
    points = scene.points[columns]
    points[2] *= -1.0
    u[:, 8] = 0.0  # its column is not asked for
    forget_outliers(poses, points, u, v, seen, columns, CAMERA, 4.9)
    np.testing.assert_array_equal(seen, expected)
    seen[0, 3] = True
    forget_outliers(poses, points[:1], u, v, seen, columns[:1], CAMERA, 5.1)
    assert seen[0, 3]


def localisation_case(outliers):
    scene = Scene.box(400, seed=3)
    T = looking((0.2, 0.1, 0.3), (0.02, -0.05, 0.1))
    px = CAMERA.project(transform(inverse(T), scene.points))
    ahead = transform(inverse(T), scene.points)[:, 2] > 0.5
    points, px = scene.points[ahead], px[ahead].astype(np.float32)
    generator = np.random.default_rng(0)
    wrong = int(outliers * len(px))
    px[:wrong] = generator.uniform((0, 0), (640, 480), (wrong, 2))
    return T, points, px


def test_a_near_prediction_suffices():
    T, points, px = localisation_case(0.3)
    near = T @ looking((0.03, 0.0, 0.0), (0.0, 0.01, 0.0))
    found = refine(near, Correspondences(points, px), CAMERA, LocalisationParameters())
    np.testing.assert_allclose(found.T_world_camera, T, atol=1e-4)
    assert found.inliers.sum() >= 0.69 * len(px)


def test_a_hopeless_prediction_is_mended_by_ransac():
    T, points, px = localisation_case(0.4)
    far = T @ looking((2.0, 1.0, -1.0), (0.0, 0.8, 0.0))
    generator = np.random.default_rng(0)
    found = locate([far], Correspondences(points, px), CAMERA, LocalisationParameters(), generator)
    np.testing.assert_allclose(found.T_world_camera, T, atol=1e-3)


def test_refined_rotations_stay_rotations():
    T, points, px = localisation_case(0.0)
    skewed = T.copy()
    skewed[:3, :3] *= 1.001
    found = refine(skewed, Correspondences(points, px), CAMERA, LocalisationParameters())
    R = found.T_world_camera[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)


def keyframe_at(number, x):
    pose = np.eye(4)
    pose[0, 3] = x
    return Keyframe(
        id=number, frame=number, segment=0, T_world_camera=pose, rows=np.array([number], np.int32),
        points_px=np.zeros((1, 2), np.float32), rolled_px=np.zeros((1, 2), np.float32),
        focus=np.array([x, 0.0, 5.0]),
    )  # fmt: skip


def test_points_are_looked_for_near_the_newest_keyframe_only():
    keyframes = [keyframe_at(k, 10.0 * k) for k in range(40)]
    newest = keyframe_at(40, 12.0)
    near = near_keyframes(keyframes, newest.T_world_camera, 3)
    assert [keyframe.id for keyframe in near] == [0, 1, 2]
    assert rows_of(near, np.array([7], np.int32), 50).tolist() == [0, 1, 2, 7]
    assert near_keyframes(keyframes[:2], newest.T_world_camera, 3) == keyframes[:2]


def test_missing_points_are_mapped_have_no_track_and_wait_after_many_misses():
    state = np.array([MAPPED, MAPPED, CANDIDATE, MAPPED, MAPPED], np.uint8)
    misses = np.array([0, 0, 0, 8, 0], np.uint8)
    rows, marks = np.arange(4, dtype=np.int32), np.full(5, -1, np.int64)
    linked = np.array([1, -1], np.int32)
    assert missing_rows(rows, linked, state, misses, marks, 3).tolist() == [0]
    assert missing_rows(rows, linked, state, misses, marks, 5).tolist() == [0, 3]
    assert missing_rows(rows, linked[1:], state, misses, marks, 6).tolist() == [0, 1]


@pytest.mark.parametrize("share", [0.0, 0.02, 0.5])
def test_marks_are_counted_up_to_the_limit(share):
    rng = np.random.default_rng(0)
    marked = rng.random(4000) < share
    rows = rng.choice(4000, 1500, replace=False).astype(np.int32)
    count = np.count_nonzero(marked[rows])
    for least in (0, 1, count, count + 1):
        assert marks_fewer(marked, rows, least) == (count < least)

"""Tracks that a blurred frame ends go on after it, with their ids and their points."""

import cv2
import numpy as np
from moving_texture import follow, motion, render

from pliant.algorithms.arrays import U8
from pliant.algorithms.slam.map.covisibility import collect_garbage
from pliant.algorithms.slam.map.landmarks import CANDIDATE, FREE, Landmarks
from pliant.algorithms.slam.map.track_links import UNLINKED, TrackLinks
from pliant.algorithms.tracking.parameters import TrackingParameters
from pliant.state import load_state, save_state

BLURRED = (6, 7, 8)


def film() -> list[U8]:
    """The known motion; in three frames the camera shakes by 24 px within the exposure."""
    kernel = np.full((1, 25), 1.0 / 25.0)
    frames = [render(number) for number in range(14)]
    for number in BLURRED:
        frames[number] = np.asarray(cv2.filter2D(frames[number], -1, kernel), np.uint8)
    return frames


def test_tracks_continue_after_frames_without_details() -> None:
    results = follow(film(), TrackingParameters(max_tracks=3000))
    before, after = results[BLURRED[0] - 1], results[-1]
    assert len(np.intersect1d(before.ids, results[BLURRED[-1]].ids)) < 0.3 * len(before.ids)
    shared, i, j = np.intersect1d(before.ids, after.ids, return_indices=True)
    assert len(shared) > 0.5 * len(before.ids)
    assert (np.diff(after.ids) > 0).all()
    M, N = motion(BLURRED[0] - 1), motion(13)
    source = (before.points_px[i] - M[:, 2]) @ np.linalg.inv(M[:, :2]).T
    error = np.linalg.norm(source @ N[:, :2].T + N[:, 2] - after.points_px[j], axis=1)
    assert np.quantile(error, 0.9) < 1.0


def test_tracks_are_the_same_after_a_restart_within_the_blur() -> None:
    from pliant.algorithms.tracking.tracker import ExtremaTracker

    frames = film()
    tracker = ExtremaTracker(frames[0].shape[1], frames[0].shape[0], TrackingParameters())
    for number, image in enumerate(frames[:8]):
        tracker.track(image, number * 33_000_000)
    again = load_state(save_state(tracker))
    for number, image in enumerate(frames[8:], 8):
        a, b = (each.track(image, number * 33_000_000) for each in (tracker, again))
        np.testing.assert_array_equal(a.ids, b.ids)
        np.testing.assert_array_equal(a.points_px, b.points_px)


def test_track_that_comes_back_has_its_point_again() -> None:
    points, links = Landmarks(), TrackLinks()
    rows = points.allocate(4)
    points.promote(rows[:3])
    links.ids, links.rows = np.array([10, 11, 12, 13]), rows.copy()
    links.follow(np.array([13]), points)
    points.remove(rows[1:2])  # that point is none any more
    links.follow(np.array([13, 20]), points)
    links.rows[1] = rows[2]  # and that one has another track
    links.follow(np.array([10, 11, 12, 13, 20]), points)
    assert links.rows.tolist() == [rows[0], UNLINKED, UNLINKED, rows[3], rows[2]]


def test_candidates_lost_at_once_wait_for_their_tracks() -> None:
    """After a blurred frame there may be little else for a pose of a fast camera."""
    points, links = Landmarks(), TrackLinks()
    rows = points.allocate(6)
    points.promote(rows[:1])
    links.ids, links.rows = np.arange(6), rows.copy()
    links.follow(np.array([5]), points)
    collect_garbage(points, [], np.concatenate([links.rows, links.awaited()]), segment=0)
    assert (points.state[rows[1:]] == CANDIDATE).all()
    points.promote(rows[1:2])  # a point by what keyframes saw of it before
    links.follow(np.array([0, 1, 2, 4, 5, 9]), points)
    assert links.rows.tolist() == [*rows[[0, 1, 2, 4, 5]], UNLINKED]


def test_candidates_lost_one_by_one_are_given_back() -> None:
    points, links = Landmarks(), TrackLinks()
    rows = points.allocate(6)
    links.ids, links.rows = np.arange(6), rows.copy()
    links.follow(np.arange(4), points)
    collect_garbage(points, [], np.concatenate([links.rows, links.awaited()]), segment=0)
    assert points.state[rows].tolist() == [CANDIDATE] * 4 + [FREE] * 2
    links.follow(np.arange(6), points)
    assert links.rows.tolist() == [*rows[:4], UNLINKED, UNLINKED]


def test_candidates_are_given_back_where_points_of_the_map_carry_the_pose() -> None:
    points, links = Landmarks(), TrackLinks()
    rows = points.allocate(6)
    points.promote(rows[4:])
    links.ids, links.rows = np.arange(6), rows.copy()
    links.follow(np.arange(4, 6), points)
    collect_garbage(points, [], np.concatenate([links.rows, links.awaited()]), segment=0)
    assert (points.state[rows[:4]] == FREE).all()

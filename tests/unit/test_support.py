"""What counts for a pose and for a run: share and spread over the image, not inliers alone."""

from typing import Any

import numpy as np
import pytest
from mapped_scene import run, trajectory_error
from mapping_scene import CAMERA, INTERVAL_NS, Scene, sideways

from pliant.algorithms.map_delta import TRACKING
from pliant.algorithms.slam.frame import Frame
from pliant.algorithms.slam.locate.pose_quality import support_of, why_doubtful
from pliant.algorithms.slam.mapper import Mapper
from pliant.algorithms.slam.parameters import MappingParameters
from pliant.algorithms.tracks import FrameExtrema
from pliant.map_history import FramePose, MapHistory
from pliant.messages.types import PASSED_OVER
from pliant.results.judgement import (
    BAD,
    DOUBTFUL,
    GOOD,
    doubtful_frames,
    judge,
    judge_surfels,
    slipping_frames,
)


def doubt_of(points, inliers, settled):
    """settled: where tracks are that had time to become points."""
    return why_doubtful(support_of(points, inliers, len(points), settled, CAMERA))


def places(count, left=0.0, right=1.0, seed=0):
    generator = np.random.default_rng(seed)
    low, high = (left * CAMERA.width, 0.0), (right * CAMERA.width, CAMERA.height)
    return generator.uniform(low, high, (count, 2)).astype(np.float32)


def test_points_all_over_the_image_leave_no_doubt():
    points = places(1000)
    assert doubt_of(points, np.ones(1000, np.bool_), points) == ""
    assert doubt_of(points, np.ones(1000, np.bool_), places(0)) == ""


def test_half_an_image_of_tracks_without_points_is_doubtful():
    points = places(1000, right=0.5)
    told = doubt_of(points, np.ones(1000, np.bool_), np.concatenate([points, places(500, 0.5)]))
    assert told == "doubtful: 50% of the image disagrees with the camera motion"


def test_few_that_fit_and_all_in_one_place_are_doubtful():
    points = places(1000)
    few = np.arange(1000) < 300
    assert doubt_of(points, few, points).startswith("doubtful: only 30% of the visible map points")
    corner = places(200, right=0.1)
    assert "one place" in doubt_of(corner, np.ones(200, np.bool_), corner)
    assert doubt_of(places(0), np.zeros(0, np.bool_), places(0)).startswith("doubtful")


def test_a_large_moving_object_is_reported_as_doubtful():
    """The right half of what is seen moves by itself: its tracks fit no point, the pose stands."""
    poses, scene = sideways(50), Scene.box(1500, noise_px=0.1)
    reasons = {}
    for other in (False, True):
        mapper = Mapper(CAMERA, MappingParameters(), 0)
        for k, tracks in enumerate(scene.frames(poses)):
            points_px = tracks.points_px.copy()
            if other:
                moves = points_px[:, 0] > 0.45 * CAMERA.width
                step = 40.0 * np.sin(0.7 * k)
                points_px[moves] += np.array([0.0, step], np.float32)
            kept = {name: getattr(tracks, name) for name in vars(tracks)}
            maxima = np.column_stack([points_px, tracks.kappas])
            now = FrameExtrema(**{**kept, "points_px": points_px, "maxima": maxima})
            delta = mapper.process(Frame(k, k * INTERVAL_NS, now))
            if delta.state == TRACKING:
                reasons.setdefault(other, []).append(delta.reason)
    assert not any(reasons[False])
    assert sum(r.startswith("doubtful") for r in reasons[True]) > 0.5 * len(reasons[True])


def with_a_thing(tracks: FrameExtrema, since: int) -> FrameExtrema:
    """The same image some frames after a thing full of texture has come before its middle."""
    low, high = np.array([160.0, 40.0]), np.array([480.0, 440.0])
    generator = np.random.default_rng(4)
    own = generator.uniform(low, high, (4000, 2)) + np.array([2.5, -2.0]) * since
    px = tracks.points_px
    seen = ((px < own.min(axis=0)) | (px > own.max(axis=0))).any(axis=1)
    points_px = np.concatenate([px[seen], own]).astype(np.float32)
    kappas = np.concatenate([tracks.kappas[seen], np.full(len(own), 50.0, np.float32)])
    return FrameExtrema(
        ids=np.concatenate([tracks.ids[seen], 10_000_000 + np.arange(len(own))]),
        points_px=points_px,
        ages=np.concatenate([tracks.ages[seen], np.full(len(own), since, np.int32)]),
        kappas=kappas, states=np.zeros(len(kappas), np.uint8),
        maxima=np.column_stack([points_px, kappas]), dominant_flow=np.eye(2, 3),
    )  # fmt: skip


def test_a_thing_that_takes_most_of_the_tracks_does_not_carry_the_camera_along():
    """They have no place in the map yet: its own points have the last word."""
    poses, scene, first = sideways(34), Scene.box(1500, noise_px=0.1), 20
    frames = [
        with_a_thing(tracks, k - first) if k >= first else tracks
        for k, tracks in enumerate(scene.frames(poses))
    ]
    published, deltas = run(frames)
    assert {*range(len(poses))} == {*published.poses}
    error, _ = trajectory_error(published, poses)
    assert error < 2e-3
    assert all(delta.reason.startswith("doubtful") for delta in deltas[first + 2 : len(poses)])


@pytest.mark.parametrize(
    ("frames", "in_segments", "doubtful", "word"),
    [
        (100, [100], 10, GOOD),
        (100, [93], 0, GOOD),
        (100, [100], 40, DOUBTFUL),
        (100, [60, 40], 0, DOUBTFUL),
        (100, [40, 30, 30], 0, BAD),
        (100, [20], 0, BAD),
        (100, [], 0, BAD),
        (0, [], 0, BAD),
    ],
)
def test_a_run_is_judged_with_a_reason(frames, in_segments, doubtful, word):
    found, reason = judge(frames=frames, in_segments=in_segments, doubtful=doubtful)
    assert found == word
    assert reason


def test_a_frame_that_was_passed_over_and_placed_later_is_not_doubtful() -> None:
    history = MapHistory()
    history.states = dict(enumerate([(TRACKING, PASSED_OVER), (TRACKING, "doubtful: x")]))
    history.frames = dict.fromkeys(range(2), FramePose(0, 0, np.zeros(7), 100))
    assert doubtful_frames(history) == [1]


def test_a_run_whose_calibration_bends_the_map_is_doubtful() -> None:
    known = "unknown focal length"
    judged = judge(frames=100, in_segments=[100], doubtful=0, calibration=known)
    assert judged == (DOUBTFUL, known)
    assert judge(frames=100, in_segments=[20], doubtful=0, calibration=known)[0] == BAD


def test_where_much_of_the_scene_moves_the_profile_for_it_is_named() -> None:
    word, why = judge(frames=100, in_segments=[100], doubtful=44)
    assert word == DOUBTFUL
    assert "--profile deformable" in why


def test_a_run_of_which_many_images_are_broken_is_doubtful() -> None:
    few = judge(frames=100, in_segments=[95], doubtful=0, broken=5)
    many = judge(frames=100, in_segments=[60], doubtful=0, broken=40)
    assert few == (GOOD, "95% of the frames of the source have a pose in the largest segment")
    assert many[0] == DOUBTFUL
    assert many[1].endswith("40% of the images are broken")


def test_a_run_that_did_not_keep_up_is_doubtful() -> None:
    few = judge(frames=100, in_segments=[92], doubtful=0, behind=8)
    most = judge(frames=100, in_segments=[29], doubtful=0, behind=71)
    lost = judge(frames=100, in_segments=[29], doubtful=0, behind=20)
    assert (few[0], most[0], lost[0]) == (GOOD, DOUBTFUL, BAD)
    assert "29% of the frames have a pose" in most[1]
    assert "the computer was too slow for 71%" in most[1]


@pytest.mark.parametrize(
    ("changed", "word", "says"),
    [
        ({}, GOOD, "all frames have a pose in one segment"),
        ({"slipping": 20}, GOOD, "all frames"),
        ({"slipping": 61}, DOUBTFUL, "in 61% of the frames less than 75% of the surfels in view"),
        ({"unsure": 20}, GOOD, "all frames"),
        (
            {"unsure": 61},
            DOUBTFUL,
            "61% of the frames less than 75% of the surfels in view are pro",
        ),
        ({"slipping": 30, "unsure": 61}, DOUBTFUL, "in 30% of the frames"),
        ({"contradicted": 8}, GOOD, "all frames"),
        ({"contradicted": 61}, DOUBTFUL, "in 61% of the frames the depth map contradicts most"),
        ({"map_problem": "only 9% of its"}, DOUBTFUL, "not determined by the whole clip: only 9%"),
        ({"together": 20}, GOOD, "all frames"),
        ({"together": 61}, DOUBTFUL, "if the camera moves, use --camera moving"),
        ({"in_segments": [60, 40]}, DOUBTFUL, "60% of the frames"),
        ({"in_segments": [30, 20, 10]}, BAD, "30% of the frames"),
        ({"in_segments": []}, BAD, "no surfels were tracked"),
        ({"in_segments": [0]}, BAD, "no surfels were tracked"),
        ({"frames": 0, "in_segments": []}, BAD, "no surfels were tracked"),
        ({"unusable": 50}, DOUBTFUL, "50% of the depth maps could not be used"),
        ({"depth_from": "flat"}, DOUBTFUL, "started on a plane"),
        ({"depth_from": "map"}, GOOD, "all frames"),
        ({"broken": 40, "in_segments": [60]}, DOUBTFUL, "of the images are broken"),
    ],
)
def test_a_run_of_surfels_is_judged_with_a_reason(
    changed: dict[str, Any], word: str, says: str
) -> None:
    evidence: dict[str, Any] = {"frames": 100, "in_segments": [100], "slipping": 0, "unusable": 0}
    found, reason = judge_surfels(**{"depth_from": "sensor", **evidence, **changed})
    assert found == word
    assert says in reason


def test_a_frame_slips_in_which_few_of_the_surfels_in_view_are_tracked() -> None:
    assert slipping_frames([0, 100, 75, 74, 40], [0, 100, 100, 100, 50]) == [3]

"""Frames between keyframes are placed once more, by the map as it has become."""

import numpy as np
import pytest
from mapping_scene import CAMERA, INTERVAL_NS, Scene, looking, sideways

from pliant.algorithms.geometry import align_umeyama, inverse, pose_to_matrix, transform
from pliant.algorithms.slam.adjust import ordinary_frames
from pliant.algorithms.slam.adjust.ordinary_frames import (
    OrdinaryFrames,
    refined_poses,
    smoothed_poses,
)
from pliant.algorithms.slam.calibration.rolling_shutter import FramePoses
from pliant.algorithms.slam.calibration.self_calibration import SelfCalibration
from pliant.algorithms.slam.frame import Frame
from pliant.algorithms.slam.map.keyframe import Keyframe
from pliant.algorithms.slam.map.landmarks import CANDIDATE, Landmarks
from pliant.algorithms.slam.mapper import Mapper
from pliant.algorithms.slam.parameters import MappingParameters
from pliant.algorithms.slam.start.start import with_minimum_parallax
from pliant.map_history import MapHistory

PARAMETERS = MappingParameters()
KNOWN = SelfCalibration.of(CAMERA, PARAMETERS.calibration)
TRUE = looking((0.3, 0.1, 0.05), (0.0, 0.02, 0.01))


@pytest.fixture
def points():
    """A map of 200 points."""
    points = Landmarks()
    rows = points.allocate(200)
    points.xyz[rows] = np.random.default_rng(0).uniform((-2, -1, 4), (2, 1, 8), (200, 3))
    points.promote(rows)
    return points


def passed(points, id=3):
    """A frame that saw all of them and was placed 5 cm aside."""
    rows = np.arange(200, dtype=np.int32)
    seen = CAMERA.project(transform(inverse(TRUE), points.xyz[rows])).astype(np.float32)
    none = np.zeros((0, 2), np.float32)
    keyframe = Keyframe(
        id=id, frame=20, segment=0, T_world_camera=np.eye(4), rows=rows[:0], points_px=none,
        rolled_px=none,
    )  # fmt: skip
    frames = OrdinaryFrames()
    frames.add(23, keyframe, looking((0.35, 0.1, 0.05), (0.0, 0.02, 0.01)), rows, seen)
    return frames


def test_a_frame_is_placed_where_it_sees_the_points_as_they_are_now(points):
    frames = passed(points)
    (placed,) = refined_poses(frames.take_all(), points, KNOWN, PARAMETERS)
    assert (placed.frame, placed.keyframe.id, placed.inliers) == (23, 3, 200)
    np.testing.assert_allclose(placed.T_world_camera, TRUE, atol=1e-5)
    assert frames.take_all() == []


def test_rows_that_became_other_points_are_ignored(points):
    frames = passed(points).take_all()
    points.xyz[:120] += 0.03  # all in one direction: robustness alone would not do
    points.first_keyframe[:120] = 4
    (placed,) = refined_poses(frames, points, KNOWN, PARAMETERS)
    assert placed.inliers == 80
    np.testing.assert_allclose(placed.T_world_camera, TRUE, atol=1e-5)


def test_a_frame_that_sees_little_of_the_map_stays(points):
    frames = passed(points).take_all()
    points.state[:160] = CANDIDATE
    assert refined_poses(frames, points, KNOWN, PARAMETERS) == []


@pytest.mark.parametrize(("landmarks", "inliers"), [(200, 200), (3, 70)])
def test_a_keyframe_with_few_landmarks_keeps_the_support_of_its_candidates(
    points, landmarks, inliers
):
    rows = np.arange(landmarks, dtype=np.int32)
    points_px = CAMERA.project(transform(inverse(TRUE), points.xyz[rows])).astype(np.float32)
    keyframe = Keyframe(
        id=3, frame=20, segment=0, T_world_camera=TRUE, rows=rows, points_px=points_px,
        rolled_px=np.zeros_like(points_px),
    )  # fmt: skip
    path = FramePoses()
    path.add(20, keyframe, TRUE, 70)
    (pose,) = smoothed_poses([keyframe], path, {20: 0}, points, KNOWN, PARAMETERS)
    assert pose.inliers == inliers


def test_what_finds_no_room_goes_first(points, monkeypatch):
    monkeypatch.setattr(ordinary_frames, "_ROOM", 500)
    frames = passed(points)
    (only,) = passed(points).take_all()
    for number in (24, 25, 26):
        T_world_camera = only.keyframe.T_world_camera @ only.T_keyframe_camera
        frames.add(number, only.keyframe, T_world_camera, only.rows, only.points_px)
    assert [each.frame for each in frames.take_surplus(PARAMETERS)] == [23, 24]
    assert frames.take_surplus(PARAMETERS) == []
    assert [each.frame for each in frames.take_all()] == [25, 26]


def test_a_static_camera_needs_bounded_memory(monkeypatch):
    """No keyframe comes, after which what finds no room would go."""
    monkeypatch.setattr(ordinary_frames, "_ROOM", 1000)
    poses = sideways(12)
    poses += [poses[-1]] * 20
    mapper = Mapper(CAMERA, with_minimum_parallax(PARAMETERS), seed=0)
    kept = []
    for k, tracks in enumerate(Scene.box().frames(poses)):
        mapper.process(Frame(k, k * INTERVAL_NS, tracks))
        active = mapper.atlas.active
        kept.append(
            sum(len(each.rows) for each in active.segment.ordinary._frames) if active else 0
        )
    assert 1000 < max(kept) <= 2000


def test_frames_between_keyframes_gain_from_the_whole_map():
    poses = sideways(20)
    mapper, history = Mapper(CAMERA, with_minimum_parallax(PARAMETERS), seed=0), MapHistory()
    for k, tracks in enumerate(Scene.box().frames(poses)):
        delta = mapper.process(Frame(k, k * INTERVAL_NS, tracks))
        history.apply(delta, frame=k, stamp_ns=k * INTERVAL_NS)
    hanging = dict(history.frames)
    history.apply(mapper.finish(), frame=len(poses) - 1, stamp_ns=0, final=True)
    between = sorted(history.final().keys() - history.keyframe_poses().keys())
    assert len(between) > 10
    final = np.array([history.final()[k][1][:3] for k in between])
    rigid = np.array(
        [
            (
                pose_to_matrix(history.keyframes[hanging[k].keyframe].pose_world_camera)
                @ pose_to_matrix(hanging[k].pose_keyframe_camera)
            )[:3, 3]
            for k in between
        ]
    )
    true = np.array([poses[k][:3, 3] for k in between])
    assert error(final, true) < 0.9 * error(rigid, true)


def error(mine, true):
    """RMS distance after alignment."""
    scale, R, t = align_umeyama(mine, true, with_scale=True)
    return np.sqrt(((scale * mine @ R.T + t - true) ** 2).sum(axis=1).mean())

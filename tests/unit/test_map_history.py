"""Updates fold into trajectories: moving a keyframe moves the frames that hang on it."""

from dataclasses import replace

import numpy as np
from map_updates import IDENTITY, nothing

from pliant.algorithms.geometry import matrix_to_pose, pose_to_matrix, so3_exp
from pliant.algorithms.map_delta import BY_GYRO, TRACKING, WAITING, MapDelta
from pliant.map_history import MapHistory


def posed(frame: int, pose: np.ndarray, *, inliers: int = 100) -> MapDelta:
    return replace(
        nothing(TRACKING),
        pose_frames=np.array([frame]),
        pose_segments=np.zeros(1, np.int32),
        pose_keyframes=np.zeros(1, np.int64),
        poses_keyframe_camera=pose[None],
        pose_inliers=np.array([inliers], np.int32),
    )


def keyframe(delta: MapDelta, pose: np.ndarray) -> MapDelta:
    return replace(
        delta,
        keyframe_ids=np.zeros(1, np.int64),
        keyframe_frames=np.zeros(1, np.int64),
        keyframe_segments=np.zeros(1, np.int32),
        keyframe_poses=pose[None],
    )


def points(delta: MapDelta, ids: list[int], value: float) -> MapDelta:
    n = len(ids)
    return replace(
        delta,
        point_ids=np.array(ids, np.int64),
        point_segments=np.zeros(n, np.int32),
        points_world=np.full((n, 3), value),
        point_colours=np.full((n, 3), int(value), np.uint8),
        point_keyframes=np.full(n, 3, np.int32),
        point_parallax_rad=np.full(n, 0.1, np.float32),
        point_sigmas=np.full(n, 0.01, np.float32),
    )


def test_a_moved_keyframe_moves_its_frames_and_not_their_online_poses() -> None:
    step = np.array([1.0, 0, 0, 0, 0, 0, 1])
    history = MapHistory()
    history.apply(keyframe(posed(0, IDENTITY), IDENTITY), frame=0, stamp_ns=100)
    history.apply(posed(1, step), frame=1, stamp_ns=200)
    T = np.eye(4)
    T[:3, :3] = so3_exp(np.array([0.0, 0.0, np.pi / 2]))
    T[:3, 3] = 0.0, 0.0, 5.0
    history.apply(keyframe(nothing(TRACKING), matrix_to_pose(T)), frame=2, stamp_ns=300)
    final = history.trajectory(history.final())
    assert final.stamps_ns.tolist() == [100, 200]
    np.testing.assert_allclose(final.positions, [[0, 0, 5], [0, 1, 5]], atol=1e-12)
    online = history.trajectory(history.online)
    np.testing.assert_allclose(online.positions, [[0, 0, 0], [1, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(pose_to_matrix(online.poses[1]), online.T_world_camera[1])


def test_a_pose_without_support_does_not_count() -> None:
    history = MapHistory()
    history.apply(keyframe(posed(0, IDENTITY), IDENTITY), frame=0, stamp_ns=0)
    history.apply(posed(1, IDENTITY, inliers=29), frame=1, stamp_ns=1)
    assert list(history.final()) == [0]
    assert list(history.online) == [0]


def test_a_pose_by_the_gyro_is_placed_but_no_evidence() -> None:
    history = MapHistory()
    history.apply(keyframe(posed(0, IDENTITY), IDENTITY), frame=0, stamp_ns=0)
    history.apply(posed(1, IDENTITY, inliers=BY_GYRO), frame=1, stamp_ns=1)
    history.apply(posed(2, IDENTITY, inliers=0), frame=2, stamp_ns=2)
    assert list(history.final()) == [0]
    assert list(history.by_gyro()) == [1]
    assert list(history.placed()) == [0, 1]


def test_the_longest_segment_has_the_most_supported_frames() -> None:
    history = MapHistory()
    assert history.longest_segment() == -1
    history.apply(keyframe(posed(0, IDENTITY), IDENTITY), frame=0, stamp_ns=0)
    for frame, inliers in ((1, 100), (2, 100), (3, 10), (4, 10)):
        delta = replace(posed(frame, IDENTITY, inliers=inliers), pose_frames=np.array([frame]))
        segment = np.full(1, 7 if frame < 3 else 9, np.int32)
        history.apply(replace(delta, pose_segments=segment), frame=frame, stamp_ns=frame)
    assert history.longest_segment() == 7


def test_points_come_change_and_go() -> None:
    history = MapHistory()
    history.apply(points(nothing(TRACKING), [3, 900], 1.0), frame=0, stamp_ns=0)
    history.apply(points(nothing(TRACKING), [3, 5], 2.0), frame=1, stamp_ns=1)
    gone = replace(nothing(TRACKING), removed_point_ids=np.array([900, 12345]))
    history.apply(gone, frame=2, stamp_ns=2)
    found = history.points()
    assert found.ids.tolist() == [3, 5]
    np.testing.assert_array_equal(found.positions, 2.0)
    assert len(found.select(found.ids == 5)) == 1


def test_a_run_without_a_map_leaves_empty_files() -> None:
    history = MapHistory()
    history.apply(nothing(WAITING, "too few tracks"), frame=0, stamp_ns=0)
    assert len(history.trajectory(history.final())) == 0
    assert len(history.points()) == 0
    assert history.states[0] == (WAITING, "too few tracks")

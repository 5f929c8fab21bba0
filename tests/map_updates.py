"""Updates of a map, to be filled in."""

import numpy as np

from pliant.algorithms.map_delta import TRACKING, WAITING, MapDelta

IDENTITY = np.array([0.0, 0, 0, 0, 0, 0, 1])


def nothing(state: int = WAITING, reason: str = "") -> MapDelta:
    return MapDelta(
        state=state,
        reason=reason,
        segment=0 if state == TRACKING else -1,
        inliers=0,
        pose_frames=np.zeros(0, np.int64),
        pose_segments=np.zeros(0, np.int32),
        pose_keyframes=np.zeros(0, np.int64),
        poses_keyframe_camera=np.zeros((0, 7)),
        pose_inliers=np.zeros(0, np.int32),
        keyframe_ids=np.zeros(0, np.int64),
        keyframe_frames=np.zeros(0, np.int64),
        keyframe_segments=np.zeros(0, np.int32),
        keyframe_poses=np.zeros((0, 7)),
        point_ids=np.zeros(0, np.int64),
        point_segments=np.zeros(0, np.int32),
        points_world=np.zeros((0, 3)),
        point_colours=np.zeros((0, 3), np.uint8),
        point_keyframes=np.zeros(0, np.int32),
        point_parallax_rad=np.zeros(0, np.float32),
        point_sigmas=np.zeros(0, np.float32),
        removed_point_ids=np.zeros(0, np.int64),
    )

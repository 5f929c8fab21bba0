"""A mapper run on a scene, what it published, and how far its poses are off."""

import numpy as np
from mapping_scene import CAMERA, INTERVAL_NS

from pliant.algorithms.arrays import check_arrays
from pliant.algorithms.geometry import (
    align_umeyama,
    matrix_to_pose,
    move_by_similarity,
    pose_to_matrix,
    so3_exp,
)
from pliant.algorithms.slam.frame import Frame
from pliant.algorithms.slam.mapper import Mapper
from pliant.algorithms.slam.parameters import MappingParameters

PARAMETERS = MappingParameters()


class Published:
    """What a reader of the deltas knows."""

    def __init__(self):
        self.keyframes, self.poses, self.points, self.states, self.reasons = {}, {}, {}, [], []
        self.frame_of_keyframe = {}

    def apply(self, delta):
        check_arrays(delta)
        if len(delta.moved_keyframes):
            self._move(delta.map_moves())
        for i, pose in zip(delta.keyframe_ids.tolist(), delta.keyframe_poses, strict=True):
            self.keyframes[i] = pose_to_matrix(pose)
        frames = delta.keyframe_frames.tolist()
        self.frame_of_keyframe |= zip(delta.keyframe_ids.tolist(), frames, strict=True)
        for k, frame in enumerate(delta.pose_frames.tolist()):
            pose = pose_to_matrix(delta.poses_keyframe_camera[k])
            segment = int(delta.pose_segments[k])
            self.poses[frame] = (int(delta.pose_keyframes[k]), pose, segment)
        for point in delta.removed_point_ids.tolist():
            del self.points[point]
        for k, point in enumerate(delta.point_ids.tolist()):
            told = (delta.points_world[k], int(delta.point_keyframes[k]), delta.point_hosts[k])
            self.points[point] = told
        self.states.append(delta.state)
        self.reasons.append(delta.reason)
        return self

    def _move(self, moves):
        for i, T in self.keyframes.items():
            self.keyframes[i] = move_by_similarity(moves.matrices(np.array(i)), T)
        if self.points:
            xyz, seen, hosts = zip(*self.points.values(), strict=True)
            moved = moves.points(np.array(xyz), np.array(hosts))
            self.points = dict(zip(self.points, zip(moved, seen, hosts, strict=True), strict=True))

    def pose(self, frame):
        keyframe, T_keyframe_camera, _ = self.poses[frame]
        return self.keyframes[keyframe] @ T_keyframe_camera


def run(frames, parameters=PARAMETERS, seed=0):
    mapper, published, deltas = Mapper(CAMERA, parameters, seed), Published(), []
    for frame, tracks in enumerate(frames):
        deltas.append(mapper.process(Frame(frame, frame * INTERVAL_NS, tracks)))
        published.apply(deltas[-1])
    deltas.append(mapper.finish())
    published.apply(deltas[-1])
    return published, deltas


def trajectory_error(published, poses):
    """Sim(3) RMSE as a share of the path."""
    frames = sorted(published.poses)
    estimated = np.array([published.pose(k)[:3, 3] for k in frames])
    true = np.array([poses[k][:3, 3] for k in frames])
    scale, R, t = align_umeyama(estimated, true, with_scale=True)
    rmse = np.sqrt(((scale * estimated @ R.T + t - true) ** 2).sum(axis=1).mean())
    return rmse / np.linalg.norm(np.diff(true, axis=0), axis=1).sum(), (scale, R, t)


def similarity(scale, rotation_vector, t):
    R = np.eye(4)
    R[:3, :3], R[:3, 3] = so3_exp(np.array(rotation_vector, np.float64)), t
    return np.concatenate([matrix_to_pose(R), [scale]])


def error_of(active, true_path):
    """Sim(3) RMSE of the keyframes."""
    true = np.array(true_path)[[keyframe.frame for keyframe in active.keyframes], :3, 3]
    at = np.array([keyframe.T_world_camera[:3, 3] for keyframe in active.keyframes])
    scale, R, t = align_umeyama(at, true, with_scale=True)
    return np.sqrt(((scale * at @ R.T + t - true) ** 2).sum(axis=1).mean())

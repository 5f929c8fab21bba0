"""Messages in metres, and with z up, once the unit and the vertical of a map are measured."""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from pliant.algorithms.arrays import F64
from pliant.algorithms.geometry import matrix_to_pose, pose_to_matrix
from pliant.messages.types import (
    CameraStream,
    Header,
    MapKeyframe,
    MapUpdate,
    MeshPiece,
    MeshUpdate,
)


def _unturned() -> F64:
    return np.eye(3)


@dataclass(frozen=True, kw_only=True)
class MetricWorld:
    """A similarity of the world: ``X -> metres_per_unit R X``.

    R: (3, 3).   z_is_up: whether the z axis points against gravity after it.
    """

    metres_per_unit: float
    R: F64 = field(default_factory=_unturned)
    z_is_up: bool = False

    def points(self, points: F64) -> F64:
        """(..., 3) in metres."""
        return (points @ self.R.T if self.z_is_up else points) * self.metres_per_unit

    def poses(self, poses: F64) -> F64:
        """(N, 7) of the world."""
        return np.concatenate([self.points(poses[:, :3]), self._turned(poses)[:, 3:7]], axis=1)

    def moves(self, moves: F64) -> F64:
        """(N, 8) similarities that move the world: ``A S A^-1`` with this one as A."""
        turned = self._turned(moves[:, :7])
        if self.z_is_up and len(moves):
            T = pose_to_matrix(turned)
            T[:, :3, :3] = T[:, :3, :3] @ self.R.T
            turned = matrix_to_pose(T)
        return np.concatenate([self.points(moves[:, :3]), turned[:, 3:], moves[:, 7:]], axis=1)

    def _turned(self, poses: F64) -> F64:
        """(N, 7) with rotations from here to the new world."""
        if not self.z_is_up or not len(poses):
            return poses
        T = pose_to_matrix(poses)
        T[:, :3, :3] = self.R @ T[:, :3, :3]
        return matrix_to_pose(T)


def in_metres(message: Header, world: MetricWorld) -> Header:
    """A message of a rigid scene in another world; those without any lengths as they are."""
    return replace(message, **_changed(message, world))


def _changed(message: Header, world: MetricWorld) -> dict[str, Any]:
    factor = world.metres_per_unit
    if isinstance(message, CameraStream):
        return {"scale_is_metric": True, "z_is_up": world.z_is_up or message.z_is_up}
    if isinstance(message, MapUpdate):
        relative = message.poses_keyframe_camera
        return {
            "poses_keyframe_camera": np.concatenate([relative[:, :3] * factor, relative[:, 3:]], 1),
            "keyframe_poses": world.poses(message.keyframe_poses),
            "points_world": world.points(message.points_world),
            "moves": world.moves(message.moves),
        }
    if isinstance(message, MapKeyframe):
        T_world_camera = message.T_world_camera.copy()
        T_world_camera[:3, 3] = world.points(T_world_camera[:3, 3])
        if world.z_is_up:
            T_world_camera[:3, :3] = world.R @ T_world_camera[:3, :3]
        return {
            "T_world_camera": T_world_camera,
            "motion": message.motion * np.repeat([1.0, factor], 3),
            "points_world": world.points(message.points_world),
        }
    if isinstance(message, MeshPiece | MeshUpdate):
        # A scale alone is applied in the precision of the vertices, as it always was.
        positions = message.positions * np.float32(factor)
        normals = message.normals
        if world.z_is_up:
            positions = np.float32(world.points(message.positions.astype(np.float64)))
            normals = np.float32(normals @ world.R.T)
        return {
            "positions": positions,
            "normals": normals,
            "voxel_size": message.voxel_size * factor,
        }
    return {}

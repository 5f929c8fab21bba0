"""Messages in metres, once the length of a map unit is measured."""

from dataclasses import replace
from typing import Any

import numpy as np

from pliant.algorithms.arrays import F64
from pliant.messages.types import (
    CameraStream,
    Header,
    MapKeyframe,
    MapUpdate,
    MeshPiece,
    MeshUpdate,
)


def in_metres(message: Header, metres_per_unit: float) -> Header:
    """A message of a rigid scene with its lengths multiplied; those without any as they are."""
    return replace(message, **_lengths(message, metres_per_unit))


def _lengths(message: Header, factor: float) -> dict[str, Any]:
    if isinstance(message, CameraStream):
        return {"scale_is_metric": True}
    if isinstance(message, MapUpdate):
        return {
            "poses_keyframe_camera": _positions(message.poses_keyframe_camera, factor),
            "keyframe_poses": _positions(message.keyframe_poses, factor),
            "points_world": message.points_world * factor,
            "moves": _positions(message.moves, factor),
        }
    if isinstance(message, MapKeyframe):
        T_world_camera = message.T_world_camera.copy()
        T_world_camera[:3, 3] *= factor
        return {
            "T_world_camera": T_world_camera,
            "motion": message.motion * np.repeat([1.0, factor], 3),
            "points_world": message.points_world * factor,
        }
    if isinstance(message, MeshPiece | MeshUpdate):
        positions = message.positions * np.float32(factor)
        return {"positions": positions, "voxel_size": message.voxel_size * factor}
    return {}


def _positions(poses: F64, factor: float) -> F64:
    """(N, 7) or (N, 8): poses, maybe with a scale of their own."""
    return np.concatenate([poses[:, :3] * factor, poses[:, 3:]], axis=1)

"""The camera of every frame by the final map, and where its landmarks are then.

Between two keyframes the displacements are nearly those in between.  From there camera and
displacements of the frame are found as ``frame_camera.py`` does online.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from pliant.algorithms.arrays import F64, I64, Shape
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.deformable.frame_camera import frame_camera
from pliant.algorithms.deformable.moving_landmarks import DeformingMap


@dataclass(frozen=True, kw_only=True)
class SeenMap:
    """The map in one frame: its camera, and M landmarks in the camera's frame at their pixels."""

    T_world_camera: Annotated[F64, Shape(4, 4)]
    landmarks: Annotated[F64, Shape("M", 3)]
    points_px: Annotated[F64, Shape("M", 2)]


class FollowedMap:
    """A map whose keyframes have been adjusted."""

    def __init__(self, found: DeformingMap, ids: I64, stamps_ns: I64) -> None:
        """ids: (L,) the track of each landmark.    stamps_ns: (K,) of the keyframes, ascending."""
        self._found, self._stamps_ns = found, stamps_ns
        self._here = frame_camera(found, ids)

    def see(self, stamp_ns: int, ids: I64, points_px: F64, camera: PinholeCamera) -> SeenMap | None:
        """The map in a frame with tracks ids (N,) at points_px (N, 2), rectified.

        None where too few landmarks are among them, or fit.
        """
        found, here = self._found, self._here
        share = float(np.interp(stamp_ns, self._stamps_ns, np.arange(len(self._stamps_ns))))
        before = min(int(share), len(self._stamps_ns) - 1)
        after, share = min(before + 1, len(self._stamps_ns) - 1), share - before
        between = (1.0 - share) * found.displacements[before] + share * found.displacements[after]
        nearest = found.T_world_camera[before if share < 0.5 else after]
        here.displacements = between[None] / found.depth
        here.T_world_camera = nearest.copy()
        here.T_world_camera[:3, 3] /= found.depth
        is_keyframe = stamp_ns in self._stamps_ns
        T_world_camera = nearest if is_keyframe else here.follow(ids, points_px, camera)
        if T_world_camera is None:
            return None
        landmarks, pixels = here.landmarks(ids, points_px)
        return SeenMap(T_world_camera=T_world_camera, landmarks=landmarks, points_px=pixels)

"""The surfels of a run on a canvas, and their camera."""

import numpy as np

from pliant.algorithms.arrays import F64
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import matrix_to_pose
from pliant.messages.types import Surfels
from pliant.viewers.canvas import Canvas, Moment
from pliant.viewers.surfel_quads import surfel_picture

_PATH_FRAMES = 10


class SceneSurfels:
    """Draws every frame as a whole: whatever a viewer missed, the newest is right."""

    camera: PinholeCamera | None = None

    def __init__(self, canvas: Canvas) -> None:
        self._canvas = canvas
        self._segment = -1
        self._path: list[F64] = []
        self._drawn = -_PATH_FRAMES

    def take(self, at: Moment, surfels: Surfels) -> None:
        """Draw the surfels of a frame; nothing where it has none."""
        if self.camera is None or surfels.missing:
            return
        if surfels.segment != self._segment:
            if self._segment >= 0:
                self._canvas.forget(at, self._segment)
            self._segment, self._path, self._drawn = surfels.segment, [], at.frame - _PATH_FRAMES
        if not surfels.lost:
            self._canvas.pose(at, surfels.segment, matrix_to_pose(surfels.T_world_camera))
            if at.frame - self._drawn >= _PATH_FRAMES:
                self._drawn = at.frame
                self._path.append(surfels.T_world_camera[:3, 3])
                self._canvas.path(at, surfels.segment, np.array(self._path))
        self._canvas.surfels(at, surfels.segment, surfel_picture(surfels, self.camera))

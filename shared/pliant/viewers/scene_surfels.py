"""The surfels of a run on a canvas, and their camera."""

import numpy as np

from pliant.algorithms.arrays import F64
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import matrix_to_pose
from pliant.algorithms.meshing.mesh_blocks import TriangleMesh
from pliant.algorithms.surfels.surface import surface_of
from pliant.algorithms.surfels.surface_strain import at_vertices, principal_strains
from pliant.messages.types import Surfels
from pliant.pictures.strain_colours import strain_colours
from pliant.viewers.canvas import Canvas, Moment
from pliant.viewers.surfel_quads import surfel_picture

_PATH_FRAMES = 10
_FULL_STRAIN = 0.1
"""Strain with the full colour: the largest of the run is not known yet."""
_FORGET = 4
"""Old triangles are forgotten at this multiple of the largest number that a frame has shown."""


class SceneSurfels:
    """Draws every frame as a whole: whatever a viewer missed, the newest is right."""

    camera: PinholeCamera | None = None

    def __init__(self, canvas: Canvas) -> None:
        self._canvas = canvas
        self._segment = -1
        self._path: list[F64] = []
        self._drawn = -_PATH_FRAMES
        self._rest: dict[tuple[int, ...], F64] = {}  # sides of each triangle when it came, by ids
        self._most = 0

    def take(self, at: Moment, surfels: Surfels) -> None:
        """Draw the surfels of a frame; nothing if it has none."""
        if self.camera is None or surfels.missing:
            return
        if surfels.segment != self._segment:
            if self._segment >= 0:
                self._canvas.forget(at, self._segment)
            self._segment, self._path, self._drawn = surfels.segment, [], at.frame - _PATH_FRAMES
            self._rest.clear()
        if not surfels.lost:
            self._canvas.pose(at, surfels.segment, matrix_to_pose(surfels.T_world_camera))
            if at.frame - self._drawn >= _PATH_FRAMES:
                self._drawn = at.frame
                self._path.append(surfels.T_world_camera[:3, 3])
                self._canvas.path(at, surfels.segment, np.array(self._path))
        self._canvas.surfels(at, surfels.segment, surfel_picture(surfels, self.camera))
        self._canvas.surface(at, surfels.segment, self._surface(surfels))

    def _surface(self, surfels: Surfels) -> TriangleMesh:
        """The mesh between the tracked surfels, coloured by its strain since each part came."""
        rows, normals, triangles = surface_of(surfels)
        names = surfels.ids[rows][triangles]
        first = names.argmin(axis=1)[:, None]  # the same triangle from any corner
        triangles = np.take_along_axis(triangles, (first + np.arange(3)) % 3, axis=1)
        corners = surfels.positions[rows][triangles]
        sides = corners[:, 1:] - corners[:, :1]
        names = [tuple(ids) for ids in surfels.ids[rows][triangles].tolist()]
        rest = [self._rest.setdefault(*pair) for pair in zip(names, sides, strict=True)]
        self._most = max(self._most, len(names))
        if len(self._rest) > _FORGET * self._most:
            self._rest = dict(zip(names, rest, strict=True))
        strain = principal_strains(np.array(rest).reshape(-1, 2, 3), sides)
        values = at_vertices(triangles, strain, len(rows))
        return TriangleMesh(
            positions=surfels.positions[rows].astype(np.float32),
            normals=normals,
            colours=strain_colours(values, _FULL_STRAIN),
            triangles=triangles,
        )

"""Surfaces that change their shape: sheets of triangles, and the scenes made of them.

A sheet is a grid of vertices whose places are a function of time.  Between the vertices it is flat:
each cell is split along the diagonal from its first to its last vertex.  So the place of a material
point, given by its column and row in the grid, is known exactly at every time.

Deforming scenes have the axes of a camera: x right, y down, z forward.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pliant.algorithms.arrays import F64
from pliant.rendering.paths import CameraPath
from pliant.rendering.solids import Material, Vector

Shape = Callable[[float], F64]
"""From a time in seconds to the (rows, columns, 3) vertices of a sheet, metres, world."""


@dataclass(frozen=True)
class Sheet:
    """A surface with a texture of its own.

    width_m, height_m: of the texture, which is spread evenly over the cells of the grid.
    """

    name: str
    material: Material
    width_m: float
    height_m: float
    shape: Shape
    texels_per_metre: float = 1300.0


@dataclass(frozen=True)
class Lamp:
    """A lamp at a place that may wander.

    place: metres, world.     wander: radius of its way, metres; its strength swings along with it.
    ambient: share of the light that comes from everywhere.    gloss: grey values of a highlight.
    at_camera: the lamp rides with the camera and is the only light; ``place`` does not count.
    """

    place: Vector = (-0.25, -0.35, -0.1)
    wander_m: float = 0.0
    ambient: float = 0.55
    gloss: float = 0.0
    at_camera: bool = False

    def at(self, time_s: float) -> tuple[F64, float]:
        """(3,) place and strength, 1 where the lamp does not wander."""
        angle = 2.0 * np.pi * time_s / 2.3
        way = np.array([np.sin(angle), 0.6 * np.sin(1.618 * angle), 0.0])
        return np.array(self.place) + self.wander_m * way, 1.0 + self.wander_m * np.sin(1.3 * angle)


@dataclass(frozen=True)
class DeformingScene:
    """Sheets before a camera, and how many frames of 30 a second they are made for.

    reach_m: what is farther away gets no depth, as with a sensor.
    """

    name: str
    sheets: tuple[Sheet, ...]
    path: CameraPath
    frames: int
    lamp: Lamp = Lamp()
    reach_m: float = 2.0
    depth_scale: float = 1e-4
    seed: int = 41


def vertex_normals(vertices: F64) -> F64:
    """(R, C, 3) unit normals of a grid of vertices: across its central differences."""
    normals = np.cross(np.gradient(vertices, axis=1), np.gradient(vertices, axis=0))
    length = np.linalg.norm(normals, axis=2, keepdims=True)
    return normals / np.maximum(length, 1e-12)


def material_positions(vertices: F64, points: F64) -> F64:
    """(N, 3) places of material points.

    vertices: (R, C, 3) of their sheet.    points: (N, 2) column and row in its grid.
    """
    rows, columns = vertices.shape[:2]
    j = np.clip(np.floor(points[:, 0]).astype(np.int64), 0, columns - 2)
    i = np.clip(np.floor(points[:, 1]).astype(np.int64), 0, rows - 2)
    a, b = (points[:, 0] - j)[:, None], (points[:, 1] - i)[:, None]
    first, last = vertices[i, j], vertices[i + 1, j + 1]
    right, below = vertices[i, j + 1], vertices[i + 1, j]
    upper = first + a * (right - first) + b * (last - right)
    lower = first + b * (below - first) + a * (last - below)
    return np.where(a >= b, upper, lower)

"""A box in the map's frame to which an export is cropped."""

from dataclasses import dataclass

import numpy as np

from pliant.algorithms.arrays import F32, F64, BoolArray
from pliant.algorithms.meshing.mesh_blocks import TriangleMesh
from pliant.errors import ResultError


@dataclass(frozen=True)
class Box:
    """low, high: (x, y, z) corners in the frame and unit of ``mesh.ply``."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]

    def __str__(self) -> str:
        return ",".join(f"{value:g}" for value in (*self.low, *self.high))

    def holds(self, positions: F32 | F64) -> BoolArray:
        """(N,) which of the positions (N, 3) lie inside."""
        inside = (positions >= np.array(self.low)) & (positions <= np.array(self.high))
        return np.all(inside, axis=1)


def cropped_mesh(mesh: TriangleMesh, box: Box | None) -> TriangleMesh:
    """The triangles with all corners in a box; None: the mesh.  Raises ResultError for none."""
    if box is None:
        return mesh
    whole = np.all(box.holds(mesh.positions)[mesh.triangles], axis=1)
    return mesh.of_triangles(_some(whole, "triangle of the mesh", mesh.positions, box))


def rows_in(box: Box | None, positions: F32 | F64) -> BoolArray:
    """(N,) which points (N, 3) are in a box; None: all.  Raises ResultError for none."""
    if box is None:
        return np.ones(len(positions), np.bool_)
    return _some(box.holds(positions), "point", positions, box)


def _some(inside: BoolArray, what: str, positions: F32 | F64, box: Box) -> BoolArray:
    if inside.any():
        return inside
    ends = (positions.min(axis=0), positions.max(axis=0)) if len(positions) else ()
    extent = ",".join(f"{value:.3g}" for end in ends for value in end.tolist())
    raise ResultError(f"--crop {box}: no {what} is inside; the extent is {extent or 'nothing'}")

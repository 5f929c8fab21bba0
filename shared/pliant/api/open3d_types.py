"""Points and meshes as numpy has them, which Open3D takes, too."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from pliant.algorithms.arrays import F64, I64, U8
from pliant.algorithms.meshing.mesh_blocks import TriangleMesh
from pliant.open3d_geometry import to_cloud, to_mesh


class PointArray(np.ndarray[tuple[int, ...], np.dtype[np.float64]]):
    """(P, 3) points: an array like any other, but for ``to_open3d``."""

    colours: U8 | None = None
    """(P, 3) RGB; not of what is computed or cut out of it, which has other rows."""

    @staticmethod
    def of(positions: F64, colours: U8) -> "PointArray":
        """Points with their colours; nothing is copied."""
        made = np.asarray(positions, np.float64).view(PointArray)
        made.colours = colours
        return made

    def __array_wrap__(
        self, array: Any, context: Any = None, return_scalar: bool = False, /
    ) -> Any:
        """Results of arithmetic with them are plain numpy arrays."""
        plain = np.asarray(array)
        return plain[()] if return_scalar else plain

    def to_open3d(self) -> Any:
        """``open3d.geometry.PointCloud``, in colour.  Raises Open3dError if it cannot be loaded.

        Of some of the points it has no colours.
        """
        return to_cloud(np.asarray(self).reshape(-1, 3), self.colours)


class Mesh(TriangleMesh):
    """A mesh: ``positions``, ``normals``, ``colours`` of vertices, and ``triangles``."""

    def to_open3d(self) -> Any:
        """``open3d.geometry.TriangleMesh``.  Raises Open3dError if it cannot be loaded."""
        return to_mesh(self)


@dataclass(frozen=True, kw_only=True)
class Surface(Mesh):
    """The mesh between the tracked surfels of a frame.  ids: (V,) of the surfel at each vertex."""

    ids: I64

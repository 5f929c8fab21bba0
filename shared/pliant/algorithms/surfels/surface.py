"""The surface between surfels (not in the paper, whose map has none)."""

import numpy as np

from pliant.algorithms.arrays import F32, I32, I64
from pliant.algorithms.meshing.delaunay import triangulate
from pliant.algorithms.surfels.surfel_frame import SurfelFrame, SurfelState

_MAX_LENGTHS = 3.0
"""A longer edge, in medians of all edges, may span a hole."""
_MAX_STEEPNESS = 2.0
"""An edge whose ends differ more in depth than this times their lateral distance joins two
surfaces, or a surface in profile.
"""
_MAX_SLOPE = 0.25
"""An edge of any length lies on one surface if it leaves the planes of both ends by at most this
share of its length.
"""


def surface_of(surfels: SurfelFrame) -> tuple[I64, F32, I32]:
    """The tracked surfels of a frame as a triangle mesh.

    Returns their rows (V,), unit normals (V, 3) towards the camera, world, and triangles (T, 3) of
    rows of these.  Neighbours in the image are joined where they are neighbours in space.
    """
    rows = np.flatnonzero(surfels.state == SurfelState.TRACKED)
    T = surfels.T_world_camera
    normals = np.cross(surfels.tangents[rows, :, 0], surfels.tangents[rows, :, 1])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    away = ((surfels.positions[rows] - T[:3, 3]) * normals).sum(axis=1) > 0.0
    normals[away] *= -1.0
    found = triangulate(surfels.points_px[rows])
    triangles = found.vertices[found.triangles].astype(np.int32)
    if not len(triangles):
        return rows, normals.astype(np.float32), triangles
    corners = ((surfels.positions[rows] - T[:3, 3]) @ T[:3, :3])[triangles]
    edges = corners - np.roll(corners, 1, axis=1)
    lengths = np.linalg.norm(edges, axis=2)
    across = np.linalg.norm(edges[..., :2], axis=2)
    joined = lengths <= _MAX_LENGTHS * np.median(lengths)
    joined &= np.abs(edges[..., 2]) <= _MAX_STEEPNESS * across
    here = (normals @ T[:3, :3])[triangles]
    there = np.roll(here, 1, axis=1)
    off_plane = np.maximum(np.abs((edges * here).sum(axis=2)), np.abs((edges * there).sum(axis=2)))
    joined |= off_plane <= _MAX_SLOPE * lengths
    return rows, normals.astype(np.float32), triangles[joined.all(axis=1)]

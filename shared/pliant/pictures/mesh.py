"""Pictures of a mesh without any GUI library: its colours, its shape and its normals."""

from dataclasses import dataclass

import cv2
import numpy as np

from pliant.algorithms.arrays import F32, F64, U8, BoolArray
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.meshing.mesh_blocks import TriangleMesh
from pliant.algorithms.meshing.rendering import MeshView, view_mesh
from pliant.pictures.map import BACKGROUND, FOCAL, MapView, choose_view, dimmed_behind, views_from

_DIRECTIONS_DEG = [(azimuth, up) for up in (25.0, 35.0, 50.0) for azimuth in range(-75, 76, 25)]
"""Azimuth and elevation of the views of which one is chosen."""
_SAMPLES = 10_000
_CELLS = 60, 80
"""Rows and columns of a coarse picture, by which views are compared."""
_CELL_DEPTH = 0.03
"""Share of its depth by which a surface that is seen extends in depth within a cell."""
_SUPERSAMPLE = 2
_BAND = 32
"""Rows that are drawn at a time: what is in between stays small, and in the processor's cache."""
_ROWS = 1 << 16
"""Triangles that are worked on at a time."""
_CLAY = 235.0
# A lamp above the left shoulder shows form, one at the eye leaves nothing black.
_LAMP = np.array([-0.43, -0.72, -0.55])
_AMBIENT, _FROM_EYE, _FROM_LAMP = 0.28, 0.3, 0.55
_OWN_LIGHT = 0.5
"""Share of the colours that needs no lamp, because they contain the scene's own light."""
_BRIGHT = 1.1
"""Factor of the lamps on the rest: white stays white."""


@dataclass(frozen=True)
class MeshPictures:
    """(H, W, 3) RGB pictures from one place.

    colours: as the camera saw them.    shaded: of clay, under a lamp.    normals: (x, y, z) of
    the eye's frame as red, green and blue (VITAMIN-E, Fig. 3d).
    """

    colours: U8
    shaded: U8
    normals: U8


def mesh_view(mesh: TriangleMesh, T_world_camera: F64) -> MapView:
    """The view from above that shows most of a mesh, seen from a path (N, 4, 4).

    Of several directions it is the one with the largest product of two shares: of the surface that
    is visible, and of the picture that it fills.
    """
    if not len(mesh.triangles):
        return choose_view(mesh.positions.astype(np.float64), T_world_camera)
    places, normals = _samples(mesh)
    views = views_from(places, T_world_camera, _DIRECTIONS_DEG, with_path=False)
    return max(views, key=lambda view: _shown(places, normals, view))


def _samples(mesh: TriangleMesh) -> tuple[F64, F64]:
    """(N, 3) places spread over the surface by area, and its normals there, of any length."""
    normals = np.concatenate([_outwards(mesh, rows) for rows in _parts(mesh)])
    ends = np.cumsum(np.linalg.norm(normals, axis=1))
    at = (np.arange(_SAMPLES) + 0.5) / _SAMPLES * ends[-1]
    rows = np.minimum(np.searchsorted(ends, at), len(ends) - 1)
    return mesh.positions[mesh.triangles[rows]].astype(np.float64).mean(axis=1), normals[rows]


def _shown(places: F64, normals: F64, view: MapView) -> float:
    """The share of samples that are seen, times the share of the picture's cells with any."""
    rows, columns = _CELLS
    rays = places - view.T_world_view[:3, 3]
    local = rays @ view.T_world_view[:3, :3]
    local = local[((normals * rays).sum(axis=1) < 0.0) & (local[:, 2] > 0.0)]
    at = np.floor(local[:, :2] / local[:, 2:] * FOCAL * rows + (0.5 * columns, 0.5 * rows))
    inside = np.all((at >= 0) & (at < (columns, rows)), axis=1)
    cells = (at[inside] @ (1, columns)).astype(np.int64)
    depths = local[inside, 2]
    nearest = np.full(rows * columns, np.inf)
    np.minimum.at(nearest, cells, depths)
    seen = (depths < (1.0 + _CELL_DEPTH) * nearest[cells]).sum()
    return float(seen / len(places) * np.isfinite(nearest).mean())


def draw_mesh(
    mesh: TriangleMesh, view: MapView, *, size: tuple[int, int] = (960, 720)
) -> MeshPictures:
    """Draw the faces that turn to the eye: so one looks into a room through its walls.

    size: columns and rows.
    """
    width, height = (_SUPERSAMPLE * n for n in size)
    focal = FOCAL * height
    camera = PinholeCamera(
        width=width, height=height, fx=focal, fy=focal, cx=0.5 * width - 0.5, cy=0.5 * height - 0.5
    )
    faces = mesh.triangles[_towards(mesh, view)]
    seen = view_mesh(mesh.positions, faces, camera, view.T_world_view)
    depths = np.where(seen.triangles >= 0, seen.depths, np.float32(np.inf))
    edges = dimmed_behind(depths, view.reach)
    normals = mesh.normals @ view.T_world_view[:3, :3]
    values = np.hstack([normals, mesh.colours]).astype(np.float32)
    bands: list[list[U8]] = []
    for top in range(0, height, _BAND):
        rows = slice(top, top + _BAND)
        band = MeshView(seen.depths[rows], seen.triangles[rows], seen.shares[rows])
        planes = np.ascontiguousarray(band.interpolate(faces, values).transpose(2, 0, 1))
        lit = _lit(planes[:3], planes[3:], edges[rows])
        bands.append([_finish(picture, band.triangles >= 0) for picture in lit])
    return MeshPictures(*(np.concatenate(parts) for parts in zip(*bands, strict=True)))


def _lit(normals: F32, colours: F32, edges: F32) -> tuple[F32, F32, F32]:
    """(3, H, W) colours, clay and normals; normals: (3, H, W) of the eye's frame, of any length."""
    normals = normals / np.maximum(np.sqrt((normals**2).sum(axis=0)), np.float32(1e-9))
    from_eye = np.clip(-normals[2], 0.0, 1.0)
    lamp = (_LAMP / np.linalg.norm(_LAMP)).astype(np.float32)
    from_lamp = np.clip(np.tensordot(lamp, normals, 1), 0.0, 1.0)
    light = edges * (_AMBIENT + _FROM_EYE * from_eye + _FROM_LAMP * from_lamp)
    lit = colours * (_OWN_LIGHT * edges + (1.0 - _OWN_LIGHT) * _BRIGHT * light)
    # Right, up and towards the eye are positive, as normal maps are usually shown.
    mapped = 127.5 * (1.0 + normals * np.array([1.0, -1.0, -1.0], np.float32)[:, None, None])
    return lit, np.broadcast_to(_CLAY * light, normals.shape), mapped


def _towards(mesh: TriangleMesh, view: MapView) -> BoolArray:
    eye = view.T_world_view[:3, 3]
    parts = [
        (_outwards(mesh, rows) * (mesh.positions[mesh.triangles[rows, 0]] - eye)).sum(axis=1) < 0.0
        for rows in _parts(mesh)
    ]
    return np.concatenate(parts) if parts else np.zeros(0, np.bool_)


def _parts(mesh: TriangleMesh) -> list[slice]:
    """Slices of the triangles, of which there may be millions, to bound temporary arrays."""
    return [slice(first, first + _ROWS) for first in range(0, len(mesh.triangles), _ROWS)]


def _outwards(mesh: TriangleMesh, rows: slice) -> F64:
    """(F, 3) normals of some triangles, as long as twice their area."""
    faces = mesh.triangles[rows]
    corners = mesh.positions[faces].astype(np.float64)
    edges = corners[:, 1:] - corners[:, :1]
    away = np.cross(edges[:, 0], edges[:, 1])
    # The normals determine the outer side, whatever the order of the corners.
    return away * np.sign((away * mesh.normals[faces[:, 0]]).sum(axis=1))[:, None]


def _finish(planes: F32, covered: BoolArray) -> U8:
    """(H, W, 3) before the background, of (3, H, W), at the size that is shown."""
    size = covered.shape[1] // _SUPERSAMPLE, covered.shape[0] // _SUPERSAMPLE
    whole = np.where(covered, planes, np.array(BACKGROUND, np.float32)[:, None, None])
    small = [cv2.resize(plane, size, interpolation=cv2.INTER_AREA) for plane in whole]
    return np.clip(np.round(np.stack(small, axis=-1)), 0, 255).astype(np.uint8)

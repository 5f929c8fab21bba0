"""Pictures of a mesh without any GUI library: its colours, its shape and its normals."""

from dataclasses import dataclass

import cv2
import numpy as np

from pliant.algorithms.arrays import F32, F64, U8, BoolArray
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.meshing.mesh_blocks import TriangleMesh
from pliant.algorithms.meshing.rendering import view_mesh
from pliant.pictures.map import BACKGROUND, FOCAL, MapView, choose_view

_SUPERSAMPLE = 2
_CLAY = 225.0
_AMBIENT = 0.35


@dataclass(frozen=True)
class MeshPictures:
    """(H, W, 3) RGB pictures from one place.

    colours: as the camera saw them.    shaded: of clay, lit from the eye.    normals: (x, y, z) of
    the eye's frame as red, green and blue (VITAMIN-E, Fig. 3d).
    """

    colours: U8
    shaded: U8
    normals: U8


def mesh_view(mesh: TriangleMesh, T_world_camera: F64) -> MapView:
    """A view from above on a mesh and the path (N, 4, 4) from which it was seen."""
    return choose_view(mesh.positions.astype(np.float64), T_world_camera)


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
    covered = seen.triangles >= 0
    normals = _unit(seen.interpolate(faces, mesh.normals) @ view.T_world_view[:3, :3])
    # Where the eye looks from: the light is there, too.
    light = _AMBIENT + (1.0 - _AMBIENT) * np.clip(-normals[..., 2:3], 0.0, 1.0)
    colours = seen.interpolate(faces, mesh.colours.astype(np.float32))
    # Right, up and towards the eye are positive, as normal maps are usually shown.
    mapped = 127.5 * (1.0 + normals * np.array([1.0, -1.0, -1.0]))
    return MeshPictures(
        colours=_finish(colours * (0.5 + 0.5 * light), covered, size),
        shaded=_finish(_CLAY * light * np.ones(3), covered, size),
        normals=_finish(mapped, covered, size),
    )


def _towards(mesh: TriangleMesh, view: MapView) -> BoolArray:
    corners = mesh.positions[mesh.triangles].astype(np.float64)
    edges = corners[:, 1:] - corners[:, :1]
    away = np.cross(edges[:, 0], edges[:, 1])
    # Which side is out is said by the normals, whatever the order of the corners.
    away *= np.sign((away * mesh.normals[mesh.triangles[:, 0]]).sum(axis=1))[:, None]
    rays = corners[:, 0] - view.T_world_view[:3, 3]
    return (away * rays).sum(axis=1) < 0.0


def _unit(vectors: F32 | F64) -> F64:
    lengths = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors / np.maximum(lengths, 1e-9), np.float64)


def _finish(
    picture: F32 | F64,
    covered: BoolArray,
    size: tuple[int, int],
) -> U8:
    whole = np.where(covered[..., None], picture, np.array(BACKGROUND, np.float64))
    small = cv2.resize(whole.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    return np.clip(np.round(small), 0, 255).astype(np.uint8)

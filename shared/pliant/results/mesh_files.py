"""Writes the meshes of a recording as files for users."""

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pliant.algorithms.arrays import F64
from pliant.algorithms.meshing.mesh_blocks import TriangleMesh
from pliant.errors import ResultError
from pliant.formats.ply import read_ply, write_ply
from pliant.messages.mesh_pieces import joined
from pliant.messages.types import MeshPiece
from pliant.pictures.mesh import draw_mesh, mesh_view
from pliant.pictures.movie import write_image
from pliant.wording import shown

MESHED_NAME = "mesh.json"
"""Report of ``pliant mesh``, in a folder of its own."""
_RECORDING = "recording"
_NAMES = {"fine": "mesh", "coarse": "mesh_coarse"}


def meshes_of(pieces: Sequence[MeshPiece]) -> dict[tuple[int, str], list[MeshPiece]]:
    """The complete meshes by segment and level: those that an interruption cut off are left out."""
    found: dict[tuple[int, str], list[MeshPiece]] = {}
    for piece in pieces:
        found.setdefault((piece.segment, piece.level), []).append(piece)
    return {key: some for key, some in found.items() if len(some) == some[0].pieces}


def mesh_of(pieces: Sequence[MeshPiece], segment: int) -> TriangleMesh | None:
    """The fine mesh of a segment, or None."""
    found = meshes_of(pieces).get((segment, "fine"))
    return None if found is None else joined(found)


def write_meshes(
    folder: Path, pieces: Sequence[MeshPiece], segment: int, suffix: str, T_world_camera: F64
) -> None:
    """Write the meshes of a segment, and pictures of the fine one from over the camera's path."""
    for (of, level), some in meshes_of(pieces).items():
        if of != segment or level not in _NAMES:
            continue
        mesh = joined(some)
        path = folder / f"{_NAMES[level]}{suffix}.ply"
        write_mesh(path, mesh)
        if level == "fine" and len(mesh.triangles) and len(T_world_camera):
            write_pictures(folder, mesh, T_world_camera, suffix)


def write_mesh(path: Path, mesh: TriangleMesh) -> None:
    """Write a PLY file; vertices that close holes are marked, if there are any."""
    write_ply(
        path, mesh.positions, mesh.colours, normals=mesh.normals, faces=mesh.triangles,
        closed=mesh.closed if len(mesh.closed) else None,
    )  # fmt: skip


def read_mesh(path: Path) -> TriangleMesh | None:
    """The mesh of a PLY file, None if it is a cloud of points.  Normals it lacks are zero."""
    data = read_ply(path)
    if data.faces is None:
        return None
    grey = np.full((len(data.points), 3), 200, np.uint8)
    return TriangleMesh(
        positions=data.points,
        normals=np.zeros_like(data.points) if data.normals is None else data.normals,
        colours=grey if data.colours is None else data.colours,
        triangles=data.faces,
        closed=data.closed,
    )


def write_pictures(folder: Path, mesh: TriangleMesh, T_world_camera: F64, suffix: str = "") -> None:
    """Draw the mesh in its colours, shaded, and by its normals."""
    pictures = draw_mesh(mesh, mesh_view(mesh, T_world_camera))
    write_image(folder / f"mesh{suffix}.png", pictures.colours)
    write_image(folder / f"mesh_shaded{suffix}.png", pictures.shaded)
    write_image(folder / f"mesh_normals{suffix}.png", pictures.normals)


def place_of(recording: Path, folder: Path) -> dict[str, str]:
    """The entry of MESHED_NAME for the recording that was meshed: relative to the folder."""
    return {_RECORDING: os.path.relpath(recording.resolve(), folder.resolve())}


def run_of(folder: Path) -> Path:
    """The result folder of the run: that of a folder of ``pliant mesh``, else the folder itself.

    Raises ResultError if the report does not name a recording that is there.
    """
    report = folder / MESHED_NAME
    if not report.is_file():
        return folder
    try:
        recording = folder.resolve() / json.loads(report.read_text(encoding="utf-8"))[_RECORDING]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ResultError(f"{report}: names no recording ({shown(error)}): mesh it again") from None
    if not recording.exists():
        raise ResultError(f"{report}: its recording {recording} is gone: mesh it again")
    return recording.parent


def mesh_report(pieces: Sequence[MeshPiece]) -> list[dict[str, Any]]:
    """The entry of report.json for each mesh."""
    return [
        {
            "segment": segment,
            "level": level,
            "voxel_size": some[0].voxel_size,
            "keyframes": some[0].keyframes,
            "vertices": sum(len(piece.positions) for piece in some),
            "triangles": sum(len(piece.triangles) for piece in some),
        }
        for (segment, level), some in sorted(meshes_of(pieces).items())
    ]

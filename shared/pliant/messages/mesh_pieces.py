"""Final meshes as messages of bounded size, and back."""

from collections.abc import Iterator, Sequence

import numpy as np

from pliant.algorithms.meshing.mesh_blocks import TriangleMesh
from pliant.errors import MessageError
from pliant.messages.types import WORLD_FRAME_ID, Header, MeshPiece

PIECE_VERTICES = 1 << 16
PIECE_TRIANGLES = 1 << 17


def split(
    header: Header, mesh: TriangleMesh, *, segment: int, level: str, voxel_size: float,
    keyframes: int,
) -> Iterator[MeshPiece]:  # fmt: skip
    """The pieces of a mesh, at least one."""
    V, T = len(mesh.positions), len(mesh.triangles)
    pieces = max(1, -(-V // PIECE_VERTICES), -(-T // PIECE_TRIANGLES))
    for piece in range(pieces):
        rows = slice(piece * PIECE_VERTICES, (piece + 1) * PIECE_VERTICES)
        faces = slice(piece * PIECE_TRIANGLES, (piece + 1) * PIECE_TRIANGLES)
        yield MeshPiece(
            frame=header.frame,
            stamp_ns=header.stamp_ns,
            frame_id=WORLD_FRAME_ID,
            segment=segment,
            level=level,
            voxel_size=voxel_size,
            keyframes=keyframes,
            piece=piece,
            pieces=pieces,
            positions=mesh.positions[rows],
            normals=mesh.normals[rows],
            colours=mesh.colours[rows],
            triangles=mesh.triangles[faces],
            closed=mesh.closed[(mesh.closed >= rows.start) & (mesh.closed < rows.stop)],
        )


def joined(pieces: Sequence[MeshPiece]) -> TriangleMesh:
    """The mesh of all its pieces, in order.  Raises MessageError if they are not all there."""
    wanted = pieces[0].pieces if pieces else 1
    if [p.piece for p in pieces] != list(range(wanted)):
        raise MessageError(f"a mesh has {wanted} pieces, {len(pieces)} came")
    mesh = TriangleMesh(
        positions=np.concatenate([p.positions for p in pieces]),
        normals=np.concatenate([p.normals for p in pieces]),
        colours=np.concatenate([p.colours for p in pieces]),
        triangles=np.concatenate([p.triangles for p in pieces]),
        closed=np.concatenate([p.closed for p in pieces]),
    )
    for rows in (mesh.triangles, mesh.closed):
        if len(rows) and not 0 <= int(rows.min()) <= int(rows.max()) < len(mesh.positions):
            raise MessageError("a mesh has a corner that is not a vertex")
    return mesh

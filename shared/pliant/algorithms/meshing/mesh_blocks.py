"""The mesh as blocks that change: what the mesher sends, and what it and its viewers hold.

No kernels: readers of messages load this module.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, fields
from typing import Annotated

import numpy as np

from pliant.algorithms.arrays import F32, I32, I64, U8, BoolArray, Shape

SIDE = 8
"""Voxels along the side of a block."""
BLOCK_BYTES = SIDE**3 * 4 * 6
"""Six int32 a voxel: see ``VoxelSums``."""
KEY_LIMIT = 1 << 20
"""Keys beyond this have no number: such blocks are passed over."""
KEY_BITS = 21
_KEY_MASK = (1 << KEY_BITS) - 1
LATTICE = SIDE + 1
"""Lattice points along the side of a block's cubes."""
_ROWS = 1 << 16
LAST_KEY = (1 << 63) - 1
"""No packed key lies behind this one; none lies before 0."""


@dataclass(frozen=True, kw_only=True)
class MeshBlocks:
    """The whole surface of some blocks, which replaces an earlier one.

    Vertices and triangles stand block after block, in the order of the keys.

    keys: blocks, ascending.    vertex_counts, triangle_counts: of each; none: it is empty now.
    edges: the lattice edge of its block on which a vertex lies, ascending within a block:
    ((z * LATTICE + y) * LATTICE + x) * 3 + axis.  Blocks that touch share those on their faces.
    positions, normals: world frame; normals are unit and point to where the cameras were.
    colours: RGB.    triangles: rows of the block's own vertices, anticlockwise from outside.
    """

    keys: Annotated[I32, Shape("B", 3)]
    vertex_counts: Annotated[I32, Shape("B")]
    triangle_counts: Annotated[I32, Shape("B")]
    edges: Annotated[I32, Shape("V")]
    positions: Annotated[F32, Shape("V", 3)]
    normals: Annotated[F32, Shape("V", 3)]
    colours: Annotated[U8, Shape("V", 3)]
    triangles: Annotated[I32, Shape("T", 3)]


def no_rows() -> I32:
    """(0,) of none."""
    return np.zeros(0, np.int32)


@dataclass(frozen=True, kw_only=True)
class TriangleMesh:
    """A welded mesh.  Fields as in MeshBlocks; triangles are rows of the vertices here.

    closed: rows of vertices that no keyframe saw, ascending: with their triangles they close holes.
    """

    positions: Annotated[F32, Shape("V", 3)]
    normals: Annotated[F32, Shape("V", 3)]
    colours: Annotated[U8, Shape("V", 3)]
    triangles: Annotated[I32, Shape("T", 3)]
    closed: Annotated[I32, Shape("C")] = field(default_factory=no_rows)

    def of_triangles(self, rows: BoolArray | slice) -> "TriangleMesh":
        """Some of its triangles with the vertices that they use."""
        used, corners = np.unique(self.triangles[rows], return_inverse=True)
        return TriangleMesh(
            positions=self.positions[used],
            normals=self.normals[used],
            colours=self.colours[used],
            triangles=corners.reshape(-1, 3).astype(np.int32),
            closed=np.flatnonzero(np.isin(used, self.closed)).astype(np.int32),
        )

    def observed(self) -> "TriangleMesh":
        """Without the triangles that close holes: those with a vertex that no keyframe saw."""
        return self.of_triangles(~np.any(np.isin(self.triangles, self.closed), axis=1))


def pack(keys: I32) -> I64:
    """(N,) numbers in the order of the (N, 3) keys (by x, then y, then z)."""
    shifted = keys.astype(np.int64) + KEY_LIMIT
    return (shifted[:, 0] << 2 * KEY_BITS) | (shifted[:, 1] << KEY_BITS) | shifted[:, 2]


def unpack(packed: I64) -> I32:
    """The inverse of ``pack``."""
    columns = [packed >> 2 * KEY_BITS, packed >> KEY_BITS & _KEY_MASK, packed & _KEY_MASK]
    return (np.stack(columns, axis=1) - KEY_LIMIT).astype(np.int32)


def sorted_keys(keys: I32) -> I32:
    """Distinct keys, ascending."""
    return unpack(np.unique(pack(keys)))


def no_blocks() -> MeshBlocks:
    """No block at all."""
    return MeshBlocks(
        keys=np.zeros((0, 3), np.int32),
        vertex_counts=np.zeros(0, np.int32),
        triangle_counts=np.zeros(0, np.int32),
        edges=np.zeros(0, np.int32),
        positions=np.zeros((0, 3), np.float32),
        normals=np.zeros((0, 3), np.float32),
        colours=np.zeros((0, 3), np.uint8),
        triangles=np.zeros((0, 3), np.int32),
    )


class BlockMesh:
    """A mesh that grows and changes by blocks.  It holds no empty ones."""

    def __init__(self) -> None:
        self._blocks: dict[int, MeshBlocks] = {}

    def __len__(self) -> int:
        return len(self._blocks)

    def changes(self, blocks: MeshBlocks) -> MeshBlocks:
        """Return the blocks that differ from the stored ones, for a reader that has the same."""
        starts, faces = _bounds(blocks.vertex_counts), _bounds(blocks.triangle_counts)
        differ = np.zeros(len(blocks.keys), np.bool_)
        for row, key in enumerate(pack(blocks.keys).tolist()):
            held = self._blocks.get(key)
            vertices = slice(starts[row], starts[row + 1])
            triangles = slice(faces[row], faces[row + 1])
            if held is None:
                differ[row] = blocks.triangle_counts[row] > 0
            else:
                differ[row] = not _same(held, blocks, vertices, triangles)
        return select_blocks(blocks, differ)

    def apply(self, blocks: MeshBlocks) -> None:
        """Put the blocks in the place of what is held of them."""
        starts, faces = _bounds(blocks.vertex_counts), _bounds(blocks.triangle_counts)
        for row, key in enumerate(pack(blocks.keys).tolist()):
            if blocks.triangle_counts[row] == 0:
                self._blocks.pop(key, None)
                continue
            at, face = slice(starts[row], starts[row + 1]), slice(faces[row], faces[row + 1])
            self._blocks[key] = MeshBlocks(
                keys=blocks.keys[row : row + 1].copy(),
                vertex_counts=blocks.vertex_counts[row : row + 1].copy(),
                triangle_counts=blocks.triangle_counts[row : row + 1].copy(),
                edges=blocks.edges[at].copy(),
                positions=blocks.positions[at].copy(),
                normals=blocks.normals[at].copy(),
                colours=blocks.colours[at].copy(),
                triangles=blocks.triangles[face].copy(),
            )

    def clear_span(self, published: I32, first: int, last: int) -> I32:
        """Let go of blocks whose packed keys lie in [first, last] and that were not published.

        published: (T, 3) keys.  Returns the (N, 3) keys of those that are gone, ascending.
        """
        kept = set(pack(published).tolist())
        gone = sorted(key for key in self._blocks if first <= key <= last and key not in kept)
        for key in gone:
            del self._blocks[key]
        return unpack(np.array(gone, np.int64))

    def packed_keys(self) -> list[int]:
        """The packed keys of all blocks, ascending."""
        return sorted(self._blocks)

    def blocks(self, packed_keys: list[int]) -> MeshBlocks:
        """The held ones of some blocks, which are given in ascending order."""
        return joined_blocks([self._blocks[key] for key in packed_keys if key in self._blocks])

    def snapshot(self) -> MeshBlocks:
        """Everything held, for a viewer that joins late."""
        return self.blocks(self.packed_keys())

    def mesh(self) -> TriangleMesh:
        """One mesh, welded across blocks.  It depends on what is held, not on how it came."""
        return weld(self.snapshot())


def weld(blocks: MeshBlocks) -> TriangleMesh:
    """One mesh: vertices on the same lattice edge are one, in the order of first use.

    Blocks must be of one time: what they share on their faces must be the same in both.
    """
    block = np.repeat(np.arange(len(blocks.keys), dtype=np.int32), blocks.vertex_counts)
    ids = np.empty(len(block), np.int64)
    for rows in _parts(len(block)):
        ids[rows] = _edge_ids(blocks.keys[block[rows]], blocks.edges[rows])
    _, first, where = np.unique(ids, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty(len(order), np.int32)
    rank[order] = np.arange(len(order), dtype=np.int32)
    place, kept = rank[where.ravel()], first[order]
    del block, ids, first, where, order, rank
    of_triangle = np.repeat(np.cumsum(blocks.vertex_counts, dtype=np.int64) - blocks.vertex_counts,
                            blocks.triangle_counts)  # fmt: skip
    triangles = np.empty((len(of_triangle), 3), np.int32)
    for rows in _parts(len(triangles)):
        triangles[rows] = place[blocks.triangles[rows] + of_triangle[rows, None]]
    return TriangleMesh(
        positions=blocks.positions[kept],
        normals=blocks.normals[kept],
        colours=blocks.colours[kept],
        triangles=triangles,
    )


def _edge_ids(keys: I32, edges: I32) -> I64:
    """(N,) numbers of lattice edges: 20 bits a coordinate and two for the axis."""
    at, axis = edges // 3, edges % 3
    local = np.stack([at % LATTICE, at // LATTICE % LATTICE, at // LATTICE**2], axis=1)
    shifted = keys.astype(np.int64) * SIDE + local + (1 << 19)
    return (((shifted[:, 0] << 20 | shifted[:, 1]) << 20 | shifted[:, 2]) << 2) | axis


def _parts(count: int) -> Iterator[slice]:
    """Slices of many rows, so that temporary arrays stay small."""
    return (slice(first, first + _ROWS) for first in range(0, count, _ROWS))


def unwelded(blocks: MeshBlocks) -> TriangleMesh:
    """One mesh with the vertices of each block for itself: blocks may be of different times."""
    starts = np.cumsum(blocks.vertex_counts) - blocks.vertex_counts
    return TriangleMesh(
        positions=blocks.positions,
        normals=blocks.normals,
        colours=blocks.colours,
        triangles=blocks.triangles
        + np.repeat(starts, blocks.triangle_counts).astype(np.int32)[:, None],
    )


def select_blocks(blocks: MeshBlocks, chosen: BoolArray) -> MeshBlocks:
    """The (B,) chosen ones."""
    vertices = np.repeat(chosen, blocks.vertex_counts)
    return MeshBlocks(
        keys=blocks.keys[chosen],
        vertex_counts=blocks.vertex_counts[chosen],
        triangle_counts=blocks.triangle_counts[chosen],
        edges=blocks.edges[vertices],
        positions=blocks.positions[vertices],
        normals=blocks.normals[vertices],
        colours=blocks.colours[vertices],
        triangles=blocks.triangles[np.repeat(chosen, blocks.triangle_counts)],
    )


def _bounds(counts: I32) -> list[int]:
    return [0, *np.cumsum(counts).tolist()]


def _same(held: MeshBlocks, blocks: MeshBlocks, at: slice, face: slice) -> bool:
    return (
        np.array_equal(held.triangles, blocks.triangles[face])
        and np.array_equal(held.edges, blocks.edges[at])
        and np.array_equal(held.positions, blocks.positions[at])
        and np.array_equal(held.normals, blocks.normals[at])
        and np.array_equal(held.colours, blocks.colours[at])
    )


def joined_blocks(parts: list[MeshBlocks]) -> MeshBlocks:
    """Concatenate the blocks of several parts; keys must ascend throughout.

    The list is empty then.
    """
    if not parts:
        return no_blocks()
    columns = {f.name: [getattr(part, f.name) for part in parts] for f in fields(MeshBlocks)}
    parts.clear()  # a column at a time, so that not all is there twice
    return MeshBlocks(**{name: np.concatenate(columns.pop(name)) for name in list(columns)})

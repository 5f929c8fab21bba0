"""Marching cubes over blocks of a TSDF, with welded vertices, normals and colours.

A cube is meshed where all of its corners were seen and no edge that it cuts changes faster than a
distance can: where that happens, sights of different surfaces meet, as behind an edge of a thing,
and there is no surface.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from pliant.algorithms.arrays import F32, I32, I64, U8
from pliant.algorithms.kernel import fast_kernel, kernel
from pliant.algorithms.meshing.marching_cubes_table import edge_corners, triangle_table
from pliant.algorithms.meshing.mesh_blocks import LATTICE, MeshBlocks
from pliant.algorithms.meshing.tsdf_blocks import SIDE, BlockTable, pack_one, row_of
from pliant.algorithms.meshing.tsdf_integrate import DISTANCE_UNITS

_PAD = SIDE + 3
"""Voxels of a block, one before and two behind it: what its cubes and their gradients read."""
_END = np.float32(0.01)
"""Vertices keep this share of an edge from its ends, so that no triangle is without area."""
_MAX_STEPS = 3.0
"""A cut edge may change by so many voxels' worth of distance.  A true distance has one."""
_VERTEX = 9
"""Values of a vertex: position, normal, colour."""


@dataclass(frozen=True)
class TsdfArrays:
    """The sums of ``tsdf_integrate``, where the blocks stand in them, and their scale."""

    table: BlockTable
    slots: I32
    distance_sums: I32
    weight_sums: I32
    colour_sums: I32
    voxel: float
    truncation: float
    min_weight: int


def extract_blocks(keys: I32, tsdf: TsdfArrays) -> MeshBlocks:
    """The surface in the cubes that start in the (B, 3) blocks given, in their order.

    Blocks that are not in the table have no surface.
    """
    counts, triangles_of = triangle_table()
    max_jump = _MAX_STEPS * tsdf.voxel / tsdf.truncation
    vertex_counts, triangle_counts, edges, values, triangles = _march(
        np.ascontiguousarray(keys), tsdf.table.packed, tsdf.table.rows, tsdf.slots,
        tsdf.distance_sums, tsdf.weight_sums, tsdf.colour_sums, tsdf.voxel, tsdf.min_weight,
        max_jump, counts, triangles_of, edge_corners(),
    )  # fmt: skip
    return MeshBlocks(
        keys=keys.copy(),
        vertex_counts=vertex_counts,
        triangle_counts=triangle_counts,
        edges=edges,
        positions=values[:, 0:3].copy(),
        normals=values[:, 3:6].copy(),
        colours=np.rint(values[:, 6:9]).astype(np.uint8),
        triangles=triangles,
    )


@kernel
def _march(
    keys: I32, packed: I64, rows: I32, slots: I32, distance_sums: I32, weight_sums: I32,
    colour_sums: I32, voxel: float, min_weight: int, max_jump: float,
    counts: I32, triangles_of: I32, corners: I32,
) -> tuple[I32, I32, I32, F32, I32]:  # fmt: skip
    vertex_counts = np.zeros(len(keys), np.int32)
    triangle_counts = np.zeros(len(keys), np.int32)
    edges: Any = np.empty(4096, np.int32)
    values: Any = np.empty((4096, _VERTEX), np.float32)
    triangles: Any = np.empty((8192, 3), np.int32)
    near = np.empty((3, 3, 3), np.int32)
    field = np.empty((_PAD, _PAD, _PAD), np.float32)
    cases = np.zeros((SIDE, SIDE, SIDE), np.uint8)
    ids = np.full(LATTICE * LATTICE * LATTICE * 3, -1, np.int32)
    vertex, face = 0, 0
    for i in range(len(keys)):
        _neighbours(keys[i], packed, rows, slots, near)
        if near[1, 1, 1] < 0:
            continue
        if not _crossed(near, distance_sums, weight_sums, min_weight):
            continue
        _gather(near, distance_sums, weight_sums, min_weight, field)
        faces = _classify(field, max_jump, counts, triangles_of, corners, cases, ids)
        if faces == 0:
            continue
        while vertex + len(ids) > len(values):
            edges, values = _longer(edges), _larger(values)
        while face + faces > len(triangles):
            triangles = _larger(triangles)
        first = vertex
        for e in range(len(ids)):
            if ids[e] == 0:
                ids[e] = vertex - first
                edges[vertex] = e
                _vertex(e, keys[i], near, field, colour_sums, voxel, values[vertex])
                vertex += 1
        face = _emit(cases, counts, triangles_of, corners, ids, triangles, face)
        vertex_counts[i], triangle_counts[i] = vertex - first, faces
        for k in range(first, vertex):
            ids[edges[k]] = -1
    return (
        vertex_counts, triangle_counts,
        edges[:vertex].copy(), values[:vertex].copy(), triangles[:face].copy(),
    )  # fmt: skip


@kernel
def _larger(array: Any) -> Any:
    """The same rows, and room for as many more."""
    longer = np.empty((2 * array.shape[0], array.shape[1]), array.dtype)
    longer[: array.shape[0]] = array
    return longer


@kernel
def _longer(array: I32) -> I32:
    longer = np.empty(2 * len(array), array.dtype)
    longer[: len(array)] = array
    return longer


@kernel
def _neighbours(key: I32, packed: I64, rows: I32, slots: I32, near: I32) -> None:
    """Slots of the 27 blocks around a key by (z, y, x), -1 where there is none."""
    for dz in range(3):
        for dy in range(3):
            for dx in range(3):
                row = row_of(
                    packed, rows, pack_one(key[0] + dx - 1, key[1] + dy - 1, key[2] + dz - 1)
                )
                near[dz, dy, dx] = slots[row] if row >= 0 else -1


@kernel
def _crossed(near: I32, distance_sums: I32, weight_sums: I32, min_weight: int) -> bool:
    """Whether the voxels that the cubes of a block read have both signs."""
    inside, outside = False, False
    for z in range(SIDE + 1):
        for y in range(SIDE + 1):
            for part in range(2):
                slot = near[1 + (z >> 3), 1 + (y >> 3), 1 + part]
                if slot < 0:
                    continue
                sums = distance_sums[slot, z & 7, y & 7]
                weights = weight_sums[slot, z & 7, y & 7]
                for x in range(1 if part else SIDE):
                    if weights[x] >= min_weight:
                        inside |= sums[x] < 0
                        outside |= sums[x] >= 0
            if inside and outside:
                return True
    return False


@fast_kernel
def _gather(near: I32, distance_sums: I32, weight_sums: I32, min_weight: int, field: F32) -> None:
    """Mean distances in truncations, NaN where the weight is too small."""
    for z in range(_PAD):
        for y in range(_PAD):
            for x in range(_PAD):
                slot = near[(z + 7) >> 3, (y + 7) >> 3, (x + 7) >> 3]
                value = np.float32(np.nan)
                if slot >= 0:
                    w = weight_sums[slot, (z + 7) & 7, (y + 7) & 7, (x + 7) & 7]
                    if w >= min_weight:
                        s = distance_sums[slot, (z + 7) & 7, (y + 7) & 7, (x + 7) & 7]
                        value = np.float32(s) / (np.float32(DISTANCE_UNITS) * np.float32(w))
                field[z, y, x] = value


@kernel
def _classify(
    field: F32, max_jump: float, counts: I32, triangles_of: I32, corners: I32, cases: U8, ids: I32
) -> int:
    """Set the case of each cube, mark the edges that it uses with 0, and count the triangles."""
    faces = 0
    for z in range(SIDE):
        for y in range(SIDE):
            for x in range(SIDE):
                case, seen = 0, True
                for c in range(8):
                    value = field[z + 1 + (c >> 2), y + 1 + (c >> 1 & 1), x + 1 + (c & 1)]
                    if not value >= 0.0:
                        if not value < 0.0:
                            seen = False
                        case |= 1 << c
                if not seen or counts[case] == 0:
                    cases[z, y, x] = 0
                    continue
                for e in range(12):
                    a, b = corners[e, 0], corners[e, 1]
                    if (case >> a & 1) != (case >> b & 1):
                        first = field[z + 1 + (a >> 2), y + 1 + (a >> 1 & 1), x + 1 + (a & 1)]
                        last = field[z + 1 + (b >> 2), y + 1 + (b >> 1 & 1), x + 1 + (b & 1)]
                        if abs(first - last) > max_jump:
                            seen = False
                if not seen:
                    cases[z, y, x] = 0
                    continue
                cases[z, y, x] = case
                faces += counts[case]
                for t in range(counts[case]):
                    for k in range(3):
                        ids[_edge_id(x, y, z, triangles_of[case, t, k], corners)] = 0
    return faces


@kernel
def _edge_id(x: int, y: int, z: int, edge: int, corners: I32) -> int:
    """The number of a cube's edge among those of its block, by z, y, x of its start, then axis."""
    c = corners[edge, 0]
    at = ((z + (c >> 2)) * LATTICE + y + (c >> 1 & 1)) * LATTICE + x + (c & 1)
    return at * 3 + edge // 4


@kernel
def _emit(
    cases: U8, counts: I32, triangles_of: I32, corners: I32, ids: I32, triangles: I32, first: int
) -> int:
    """Write the triangles from row ``first`` on; the row after the last."""
    face = first
    for z in range(SIDE):
        for y in range(SIDE):
            for x in range(SIDE):
                case = cases[z, y, x]
                for t in range(counts[case]):
                    for k in range(3):
                        edge = triangles_of[case, t, k]
                        triangles[face, k] = ids[_edge_id(x, y, z, edge, corners)]
                    face += 1
    return face


@kernel
def _difference(field: F32, z: int, y: int, x: int, dz: int, dy: int, dx: int) -> np.float32:
    """A slope in one direction: between both neighbours, or on the side that was seen."""
    here, after, before = (
        field[z, y, x], field[z + dz, y + dy, x + dx], field[z - dz, y - dy, x - dx]
    )  # fmt: skip
    if np.isnan(after):
        return here - before if not np.isnan(before) else np.float32(0.0)
    if np.isnan(before):
        return after - here
    return np.float32(0.5) * (after - before)


@kernel
def _vertex(
    edge: int, key: I32, near: I32, field: F32, colour_sums: I32, voxel: float, out: F32
) -> None:
    """Position, normal and colour where the distance is zero on an edge of the lattice."""
    axis, at = edge % 3, edge // 3
    x, y, z = at % LATTICE, at // LATTICE % LATTICE, at // (LATTICE * LATTICE)
    dx, dy, dz = int(axis == 0), int(axis == 1), int(axis == 2)
    px, py, pz = x + 1, y + 1, z + 1
    a, b = field[pz, py, px], field[pz + dz, py + dy, px + dx]
    t = min(max(a / (a - b), _END), np.float32(1.0) - _END)
    # From whole numbers, so that both blocks at a face give the same bits.
    out[0] = (key[0] * SIDE + x + dx * t) * voxel
    out[1] = (key[1] * SIDE + y + dy * t) * voxel
    out[2] = (key[2] * SIDE + z + dz * t) * voxel
    s = np.float32(1.0) - t
    nx = s * _difference(field, pz, py, px, 0, 0, 1)
    ny = s * _difference(field, pz, py, px, 0, 1, 0)
    nz = s * _difference(field, pz, py, px, 1, 0, 0)
    px, py, pz = px + dx, py + dy, pz + dz
    nx += t * _difference(field, pz, py, px, 0, 0, 1)
    ny += t * _difference(field, pz, py, px, 0, 1, 0)
    nz += t * _difference(field, pz, py, px, 1, 0, 0)
    norm = np.sqrt(nx * nx + ny * ny + nz * nz)
    if norm > 0.0:
        out[3], out[4], out[5] = nx / norm, ny / norm, nz / norm
    else:  # The edge itself changes sign.
        sign = np.float32(1.0) if b > a else np.float32(-1.0)
        out[3], out[4], out[5] = sign * dx, sign * dy, sign * dz
    first = colour_sums[near[1 + (z >> 3), 1 + (y >> 3), 1 + (x >> 3)], z & 7, y & 7, x & 7]
    x, y, z = x + dx, y + dy, z + dz
    last = colour_sums[near[1 + (z >> 3), 1 + (y >> 3), 1 + (x >> 3)], z & 7, y & 7, x & 7]
    s = s / first[3] if first[3] > 0 else np.float32(0.0)
    t = t / last[3] if last[3] > 0 else np.float32(0.0)
    total = max(s * first[3] + t * last[3], np.float32(1e-9))
    for k in range(3):
        out[6 + k] = (s * first[k] + t * last[k]) / total

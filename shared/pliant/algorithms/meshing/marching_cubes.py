"""Marching cubes over blocks of a TSDF, with welded vertices, normals and colours.

A cube is meshed where all of its corners were seen and no edge that it cuts changes faster than a
distance can: where that happens, sights of different surfaces meet, as behind an edge of a thing,
and there is no surface.

The triangles of a cube are worked out from the cube itself (Lorensen and Cline 1987).  Corner c of
a cube stands at (c & 1, c >> 1 & 1, c >> 2): x, y, z.  A case is the set of corners inside (tsdf <
0), bit c for corner c.  Edge 4 * axis + i runs along the axis from its i-th corner without that
bit.  On each face the crossings are joined so that corners inside which share no edge of the face
are kept apart; both cubes at the face see the same, so that the surfaces of neighbours meet.  The
joints of a cube form loops, one crossing each, and a loop is cut into triangles whose inner edges
run through the cube and not along a face, where the neighbour could have the same.
"""

from functools import cache
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from pliant.algorithms.arrays import F32, I32, U8
from pliant.algorithms.meshing.mesh_blocks import LATTICE, SIDE, MeshBlocks
from pliant.algorithms.meshing.tsdf_blocks import BlockTable, Scale, VoxelSums, pack_one, row_of
from pliant.algorithms.meshing.tsdf_integrate import DISTANCE_UNITS
from pliant.compiler.kernel import fast_kernel, kernel

MAX_TRIANGLES = 5
_FACES = (  # Corners in the order of their outline, anticlockwise from outside.
    (0, 4, 6, 2), (1, 3, 7, 5), (0, 1, 5, 4), (2, 6, 7, 3), (0, 2, 3, 1), (4, 5, 7, 6),
)  # fmt: skip
_EDGES = tuple((c, c | 1 << axis) for axis in range(3) for c in range(8) if not c & 1 << axis)
_PAD = SIDE + 3
"""Voxels of a block, one before and two behind it: what its cubes and their gradients read."""
_END = np.float32(0.01)
"""Vertices keep this share of an edge from its ends, so that no triangle is without area."""
MAX_STEPS = 3.0
"""A cut edge may change by this many voxels' worth of distance.  A true distance has one."""
_VERTEX = 9
"""Values of a vertex: position, normal, colour."""


class Tsdf(NamedTuple):
    """The sums of a volume's blocks, and their scale.

    min_weight: voxels of less, in WEIGHT_UNITS, were not seen.    max_steps: see MAX_STEPS.
    """

    table: BlockTable
    sums: VoxelSums
    scale: Scale
    min_weight: int
    max_steps: float = MAX_STEPS


class CubeTable(NamedTuple):
    """counts: (256,) how many triangles a case has.    triangles: (256, MAX_TRIANGLES, 3) the edges
    of their corners, anticlockwise seen from outside the surface (tsdf > 0).    corners: (12, 2) of
    each edge, the smaller first.
    """

    counts: I32
    triangles: I32
    corners: I32


def extract_blocks(keys: I32, tsdf: Tsdf) -> MeshBlocks:
    """The surface in the cubes that start in the (B, 3) blocks given, in their order.

    Blocks that are not in the table have no surface.
    """
    vertex_counts, triangle_counts, edges, values, triangles = _march(
        np.ascontiguousarray(keys), tsdf, cube_table()
    )
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


@cache
def _edge(a: int, b: int) -> int:
    return _EDGES.index((min(a, b), max(a, b)))


@cache
def _on_one_face(e: int, f: int) -> bool:
    corners = {*_EDGES[e], *_EDGES[f]}
    return any(corners <= set(face) for face in _FACES)


@cache
def cube_table() -> CubeTable:
    """The triangles of every case."""
    counts = np.zeros(256, np.int32)
    table = np.zeros((256, MAX_TRIANGLES, 3), np.int32)
    for case in range(256):
        triangles = [t for loop in _loops(case) for t in _cut(tuple(loop))]
        counts[case] = len(triangles)
        table[case, : len(triangles)] = np.array(triangles, np.int32).reshape(-1, 3)
    return CubeTable(counts, table, np.array(_EDGES, np.int32))


def _loops(case: int) -> list[list[int]]:
    """The outlines of the surface in one cube, as edges in order."""
    after: dict[int, int] = {}
    for face in _FACES:
        inside = [bool(case >> c & 1) for c in face]
        for k in range(4):
            if inside[k] or not inside[(k + 1) % 4]:
                continue
            # The run of corners inside that starts at k + 1 ends at the next one outside.
            end = k + 1
            while inside[(end + 1) % 4]:
                end += 1
            entry = _edge(face[k], face[(k + 1) % 4])
            leave = _edge(face[end % 4], face[(end + 1) % 4])
            after[entry] = leave
    loops: list[list[int]] = []
    while after:
        edge = min(after)
        loop: list[int] = []
        while edge in after:
            loop.append(edge)
            edge = after.pop(edge)
        loops.append(loop)
    return loops


@cache
def _cut(loop: tuple[int, ...]) -> tuple[tuple[int, int, int], ...]:
    """Triangles of a loop, with as few inner edges along a face as can be."""
    return _best_cut(loop)[1]


@cache
def _best_cut(loop: tuple[int, ...]) -> tuple[int, tuple[tuple[int, int, int], ...]]:
    if len(loop) < 3:
        return 0, ()
    first, last = loop[0], loop[-1]
    best: tuple[int, tuple[tuple[int, int, int], ...]] | None = None
    for k in range(1, len(loop) - 1):
        left, right = _best_cut(loop[: k + 1]), _best_cut(loop[k:])
        cost = left[0] + right[0]
        for i, j in pairwise((0, k, len(loop) - 1)):
            cost += int(j - i > 1 and _on_one_face(loop[i], loop[j]))
        if best is None or cost < best[0]:
            best = cost, ((first, loop[k], last), *left[1], *right[1])
    assert best is not None
    return best


@kernel
def _march(keys: I32, tsdf: Tsdf, cube: CubeTable) -> tuple[I32, I32, I32, F32, I32]:
    max_jump = tsdf.max_steps * tsdf.scale.voxel / tsdf.scale.truncation
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
        _neighbours(keys[i], tsdf.table, near)
        if near[1, 1, 1] < 0:
            continue
        if not _crossed(near, tsdf.sums, tsdf.min_weight):
            continue
        _gather(near, tsdf.sums, tsdf.min_weight, field)
        faces = _classify(field, max_jump, cube, cases, ids)
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
                _vertex(e, keys[i], near, field, tsdf, values[vertex])
                vertex += 1
        face = _emit(cases, cube, ids, triangles, face)
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
def _neighbours(key: I32, table: BlockTable, near: I32) -> None:
    """Rows of the 27 blocks around a key by (z, y, x), -1 where there is none."""
    for dz in range(3):
        for dy in range(3):
            for dx in range(3):
                at = pack_one(key[0] + dx - 1, key[1] + dy - 1, key[2] + dz - 1)
                near[dz, dy, dx] = row_of(table, at)


@kernel
def _crossed(near: I32, sums: VoxelSums, min_weight: int) -> bool:
    """Whether the voxels that the cubes of a block read have both signs."""
    inside, outside = False, False
    for z in range(SIDE + 1):
        for y in range(SIDE + 1):
            for part in range(2):
                row = near[1 + (z >> 3), 1 + (y >> 3), 1 + part]
                if row < 0:
                    continue
                distances = sums.distances[row, z & 7, y & 7]
                weights = sums.weights[row, z & 7, y & 7]
                for x in range(1 if part else SIDE):
                    if weights[x] >= min_weight:
                        inside |= distances[x] < 0
                        outside |= distances[x] >= 0
            if inside and outside:
                return True
    return False


@fast_kernel
def _gather(near: I32, sums: VoxelSums, min_weight: int, field: F32) -> None:
    """Mean distances in truncations, NaN where the weight is too small."""
    for z in range(_PAD):
        for y in range(_PAD):
            for x in range(_PAD):
                row = near[(z + 7) >> 3, (y + 7) >> 3, (x + 7) >> 3]
                value = np.float32(np.nan)
                if row >= 0:
                    w = sums.weights[row, (z + 7) & 7, (y + 7) & 7, (x + 7) & 7]
                    if w >= min_weight:
                        s = sums.distances[row, (z + 7) & 7, (y + 7) & 7, (x + 7) & 7]
                        value = np.float32(s) / (np.float32(DISTANCE_UNITS) * np.float32(w))
                field[z, y, x] = value


@kernel
def _classify(field: F32, max_jump: float, cube: CubeTable, cases: U8, ids: I32) -> int:
    """Set the case of each cube, mark the edges that it uses with 0, and count the triangles."""
    counts, triangles_of, corners = cube
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
def _emit(cases: U8, cube: CubeTable, ids: I32, triangles: I32, first: int) -> int:
    """Write the triangles from row ``first`` on; the row after the last."""
    counts, triangles_of, corners = cube
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
def _vertex(edge: int, key: I32, near: I32, field: F32, tsdf: Tsdf, out: F32) -> None:
    """Position, normal and colour where the distance is zero on an edge of the lattice."""
    colour_sums, voxel = tsdf.sums.colours, tsdf.scale.voxel
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

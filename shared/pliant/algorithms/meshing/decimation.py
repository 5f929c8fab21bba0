"""Meshes of fewer triangles: edges collapse where that moves the surface the least.

Garland and Heckbert 1997: what a vertex may not leave are the planes of the triangles that it has
stood for, summed up as a quadric q by their areas; an edge collapses into the point with the least
sum of both, [x 1] (q_u + q_v) [x 1]^T.  Planes that stand on its rim keep a surface's outline.
Edges that are the cheapest at both of their ends collapse together, so that a few passes over
arrays do it.

Why not a library: Open3D's needs libraries of the system.  fast-simplification orders edges by
thresholds, not by cost: of a flat square it loses 6 % at 40 triangles, and it spends as many on
what is flat as on what is bent (tests/unit/test_decimation.py fails with it).
"""

import math
from collections.abc import Iterator

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, I64, U8, BoolArray
from pliant.compiler.kernel import kernel

_AT_ONCE = 0.2
"""Share of the edges, the cheapest ones, that may collapse in a pass."""
_WORKABLE = 1_000_000
"""Triangles whose edges are looked at one by one, which takes some 300 MB.  Of more, vertices are
clustered first: where _MANY times fewer are wanted that no longer shows."""
_MANY = 8
_COARSER = 1.5
_ROWS = 1 << 16
"""Worked on together, so that what is needed between steps stays small."""
_EVEN = 1e-4
"""How much an edge's squared length counts beside squared distances from planes: where all is flat
the shortest collapse, and triangles stay even.  More of it costs shape, less makes splinters."""
_FOLD_COSINE = 0.2
"""Of the angle by which no triangle turns in a pass."""


def decimated(positions: F32, colours: U8, triangles: I32, most: int) -> tuple[F32, U8, I32]:
    """A mesh of at most that many triangles, without vertices that none of them has.

    positions, colours: (V, 3).    triangles: (T, 3).  Which way they turn stays.  It has more
    where the edges that are left folded when they were tried.
    """
    workable = max(_WORKABLE, _MANY * most)
    if len(triangles) > workable:
        positions, colours, triangles = clustered(positions, colours, triangles, workable)
    places = positions.astype(np.float64)
    tints = np.column_stack([colours, np.ones(len(colours))]).astype(np.float64)
    faces = _proper(triangles.astype(np.int64))
    quadrics = _quadrics(places, faces)
    blocked = np.zeros(0, np.int64)
    while len(faces) > most:
        edges, _ = _edges(faces, len(places))
        free = edges[~np.isin(edges, blocked)]
        chosen, onto = _cheapest(free, places, quadrics, -(-(len(faces) - most) // 2))
        kept = _unfolded(chosen, onto, places, faces)
        blocked = np.concatenate([blocked, chosen[~kept]])
        if not kept.any():
            if not len(chosen):
                break
            continue
        u, v = np.divmod(chosen[kept], len(places))
        places[u] = onto[kept]
        quadrics[u] += quadrics[v]
        tints[u] += tints[v]
        becomes = np.arange(len(places))
        becomes[v] = u
        faces = _proper(becomes[faces])
    used, corners = np.unique(faces, return_inverse=True)
    means = np.rint(tints[used, :3] / tints[used, 3:]).astype(np.uint8)
    return places[used].astype(np.float32), means, corners.reshape(-1, 3).astype(np.int32)


def clustered(positions: F32, colours: U8, triangles: I32, most: int) -> tuple[F32, U8, I32]:
    """A mesh of at most that many triangles: the vertices in each cell of a grid become their mean.

    Rossignac and Borrel 1993: coarse, and in memory that is a few times the mesh's own.
    """
    low = positions.min(axis=0)
    some = positions[triangles[:: max(1, len(triangles) // 4096)]].astype(np.float64)
    side = float(np.median(np.linalg.norm(some[:, 1] - some[:, 0], axis=1))) or 1e-30
    while True:
        side *= _COARSER
        cells = np.floor((positions - low) / np.float32(side)).astype(np.int64)
        _, cluster = np.unique(_numbered(cells), return_inverse=True)
        faces = _proper(cluster[triangles])
        # Of triangles that fall onto each other one stays.
        _, first = np.unique(_numbered(np.sort(faces, axis=1)), return_index=True)
        if len(first) <= most:
            break
    faces = faces[np.sort(first)]
    counts = np.bincount(cluster)
    means = [np.bincount(cluster, column) / counts for column in (*positions.T, *colours.T)]
    return (
        np.stack(means[:3], axis=1).astype(np.float32),
        np.rint(np.stack(means[3:], axis=1)).astype(np.uint8),
        faces.astype(np.int32),
    )


def _numbered(rows: I64) -> I64:
    """(N,) the same number for rows (N, 3) that are the same."""
    first, second, third = rows.T
    _, pair = np.unique(first * (int(second.max(initial=0)) + 1) + second, return_inverse=True)
    return pair * (int(third.max(initial=0)) + 1) + third


def _proper(triangles: I64) -> I64:
    """Those of three different vertices."""
    a, b, c = triangles.T
    return triangles[(a != b) & (b != c) & (c != a)]


def _edges(triangles: I64, vertices: int) -> tuple[I64, I64]:
    """(E,) u * vertices + v of each edge, u < v, and of how many triangles it is a side."""
    return np.unique(np.concatenate(_sides(triangles, vertices)), return_counts=True)


def _sides(triangles: I64, vertices: int) -> list[I64]:
    """The edges (T,) of all triangles, side by side, as ``_edges`` numbers them."""
    pairs = [(triangles[:, k], triangles[:, (k + 1) % 3]) for k in range(3)]
    return [np.minimum(a, b) * vertices + np.maximum(a, b) for a, b in pairs]


def _turned(places: F64, triangles: I64) -> F64:
    """(T, 3) normals, as long as twice the area."""
    turned = np.empty((len(triangles), 3))
    for rows in _parts(len(triangles)):
        a, b, c = places[triangles[rows]].transpose(1, 0, 2)
        turned[rows] = np.cross(b - a, c - a)
    return turned


def _quadrics(places: F64, triangles: I64) -> F64:
    """(V, 4, 4) of the vertices: planes of their triangles, and those that stand on their rims."""
    turned = _turned(places, triangles)
    twice = np.linalg.norm(turned, axis=1)
    normals = turned / np.maximum(twice, 1e-300)[:, None]
    found = np.zeros((len(places), 16))
    _add(found, triangles, normals, places[triangles[:, 0]], 0.5 * twice)
    edges, sides = _edges(triangles, len(places))
    for side in _sides(triangles, len(places)):
        rim = sides[np.searchsorted(edges, side)] == 1
        ends = np.stack(np.divmod(side[rim], len(places)), axis=1)
        along = places[ends[:, 1]] - places[ends[:, 0]]
        length = np.linalg.norm(along, axis=1)
        upright = np.cross(along / np.maximum(length, 1e-300)[:, None], normals[rim])
        _add(found, ends, upright, places[ends[:, 0]], length**2)
    return found.reshape(-1, 4, 4)


def _add(quadrics: F64, corners: I64, normals: F64, on: F64, weights: F64) -> None:
    """Add planes, by their unit normals and a point of each, to the vertices at their corners."""
    planes = np.column_stack([normals, -(normals * on).sum(axis=1)])
    for column in corners.T:
        for rows in _parts(len(planes)):
            n = planes[rows]
            each = weights[rows, None, None] * n[:, :, None] * n[:, None, :]
            np.add.at(quadrics, column[rows], each.reshape(-1, 16))


def _parts(count: int) -> Iterator[slice]:
    return (slice(first, first + _ROWS) for first in range(0, count, _ROWS))


def _cheapest(edges: I64, places: F64, quadrics: F64, most: int) -> tuple[I64, F64]:
    """(C,) edges that collapse together, at most that many, and (C, 3) what they become."""
    u, v = np.divmod(edges, len(places))
    onto, costs = np.empty((len(edges), 3)), np.empty(len(edges))
    _collapse(u, v, places, quadrics, onto, costs)
    order = np.argsort(costs, kind="stable")
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    best = np.full(len(places), len(order))
    np.minimum.at(best, u, rank)
    np.minimum.at(best, v, rank)
    order = order[: int(np.ceil(_AT_ONCE * len(order)))]
    chosen = order[(best[u] == rank)[order] & (best[v] == rank)[order]][:most]
    return edges[chosen], onto[chosen]


@kernel
def _collapse(u: I64, v: I64, places: F64, quadrics: F64, onto: F64, costs: F64) -> None:
    """Write (E, 3) what edges from u to v become, and (E,) what that costs.

    Near the middle m where the quadric (A, b, c) determines little, along a plane: with s of EVEN
    trace(A), (A + s I) d = -(A m + b), both sides over the trace, by Cramer's rule.
    """
    x, g = np.empty(4), np.empty(3)
    q = np.empty((4, 4))
    for edge in range(len(u)):
        one, other = u[edge], v[edge]
        apart = 0.0
        for i in range(3):
            apart += (places[one, i] - places[other, i]) ** 2
            x[i] = 0.5 * (places[one, i] + places[other, i])
        x[3] = 1.0
        for i in range(4):
            for j in range(4):
                q[i, j] = quadrics[one, i, j] + quadrics[other, i, j]
        size = q[0, 0] + q[1, 1] + q[2, 2] + 1e-300
        for i in range(3):
            g[i] = -(q[i, 0] * x[0] + q[i, 1] * x[1] + q[i, 2] * x[2] + q[i, 3]) / size
        a, d, f = q[0, 0] / size + _EVEN, q[1, 1] / size + _EVEN, q[2, 2] / size + _EVEN
        b, c, e = q[0, 1] / size, q[0, 2] / size, q[1, 2] / size
        ab, ac, bc = d * f - e * e, c * e - b * f, b * e - c * d
        scale = 1.0 / (a * ab + b * ac + c * bc)
        x[0] += (ab * g[0] + ac * g[1] + bc * g[2]) * scale
        x[1] += (ac * g[0] + (a * f - c * c) * g[1] + (b * c - a * e) * g[2]) * scale
        x[2] += (bc * g[0] + (b * c - a * e) * g[1] + (a * d - b * b) * g[2]) * scale
        cost = _EVEN * size * apart
        for i in range(4):
            for j in range(4):
                cost += x[i] * q[i, j] * x[j]
        for i in range(3):
            onto[edge, i] = x[i]
        costs[edge] = cost


def _unfolded(edges: I64, onto: F64, places: F64, triangles: I64) -> BoolArray:
    """(C,) which of the edges may collapse together so that no triangle turns too far."""
    u, v = np.divmod(edges, len(places))
    kept = np.ones(len(edges), np.bool_)
    while True:
        moved, becomes = places.copy(), np.arange(len(places))
        moved[u[kept]] = moved[v[kept]] = onto[kept]
        becomes[v[kept]] = u[kept]
        touched = np.zeros(len(places), np.bool_)
        _mark_folds(places, moved, becomes, triangles, touched)
        bad = kept & (touched[u] | touched[v])
        if not bad.any():
            return kept
        kept &= ~bad


@kernel
def _mark_folds(places: F64, moved: F64, becomes: I64, triangles: I64, touched: BoolArray) -> None:
    """Mark the corners of triangles that stay and turn too far between places and moved."""
    before, after = np.empty(3), np.empty(3)
    for t in range(len(triangles)):
        a, b, c = triangles[t]
        if becomes[a] == becomes[b] or becomes[b] == becomes[c] or becomes[c] == becomes[a]:
            continue
        _normal(places, a, b, c, before)
        _normal(moved, a, b, c, after)
        product, first, second = 0.0, 0.0, 0.0
        for k in range(3):
            product += before[k] * after[k]
            first += before[k] * before[k]
            second += after[k] * after[k]
        if product < _FOLD_COSINE * math.sqrt(first) * math.sqrt(second):
            touched[a] = touched[b] = touched[c] = True


@kernel
def _normal(places: F64, a: int, b: int, c: int, normal: F64) -> None:
    """Write the normal of a triangle, as long as twice the area."""
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        normal[k] = (places[b, i] - places[a, i]) * (places[c, j] - places[a, j]) - (
            places[b, j] - places[a, j]
        ) * (places[c, i] - places[a, i])

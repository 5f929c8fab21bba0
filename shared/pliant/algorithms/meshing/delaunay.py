"""Delaunay triangulation of image points, with the graph of its edges (VITAMIN-E, section 4).

By divide and conquer on an integer grid: Guibas and Stolfi, "Primitives for the manipulation of
general subdivisions and the computation of Voronoi diagrams", ACM TOG 1985, with Dwyer's cuts
(Algorithmica 1987): columns are halved across, then merged side by side, so that a cut is short and
few edges are made in vain.
"""

import math
from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, I64, Shape
from pliant.compiler.kernel import kernel

EXTENT_BITS = 20
"""Twice a triangle's area is at most 2**40 and a lift 2**41: exact in float64."""
_SAFE = 8.0 * 2.0**-53
"""Rounding of three products and two sums, over the sum of their magnitudes (5 suffice)."""
_SPLIT = 1 << 21
_FREE, _USED = 0, 1
_NONE = -1
_BITS = EXTENT_BITS + 1
_MASK = (1 << _BITS) - 1


@dataclass(frozen=True)
class Triangulation:
    """A triangulation whose vertices stand in raster order: by v, then u.

    Everything is in the order of positions, so it does not depend on the order of the points.

    vertices: rows of the points given; of points at one place the first, none that is not finite.
    triangles: indices into ``vertices``, the smallest first, of positive area in (u, v), ascending.
    edges: indices into ``vertices``, the smaller first, ascending.  Collinear points have edges but
    no triangles.
    """

    vertices: Annotated[I32, Shape("M")]
    triangles: Annotated[I32, Shape("T", 3)]
    edges: Annotated[I32, Shape("E", 2)]


class _HalfEdges(NamedTuple):
    """The graph that grows.

    Half edge e runs from ``org[e]``, -1 where it is unused; e ^ 1 is its other half.  ``after[e]``
    and ``before[e]`` are the next half edges around its origin, counter-clockwise (of a frame with
    y upwards) and clockwise.

    x, y: (M,) distinct points: integers of at most 2**EXTENT_BITS, so all predicates are exact.
    heap: the first of the list of free edges, and the end of those that were ever used.
    """

    x: F64
    y: F64
    org: I32
    after: I32
    before: I32
    heap: I64


def triangulate(points_px: F32 | F64) -> Triangulation:
    """The Delaunay triangulation of (N, 2) points (u, v) in px.

    Points are snapped to a grid of 2**-20 of their extent (1/1024 px up to 1024 px), on which it is
    exact; those in one cell of the grid count as one point.  Of the triangulations of four points
    on a circle it is always the same one.  Points that are not finite are left out; fewer than
    three points, or collinear ones, give no triangle.

    Raises ValueError if the points are not (N, 2).
    """
    if points_px.ndim != 2 or points_px.shape[1] != 2:
        raise ValueError(f"points_px: expected shape (N, 2), got {points_px.shape}")
    vertices, u, v = _grid_points(points_px.astype(np.float64))
    if len(vertices) < 2:
        return Triangulation(vertices, np.zeros((0, 3), np.int32), np.zeros((0, 2), np.int32))
    order, columns = _column_order(u, v)
    org, after, before = _half_edges(u.astype(np.float64), v.astype(np.float64), order, columns)
    triangles, edges = _collect(org, after, before, u, v)
    return Triangulation(vertices, triangles, edges)


def _grid_points(points: F64) -> tuple[I32, I64, I64]:
    """Rows of distinct points in raster order, and their (M,) grid coordinates u and v."""
    u, v = points[:, 0].copy(), points[:, 1].copy()
    rows = np.flatnonzero(np.isfinite(u) & np.isfinite(v))
    if len(rows) == 0:
        return np.zeros(0, np.int32), np.zeros(0, np.int64), np.zeros(0, np.int64)
    u, v = u[rows] / 2.0, v[rows] / 2.0
    # Halves do not overflow.  The cell is a power of two: scaling is exact.
    u -= u.min()
    v -= v.min()
    extent = float(max(u.max(), v.max()))
    if extent == 0.0:
        return rows[:1].astype(np.int32), np.zeros(1, np.int64), np.zeros(1, np.int64)
    exponent = max(int(np.frexp(extent)[1]), -1000)
    scale = np.ldexp(1.0, EXTENT_BITS - exponent)
    keys = (np.rint(v * scale).astype(np.int64) << _BITS) | np.rint(u * scale).astype(np.int64)
    order = np.argsort(keys)
    keys = keys[order]
    first = np.flatnonzero(np.concatenate([[True], keys[1:] != keys[:-1]]))
    keys = keys[first]
    return np.minimum.reduceat(rows[order], first).astype(np.int32), keys & _MASK, keys >> _BITS


def _column_order(u: I64, v: I64) -> tuple[I32, I64]:
    """The vertices column by column, and the (C + 1,) bounds of the columns."""
    M = len(u)
    C = _column_count(M)
    columns = np.arange(C + 1, dtype=np.int64) * M // C
    # Both keys are distinct, so there is one order only.
    across = np.argsort((u << _BITS) | v)
    column = np.repeat(np.arange(C), np.diff(columns))
    down = (column << 2 * _BITS) | (v[across] << _BITS) | (_MASK - u[across])
    return across[np.argsort(down)].astype(np.int32), columns


@kernel
def _collect(org: I32, after: I32, before: I32, u: I64, v: I64) -> tuple[I32, I32]:
    """The triangles and edges, both ascending."""
    M = len(u)
    first = np.full(M, -1, np.int32)
    count = 0
    for e in range(len(org)):
        if org[e] >= 0:
            first[org[e]] = e
            count += 1
    edges = np.empty((count // 2, 2), np.int32)
    triangles = np.empty((2 * M, 3), np.int32)
    edge, triangle = 0, 0
    for a in range(M):
        start = first[a]
        e = start
        edges_before, triangles_before = edge, triangle
        while True:
            b = org[e ^ 1]
            follower = after[e]
            if b > a:
                k = edge
                while k > edges_before and edges[k - 1, 1] > b:
                    edges[k] = edges[k - 1]
                    k -= 1
                edges[k, 0], edges[k, 1] = a, b
                edge += 1
                c = org[follower ^ 1]
                area = (u[b] - u[a]) * (v[c] - v[a]) - (v[b] - v[a]) * (u[c] - u[a])
                # Outside the hull the wedge is not a triangle, or it runs the other way round.
                if c > a and area > 0 and org[before[e ^ 1] ^ 1] == c:
                    k = triangle
                    while k > triangles_before and triangles[k - 1, 1] > b:
                        triangles[k] = triangles[k - 1]
                        k -= 1
                    triangles[k, 0], triangles[k, 1], triangles[k, 2] = a, b, c
                    triangle += 1
            e = follower
            if e == start:
                break
    return triangles[:triangle].copy(), edges


@kernel
def _orientation(x: F64, y: F64, a: int, b: int, c: int) -> float:
    """Twice the signed area of a, b, c: exact."""
    return (x[b] - x[a]) * (y[c] - y[a]) - (y[b] - y[a]) * (x[c] - x[a])


@kernel
def in_circle(x: F64, y: F64, a: int, b: int, c: int, d: int) -> bool:
    """Whether d lies strictly inside the circle through the counter-clockwise a, b, c: exact."""
    ax, ay = x[a] - x[d], y[a] - y[d]
    bx, by = x[b] - x[d], y[b] - y[d]
    cx, cy = x[c] - x[d], y[c] - y[d]
    ab, bc, ca = ax * by - bx * ay, bx * cy - cx * by, cx * ay - ax * cy
    la, lb, lc = ax * ax + ay * ay, bx * bx + by * by, cx * cx + cy * cy
    p, q, r = la * bc, lb * ca, lc * ab
    determinant = p + q + r
    if abs(determinant) > _SAFE * (abs(p) + abs(q) + abs(r)):
        return bool(determinant > 0.0)
    # The products need 81 bits.  In two parts the sums stay below 3 * 2**61 and fit int64.
    ia, ib, ic = np.int64(la), np.int64(lb), np.int64(lc)
    ja, jb, jc = np.int64(bc), np.int64(ca), np.int64(ab)
    high = (ia // _SPLIT) * ja + (ib // _SPLIT) * jb + (ic // _SPLIT) * jc
    low = (ia % _SPLIT) * ja + (ib % _SPLIT) * jb + (ic % _SPLIT) * jc
    high += low // _SPLIT
    low %= _SPLIT
    return bool(high > 0 or (high == 0 and low > 0))


@kernel
def _new_edge(graph: _HalfEdges, start: int, end: int) -> int:
    """A half edge from start to end that is linked to nothing."""
    org, after, before, heap = graph.org, graph.after, graph.before, graph.heap
    if heap[_FREE] != _NONE:
        e = heap[_FREE]
        heap[_FREE] = after[e]
    else:
        e = heap[_USED]
        heap[_USED] += 2
    f = e ^ 1
    org[e], org[f] = start, end
    after[e], before[e] = e, e
    after[f], before[f] = f, f
    return e


@kernel
def _link_after(graph: _HalfEdges, place: int, e: int) -> None:
    """Put the unlinked half edge e next to place, counter-clockwise around their origin."""
    after, before = graph.after, graph.before
    follower = after[place]
    after[place], before[e] = e, place
    after[e], before[follower] = follower, e


@kernel
def _connect(graph: _HalfEdges, a: int, b: int) -> int:
    """A new edge from the end of a to the origin of b; the three have one left face."""
    e = _new_edge(graph, graph.org[a ^ 1], graph.org[b])
    _link_after(graph, graph.before[a ^ 1], e)
    _link_after(graph, b, e ^ 1)
    return e


@kernel
def _delete(graph: _HalfEdges, e: int) -> None:
    org, after, before, heap = graph.org, graph.after, graph.before, graph.heap
    f = e ^ 1
    after[before[e]], before[after[e]] = after[e], before[e]
    after[before[f]], before[after[f]] = after[f], before[f]
    org[e], org[f] = _NONE, _NONE
    pair = e & ~1
    after[pair] = heap[_FREE]
    heap[_FREE] = pair


@kernel
def _merge(
    graph: _HalfEdges, left_outer: int, left_inner: int, right_inner: int, right_outer: int
) -> tuple[int, int]:
    """Join two triangulations that a line separates; the outer hull edges of the whole.

    The outer edges leave the first (last) vertex along the hull, counter-clockwise (clockwise);
    left_inner leaves the last vertex of the left part clockwise, right_inner the first one of the
    right part counter-clockwise.
    """
    x, y, org, after, before, _ = graph
    while True:  # down to the lower common tangent
        if _orientation(x, y, org[right_inner], org[left_inner], org[left_inner ^ 1]) > 0.0:
            left_inner = before[left_inner ^ 1]
        elif _orientation(x, y, org[left_inner], org[right_inner ^ 1], org[right_inner]) > 0.0:
            right_inner = after[right_inner ^ 1]
        else:
            break
    base = _connect(graph, right_inner ^ 1, left_inner)
    if org[left_inner] == org[left_outer]:
        left_outer = base ^ 1
    if org[right_inner] == org[right_outer]:
        right_outer = base
    while True:  # the bubble rises
        r, l = int(org[base]), int(org[base ^ 1])  # noqa: E741
        left = int(after[base ^ 1])
        left_valid = _orientation(x, y, org[left ^ 1], l, r) > 0.0
        if left_valid:
            follower = int(after[left])
            while in_circle(x, y, l, r, org[left ^ 1], org[follower ^ 1]):
                _delete(graph, left)
                left, follower = follower, int(after[follower])
        right = int(before[base])
        right_valid = _orientation(x, y, org[right ^ 1], l, r) > 0.0
        if right_valid:
            follower = int(before[right])
            while in_circle(x, y, l, r, org[right ^ 1], org[follower ^ 1]):
                _delete(graph, right)
                right, follower = follower, int(before[follower])
        if not left_valid and not right_valid:
            return left_outer, right_outer
        if not left_valid or (right_valid and in_circle(x, y, org[left ^ 1], l, r, org[right ^ 1])):
            base = _connect(graph, right, base ^ 1)
        else:
            base = _connect(graph, base ^ 1, left ^ 1)


@kernel
def _leaf(graph: _HalfEdges, vertices: I32) -> tuple[int, int]:
    """Join two or three vertices in ascending order; the outer hull edges."""
    a = _new_edge(graph, vertices[0], vertices[1])
    if len(vertices) == 2:
        return a, a ^ 1
    b = _new_edge(graph, vertices[1], vertices[2])
    _link_after(graph, a ^ 1, b)
    turn = _orientation(graph.x, graph.y, vertices[0], vertices[1], vertices[2])
    if turn == 0.0:
        return a, b ^ 1
    c = _connect(graph, b, a)
    if turn > 0.0:
        return a, b ^ 1
    return c ^ 1, c


@kernel
def _merge_all(graph: _HalfEdges, firsts: I32, lasts: I32, parts: int) -> None:
    """Merge neighbouring parts until one is left, whose outer edges are firsts[0] and lasts[0]."""
    while parts > 1:
        for k in range(parts // 2):
            firsts[k], lasts[k] = _merge(
                graph, firsts[2 * k], lasts[2 * k], firsts[2 * k + 1], lasts[2 * k + 1]
            )
        if parts % 2:
            firsts[parts // 2], lasts[parts // 2] = firsts[parts - 1], lasts[parts - 1]
        parts = (parts + 1) // 2


@kernel
def _side_edges(graph: _HalfEdges, start: int) -> tuple[int, int]:
    """The hull edge that leaves the lowest (x, y) counter-clockwise, the highest clockwise.

    start: a hull edge that runs counter-clockwise, with the outside on its right.
    """
    x, y, org, after, before, _ = graph
    first, last = start, start
    e = start
    while True:
        o = org[e]
        if x[o] < x[org[first]] or (x[o] == x[org[first]] and y[o] < y[org[first]]):
            first = e
        if x[o] > x[org[last]] or (x[o] == x[org[last]] and y[o] > y[org[last]]):
            last = e
        # The next edge of the hull is the first one counter-clockwise from the way back.
        e = after[e ^ 1]
        if e == start:
            break
    # Clockwise from the last vertex: back along the edge of the hull that arrives there.
    return first, before[last]


@kernel
def _half_edges(x: F64, y: F64, order: I32, columns: I64) -> tuple[I32, I32, I32]:
    """(H,) origins, ``after`` and ``before`` of the half edges; where the origin is -1: unused.

    x, y: (M,) distinct grid points.    columns: (C + 1,) bounds in ``order``, at least two points
    between them.    order: (M,) vertices by column from left to right, in a column by ascending y,
    then descending x.
    """
    M = len(x)
    org = np.full(6 * M + 16, _NONE, np.int32)
    after = np.empty(6 * M + 16, np.int32)
    before = np.empty(6 * M + 16, np.int32)
    graph = _HalfEdges(x, y, org, after, before, np.array([_NONE, 0], np.int64))
    C = len(columns) - 1
    firsts, lasts = np.empty(M // 2 + 1, np.int32), np.empty(M // 2 + 1, np.int32)
    column_firsts, column_lasts = np.empty(C, np.int32), np.empty(C, np.int32)
    for c in range(C):
        lo, hi = columns[c], columns[c + 1]
        parts = (hi - lo) // 2
        for k in range(parts):
            end = hi if k == parts - 1 else lo + 2 * k + 2
            firsts[k], lasts[k] = _leaf(graph, order[lo + 2 * k : end])
        _merge_all(graph, firsts, lasts, parts)
        column_firsts[c], column_lasts[c] = _side_edges(graph, firsts[0])
    _merge_all(graph, column_firsts, column_lasts, C)
    return org, after, before


def _column_count(vertices: int) -> int:
    """Dwyer's choice: columns as wide as their leaves, sqrt(n / log n) of them."""
    if vertices < 16:
        return 1
    return max(1, round(math.sqrt(vertices / math.log2(vertices))))

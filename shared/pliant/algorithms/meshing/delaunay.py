"""Delaunay triangulation of image points, with the graph of its edges (VITAMIN-E, section 4)."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, I64, Shape
from pliant.algorithms.kernel import kernel
from pliant.algorithms.meshing.divide_and_conquer import EXTENT_BITS, column_count, half_edges

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


def triangulate(points_px: F32 | F64) -> Triangulation:
    """The Delaunay triangulation of (N, 2) points (u, v) in px.

    Points are snapped to a grid of 2**-20 of their extent (1/1024 px up to 1024 px), on which it is
    exact; those in one cell of the grid count as one point.  Of the triangulations of four points
    on a circle it is always the same one.  Points that are not finite are left out; fewer than
    three points, or collinear ones, give no triangle.

    Raises ValueError where the points are not (N, 2).
    """
    if points_px.ndim != 2 or points_px.shape[1] != 2:
        raise ValueError(f"points_px: expected shape (N, 2), got {points_px.shape}")
    vertices, u, v = _grid_points(points_px.astype(np.float64))
    if len(vertices) < 2:
        return Triangulation(vertices, np.zeros((0, 3), np.int32), np.zeros((0, 2), np.int32))
    order, columns = _column_order(u, v)
    org, after, before = half_edges(u.astype(np.float64), v.astype(np.float64), order, columns)
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
    C = column_count(M)
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

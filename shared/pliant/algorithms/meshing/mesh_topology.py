"""The triangles at each vertex, and the borders of a mesh.

Edges have the orientation of their triangle, so two triangles share an edge in opposite directions.
An edge without its opposite belongs to the border.  Seen from outside, the border runs
anticlockwise around a component and clockwise around a hole.
"""

from typing import Annotated, Any, NamedTuple

import numpy as np

from pliant.algorithms.arrays import I32, I64, BoolArray, Shape
from pliant.compiler.kernel import kernel

NONE = -1


class Stars(NamedTuple):
    """The corners at each vertex v: ``corners[starts[v] : starts[v + 1]]``, ascending.

    Corner 3 t + k is the k-th of triangle t.
    """

    starts: Annotated[I64, Shape("V + 1")]
    corners: Annotated[I32, Shape("3 T")]


class Border(NamedTuple):
    """after, before: (V,) the next and the last vertex along the border; NONE within."""

    after: Annotated[I32, Shape("V")]
    before: Annotated[I32, Shape("V")]


@kernel
def stars_of(count: int, triangles: I32) -> Stars:
    """Return the corners at each of ``count`` vertices."""
    starts = np.zeros(count + 1, np.int64)
    for t in range(len(triangles)):
        for k in range(3):
            starts[triangles[t, k] + 1] += 1
    for v in range(count):
        starts[v + 1] += starts[v]
    corners = np.empty(3 * len(triangles), np.int32)
    room = starts[:-1].copy()
    for t in range(len(triangles)):
        for k in range(3):
            v = triangles[t, k]
            corners[room[v]] = 3 * t + k
            room[v] += 1
    return Stars(starts, corners)


@kernel
def corner_before(a: Any, b: Any, triangles: I32, stars: Stars, alive: BoolArray) -> int:
    """Return the corner at a of the kept triangle with the edge a to b, or NONE."""
    for at in range(stars.starts[a], stars.starts[a + 1]):
        t, k = stars.corners[at] // 3, stars.corners[at] % 3
        if alive[t] and triangles[t, (k + 1) % 3] == b:
            return stars.corners[at]
    return NONE


@kernel
def border_of(count: int, triangles: I32) -> Border:
    """Return the border of a mesh with at most one border at each vertex: see ``split_fans``."""
    stars = stars_of(count, triangles)
    alive = np.ones(len(triangles), np.bool_)
    after, before = np.full(count, NONE, np.int32), np.full(count, NONE, np.int32)
    for t in range(len(triangles)):
        for k in range(3):
            a, b = triangles[t, k], triangles[t, (k + 1) % 3]
            if corner_before(b, a, triangles, stars, alive) == NONE:
                after[a], before[b] = b, a
    return Border(after, before)


@kernel
def split_fans(count: int, triangles: I32) -> tuple[I32, I32]:
    """Split a vertex of the border that separate fans of triangles share.

    Returns the (T, 3) triangles, and (V',) the original of each vertex; the first ``count`` are
    unchanged.
    """
    stars = stars_of(count, triangles)
    alive = np.ones(len(triangles), np.bool_)
    parted = triangles.copy()
    was = list(range(count))
    for v in range(count):
        fans = 0
        for at in range(stars.starts[v], stars.starts[v + 1]):
            corner = stars.corners[at]
            t, k = corner // 3, corner % 3
            if corner_before(triangles[t, (k + 1) % 3], v, triangles, stars, alive) != NONE:
                continue
            # The border leaves v here: follow the fan to the other end.
            fans += 1
            if fans == 1:
                continue
            was.append(v)
            for _ in range(stars.starts[v + 1] - stars.starts[v]):
                parted[corner // 3, corner % 3] = len(was) - 1
                last = triangles[corner // 3, (corner % 3 + 2) % 3]
                corner = corner_before(v, last, triangles, stars, alive)
                if corner == NONE:
                    break
    return parted, np.array(was, np.int32)

"""Which triangles meet at a vertex, and where a mesh ends.

Edges are directed as the triangles turn: two triangles at one edge run along it in opposite
directions.  An edge without its opposite is one of the border, which so runs anticlockwise around
a piece of surface and clockwise around a hole, seen from outside.
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
    """Of ``count`` vertices."""
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
    """The corner at a of the living triangle that runs from a to b; NONE: there is none."""
    for at in range(stars.starts[a], stars.starts[a + 1]):
        t, k = stars.corners[at] // 3, stars.corners[at] % 3
        if alive[t] and triangles[t, (k + 1) % 3] == b:
            return stars.corners[at]
    return NONE


@kernel
def border_of(count: int, triangles: I32) -> Border:
    """Of a mesh in which at most one border passes each vertex: see ``split_fans``."""
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
    """Part the fans of triangles that meet in a vertex of the border and nowhere else.

    Returns the (T, 3) triangles, and (V',) of each vertex the one that it was; the first ``count``
    are as before.
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
            # The border leaves v here; the fan is walked to where it comes in.
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

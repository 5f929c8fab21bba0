"""The Delaunay triangulation of points on an integer grid, by divide and conquer.

Guibas and Stolfi, "Primitives for the manipulation of general subdivisions and the computation of
Voronoi diagrams", ACM TOG 1985, with Dwyer's cuts (Algorithmica 1987): columns are halved across,
then merged side by side, so that a cut is short and few edges are made in vain.

Half edge e runs from ``org[e]``; e ^ 1 is its other half.  ``after[e]`` and ``before[e]`` are the
next half edges around its origin, counter-clockwise (of a frame with y upwards) and clockwise.
Coordinates are integers in float64, at most 2**EXTENT_BITS, so all predicates are exact.
"""

import math

import numpy as np

from pliant.algorithms.arrays import F64, I32, I64
from pliant.algorithms.kernel import kernel

EXTENT_BITS = 20
"""Twice a triangle's area is at most 2**40 and a lift 2**41: exact in float64."""
_SAFE = 8.0 * 2.0**-53
"""Rounding of three products and two sums, over the sum of their magnitudes (5 suffice)."""
_SPLIT = 1 << 21
_FREE, _USED = 0, 1
_NONE = -1


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
def _new_edge(org: I32, after: I32, before: I32, heap: I64, start: int, end: int) -> int:
    """A half edge from start to end that is linked to nothing."""
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
def _link_after(after: I32, before: I32, place: int, e: int) -> None:
    """Put the unlinked half edge e next to place, counter-clockwise around their origin."""
    follower = after[place]
    after[place], before[e] = e, place
    after[e], before[follower] = follower, e


@kernel
def _connect(org: I32, after: I32, before: I32, heap: I64, a: int, b: int) -> int:
    """A new edge from the end of a to the origin of b; the three have one left face."""
    e = _new_edge(org, after, before, heap, org[a ^ 1], org[b])
    _link_after(after, before, before[a ^ 1], e)
    _link_after(after, before, b, e ^ 1)
    return e


@kernel
def _delete(org: I32, after: I32, before: I32, heap: I64, e: int) -> None:
    f = e ^ 1
    after[before[e]], before[after[e]] = after[e], before[e]
    after[before[f]], before[after[f]] = after[f], before[f]
    org[e], org[f] = _NONE, _NONE
    pair = e & ~1
    after[pair] = heap[_FREE]
    heap[_FREE] = pair


@kernel
def _merge(
    x: F64, y: F64, org: I32, after: I32, before: I32, heap: I64,
    left_outer: int, left_inner: int, right_inner: int, right_outer: int,
) -> tuple[int, int]:  # fmt: skip
    """Join two triangulations that a line separates; the outer hull edges of the whole.

    The outer edges leave the first (last) vertex along the hull, counter-clockwise (clockwise);
    left_inner leaves the last vertex of the left part clockwise, right_inner the first one of the
    right part counter-clockwise.
    """
    while True:  # down to the lower common tangent
        if _orientation(x, y, org[right_inner], org[left_inner], org[left_inner ^ 1]) > 0.0:
            left_inner = before[left_inner ^ 1]
        elif _orientation(x, y, org[left_inner], org[right_inner ^ 1], org[right_inner]) > 0.0:
            right_inner = after[right_inner ^ 1]
        else:
            break
    base = _connect(org, after, before, heap, right_inner ^ 1, left_inner)
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
                _delete(org, after, before, heap, left)
                left, follower = follower, int(after[follower])
        right = int(before[base])
        right_valid = _orientation(x, y, org[right ^ 1], l, r) > 0.0
        if right_valid:
            follower = int(before[right])
            while in_circle(x, y, l, r, org[right ^ 1], org[follower ^ 1]):
                _delete(org, after, before, heap, right)
                right, follower = follower, int(before[follower])
        if not left_valid and not right_valid:
            return left_outer, right_outer
        if not left_valid or (right_valid and in_circle(x, y, org[left ^ 1], l, r, org[right ^ 1])):
            base = _connect(org, after, before, heap, right, base ^ 1)
        else:
            base = _connect(org, after, before, heap, base ^ 1, left ^ 1)


@kernel
def _leaf(
    x: F64, y: F64, org: I32, after: I32, before: I32, heap: I64, vertices: I32
) -> tuple[int, int]:
    """Join two or three vertices in ascending order; the outer hull edges."""
    a = _new_edge(org, after, before, heap, vertices[0], vertices[1])
    if len(vertices) == 2:
        return a, a ^ 1
    b = _new_edge(org, after, before, heap, vertices[1], vertices[2])
    _link_after(after, before, a ^ 1, b)
    turn = _orientation(x, y, vertices[0], vertices[1], vertices[2])
    if turn == 0.0:
        return a, b ^ 1
    c = _connect(org, after, before, heap, b, a)
    if turn > 0.0:
        return a, b ^ 1
    return c ^ 1, c


@kernel
def _merge_all(
    x: F64, y: F64, org: I32, after: I32, before: I32, heap: I64,
    firsts: I32, lasts: I32, parts: int,
) -> None:  # fmt: skip
    """Merge neighbouring parts until one is left, whose outer edges are firsts[0] and lasts[0]."""
    while parts > 1:
        for k in range(parts // 2):
            firsts[k], lasts[k] = _merge(
                x, y, org, after, before, heap,
                firsts[2 * k], lasts[2 * k], firsts[2 * k + 1], lasts[2 * k + 1],
            )  # fmt: skip
        if parts % 2:
            firsts[parts // 2], lasts[parts // 2] = firsts[parts - 1], lasts[parts - 1]
        parts = (parts + 1) // 2


@kernel
def _side_edges(x: F64, y: F64, org: I32, after: I32, before: I32, start: int) -> tuple[int, int]:
    """The hull edge that leaves the lowest (x, y) counter-clockwise, the highest clockwise.

    start: a hull edge that runs counter-clockwise, with the outside on its right.
    """
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
def half_edges(x: F64, y: F64, order: I32, columns: I64) -> tuple[I32, I32, I32]:
    """(H,) origins, ``after`` and ``before`` of the half edges; where the origin is -1: unused.

    x, y: (M,) distinct grid points.    columns: (C + 1,) bounds in ``order``, at least two points
    between them.    order: (M,) vertices by column from left to right, in a column by ascending y,
    then descending x.
    """
    M = len(x)
    org = np.full(6 * M + 16, _NONE, np.int32)
    after = np.empty(6 * M + 16, np.int32)
    before = np.empty(6 * M + 16, np.int32)
    heap = np.array([_NONE, 0], np.int64)
    C = len(columns) - 1
    firsts, lasts = np.empty(M // 2 + 1, np.int32), np.empty(M // 2 + 1, np.int32)
    column_firsts, column_lasts = np.empty(C, np.int32), np.empty(C, np.int32)
    for c in range(C):
        lo, hi = columns[c], columns[c + 1]
        parts = (hi - lo) // 2
        for k in range(parts):
            end = hi if k == parts - 1 else lo + 2 * k + 2
            firsts[k], lasts[k] = _leaf(
                x, y, org, after, before, heap, order[lo + 2 * k : end]
            )  # fmt: skip
        _merge_all(x, y, org, after, before, heap, firsts, lasts, parts)
        column_firsts[c], column_lasts[c] = _side_edges(x, y, org, after, before, firsts[0])
    _merge_all(x, y, org, after, before, heap, column_firsts, column_lasts, C)
    return org, after, before


def column_count(vertices: int) -> int:
    """Dwyer's choice: columns as wide as their leaves, sqrt(n / log n) of them."""
    if vertices < 16:
        return 1
    return max(1, round(math.sqrt(vertices / math.log2(vertices))))

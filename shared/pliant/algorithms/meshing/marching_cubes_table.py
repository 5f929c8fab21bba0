"""The triangles of marching cubes, worked out from the cube itself (Lorensen and Cline 1987).

Corner c of a cube stands at (c & 1, c >> 1 & 1, c >> 2): x, y, z.  A case is the set of corners
inside (tsdf < 0), bit c for corner c.  Edge 4 * axis + i runs along the axis from its i-th corner
without that bit.  On each face the crossings are joined so that corners inside which share no edge
of the face are kept apart; both cubes at the face see the same, so that the surfaces of neighbours
meet.  The joints of a cube form loops, one crossing each, and a loop is cut into triangles whose
inner edges run through the cube and not along a face, where the neighbour could have the same.
"""

from functools import cache
from itertools import pairwise

import numpy as np

from pliant.algorithms.arrays import I32

MAX_TRIANGLES = 5
_FACES = (  # Corners in the order of their outline, anticlockwise from outside.
    (0, 4, 6, 2), (1, 3, 7, 5), (0, 1, 5, 4), (2, 6, 7, 3), (0, 2, 3, 1), (4, 5, 7, 6),
)  # fmt: skip
_EDGES = tuple((c, c | 1 << axis) for axis in range(3) for c in range(8) if not c & 1 << axis)


def edge_corners() -> I32:
    """(12, 2) the corners of each edge, the smaller first."""
    return np.array(_EDGES, np.int32)


@cache
def _edge(a: int, b: int) -> int:
    return _EDGES.index((min(a, b), max(a, b)))


@cache
def _on_one_face(e: int, f: int) -> bool:
    corners = {*_EDGES[e], *_EDGES[f]}
    return any(corners <= set(face) for face in _FACES)


@cache
def triangle_table() -> tuple[I32, I32]:
    """(256,) how many triangles a case has, (256, MAX_TRIANGLES, 3) the edges of their corners.

    Triangles turn anticlockwise seen from outside the surface (tsdf > 0).
    """
    counts = np.zeros(256, np.int32)
    table = np.zeros((256, MAX_TRIANGLES, 3), np.int32)
    for case in range(256):
        triangles = [t for loop in _loops(case) for t in _cut(tuple(loop))]
        counts[case] = len(triangles)
        table[case, : len(triangles)] = np.array(triangles, np.int32).reshape(-1, 3)
    return counts, table


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

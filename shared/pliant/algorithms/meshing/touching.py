"""Sheets of a closed surface that touch, taken apart, so that each edge has two triangles."""

import numpy as np

from pliant.algorithms.arrays import F32, I32, I64


def taken_apart(positions: F32, triangles: I32) -> tuple[F32, I32]:
    """The closed surface of (V, 3) and (T, 3) with one fan of triangles about each vertex.

    Where sheets meet in an edge four triangles have it, and where they meet in a vertex it has two
    fans.  Triangles whose corners turn about one vertex, from one to the next across its edges,
    share a new vertex at the old place, so the sheets still touch.  Vertices that two edges join
    get a vertex in the middle of one of these.

    Raises ValueError if the surface has a border, or neighbours that turn against each other.
    """
    while True:
        forth, back = _twins(triangles)
        rows, triangles = _fans(triangles, forth, back)
        positions = positions[rows]
        corners = triangles.ravel()
        ends = corners[_following(forth)]
        order = np.lexsort((forth, ends, corners[forth]))
        starts, ends = corners[forth][order], ends[order]
        again = np.flatnonzero((starts[1:] == starts[:-1]) & (ends[1:] == ends[:-1])) + 1
        if not len(again):
            return positions, triangles
        pairs = np.stack([forth[order[again]], back[order[again]]], axis=1)
        positions, triangles = _halved(positions, triangles, pairs)


def _following(corners: I64) -> I64:
    """The next corner of the same triangle."""
    return corners - corners % 3 + (corners + 1) % 3


def _twins(triangles: I32) -> tuple[I64, I64]:
    """(E,), (E,): the two half-edges of each edge, called by the corners that they leave."""
    begins = triangles.ravel()
    corners = np.arange(len(begins))
    ends = begins[_following(corners)]
    forth, back = corners[begins < ends], corners[begins > ends]
    forth = forth[np.lexsort((forth, ends[forth], begins[forth]))]
    back = back[np.lexsort((back, begins[back], ends[back]))]
    if len(forth) + len(back) < len(corners) or len(forth) != len(back):
        raise ValueError("the surface is not closed")
    if np.any(begins[forth] != ends[back]) or np.any(ends[forth] != begins[back]):
        raise ValueError("the surface is not closed")
    return forth, back


def _fans(triangles: I32, forth: I64, back: I64) -> tuple[I64, I32]:
    """(V,) which vertex each fan is about, and the triangles (T, 3) of fans."""
    twins = np.empty(triangles.size, np.int64)
    twins[forth], twins[back] = back, forth
    # The next corner about the same vertex; a fan is a cycle of it, called by its least corner.
    jumps, fans = _following(twins), np.arange(triangles.size)
    while True:
        least = np.minimum(fans, fans[jumps])
        if np.array_equal(least, fans):
            break
        fans, jumps = least, jumps[jumps]
    first, rows = np.unique(fans, return_inverse=True)
    return triangles.ravel()[first].astype(np.int64), rows.reshape(-1, 3).astype(np.int32)


def _halved(positions: F32, triangles: I32, pairs: I64) -> tuple[F32, I32]:
    """With a vertex in the middle of edges (E, 2) that share no triangle with an earlier one."""
    triangles, touched = triangles.copy(), set[int]()
    middles: list[F32] = []
    added: list[I32] = []
    for pair in pairs.tolist():
        if touched & {corner // 3 for corner in pair}:
            continue
        touched |= {corner // 3 for corner in pair}
        middle = len(positions) + len(middles)
        ends = triangles.ravel()[[pair[0], int(_following(np.array(pair[0])))]]
        middles.append(positions[ends].mean(axis=0, dtype=np.float32))
        for corner in pair:
            triangle, k = divmod(corner, 3)
            second = triangles[triangle].copy()
            second[k] = middle
            triangles[triangle, (k + 1) % 3] = middle
            added.append(second)
    return np.concatenate([positions, np.stack(middles)]), np.concatenate(
        [triangles, np.stack(added)]
    )

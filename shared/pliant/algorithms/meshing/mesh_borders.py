"""Smooth borders of a mesh instead of saw-toothed ones.

Marching cubes ends at unobserved voxels, with teeth, shreds and slits one voxel wide.  Sharp
corners of the surface are cut off repeatedly, which removes teeth and shreds.  Sharp corners of
gaps are closed by triangles repeatedly, which removes notches and closes slits from their ends.
Neither spreads along a straight or round border.  Then the border is smoothed along the surface
(Taubin 1995): low frequencies keep their amplitude, so nothing shrinks.
"""

import math
from typing import Any

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, BoolArray
from pliant.algorithms.meshing.mesh_topology import (
    NONE,
    Border,
    Stars,
    border_of,
    corner_before,
    stars_of,
)
from pliant.algorithms.meshing.tsdf_blocks import EMPTY, grown, slot_of
from pliant.compiler.kernel import kernel

_TOOTH = math.radians(80.0)
"""Less than a right angle: cutting a right-angled corner leaves new ones, without end."""
_NOTCH = math.radians(100.0)
"""More than a right angle: a triangle closes it and leaves two obtuse corners."""
_MIN_COSINE = 0.5
"""Minimum, between the normal of a closing triangle and those of its corners."""
_SHRINK, _GROW, _ROUNDS = 0.5, -0.53, 60
"""Taubin's lambda, mu and number of steps: they remove wavelengths below ten vertices."""
_HALVINGS = 4
"""Halvings of a vertex' motion before the vertex is left in place."""


def without_teeth(positions: F32, triangles: I32) -> BoolArray:
    """(T,) triangles that are kept, without the sharp corners of the surface.

    positions: (V, 3).
    """
    return _cut_off(positions, triangles, stars_of(len(positions), triangles), _TOOTH)


def zipped(positions: F32, normals: F32, triangles: I32, max_edge: float) -> I32:
    """(N, 3) triangles that close the sharp corners of gaps, with edges of at most ``max_edge``.

    At most one border passes each vertex.
    """
    border = border_of(len(positions), triangles)
    stars = stars_of(len(positions), triangles)
    return _zip(positions, normals, triangles, stars, border, max_edge, _NOTCH)


def smoothed_borders(positions: F32, normals: F32, triangles: I32) -> F32:
    """(V, 3) positions, those on the border smoothed along it.

    A vertex moves perpendicular to its normal, and less if a triangle would turn over.
    """
    border = border_of(len(positions), triangles)
    rows = np.flatnonzero((border.after != NONE) & (border.before != NONE))
    place = np.zeros(len(positions), np.int64)
    place[rows] = np.arange(len(rows))
    after, before = place[border.after[rows]], place[border.before[rows]]
    start = positions[rows].astype(np.float64)
    away = normals[rows].astype(np.float64)
    points: F64 = start
    for _ in range(_ROUNDS):
        for step in (_SHRINK, _GROW):
            change = 0.5 * (points[after] + points[before]) - points
            change -= (change * away).sum(axis=1, keepdims=True) * away
            points = points + step * change
    share = np.ones(len(rows))
    moved = positions.copy()
    for halving in range(_HALVINGS + 1):
        moved[rows] = (start + share[:, None] * (points - start)).astype(np.float32)
        turned = _turned_over(positions, moved, triangles)
        stuck = turned[rows]
        if not stuck.any():
            break
        share[stuck] = 0.5 * share[stuck] if halving < _HALVINGS - 1 else 0.0
    return moved


def _turned_over(before: F32, after: F32, triangles: I32) -> BoolArray:
    """(V,) corners of triangles that have turned by more than 90 degrees, or have no area."""
    changed = (before != after).any(axis=1)
    rows = np.flatnonzero(changed[triangles].any(axis=1))
    old, new = (_areas(points[triangles[rows]].astype(np.float64)) for points in (before, after))
    over = (old * new).sum(axis=1) <= 0.0
    found = np.zeros(len(before), np.bool_)
    found[triangles[rows[over]]] = True
    return found & changed


def _areas(corners: F64) -> F64:
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


@kernel
def _angle(positions: F32, at: Any, one: Any, other: Any) -> float:
    """Between the directions from a vertex to two others."""
    dot, p, q = 0.0, 0.0, 0.0
    for k in range(3):
        here = float(positions[at, k])
        a, b = float(positions[one, k]) - here, float(positions[other, k]) - here
        dot += a * b
        p += a * a
        q += b * b
    if not p * q > 0.0:
        return 0.0
    return math.acos(min(max(dot / math.sqrt(p * q), -1.0), 1.0))


@kernel
def _cut_off(positions: F32, triangles: I32, stars: Stars, sharp: float) -> BoolArray:
    alive = np.ones(len(triangles), np.bool_)
    starts, corners = stars
    ends = np.zeros(len(positions), np.bool_)
    queue: Any = [0]
    queue.clear()
    for v in range(len(positions)):
        for at in range(starts[v], starts[v + 1]):
            t, k = corners[at] // 3, corners[at] % 3
            if corner_before(triangles[t, (k + 1) % 3], v, triangles, stars, alive) == NONE:
                ends[v] = True
        if ends[v]:
            queue.append(v)
    first = 0
    while first < len(queue):
        v = queue[first]
        first += 1
        angle, count = 0.0, 0
        for at in range(starts[v], starts[v + 1]):
            t, k = corners[at] // 3, corners[at] % 3
            if alive[t]:
                angle += _angle(positions, v, triangles[t, (k + 1) % 3], triangles[t, (k + 2) % 3])
                count += 1
        if count == 0 or angle >= sharp:
            continue
        for at in range(starts[v], starts[v + 1]):
            t = corners[at] // 3
            if alive[t]:
                alive[t] = False
                for k in range(3):
                    if triangles[t, k] != v:
                        queue.append(triangles[t, k])
    return alive


@kernel
def _fits(positions: F32, normals: F32, a: Any, b: Any, c: Any) -> bool:
    """Whether a triangle's normal is close to those of the surface at its corners."""
    e0 = float(positions[b, 0]) - float(positions[a, 0])
    e1 = float(positions[b, 1]) - float(positions[a, 1])
    e2 = float(positions[b, 2]) - float(positions[a, 2])
    f0 = float(positions[c, 0]) - float(positions[a, 0])
    f1 = float(positions[c, 1]) - float(positions[a, 1])
    f2 = float(positions[c, 2]) - float(positions[a, 2])
    n0, n1, n2 = e1 * f2 - e2 * f1, e2 * f0 - e0 * f2, e0 * f1 - e1 * f0
    length = math.sqrt(n0 * n0 + n1 * n1 + n2 * n2)
    least = length
    for k in range(3):
        v = a if k == 0 else b if k == 1 else c
        least = min(least, n0 * normals[v, 0] + n1 * normals[v, 1] + n2 * normals[v, 2])
    return least > _MIN_COSINE * length


@kernel
def _zip(
    positions: F32, normals: F32, triangles: I32, stars: Stars, border: Border,
    max_edge: float, sharp: float,
) -> I32:  # fmt: skip
    alive = np.ones(len(triangles), np.bool_)
    after, before = border.after.copy(), border.before.copy()
    count = np.int64(len(positions))
    inner = np.zeros(len(positions))
    queue: Any = [0]
    queue.clear()
    for v in range(len(positions)):
        if after[v] == NONE or before[v] == NONE:
            continue
        queue.append(v)
        for at in range(stars.starts[v], stars.starts[v + 1]):
            t, k = stars.corners[at] // 3, stars.corners[at] % 3
            inner[v] += _angle(positions, v, triangles[t, (k + 1) % 3], triangles[t, (k + 2) % 3])
    added: Any = np.empty((1024, 3), np.int32)
    used = 0
    joined = np.full(1024, EMPTY, np.int64)
    joints = 0
    first = 0
    while first < len(queue):
        b = queue[first]
        first += 1
        a, c = before[b], after[b]
        if min(a, c) == NONE or a == c or 2.0 * math.pi - inner[b] >= sharp:
            continue
        length = 0.0
        for k in range(3):
            step = float(positions[c, k]) - float(positions[a, k])
            length += step * step
        closes = after[c] == a
        key = min(a, c) * count + max(a, c)
        known = joined[slot_of(joined, key)] == key
        known = known or corner_before(a, c, triangles, stars, alive) != NONE
        known = known or corner_before(c, a, triangles, stars, alive) != NONE
        if known != closes or length > max_edge * max_edge:
            continue
        angle = _angle(positions, b, a, c)
        if angle >= sharp or not _fits(positions, normals, c, b, a):
            continue
        if used == len(added):
            larger = np.empty((2 * used, 3), np.int32)
            larger[:used] = added
            added = larger
        added[used, 0], added[used, 1], added[used, 2] = c, b, a
        used += 1
        after[b], before[b] = NONE, NONE
        if closes:
            after[a], before[a], after[c], before[c] = NONE, NONE, NONE, NONE
            continue
        after[a], before[c] = c, a
        inner[a] += _angle(positions, a, b, c)
        inner[c] += _angle(positions, c, a, b)
        if 2 * (joints + 1) > len(joined):
            joined = grown(joined)
        joined[slot_of(joined, key)] = key
        joints += 1
        queue.append(a)
        queue.append(c)
    return added[:used].copy()

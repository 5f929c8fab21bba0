"""Samples of surfaces, and which of them have another surface within a distance."""

import numpy as np

from pliant.algorithms.arrays import F64, I32, I64
from pliant.compiler.kernel import kernel

_MAX_CELL = 1 << 20
"""Cells along an axis: 21 bits of a key for each."""


def sample_surface(points: F64, faces: I32, spacing: float) -> F64:
    """(S, 3) samples of (V, 3) points and (F, 3) faces: one for each spacing squared of area.

    Where a triangle is smaller it has one with that probability; the generator is seeded.
    """
    generator = np.random.default_rng(0)
    a, b, c = (points[faces[:, k]] for k in range(3))
    areas = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    counts = np.floor(areas / spacing**2 + generator.random(len(faces))).astype(np.int64)
    rows = np.repeat(np.arange(len(faces)), counts)
    p, q = generator.random(len(rows)), generator.random(len(rows))
    over = p + q > 1.0
    p[over], q[over] = 1.0 - p[over], 1.0 - q[over]
    return a[rows] + p[:, None] * (b - a)[rows] + q[:, None] * (c - a)[rows]


def thin_out(points: F64, spacing: float) -> F64:
    """The first of the (N, 3) points in each cube of that size, in the order of the cubes."""
    if len(points) == 0:
        return points
    _, first = np.unique(cell_keys(points, points.min(axis=0), spacing), return_index=True)
    return points[first]


def share_within(points: F64, others: F64, distance: float) -> float:
    """Share of (N, 3) points that have one of the (M, 3) others within a distance."""
    if len(points) == 0 or len(others) == 0:
        return 0.0
    low = np.minimum(points.min(axis=0), others.min(axis=0)) - 2.0 * distance
    keys = cell_keys(others, low, distance)
    order = np.argsort(keys, kind="stable")
    found = _near(points, np.ascontiguousarray(others[order]), keys[order], low, distance)
    return float(found / len(points))


def cell_keys(points: F64, low: F64, size: float) -> I64:
    """(N,) numbers of the cubes in which (N, 3) points lie, 21 bits for each axis."""
    cells = np.clip(((points - low) / size).astype(np.int64), 0, _MAX_CELL)
    return (cells[:, 0] << 42) | (cells[:, 1] << 21) | cells[:, 2]


@kernel
def _near(points: F64, others: F64, keys: I64, low: F64, distance: float) -> int:
    found = 0
    limit = distance * distance
    for i in range(len(points)):
        x = int((points[i, 0] - low[0]) / distance)
        y = int((points[i, 1] - low[1]) / distance)
        z = int((points[i, 2] - low[2]) / distance)
        near = False
        for a in range(x - 1, x + 2):
            for b in range(y - 1, y + 2):
                # Three cells along z follow each other in the keys.
                key = (a << 42) | (b << 21) | (z - 1)
                k = np.searchsorted(keys, key)
                while k < len(keys) and keys[k] <= key + 2:
                    d0 = others[k, 0] - points[i, 0]
                    d1 = others[k, 1] - points[i, 1]
                    d2 = others[k, 2] - points[i, 2]
                    if d0 * d0 + d1 * d1 + d2 * d2 <= limit:
                        near = True
                        break
                    k += 1
                if near:
                    break
            if near:
                break
        found += near
    return found

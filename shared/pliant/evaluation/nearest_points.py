"""The nearest of many points, up to a distance."""

import numpy as np

from pliant.algorithms.arrays import F64, I64
from pliant.compiler.kernel import kernel
from pliant.evaluation.surface_distance import cell_keys

_PER_CELL = 8.0
"""Points on a surface that share a cell, about."""
_MAX_RINGS = 1 << 10


def nearest(points: F64, others: F64, most: float) -> tuple[I64, F64]:
    """(N,) rows of the (M, 3) others and distances, -1 and infinite where none is within ``most``.

    points: (N, 3).
    """
    if len(points) == 0 or len(others) == 0:
        return np.full(len(points), -1, np.int64), np.full(len(points), np.inf)
    extent = float(np.linalg.norm(np.ptp(others, axis=0)))
    size = max(extent * np.sqrt(_PER_CELL / len(others)), most / _MAX_RINGS, 1e-30)
    margin = most + 2.0 * size
    low = np.minimum(points.min(axis=0), others.min(axis=0)) - margin
    keys = cell_keys(others, low, size)
    order = np.argsort(keys, kind="stable")
    rows, distances = np.full(len(points), -1, np.int64), np.full(len(points), np.inf)
    _search(
        points, np.ascontiguousarray(others[order]), keys[order], low, size, most, rows, distances
    )
    found = rows >= 0
    rows[found] = order[rows[found]]
    return rows, distances


@kernel
def _search(
    points: F64, others: F64, keys: I64, low: F64, size: float, most: float, rows: I64,
    distances: F64,
) -> None:  # fmt: skip
    """Cells in rings about a point's own, until no farther one can have a nearer point."""
    for i in range(len(points)):
        x = int((points[i, 0] - low[0]) / size)
        y = int((points[i, 1] - low[1]) / size)
        z = int((points[i, 2] - low[2]) / size)
        best = most * most
        ring = 0
        while ring == 0 or ((ring - 1) * size <= most and (ring - 1) * size <= np.sqrt(best)):
            for a in range(x - ring, x + ring + 1):
                for b in range(y - ring, y + ring + 1):
                    # Along z all of the cells at the ring's sides, else its first and last one.
                    is_side = max(abs(a - x), abs(b - y)) == ring
                    for part in range(1 if is_side or ring == 0 else 2):
                        first = z - ring if part == 0 else z + ring
                        last = z + ring if is_side or part == 1 else z - ring
                        base = (a << 42) | (b << 21)
                        k = np.searchsorted(keys, base | first)
                        while k < len(keys) and keys[k] <= base | last:
                            d0 = others[k, 0] - points[i, 0]
                            d1 = others[k, 1] - points[i, 1]
                            d2 = others[k, 2] - points[i, 2]
                            squared = d0 * d0 + d1 * d1 + d2 * d2
                            if squared <= best and (rows[i] < 0 or squared < best):
                                best = squared
                                rows[i] = k
                            k += 1
            ring += 1
        if rows[i] >= 0:
            distances[i] = np.sqrt(best)

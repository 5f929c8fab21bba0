"""Strain of the surface between surfels (not in the paper)."""

import numpy as np

from pliant.algorithms.arrays import F64, I32, I64
from pliant.algorithms.surfels.surface_over_time import SurfaceOverTime


def strains(surface: SurfaceOverTime) -> F64:
    """(K, T) principal strain of each triangle, the one of greater magnitude; NaN: not shown.

    0.1 is 10 % longer, -0.1 is 10 % shorter than in the first frame that shows the triangle.
    """
    out = np.full(surface.shown.shape, np.nan)
    first = surface.shown.argmax(axis=0)
    rest = _sides(surface, first, np.arange(len(first)))
    for frame, shown in enumerate(surface.shown):
        rows = np.flatnonzero(shown)
        out[frame, rows] = principal_strains(rest[rows], _sides(surface, frame, rows))
    return out


def _sides(surface: SurfaceOverTime, frames: int | I64, rows: I64) -> F64:
    """(M, 2, 3) of some triangles, in a frame, or each in its own."""
    corners = surface.positions[np.expand_dims(frames, -1), surface.triangles[rows]]
    return corners[:, 1:] - corners[:, :1]


def principal_strains(rest: F64, now: F64) -> F64:
    """(M,) principal strain of greater magnitude of triangles.  rest, now: (..., 2, 3) two sides.

    The metric G = sides sides' gives the squared principal stretches: the eigenvalues of
    G_now G_rest^-1.  A triangle without area at rest has none: NaN.
    """
    a, b = (
        sides.reshape(-1, 2, 3) @ sides.reshape(-1, 2, 3).swapaxes(1, 2) for sides in (rest, now)
    )
    area = a[:, 0, 0] * a[:, 1, 1] - a[:, 0, 1] ** 2
    flat = ~(area > 1e-12 * a[:, 0, 0] * a[:, 1, 1])
    area = np.where(flat, np.nan, area)
    trace = a[:, 1, 1] * b[:, 0, 0] + a[:, 0, 0] * b[:, 1, 1] - 2.0 * a[:, 0, 1] * b[:, 0, 1]
    half = 0.5 * trace / area
    product = (b[:, 0, 0] * b[:, 1, 1] - b[:, 0, 1] ** 2) / area
    root = np.sqrt(np.maximum(half * half - product, 0.0))
    longest = np.sqrt(half + root) - 1.0
    shortest = np.sqrt(np.maximum(half - root, 0.0)) - 1.0
    return np.where(longest > -shortest, longest, shortest)


def at_vertices(triangles: I32, values: F64, count: int) -> F64:
    """(count,) mean of the values (T,) of the triangles about each vertex; 0 without any.

    Values that are NaN do not count.
    """
    known = np.isfinite(values)
    ends = triangles[known].ravel()
    total = np.bincount(ends, weights=np.repeat(values[known], 3), minlength=count)
    return total / np.maximum(np.bincount(ends, minlength=count), 1)

"""Samples of surfaces, and the nearest of many points."""

from typing import Any

import cv2
import numpy as np

from pliant.algorithms.arrays import F64, I32, I64

_ONE_TREE: dict[str, bool | int | float | str] = {"algorithm": 4}
"""FLANN's KDTREE_SINGLE: one k-d tree, searched exactly."""
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
    rows, _ = nearest(points, others, distance)
    return float(np.mean(rows >= 0)) if len(rows) else 0.0


def nearest(points: F64, others: F64, most: float) -> tuple[I64, F64]:
    """(N,) rows of the (M, 3) others and distances, -1 and infinite where none is within ``most``.

    points: (N, 3).  Of others that single precision cannot tell apart, it may be any.
    """
    rows, distances = np.full(len(points), -1, np.int64), np.full(len(points), np.inf)
    if len(points) == 0 or len(others) == 0:
        return rows, distances
    middle = others.mean(axis=0)  # small numbers keep their digits
    tree: Any = cv2.flann.Index((others - middle).astype(np.float32), _ONE_TREE)
    found = tree.knnSearch((points - middle).astype(np.float32), 1, params={"checks": -1})[0][:, 0]
    lengths = np.linalg.norm(points - others[found], axis=1)
    near = lengths <= most
    rows[near], distances[near] = found[near], lengths[near]
    return rows, distances


def cell_keys(points: F64, low: F64, size: float) -> I64:
    """(N,) numbers of the cubes in which (N, 3) points lie, 21 bits for each axis."""
    cells = np.clip(((points - low) / size).astype(np.int64), 0, _MAX_CELL)
    return (cells[:, 0] << 42) | (cells[:, 1] << 21) | cells[:, 2]

"""Laplacian smoothing, with which NLTGV is compared: it rounds steps and creases off."""

from typing import Any

import numpy as np

from pliant.algorithms.arrays import F32, I32

_ROUNDS = 10
_STEP = 0.5


def laplacian(inverse_depths: F32, edges: I32) -> F32:
    """(M,) inverse depths after ten rounds, each half way to the mean of the neighbours."""
    count = np.bincount(edges.ravel(), minlength=len(inverse_depths))
    values: Any = inverse_depths.astype(np.float64)
    for _ in range(_ROUNDS):
        total = np.bincount(edges[:, 0], values[edges[:, 1]], len(values))
        total += np.bincount(edges[:, 1], values[edges[:, 0]], len(values))
        mean = np.where(count > 0, total / np.maximum(count, 1), values)
        values = values + _STEP * (mean - values)
    return values.astype(np.float32)

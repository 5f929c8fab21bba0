"""The reduced system of the cameras (Eq. 9): putting it together and solving it."""

import numpy as np

from pliant.algorithms.arrays import F64
from pliant.algorithms.kernel import leaf_kernel

LOWER = np.tril_indices(6)


def add_cameras(S: F64, b: F64, normal: F64) -> F64:
    """Add every camera's own block to the lower triangle; returns the (6F,) diagonal of H_cc."""
    at = 6 * np.arange(len(normal))[:, None]
    S[at + LOWER[0], at + LOWER[1]] += normal[:, :21]
    b += normal[:, 21:].reshape(-1)
    return normal[:, np.flatnonzero(LOWER[0] == LOWER[1])].reshape(-1)


def solve_reduced(S: F64, b: F64, damping: F64) -> F64 | None:
    """Solve ``(S + diag(damping)) x = b``, None where S is not positive definite.

    S: symmetric; its lower triangle is read, its diagonal changed.
    An unknown without observations has an empty row: the identity keeps it where it is.
    """
    index = np.arange(len(b))
    S[index, index] += np.where(S[index, index] == 0.0, 1.0, damping)
    try:
        L: F64 = np.linalg.cholesky(S).astype(np.float64, copy=False)
    except np.linalg.LinAlgError:
        return None
    x = b.copy()
    _solve_triangles(L, x)
    return x if np.isfinite(x).all() else None


@leaf_kernel
def _solve_triangles(L: F64, x: F64) -> None:
    """Solve ``L L^T x = b`` in place for a lower triangular L."""
    for r in range(x.size):
        total = x[r]
        for c in range(r):
            total -= L[r, c] * x[c]
        x[r] = total / L[r, r]
    for r in range(x.size - 1, -1, -1):
        last = x[r] / L[r, r]
        x[r] = last
        for c in range(r):
            x[c] -= L[r, c] * last

"""One damped step of a small system, relative to its diagonal (DSDT, Eq. 14-15)."""

import numpy as np

from pliant.algorithms.arrays import F64
from pliant.algorithms.kernel import inner_kernel, leaf_kernel

_RIDGE = 1e-9
"""Share of the diagonal that is added to it, and the least of it that a pivot keeps: directions in
which nothing is seen must not blow up."""


@inner_kernel
def copy(source: F64, target: F64) -> None:
    """Fill ``target``.  An assignment to a slice makes a copy in between."""
    for k in range(len(target)):
        target[k] = source[k]


@leaf_kernel
def factorise(H: F64, n: int, damped: int, damping: float, L: F64, inverse: F64) -> bool:
    """L D L' = H + lambda D_w, with ones on the diagonal of L.

    D_w is the diagonal of the first ``damped`` rows of H: the ellipsoidal trust region bounds the
    motion.  Gain and bias stand last; the cost is quadratic in them and they need no bound.
    L: below the diagonal; what stands above is scratch.  inverse: (n,) receives that of D.
    Returns False where H is not a number.
    """
    for k in range(n):
        s = H[k, k] * (1.0 + (damping if k < damped else 0.0))
        if not (s >= 0.0 and s < 1e300):
            return False
        inverse[k] = s
    for row in range(n):
        s = inverse[row]
        total = s * (1.0 + _RIDGE)
        for column in range(row):
            v = H[row, column]
            for k in range(column):
                v -= L[k, row] * L[column, k]
            L[column, row] = v
            L[row, column] = v * inverse[column]
            total -= v * L[row, column]
        # A parameter that nothing depends on keeps its value: its gradient is zero.
        inverse[row] = 1.0 / max(total, _RIDGE * s) if s > 1e-30 else 0.0
    return True


@leaf_kernel
def solve(L: F64, inverse: F64, n: int, g: F64, step: F64) -> None:
    """step = -(L D L')^-1 g, for a factor from ``factorise``."""
    for row in range(n):
        total = -g[row]
        for k in range(row):
            total -= L[row, k] * step[k]
        step[row] = total
    for row in range(n - 1, -1, -1):
        total = step[row] * inverse[row]
        for k in range(row + 1, n):
            total -= L[k, row] * step[k]
        step[row] = total


@leaf_kernel
def invert(L: F64, inverse: F64, n: int, scratch: F64, out: F64) -> None:
    """out = (L D L')^-1, the inverse of the factored matrix: many solves are products."""
    for column in range(n):
        for row in range(n):
            scratch[row] = -1.0 if row == column else 0.0
        solve(L, inverse, n, scratch, out[column])


@leaf_kernel
def inverse_diagonal(L: F64, inverse: F64, n: int, count: int, scratch: F64) -> float:
    """Trace of the leading ``count`` x ``count`` block of the inverse of the factored matrix."""
    trace = 0.0
    for column in range(count):
        # L y = e_column, starting at that row: above it y is zero.
        for row in range(column, n):
            value = 1.0 if row == column else 0.0
            for k in range(column, row):
                value -= L[row, k] * scratch[k]
            scratch[row] = value
            trace += value * value * inverse[row]
    return float(np.float64(trace))

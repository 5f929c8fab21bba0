"""One damped step of a small system, scaled by its diagonal (DSDT, Eq. 14-15)."""

import math

import numpy as np

from pliant.algorithms.arrays import F64
from pliant.algorithms.kernel import leaf_kernel

_RIDGE = 1e-9
"""Added to the unit diagonal: directions in which nothing is seen must not blow up."""


@leaf_kernel
def copy(source: F64, target: F64) -> None:
    """Fill ``target``.  An assignment to a slice makes a copy in between."""
    for k in range(len(target)):
        target[k] = source[k]


@leaf_kernel
def factorise(H: F64, n: int, damped: int, damping: float, L: F64, scale: F64) -> bool:
    """Cholesky factor L of D_s (H + lambda D_w) D_s with D_s = diag(H + lambda D_w)^-1/2.

    D_w is the diagonal of the first ``damped`` rows of H: the ellipsoidal trust region bounds the
    motion.  Gain and bias stand last; the cost is quadratic in them and they need no bound.
    scale: (n,) receives the diagonal of D_s.  Returns False where H is not a number.
    """
    for k in range(n):
        s = H[k, k] * (1.0 + (damping if k < damped else 0.0))
        if not (s >= 0.0 and s < 1e300):
            return False
        # A parameter that nothing depends on keeps its value: its gradient is zero.
        scale[k] = 1.0 / math.sqrt(s) if s > 1e-30 else 0.0
    for row in range(n):
        for column in range(row + 1):
            total = H[row, column] * scale[row] * scale[column]
            if row == column:
                total = 1.0 + _RIDGE
            for k in range(column):
                total -= L[row, k] * L[column, k]
            if row == column:
                L[row, row] = math.sqrt(max(total, _RIDGE))
            else:
                L[row, column] = total / L[column, column]
    return True


@leaf_kernel
def solve(L: F64, scale: F64, n: int, g: F64, step: F64) -> None:
    """step = -(D_s L^-T L^-1 D_s) g, for a factor from ``factorise``."""
    for row in range(n):
        total = -g[row] * scale[row]
        for k in range(row):
            total -= L[row, k] * step[k]
        step[row] = total / L[row, row]
    for row in range(n - 1, -1, -1):
        total = step[row]
        for k in range(row + 1, n):
            total -= L[k, row] * step[k]
        step[row] = total / L[row, row]
    for row in range(n):
        step[row] *= scale[row]


@leaf_kernel
def invert(L: F64, scale: F64, n: int, scratch: F64, out: F64) -> None:
    """out = D_s L^-T L^-1 D_s, the inverse of the factored matrix: many solves are products."""
    for column in range(n):
        for row in range(n):
            scratch[row] = -1.0 if row == column else 0.0
        solve(L, scale, n, scratch, out[column])


@leaf_kernel
def inverse_diagonal(L: F64, scale: F64, n: int, count: int, scratch: F64) -> float:
    """Trace of the leading ``count`` x ``count`` block of the inverse of the factored matrix."""
    trace = 0.0
    for column in range(count):
        # L y = e_column, starting at that row: above it y is zero.
        total = 0.0
        for row in range(column, n):
            value = 1.0 if row == column else 0.0
            for k in range(column, row):
                value -= L[row, k] * scratch[k]
            scratch[row] = value / L[row, row]
            total += scratch[row] * scratch[row]
        trace += total * scale[column] * scale[column]
    return float(np.float64(trace))

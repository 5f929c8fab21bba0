"""Preconditioned conjugate gradients."""

from collections.abc import Callable
from typing import TypeAlias

import numpy as np

from pliant.algorithms.arrays import F64

Product: TypeAlias = Callable[[F64], F64]


def conjugate_gradients(
    product: Product, precondition: Product, b: F64, *, tolerance: float, limit: int
) -> F64:
    """Solve ``product(x) = b`` to a share of the first residual, or by ``limit`` products.

    product, precondition: symmetric and positive definite.    b: an array of any shape.
    """
    x = np.zeros_like(b)
    r = b.copy()
    z = precondition(r)
    p = z.copy()
    rz = float(np.vdot(r, z))
    end = tolerance**2 * rz
    for _ in range(limit):
        if not rz > end:
            break
        Sp = product(p)
        curvature = float(np.vdot(p, Sp))
        if not curvature > 0.0:
            break
        x += rz / curvature * p
        r -= rz / curvature * Sp
        z = precondition(r)
        rz, before = float(np.vdot(r, z)), rz
        p = z + rz / before * p
    return x

"""Where surfels rest before a moving camera: the regulariser of DSDT, Eq. 20.

    omega_E (X - X^0)' Sigma^-1 (X - X^0)

It is all that ties the camera to the surfels (the floating map ambiguity, Eq. 16-19).
"""

from typing import NamedTuple

import numpy as np

from pliant.algorithms.arrays import F64
from pliant.algorithms.kernel import leaf_kernel
from pliant.algorithms.surfels.sampling import X


class Rest(NamedTuple):
    """Equilibria of N surfels as a camera sees them."""

    points: F64  # (N, 3) metres, camera's frame
    weights: F64  # (N, 3, 3) omega_E Sigma^-1, camera's axes, DN^2 / m^2


def no_rest(count: int) -> Rest:
    """Of a static camera: nothing holds a surfel."""
    return Rest(np.zeros((count, 3)), np.zeros((count, 3, 3)))


@leaf_kernel
def rest_cost(pose: F64, point: F64, W: F64) -> float:
    """omega_E times Eq. 20, DN^2.  point: (3,).  W: (3, 3)."""
    total = 0.0
    for r in range(3):
        for c in range(3):
            total += (pose[X + r] - point[r]) * W[r, c] * (pose[X + c] - point[c])
    return float(np.float64(total))


@leaf_kernel
def add_rest(pose: F64, point: F64, W: F64, H: F64, g: F64) -> None:
    """Add its matrix and half of its gradient; the position is the first three parameters."""
    for r in range(3):
        for c in range(3):
            g[r] += W[r, c] * (pose[X + c] - point[c])
            H[r, c] += W[r, c]

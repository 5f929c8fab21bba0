"""Where surfels rest before a moving camera: the regulariser of DSDT, Eq. 20.

    omega_E (X - X^0)' Sigma^-1 (X - X^0)

It is all that ties the camera to the surfels (the floating map ambiguity, Eq. 16-19).
"""

from typing import NamedTuple

import numpy as np

from pliant.algorithms.arrays import F64
from pliant.algorithms.kernel import leaf_kernel
from pliant.algorithms.surfels.sampling import X

OMEGA_E = 25.0
"""omega_E, DN^2: the variance of a residual that is as likely as a surfel one Sigma off its
equilibrium."""


class Rest(NamedTuple):
    """Equilibria of N surfels as a camera sees them."""

    points: F64  # (N, 3) metres, camera's frame
    weights: F64  # (N, 3, 3) omega_E Sigma^-1, camera's axes, DN^2 / m^2


def no_rest(count: int) -> Rest:
    """Of a static camera: nothing holds a surfel."""
    return Rest(np.zeros((count, 3)), np.zeros((count, 3, 3)))


@leaf_kernel
def turn_rest(T: F64, points: F64, weights: F64, seen: F64, turned: F64) -> None:
    """Positions and weights in the axes of a camera.

    T: (4, 4) T_camera_world.  points: (N, 3), weights: (N, 3, 3), world.  seen: (N, 3), turned:
    (N, 3, 3), filled.
    """
    for s in range(len(points)):
        p, W, out = points[s], weights[s], turned[s]
        for r in range(3):
            seen[s, r] = T[r, 0] * p[0] + T[r, 1] * p[1] + T[r, 2] * p[2] + T[r, 3]
            a = T[r, 0] * W[0, 0] + T[r, 1] * W[1, 0] + T[r, 2] * W[2, 0]
            b = T[r, 0] * W[0, 1] + T[r, 1] * W[1, 1] + T[r, 2] * W[2, 1]
            c = T[r, 0] * W[0, 2] + T[r, 1] * W[1, 2] + T[r, 2] * W[2, 2]
            for k in range(3):
                out[r, k] = a * T[k, 0] + b * T[k, 1] + c * T[k, 2]


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

"""The step of one camera: 6 x 6 damped normal equations by Cholesky, and the motion."""

import numpy as np

from pliant.algorithms.arrays import F64
from pliant.algorithms.kernel import kernel

SINGULAR = 1e-12


@kernel
def solve_camera(normal: F64, damping: float, step: F64) -> bool:
    """Solve ``(H + damping diag(H)) step = g``; False, and step 0, where there is no solution.

    normal: (>= 27,) lower triangle of H by rows, then g.
    """
    L = np.empty((6, 6))
    at = 0
    for r in range(6):
        for c in range(r + 1):
            total = normal[at] * (1.0 + damping) if r == c else normal[at]
            diagonal = total
            for k in range(c):
                total -= L[r, k] * L[c, k]
            if r == c:
                if not total > SINGULAR * diagonal:
                    step[:] = 0.0
                    return False
                L[r, r] = np.sqrt(total)
            else:
                L[r, c] = total / L[c, c]
            at += 1
    for r in range(6):
        total = normal[21 + r]
        for k in range(r):
            total -= L[r, k] * step[k]
        step[r] = total / L[r, r]
    for r in range(5, -1, -1):
        total = step[r]
        for k in range(r + 1, 6):
            total -= L[k, r] * step[k]
        step[r] = total / L[r, r]
    return True


@kernel
def move_camera(camera: F64, step: F64, out: F64) -> None:
    """Left-multiply T_camera_world (12,) by ``(exp(theta), rho)``, step (6,) = (rho, theta)."""
    a, b, c = step[3], step[4], step[5]
    angle2 = a * a + b * b + c * c
    if angle2 < 1e-12:
        p, q = 1.0 - angle2 / 6.0, 0.5 - angle2 / 24.0
    else:
        angle = np.sqrt(angle2)
        p, q = np.sin(angle) / angle, (1.0 - np.cos(angle)) / angle2
    e00, e01, e02 = 1.0 - q * (b * b + c * c), q * a * b - p * c, q * a * c + p * b
    e10, e11, e12 = q * a * b + p * c, 1.0 - q * (a * a + c * c), q * b * c - p * a
    e20, e21, e22 = q * a * c - p * b, q * b * c + p * a, 1.0 - q * (a * a + b * b)
    for k in range(3):
        r0, r1, r2 = camera[k], camera[3 + k], camera[6 + k]
        out[k] = e00 * r0 + e01 * r1 + e02 * r2
        out[3 + k] = e10 * r0 + e11 * r1 + e12 * r2
        out[6 + k] = e20 * r0 + e21 * r1 + e22 * r2
    t0, t1, t2 = camera[9], camera[10], camera[11]
    out[9] = e00 * t0 + e01 * t1 + e02 * t2 + step[0]
    out[10] = e10 * t0 + e11 * t1 + e12 * t2 + step[1]
    out[11] = e20 * t0 + e21 * t1 + e22 * t2 + step[2]


@kernel
def move_cameras(cameras: F64, steps: F64) -> F64:
    """``move_camera`` for (M, 12) cameras and (M, 6) steps; a step of 0 changes no bit."""
    out = cameras.copy()
    for m in range(cameras.shape[0]):
        if np.any(steps[m] != 0.0):
            move_camera(cameras[m], steps[m], out[m])
    return out

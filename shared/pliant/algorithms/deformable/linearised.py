"""Kernels: reprojection errors, their derivatives, and products with the normal equations.

The unknowns of a keyframe are one block: rotation (3), position (3), displacements of the nodes
(3 each).  An observation touches the block of its keyframe and its landmark.
"""

import math

from pliant.algorithms.arrays import F64, I64
from pliant.compiler.kernel import kernel

CAMERA = 6
"""Unknowns of a camera, before those of the nodes."""
_NEAREST_Z = 1e-3


@kernel
def linearise(
    keyframes: I64,
    landmarks: I64,
    points_px: F64,
    intrinsics: F64,
    T: F64,
    rest: F64,
    d: F64,
    carriers: I64,
    weights: F64,
    noise_px: float,
    kernel_px: float,
    J_camera: F64,
    J_point: F64,
    r: F64,
    squares: F64,
) -> float:
    """Errors by their noise, times the root of the Cauchy weight, and derivatives.

    J_camera: (M, 2, 6) receives those by a rotation on the right of R and by the position.
    J_point: (M, 2, 3), by the point in the world.    r: (M, 2).    squares: (M,) px squared.
    Returns the robust cost.  Points behind the camera count nothing but the cost of a lost one.
    """
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    scale = (kernel_px / noise_px) ** 2
    cost = 0.0
    for m in range(keyframes.size):
        k, i = keyframes[m], landmarks[m]
        px, py, pz = rest[i, 0], rest[i, 1], rest[i, 2]
        for j in range(carriers.shape[1]):
            n, w = carriers[i, j], weights[i, j]
            px += w * d[k, n, 0]
            py += w * d[k, n, 1]
            pz += w * d[k, n, 2]
        px, py, pz = px - T[k, 0, 3], py - T[k, 1, 3], pz - T[k, 2, 3]
        x = T[k, 0, 0] * px + T[k, 1, 0] * py + T[k, 2, 0] * pz
        y = T[k, 0, 1] * px + T[k, 1, 1] * py + T[k, 2, 1] * pz
        z = T[k, 0, 2] * px + T[k, 1, 2] * py + T[k, 2, 2] * pz
        if z < _NEAREST_Z:
            J_camera[m], J_point[m], r[m] = 0.0, 0.0, 0.0
            squares[m] = 1e12
            cost += scale * math.log(1e6)
            continue
        eu = fx * x / z + cx - points_px[m, 0]
        ev = fy * y / z + cy - points_px[m, 1]
        squares[m] = eu * eu + ev * ev
        square = squares[m] / noise_px**2
        cost += scale * math.log(1.0 + square / scale)
        root = math.sqrt(1.0 / (1.0 + square / scale)) / noise_px
        r[m, 0], r[m, 1] = root * eu, root * ev
        for row in range(2):
            f, q = (fx, x) if row == 0 else (fy, y)
            a = root * f / z if row == 0 else 0.0
            b = root * f / z if row == 1 else 0.0
            c = -root * f * q / (z * z)
            for axis in range(3):
                by_world = a * T[k, axis, 0] + b * T[k, axis, 1] + c * T[k, axis, 2]
                J_point[m, row, axis] = by_world
                J_camera[m, row, 3 + axis] = -by_world
            J_camera[m, row, 0] = b * z - c * y
            J_camera[m, row, 1] = c * x - a * z
            J_camera[m, row, 2] = a * y - b * x
    return cost


@kernel
def accumulate(
    keyframes: I64,
    landmarks: I64,
    carriers: I64,
    weights: F64,
    J_camera: F64,
    J_point: F64,
    r: F64,
    H: F64,
    g: F64,
    H_point: F64,
    g_point: F64,
) -> None:
    """Add J^T J and J^T r.  H: (K, B, B), g: (K, B), H_point: (L, 3, 3), g_point: (L, 3)."""
    for m in range(keyframes.size):
        k, i = keyframes[m], landmarks[m]
        for row in range(2):
            for a in range(3):
                g_point[i, a] += J_point[m, row, a] * r[m, row]
                for b in range(3):
                    H_point[i, a, b] += J_point[m, row, a] * J_point[m, row, b]
            for a in range(CAMERA):
                g[k, a] += J_camera[m, row, a] * r[m, row]
                for b in range(CAMERA):
                    H[k, a, b] += J_camera[m, row, a] * J_camera[m, row, b]
        for j in range(carriers.shape[1]):
            at, w = CAMERA + 3 * carriers[i, j], weights[i, j]
            for c in range(3):
                ju, jv = w * J_point[m, 0, c], w * J_point[m, 1, c]
                g[k, at + c] += ju * r[m, 0] + jv * r[m, 1]
                for a in range(CAMERA):
                    value = ju * J_camera[m, 0, a] + jv * J_camera[m, 1, a]
                    H[k, a, at + c] += value
                    H[k, at + c, a] += value
                for other in range(carriers.shape[1]):
                    to, v = CAMERA + 3 * carriers[i, other], weights[i, other]
                    for b in range(3):
                        H[k, at + c, to + b] += v * (ju * J_point[m, 0, b] + jv * J_point[m, 1, b])


@kernel
def times(
    keyframes: I64,
    landmarks: I64,
    carriers: I64,
    weights: F64,
    J_camera: F64,
    J_point: F64,
    v: F64,
    u: F64,
    by_point: F64,
) -> None:
    """u = J v, (M, 2) for v (K, B), and by_point += J_point^T u, (L, 3)."""
    for m in range(keyframes.size):
        k, i = keyframes[m], landmarks[m]
        for row in range(2):
            total = 0.0
            for a in range(CAMERA):
                total += J_camera[m, row, a] * v[k, a]
            for j in range(carriers.shape[1]):
                at, w = CAMERA + 3 * carriers[i, j], weights[i, j]
                for c in range(3):
                    total += w * J_point[m, row, c] * v[k, at + c]
            u[m, row] = total
            for c in range(3):
                by_point[i, c] += J_point[m, row, c] * total


@kernel
def times_transposed(
    keyframes: I64,
    landmarks: I64,
    carriers: I64,
    weights: F64,
    J_camera: F64,
    J_point: F64,
    u: F64,
    x: F64,
    out: F64,
) -> None:
    """out += J^T (u - J_point x), (K, B), for u (M, 2) and x (L, 3)."""
    for m in range(keyframes.size):
        k, i = keyframes[m], landmarks[m]
        for row in range(2):
            value = u[m, row]
            for c in range(3):
                value -= J_point[m, row, c] * x[i, c]
            for a in range(CAMERA):
                out[k, a] += J_camera[m, row, a] * value
            for j in range(carriers.shape[1]):
                at, w = CAMERA + 3 * carriers[i, j], weights[i, j]
                for c in range(3):
                    out[k, at + c] += w * J_point[m, row, c] * value

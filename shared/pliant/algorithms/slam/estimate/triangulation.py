"""Points from the rays of several cameras, over a dense camera x point table of observations.

Gauss-Newton on the reprojection error (Hartley and Zisserman 2004, section 12.3) from the linear
least squares intersection of the rays.
"""

import math

import numpy as np

from pliant.algorithms.arrays import F32, F64, I64, BoolArray
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import inverse
from pliant.compiler.kernel import fast_kernel, kernel

_ITERATIONS = 4
_MIN_DEPTH = 1e-6


def triangulate(
    T_world_camera: F64,
    u: F32,
    v: F32,
    seen: BoolArray,
    columns: I64,
    camera: PinholeCamera,
) -> tuple[F64, F32, F32, F32]:
    """Intersect the rays of each point in ``columns``.

    T_world_camera: (M, 4, 4).  u, v, seen: (M, N) observations.  columns: (C,) points wanted.
    Returns xyz (C, 3) in the world, the largest reprojection error (C,) in px, inf where the rays
    do not meet before all cameras, and the ``spread_of_rays`` of each.
    """
    xyz = np.empty((len(columns), 3))
    errors = np.empty(len(columns), np.float32)
    T_camera_world = np.ascontiguousarray(inverse(T_world_camera)[:, :3])
    intrinsics = camera.intrinsics
    _triangulate(
        T_camera_world, np.ascontiguousarray(T_world_camera[:, :3, 3]), u, v, seen, columns,
        intrinsics, xyz, errors,
    )  # fmt: skip
    parallax, sigmas = spread_of_rays(T_world_camera, seen, columns, xyz, focal_px=camera.fx)
    return xyz, errors, parallax, sigmas


def spread_of_rays(
    T_world_camera: F64, seen: BoolArray, columns: I64, xyz: F64, *, focal_px: float
) -> tuple[F32, F32]:
    """Parallax and depth uncertainty of points that several cameras see.

    xyz: (C, 3) of the points in ``columns`` (C,).  Returns two arrays (C,).  The first is the
    largest angle between two rays in radians, starting with the ray farthest from the first.  The
    second is the standard deviation along the first ray as a share of the depth, for a noise of 1
    px.
    """
    parallax, sigmas = np.empty(len(columns), np.float32), np.empty(len(columns), np.float32)
    centres = np.ascontiguousarray(T_world_camera[:, :3, 3])
    _spread(centres, seen, columns, np.ascontiguousarray(xyz), focal_px, parallax, sigmas)
    return parallax, sigmas


@fast_kernel
def _solve3(H: F64, g: F64, x: F64) -> bool:
    """Solve the symmetric ``H x = g`` by cofactors; H as xx, xy, xz, yy, yz, zz."""
    a = H[3] * H[5] - H[4] * H[4]
    b = H[2] * H[4] - H[1] * H[5]
    c = H[1] * H[4] - H[2] * H[3]
    det = H[0] * a + H[1] * b + H[2] * c
    size = H[0] * H[3] * H[5]
    if not det > 1e-14 * size or size <= 0.0:
        return False
    d = H[0] * H[5] - H[2] * H[2]
    e = H[1] * H[2] - H[0] * H[4]
    f = H[0] * H[3] - H[1] * H[1]
    x[0] = (a * g[0] + b * g[1] + c * g[2]) / det
    x[1] = (b * g[0] + d * g[1] + e * g[2]) / det
    x[2] = (c * g[0] + e * g[1] + f * g[2]) / det
    return True


@fast_kernel
def _intersect(
    T: F64, centres: F64, u: F32, v: F32, seen: BoolArray, n: int, K: F64, H: F64, g: F64, X: F64
) -> bool:
    """The point nearest to all rays in the least squares sense."""
    H[:] = 0.0
    g[:] = 0.0
    for m in range(T.shape[0]):
        if seen[m, n]:
            x, y = (u[m, n] - K[2]) / K[0], (v[m, n] - K[3]) / K[1]
            length = math.sqrt(x * x + y * y + 1.0)
            x, y, z = x / length, y / length, 1.0 / length
            dx = T[m, 0, 0] * x + T[m, 1, 0] * y + T[m, 2, 0] * z
            dy = T[m, 0, 1] * x + T[m, 1, 1] * y + T[m, 2, 1] * z
            dz = T[m, 0, 2] * x + T[m, 1, 2] * y + T[m, 2, 2] * z
            cx, cy, cz = centres[m, 0], centres[m, 1], centres[m, 2]
            along = dx * cx + dy * cy + dz * cz
            H[0] += 1.0 - dx * dx
            H[1] -= dx * dy
            H[2] -= dx * dz
            H[3] += 1.0 - dy * dy
            H[4] -= dy * dz
            H[5] += 1.0 - dz * dz
            g[0] += cx - dx * along
            g[1] += cy - dy * along
            g[2] += cz - dz * along
    return _solve3(H, g, X)


@fast_kernel
def _step(T: F64, u: F32, v: F32, seen: BoolArray, n: int, K: F64, H: F64, g: F64, X: F64) -> float:
    """Normal equations of the reprojection error at X; returns the largest error, px squared."""
    H[:] = 0.0
    g[:] = 0.0
    worst = 0.0
    for m in range(T.shape[0]):
        if seen[m, n]:
            x = T[m, 0, 0] * X[0] + T[m, 0, 1] * X[1] + T[m, 0, 2] * X[2] + T[m, 0, 3]
            y = T[m, 1, 0] * X[0] + T[m, 1, 1] * X[1] + T[m, 1, 2] * X[2] + T[m, 1, 3]
            z = T[m, 2, 0] * X[0] + T[m, 2, 1] * X[1] + T[m, 2, 2] * X[2] + T[m, 2, 3]
            if z < _MIN_DEPTH:
                return np.inf
            x, y = x / z, y / z
            ru, rv = u[m, n] - (K[0] * x + K[2]), v[m, n] - (K[1] * y + K[3])
            worst = max(worst, ru * ru + rv * rv)
            au, av = K[0] / z, K[1] / z
            ux = au * (T[m, 0, 0] - x * T[m, 2, 0])
            uy = au * (T[m, 0, 1] - x * T[m, 2, 1])
            uz = au * (T[m, 0, 2] - x * T[m, 2, 2])
            vx = av * (T[m, 1, 0] - y * T[m, 2, 0])
            vy = av * (T[m, 1, 1] - y * T[m, 2, 1])
            vz = av * (T[m, 1, 2] - y * T[m, 2, 2])
            H[0] += ux * ux + vx * vx
            H[1] += ux * uy + vx * vy
            H[2] += ux * uz + vx * vz
            H[3] += uy * uy + vy * vy
            H[4] += uy * uz + vy * vz
            H[5] += uz * uz + vz * vz
            g[0] += ux * ru + vx * rv
            g[1] += uy * ru + vy * rv
            g[2] += uz * ru + vz * rv
    return worst


@kernel
def _triangulate(
    T_camera_world: F64,
    centres: F64,
    u: F32,
    v: F32,
    seen: BoolArray,
    columns: I64,
    K: F64,
    xyz: F64,
    errors: F32,
) -> None:
    H, g, X, d = np.empty(6), np.empty(3), np.empty(3), np.empty(3)
    for i in range(columns.size):
        n = columns[i]
        worst = np.inf
        if _intersect(T_camera_world, centres, u, v, seen, n, K, H, g, X):
            for k in range(_ITERATIONS + 1):
                worst = _step(T_camera_world, u, v, seen, n, K, H, g, X)
                if k == _ITERATIONS or worst == np.inf or not _solve3(H, g, d):
                    break
                X[:] += d
        xyz[i] = X
        errors[i] = math.sqrt(worst)


@kernel
def _spread(
    centres: F64,
    seen: BoolArray,
    columns: I64,
    xyz: F64,
    focal_px: float,
    parallax: F32,
    sigmas: F32,
) -> None:
    directions = np.empty((centres.shape[0], 3))
    for i in range(columns.size):
        n = columns[i]
        count = 0
        for m in range(centres.shape[0]):
            if seen[m, n]:
                x, y, z = (
                    xyz[i, 0] - centres[m, 0],
                    xyz[i, 1] - centres[m, 1],
                    xyz[i, 2] - centres[m, 2],
                )
                scale = 1.0 / math.sqrt(max(x * x + y * y + z * z, 1e-300))
                directions[count, 0] = x * scale
                directions[count, 1] = y * scale
                directions[count, 2] = z * scale
                count += 1
        # sin^2 of the angle between two unit vectors from their difference: exact for small ones.
        far, widest, information = 0, 0.0, 0.0
        for k in range(1, count):
            apart = _apart(directions, 0, k)
            information += apart * (1.0 - 0.25 * apart)
            if apart > widest:
                widest, far = apart, k
        if widest > 0.0:
            for k in range(1, count):
                widest = max(widest, _apart(directions, far, k))
        parallax[i] = 2.0 * math.asin(min(0.5 * math.sqrt(widest), 1.0))
        sigmas[i] = 1.0 / (focal_px * math.sqrt(information)) if information > 0.0 else np.inf


@fast_kernel
def _apart(directions: F64, a: int, b: int) -> float:
    """Squared distance of two unit vectors: ``4 sin^2`` of half the angle between them."""
    x = directions[a, 0] - directions[b, 0]
    y = directions[a, 1] - directions[b, 1]
    z = directions[a, 2] - directions[b, 2]
    return x * x + y * y + z * z

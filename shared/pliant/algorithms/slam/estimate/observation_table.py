"""Kernels over the dense camera x landmark table of a window's observations."""

import math

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, I64, U8, BoolArray
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import inverse
from pliant.compiler.kernel import fast_kernel, kernel


def weigh(points_px: F32, camera: PinholeCamera, k_sigmas: tuple[float, float]) -> F32:
    """(n,) weights of observations at points_px (n, 2), 1 on the axis.

    k_sigmas: standard deviations of the distortions k1 and k3.  An observation at distance r from
    the axis, on the plane z = 1, may be off by f k1 r^3 + f k3 r^7 px beside its noise of 1 px: the
    weight is the inverse of the sum of the three variances.  An error of the focal length moves all
    observations alike, and depths absorb it.
    """
    k1, k3 = k_sigmas
    lens = np.array([*camera.intrinsics, camera.fx * k1, camera.fx * k3], np.float32)
    return _weigh(points_px, lens)


@kernel
def _weigh(points_px: F32, lens: F32) -> F32:
    weights = np.empty(points_px.shape[0], np.float32)
    one, of_k1, of_k3 = np.float32(1.0), lens[4] * lens[4], lens[5] * lens[5]
    for i in range(points_px.shape[0]):
        x, y = (points_px[i, 0] - lens[2]) / lens[0], (points_px[i, 1] - lens[3]) / lens[1]
        r2 = x * x + y * y
        r4 = r2 * r2
        weights[i] = one / (one + r2 * r4 * (of_k1 + of_k3 * r4 * r4))
    return weights


@kernel
def observe(
    rows: I32,
    points_px: F32,
    weights: F32,
    column_of: I32,
    slot: int,
    u: F32,
    v: F32,
    w: F32,
    seen: BoolArray,
) -> None:
    """Write the observations of one camera, rows (n,) at points_px (n, 2), into its slot.

    column_of: (capacity,) column of each row, negative where it is not in the table.
    """
    for i in range(rows.size):
        column = column_of[rows[i]]
        if column >= 0:
            u[slot, column], v[slot, column] = points_px[i, 0], points_px[i, 1]
            w[slot, column] = weights[i]
            seen[slot, column] = True


@kernel
def count_cameras(columns: I32, seen: BoolArray, first: int, last: int) -> I32:
    """(C,) number of the cameras first, ..., last - 1 that see each of the columns."""
    counts = np.zeros(columns.size, np.int32)
    for m in range(first, last):
        for i in range(columns.size):
            counts[i] += seen[m, columns[i]]
    return counts


@kernel
def columns_in_state(rows: I32, state: U8, wanted: int) -> I32:
    """Columns of the rows (N,) in the wanted state, ascending."""
    columns = np.empty(rows.size, np.int32)
    count = 0
    for n in range(rows.size):
        columns[count] = n
        count += state[rows[n]] == wanted
    return columns[:count].copy()


@kernel
def seen_in_state(rows: I32, state: U8, wanted: int, seen: BoolArray, slot: int, least: int) -> I32:
    """Columns in the wanted state that the slot and at least ``least`` cameras see."""
    columns = np.empty(rows.size, np.int32)
    count = 0
    for n in range(rows.size):
        if seen[slot, n] and state[rows[n]] == wanted:
            cameras = 0
            if least > 1:
                for m in range(seen.shape[0]):
                    cameras += seen[m, n]
            if least <= 1 or cameras >= least:
                columns[count] = n
                count += 1
    return columns[:count].copy()


@kernel
def flows(
    rows: I32, state: U8, least: int, u: F32, v: F32, seen: BoolArray, H: F64
) -> tuple[int, F32]:
    """Return the number of points in at least the given state in the second last slot.  Also return
    the motions, px, of those that the last slot sees, too, without the rotation H (3, 3) of its
    pixels.
    """
    moved = np.empty(rows.size, np.float32)
    before, both = 0, 0
    last = seen.shape[0] - 1
    for n in range(rows.size):
        if seen[last - 1, n] and state[rows[n]] >= least:
            before += 1
            if seen[last, n]:
                a, b = u[last - 1, n], v[last - 1, n]
                z = H[2, 0] * a + H[2, 1] * b + H[2, 2]
                du = u[last, n] - (H[0, 0] * a + H[0, 1] * b + H[0, 2]) / z
                dv = v[last, n] - (H[1, 0] * a + H[1, 1] * b + H[1, 2]) / z
                moved[both] = np.sqrt(du * du + dv * dv)
                both += 1
    return before, moved[:both].copy()


@kernel
def count_in_view(
    T_camera_world: F64, rows: I32, xyz: F64, lens: F32, width: int, height: int
) -> int:
    """Number of points in the image of a camera (4, 4).   rows: of ``xyz`` (capacity, 3)."""
    T, count = T_camera_world, 0
    for row in rows:
        x, y, z = xyz[row, 0], xyz[row, 1], xyz[row, 2]
        depth = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
        if depth > 0.0:
            u = lens[0] * (T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]) / depth + lens[2]
            v = lens[1] * (T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]) / depth + lens[3]
            count += 0.0 <= u < width and 0.0 <= v < height
    return count


@kernel
def has_parallax(
    columns: I32,
    slot: int,
    R_world_camera: F64,
    u: F32,
    v: F32,
    seen: BoolArray,
    lens: F32,
    cosine: float,
) -> I64:
    """Which columns have rays of the slot and of another camera that differ by more than an angle.

    R_world_camera: (M, 3, 3).   cosine: of the angle.
    """
    kept = np.empty(columns.size, np.int64)
    count = 0
    for i in range(columns.size):
        n = columns[i]
        x, y = (u[slot, n] - lens[2]) / lens[0], (v[slot, n] - lens[3]) / lens[1]
        A = R_world_camera[slot]
        ax = A[0, 0] * x + A[0, 1] * y + A[0, 2]
        ay = A[1, 0] * x + A[1, 1] * y + A[1, 2]
        az = A[2, 0] * x + A[2, 1] * y + A[2, 2]
        length = ax * ax + ay * ay + az * az
        for m in range(seen.shape[0]):
            if seen[m, n] and m != slot:
                x, y = (u[m, n] - lens[2]) / lens[0], (v[m, n] - lens[3]) / lens[1]
                B = R_world_camera[m]
                bx = B[0, 0] * x + B[0, 1] * y + B[0, 2]
                by = B[1, 0] * x + B[1, 1] * y + B[1, 2]
                bz = B[2, 0] * x + B[2, 1] * y + B[2, 2]
                dot = ax * bx + ay * by + az * bz
                other = bx * bx + by * by + bz * bz
                if dot < 0.0 or dot * dot < cosine * cosine * length * other:
                    kept[count] = n
                    count += 1
                    break
    return kept[:count].copy()


_MIN_DEPTH = 1e-6


def reprojection_errors(
    T_world_camera: F64, points_world: F64, points_px: F32, camera: PinholeCamera
) -> F32:
    """(N,) errors in px of points (N, 3) seen at (N, 2); inf for points behind the camera."""
    errors = np.empty(len(points_world), np.float32)
    T_camera_world = np.ascontiguousarray(inverse(T_world_camera)[:3])
    _errors(T_camera_world, points_world, points_px, camera.intrinsics, errors)
    return errors


def forget_outliers(
    T_world_camera: F64,
    points_world: F64,
    u: F32,
    v: F32,
    seen: BoolArray,
    columns: I32,
    camera: PinholeCamera,
    outlier_px: float,
) -> None:
    """Remove observations of the cameras (M) in the table u, v, seen (., N): those of the points
    (C, 3) in ``columns`` with an error above outlier_px, or behind the camera.
    """
    T_camera_world = np.ascontiguousarray(inverse(T_world_camera)[:, :3])
    K, most = camera.intrinsics, np.float32(outlier_px)
    _forget_outliers(T_camera_world, points_world, u, v, seen, columns, K, most)


def list_errors(
    T_world_camera: F64,
    points_world: F64,
    camera_index: I32,
    point_index: I32,
    points_px: F32,
    camera: PinholeCamera,
) -> F32:
    """(O,) errors in px of a list of observations; inf for points behind their camera."""
    errors = np.empty(len(points_px), np.float32)
    T_camera_world = np.ascontiguousarray(inverse(T_world_camera)[:, :3])
    K = camera.intrinsics
    _list_errors(T_camera_world, points_world, camera_index, point_index, points_px, K, errors)
    return errors


@fast_kernel
def _error(T: F64, X: F64, u: float, v: float, K: F64) -> float:
    z = T[2, 0] * X[0] + T[2, 1] * X[1] + T[2, 2] * X[2] + T[2, 3]
    if z < _MIN_DEPTH:
        return np.inf
    du = K[0] * (T[0, 0] * X[0] + T[0, 1] * X[1] + T[0, 2] * X[2] + T[0, 3]) / z + K[2] - u
    dv = K[1] * (T[1, 0] * X[0] + T[1, 1] * X[1] + T[1, 2] * X[2] + T[1, 3]) / z + K[3] - v
    return math.sqrt(du * du + dv * dv)


@kernel
def _errors(T: F64, points_world: F64, points_px: F32, K: F64, errors: F32) -> None:
    for n in range(points_world.shape[0]):
        errors[n] = _error(T, points_world[n], points_px[n, 0], points_px[n, 1], K)


@kernel
def _list_errors(
    T: F64, points_world: F64, camera: I32, point: I32, points_px: F32, K: F64, errors: F32
) -> None:
    for o in range(errors.size):
        X = points_world[point[o]]
        errors[o] = _error(T[camera[o]], X, points_px[o, 0], points_px[o, 1], K)


@kernel
def _forget_outliers(
    T: F64,
    points_world: F64,
    u: F32,
    v: F32,
    seen: BoolArray,
    columns: I32,
    K: F64,
    outlier_px: np.float32,
) -> None:
    for m in range(T.shape[0]):
        for i in range(columns.size):
            n = columns[i]
            if seen[m, n]:
                error = np.float32(_error(T[m], points_world[i], u[m, n], v[m, n], K))
                seen[m, n] = not error > outlier_px

"""Reprojection errors of points in one camera, and in all cameras of a window."""

import math

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, BoolArray
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import inverse
from pliant.algorithms.kernel import inline_kernel, kernel

_MIN_DEPTH = 1e-6


def reprojection_errors(
    T_world_camera: F64, points_world: F64, points_px: F32, camera: PinholeCamera
) -> F32:
    """(N,) errors in px of points (N, 3) seen at (N, 2); inf for points behind the camera."""
    errors = np.empty(len(points_world), np.float32)
    T_camera_world = np.ascontiguousarray(inverse(T_world_camera)[:3])
    _errors(T_camera_world, points_world, points_px, _intrinsics(camera), errors)
    return errors


def window_errors(
    T_world_camera: F64,
    points_world: F64,
    u: F32,
    v: F32,
    seen: BoolArray,
    columns: I32,
    camera: PinholeCamera,
) -> F32:
    """(M, C) errors in px of the points (C, 3) in ``columns`` of the table u, v, seen (M, N).

    0 where a camera does not see the point, inf where the point lies behind it.
    """
    errors = np.zeros((len(T_world_camera), len(columns)), np.float32)
    T_camera_world = np.ascontiguousarray(inverse(T_world_camera)[:, :3])
    _window_errors(T_camera_world, points_world, u, v, seen, columns, _intrinsics(camera), errors)
    return errors


def _intrinsics(camera: PinholeCamera) -> F64:
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy])


@inline_kernel
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
def _window_errors(
    T: F64, points_world: F64, u: F32, v: F32, seen: BoolArray, columns: I32, K: F64, errors: F32
) -> None:
    for m in range(errors.shape[0]):
        for i in range(columns.size):
            n = columns[i]
            if seen[m, n]:
                errors[m, i] = _error(T[m], points_world[i], u[m, n], v[m, n], K)

"""A first map of the waiting frames."""

from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, I64, BoolArray
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import inverse, transform
from pliant.algorithms.slam.estimate.problem import BundleProblem, shared_intrinsics
from pliant.algorithms.slam.estimate.schur import solve_schur
from pliant.algorithms.slam.parameters import MappingParameters, StartParameters

_MIN_DEPTH = 1e-6

_ADJUSTMENTS = 3
"""Rounds of adjustment and removal of outliers."""

_MAX_MEDIAN_ERROR_PX = 1.0
"""Maximum median reprojection error of a start."""

_LEAST_WAITING = 12
"""Minimum waiting frames, however old: a time lapse has no more."""


class Stamped(Protocol):
    """A frame and its capture time."""

    @property
    def stamp_ns(self) -> int: ...


_F = TypeVar("_F", bound=Stamped)


@dataclass(frozen=True, kw_only=True)
class BufferedFrame:
    """The stored part of a frame until the map starts."""

    frame: int
    stamp_ns: int
    ids: I64
    points_px: F32
    kappas: F32


@dataclass(frozen=True, kw_only=True)
class Start:
    """A first map.  The world is the camera of the first keyframe; the median depth in it is 1.

    frames: (K,) frame numbers of the keyframes, ascending.   T_world_camera: (K, 4, 4).
    ids: (N,) track of each landmark, ascending.   points_world: (N, 3).
    keyframe_index, point_index, points_px: (O,) observations that support the landmarks.
    kappas, newest_px: (N,) and (N, 2): the landmark's curvature where it was last detected, and its
    position in the image of the last keyframe, or near where it left the image.
    """

    frames: I64
    T_world_camera: F64
    ids: I64
    points_world: F64
    keyframe_index: I32
    point_index: I32
    points_px: F32
    kappas: F32
    newest_px: F32


def keep_newest(waiting: list[_F], newest: _F, parameters: StartParameters) -> list[_F]:
    """Return the waiting frames that are not too old, and the newest one."""
    oldest_ns = newest.stamp_ns - 1e9 * parameters.max_s
    young = [frame for frame in waiting if frame.stamp_ns > oldest_ns]
    return [*max(young, waiting[1 - _LEAST_WAITING :], key=len), newest]


def table_of(chosen: list[BufferedFrame], ids: I64) -> tuple[F32, F32, BoolArray]:
    """Return u, v and visibility, each (M, N), of the N tracks in M frames."""
    frames, columns, points_px = _observations(chosen, ids)
    u, v = np.zeros((2, len(chosen), len(ids)), np.float32)
    seen = np.zeros(u.shape, np.bool_)
    u[frames, columns], v[frames, columns] = points_px.T
    seen[frames, columns] = True
    return u, v, seen


def _observations(chosen: list[BufferedFrame], ids: I64) -> tuple[I32, I32, F32]:
    keyframe_index: list[I32] = []
    point_index: list[I32] = []
    points_px: list[F32] = []
    for k, frame in enumerate(chosen):
        _, i, j = np.intersect1d(frame.ids, ids, assume_unique=True, return_indices=True)
        keyframe_index.append(np.full(len(i), k, np.int32))
        point_index.append(j.astype(np.int32))
        points_px.append(frame.points_px[i])
    return np.concatenate(keyframe_index), np.concatenate(point_index), np.concatenate(points_px)


def adjusted_start(
    chosen: list[BufferedFrame],
    T_world_camera: F64,
    ids: I64,
    points: F64,
    camera: PinholeCamera,
    parameters: MappingParameters,
) -> Start | str:
    """Return the adjusted start of these keyframes (K,) and points, or the reason why there is
    none.

    T_world_camera: (K, 4, 4), the first the world.    ids, points: (N,) tracks and (N, 3).
    """
    start = parameters.start
    order = np.argsort(ids, kind="stable")
    ids, points = ids[order], points[order]
    scale = 1.0 / float(np.median(np.abs(points[:, 2])))  # some may lie behind the first camera
    points *= scale
    T_world_camera[:, :3, 3] *= scale
    keyframe_index, point_index, points_px = _observations(chosen, ids)
    fixed = np.zeros(len(chosen), np.bool_)
    fixed[0] = True
    median = np.inf
    for _ in range(_ADJUSTMENTS):
        problem = BundleProblem(
            T_world_camera=T_world_camera,
            points_world=points,
            camera_index=keyframe_index,
            point_index=point_index,
            points_px=points_px,
            intrinsics=shared_intrinsics(camera, len(chosen)),
            fixed_cameras=fixed,
        )
        result = solve_schur(problem, parameters.bundle)
        T_world_camera = result.T_world_camera
        error = np.sqrt(result.squared_residuals)
        median = float(np.median(error))
        keep = error < parameters.window.outlier_px
        # A point needs three frames: two always agree with some depth.
        seen = np.bincount(point_index[keep], minlength=len(ids))
        stays = seen >= 3
        keep &= stays[point_index]
        renumber = np.cumsum(stays) - 1
        ids, points = ids[stays], result.points_world[stays]
        keyframe_index, points_px = keyframe_index[keep], points_px[keep]
        point_index = renumber[point_index[keep]].astype(np.int32)
        if len(ids) < start.min_points:
            return f"too few points: {len(ids)} of {start.min_points}"
    if median > _MAX_MEDIAN_ERROR_PX:
        return f"no consistent start: error {median:.1f} of {_MAX_MEDIAN_ERROR_PX:.1f} px"
    return Start(
        frames=np.array([frame.frame for frame in chosen]),
        T_world_camera=T_world_camera,
        ids=ids,
        points_world=points,
        keyframe_index=keyframe_index,
        point_index=point_index,
        points_px=points_px,
        kappas=_kappas(chosen, ids),
        newest_px=_in_image(T_world_camera[-1], points, camera),
    )


def _kappas(chosen: list[BufferedFrame], ids: I64) -> F32:
    kappas = np.zeros(len(ids), np.float32)
    for frame in chosen:
        _, i, j = np.intersect1d(frame.ids, ids, assume_unique=True, return_indices=True)
        kappas[j] = frame.kappas[i]
    return kappas


def _in_image(T_world_camera: F64, points: F64, camera: PinholeCamera) -> F32:
    seen = transform(inverse(T_world_camera), points)
    seen[:, 2] = np.maximum(seen[:, 2], _MIN_DEPTH)
    inside = np.clip(camera.project(seen), 0.0, (camera.width - 1.0, camera.height - 1.0))
    return inside.astype(np.float32)

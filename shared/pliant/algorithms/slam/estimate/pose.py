"""The pose of one camera by points that stay where they are (VITAMIN-E section 3.2, Eq. 11 alone).

Levenberg-Marquardt over the pose and an unknown s that all points share finds the least

    sum w rho(r^T W r) + s^2 + d^T L d.

W and s belong to points with an uncertain depth, see ``inverse_depth``; for others W = I and s = 0.
d and L are the difference from the mean of a prior, and its information, see ``pose_prior``.
"""

from typing import Any, NamedTuple

import numpy as np

from pliant.algorithms.arrays import F32, F64, BoolArray
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.slam.estimate.dense_layout import BLOCK, Layout, Table
from pliant.algorithms.slam.estimate.pose_prior import (
    NO_PRIOR,
    PosePrior,
    add_prior,
    shifted_motion,
)
from pliant.algorithms.slam.estimate.problem import INITIAL_DAMPING, BundleParameters
from pliant.algorithms.slam.estimate.projection import (
    Cameras,
    Limits,
    limits_of,
    move_camera,
    solve_camera,
)
from pliant.algorithms.slam.estimate.subspace import squared_residuals
from pliant.algorithms.slam.estimate.subspace_kernels import linearise_camera
from pliant.compiler.kernel import kernel

_LOWER = np.tril_indices(6)

_NEAREST = -1.8
"""Least s: at -2 a point that no other keyframe has seen would be at the camera."""


class Spread(NamedTuple):
    """vectors: (N, 3) how uncertain points are.   standing: (3,) where the camera stood last."""

    vectors: F64
    standing: F64


class Correspondences(NamedTuple):
    """Points and their observations in one image, and any prior on the pose of its camera.

    points_world: (N, 3).   points_px: (N, 2), NaN where not seen.   weights: (N,) of the
    observations; None: all alike.   spread: of points with an uncertain depth, see
    ``inverse_depth``; None: all are certain.
    """

    points_world: F64
    points_px: F32
    weights: F32 | None = None
    spread: Spread | None = None
    prior: PosePrior = NO_PRIOR


class PoseEstimate(NamedTuple):
    """T_world_camera (4, 4), and how well the points agree with it.

    inliers: (N,) whether sqrt(r^T W r) is under a limit, with the point in front.
    information: (6, 6) of the pose, px^2, in the order (translation, rotation) of
    ``T_camera_world = (exp(theta), rho) * T_camera_world``.   cost: the least sum, px^2.
    """

    T_world_camera: F64
    inliers: BoolArray
    information: F64
    cost: float


def refine_pose(
    T_world_camera: F64,
    seen: Correspondences,
    camera: PinholeCamera,
    parameters: BundleParameters,
    *,
    inlier_px: float = 1.5,
    iterations: int = 10,
) -> PoseEstimate:
    """Refine a pose (4, 4) robustly, with the points fixed.  Without observations or prior it
    stays.
    """
    start, N = np.ascontiguousarray(T_world_camera, np.float64), len(seen.points_px)
    layout = _one_camera(start, seen, camera)
    depths: tuple[F64, ...] = ()
    if seen.spread is not None:
        depths = (np.zeros(layout.points.shape),)
        depths[0][:, :N] = seen.spread.vectors.T
    before = layout.cameras.motion[0]
    mean = shifted_motion(seen.prior.T_world_camera, layout.origin)
    pose, normal = before.copy(), np.zeros(36)
    shared, cost = _minimise(
        pose, layout.cameras.single(), layout.points.astype(np.float32), layout.table,
        tuple(each.astype(np.float32) for each in depths), limits_of(parameters, np.float32),
        mean, seen.prior.information, INITIAL_DAMPING,
        parameters.min_relative_decrease, iterations, normal,
    )  # fmt: skip
    squared = squared_residuals(layout, pose[None], layout.points, parameters, depths, shared)
    H = np.zeros((6, 6))
    H[_LOWER] = _of_pose(normal)[0]
    H.T[_LOWER] = H[_LOWER]
    moved = (pose != before).any()
    return PoseEstimate(
        _motion(pose, layout.origin) if moved else start.copy(),
        squared[0, :N] < np.float32(inlier_px**2),
        H,
        cost,
    )


def _one_camera(T_world_camera: F64, seen: Correspondences, camera: PinholeCamera) -> Layout:
    """The layout of a problem with one camera, without the detour over a ``BundleWindow``."""
    points_world = np.asarray(seen.points_world, np.float64)
    points_px = np.asarray(seen.points_px, np.float32)
    N = len(points_world)
    P = max(1, -(-N // BLOCK)) * BLOCK
    origin = T_world_camera[:3, 3]
    pinhole = camera.intrinsics[None]
    u, v, w = np.zeros((3, 1, P), np.float32)
    table = Table(u, v, w, np.zeros((1, P // BLOCK), np.uint8))
    points = np.zeros((3, P))
    _fill(points_world, points_px, origin, table, points)
    if seen.weights is not None:
        w[0, :N] *= seen.weights
    cameras = Cameras(shifted_motion(T_world_camera, origin)[None], pinhole, np.zeros(0))
    return Layout(
        column=np.arange(N), cameras=cameras, free=np.ones(1, np.bool_), origin=origin,
        points=points, table=table,
    )  # fmt: skip


@kernel
def _fill(points_world: F64, points_px: F32, origin: F64, table: Table, points: F64) -> None:
    for n in range(points_px.shape[0]):
        finite = np.isfinite(points_px[n, 0]) and np.isfinite(points_px[n, 1])
        for k in range(3):
            finite = finite and np.isfinite(points_world[n, k])
        if finite:
            table.u[0, n] = points_px[n, 0]
            table.v[0, n] = points_px[n, 1]
            table.w[0, n] = 1.0
            table.seen[0, n // BLOCK] = 1
            for k in range(3):
                points[k, n] = points_world[n, k] - origin[k]


def _motion(camera: F64, origin: F64) -> F64:
    """(4, 4) T_world_camera of a (12,) camera in the shifted world, on SE(3) to rounding.

    Predictions extrapolate: a rotation slightly off SO(3) would grow threefold in every frame.
    """
    rotation = camera[:9].reshape(3, 3)
    for _ in range(2):
        # A Newton step to the polar factor: it is nearly a rotation.
        rotation = 1.5 * rotation - 0.5 * (rotation @ rotation.T @ rotation)
    T_world_camera = np.eye(4)
    T_world_camera[:3, :3] = rotation.T
    T_world_camera[:3, 3] = origin - rotation.T @ camera[9:]
    return T_world_camera


@kernel
def _minimise(
    camera: F64,
    cameras: Cameras,
    points: F32,
    table: Table,
    spread: Any,
    limits: Limits,
    mean: F64,
    information: F64,
    damping: float,
    min_relative_decrease: float,
    iterations: int,
    normal: F64,
) -> tuple[float, float]:
    """Levenberg-Marquardt on the motion of one camera (12,), moved in place.

    cameras: that one, whose motion is overwritten.   spread: as of ``linearise_camera``.   mean,
    information: of the prior, (12,) and (6, 6).   normal: (36,) at its end.
    Returns s and the cost.
    """
    trial, step, fresh = camera.copy(), np.zeros(6), np.empty(36)
    shared, trial_shared, lowest = 0.0, 0.0, np.inf
    m = len(cameras.motion) - 1  # for a literal 0 numba compiles what is called once more
    for iteration in range(iterations + 1):
        for k in range(12):
            cameras.motion[m, k] = np.float32(trial[k])
        linearise_camera(
            m, cameras, points, table, limits, spread, np.float32(trial_shared), fresh
        )  # fmt: skip
        fresh[27] += 1.0
        fresh[34] -= trial_shared
        fresh[35] += trial_shared * trial_shared
        add_prior(trial, mean, information, fresh)
        if fresh[35] <= lowest:
            small = lowest - fresh[35] <= min_relative_decrease * fresh[35]
            lowest, shared = fresh[35], trial_shared
            camera[:] = trial
            normal[:] = fresh
            damping = max(damping * 0.1, 1e-9)
            if small:
                break
        else:
            damping *= 10.0
        H, g = _of_pose(normal)
        if iteration == iterations or not solve_camera(H, g, damping, step):
            break
        move_camera(camera, step, trial)
        rest = normal[34]
        for r in range(6):
            rest -= normal[21 + r] * step[r]
        trial_shared = max(shared + rest / normal[27], _NEAREST)
    return shared, lowest


@kernel
def _of_pose(normal: F64) -> tuple[F64, F64]:
    """H (21,) and g (6,) of the pose: s is eliminated from ``linearise_camera``'s equations."""
    H, g = np.empty(21), np.empty(6)
    at = 0
    for r in range(6):
        share = normal[21 + r] / normal[27]
        for c in range(r + 1):
            H[at] = normal[at] - share * normal[21 + c]
            at += 1
        g[r] = normal[28 + r] - share * normal[34]
    return H, g

"""Tracks without parallax count as directions: they tell how the camera turned.

A track that several keyframes see from nearly one place has a direction, but hardly a depth.
From the first keyframe of the window that sees it, at c, along the unit ray d, it is provisionally

    X = c + d / rho,    rho ~ N(rho_0, rho_0^2 / 4),

rho_0 the inverse distance of what is mapped: infinity lies two standard deviations away (Civera,
Davison and Montiel 2008).  What the other keyframes see of it improves rho and its deviation
sigma_rho.  To first order the depth's error moves X by a multiple, of variance 1, of

    spread = (X - c) sigma_rho / rho

and so its projection by e = (d phi / d X) spread: nothing for a camera at c, however it has
turned, and the more the farther it went.  With 1 px of noise, the unknown depth integrated out,

    r ~ N(0, I + e e^T),    W = (I + e e^T)^-1 = I - e e^T / (1 + e^T e)

weighs the residual r.  So the observation constrains the rotation, and the translation across the
epipolar line of the ray, in full.  It constrains the translation along that line only as far as
the depth is known.  A point of the map has spread 0 and W = I.

What is not mapped may all be nearer or farther than what is, so that depths err together, too: a
frame sees candidates at X + s spread, with one s ~ N(0, 1) that is found with its pose.  Thousands
that err alike would outweigh the points that tell how far the camera went.
"""

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, I64, U8, BoolArray
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import inverse, lengths
from pliant.algorithms.slam.estimate.pose import (
    Correspondences,
    PoseEstimate,
    Spread,
    refine_pose,
)
from pliant.algorithms.slam.estimate.problem import BundleParameters
from pliant.algorithms.slam.map.keyframe import Keyframe
from pliant.algorithms.slam.map.landmarks import CANDIDATE, MAPPED, MAPPED_SHARE, Landmarks
from pliant.algorithms.slam.map.track_links import UNLINKED
from pliant.compiler.kernel import kernel

_PRIOR_SHARE = 0.5
"""Standard deviation of an unknown inverse depth, as a share of it."""

_FARTHEST = 0.02
"""Least inverse depth, as a share of the prior's: it stays before the camera."""

_COMMON_PX = 0.1
"""Error that all tracks may have in common: a gain within it is no sign of a translation."""

_ANY_DEPTH = 10.0
"""Standard deviations of an inverse depth that leave it open: near is far from the prior."""

_ENDLESS = 1e6
"""Distance, in medians of the map, at which no camera in it can tell a point from a direction."""

_STEPS = 3
_MIN_DEPTH = 1e-6


def spread_of(points: Landmarks, rows: I32, last: Keyframe) -> Spread:
    """How uncertain the rows are, for a camera that may stand where the last keyframe does."""
    return Spread(vectors=points.spread.take(rows, 0), standing=last.T_world_camera[:3, 3])


def placed_candidates(points: Landmarks, rows: I32) -> I64:
    """Indices of the rows that are candidates with a provisional position; rows may be UNLINKED."""
    return _placed(rows, points.state, points.spread)[0]


def helping_candidates(points: Landmarks, rows: I32) -> I64:
    """As ``placed_candidates``; none where enough of the rows are mapped."""
    others, mapped = _placed(rows, points.state, points.spread)
    return others if mapped < MAPPED_SHARE * (mapped + len(others)) else others[:0]


@kernel
def _placed(rows: I32, state: U8, spread: F64) -> tuple[I64, int]:
    """Indices of the rows that are candidates with a place, and how many rows are mapped."""
    placed = np.empty(rows.size, np.int64)
    count, mapped = 0, 0
    for i in range(rows.size):
        row = rows[i]
        if row == UNLINKED:
            continue
        mapped += state[row] == MAPPED
        if state[row] == CANDIDATE and np.isfinite(spread[row, 0]):
            placed[count] = i
            count += 1
    return placed[:count].copy(), mapped


def at_infinity(points_world: F64, centre: F64) -> BoolArray:
    """(N,) which points of a map are directions after all.

    An adjustment takes a point whose rays part, by noise, behind the infinite: farther away every
    time, for the step grows with the distance, until its coordinates are no numbers.

    points_world: (N, 3).   centre: (3,) of a camera that is among them.
    """
    distances = lengths(points_world - centre)
    # The median is no less than the minimum: mostly there is no need to know it.
    if len(distances) and distances.max() <= _ENDLESS * distances.min():
        return np.zeros(len(distances), np.bool_)
    median = np.median(distances) if len(distances) else 0.0
    return ~(distances <= _ENDLESS * median)


def place(
    T_world_camera: F64,
    u: F32,
    v: F32,
    seen: BoolArray,
    columns: I32,
    camera: PinholeCamera,
    inverse_distance: float,
) -> tuple[F64, F64]:
    """Provisional points of the ``columns`` (C,) that the cameras see.

    T_world_camera: (M, 4, 4).  u, v, seen: (M, N) observations.   inverse_distance: rho_0.
    Returns X (C, 3) and spread (C, 3) in the world; NaN where no camera sees the column.
    """
    xyz, spread = np.full((2, len(columns), 3), np.nan)
    K = camera.intrinsics
    T_camera_world = np.ascontiguousarray(inverse(T_world_camera)[:, :3])
    _place(T_world_camera, T_camera_world, u, v, seen, columns, K, inverse_distance, xyz, spread)
    return xyz, spread


@kernel
def _place(
    T_world_camera: F64,
    T_camera_world: F64,
    u: F32,
    v: F32,
    seen: BoolArray,
    columns: I32,
    K: F64,
    prior: float,
    xyz: F64,
    spread: F64,
) -> None:
    X, ray, shift = np.empty(3), np.empty(3), np.empty(2)
    for i in range(columns.size):
        n, first = columns[i], 0
        while first < seen.shape[0] and not seen[first, n]:
            first += 1
        if first == seen.shape[0]:
            continue
        T = T_world_camera[first]
        x, y = (u[first, n] - K[2]) / K[0], (v[first, n] - K[3]) / K[1]
        length = np.sqrt(x * x + y * y + 1.0)
        for k in range(3):
            ray[k] = (T[k, 0] * x + T[k, 1] * y + T[k, 2]) / length
        rho = prior
        information = 0.0
        for _ in range(_STEPS):
            for k in range(3):
                X[k] = T[k, 3] + ray[k] / rho
            information = 1.0 / (_PRIOR_SHARE * prior) ** 2
            gradient = information * (prior - rho)
            for m in range(first + 1, seen.shape[0]):
                if not seen[m, n]:
                    continue
                z = _project(T_camera_world[m], X, ray, K, shift)
                if z > _MIN_DEPTH:
                    # d phi / d rho = -(d phi / d X) d / rho^2
                    ju, jv = -shift[0] / (rho * rho), -shift[1] / (rho * rho)
                    du, dv = _residual(T_camera_world[m], X, u[m, n], v[m, n], K)
                    information += ju * ju + jv * jv
                    gradient += ju * du + jv * dv
            rho = max(rho + gradient / information, _FARTHEST * prior)
        for k in range(3):
            xyz[i, k] = T[k, 3] + ray[k] / rho
            spread[i, k] = ray[k] / (rho * rho * np.sqrt(information))


@kernel
def _project(T: F64, X: F64, move: F64, K: F64, shift: F64) -> float:
    """How far the projection of X shifts per ``move``, px; returns the depth of X."""
    z = T[2, 0] * X[0] + T[2, 1] * X[1] + T[2, 2] * X[2] + T[2, 3]
    if z > _MIN_DEPTH:
        x = (T[0, 0] * X[0] + T[0, 1] * X[1] + T[0, 2] * X[2] + T[0, 3]) / z
        y = (T[1, 0] * X[0] + T[1, 1] * X[1] + T[1, 2] * X[2] + T[1, 3]) / z
        mz = T[2, 0] * move[0] + T[2, 1] * move[1] + T[2, 2] * move[2]
        mx = T[0, 0] * move[0] + T[0, 1] * move[1] + T[0, 2] * move[2]
        my = T[1, 0] * move[0] + T[1, 1] * move[1] + T[1, 2] * move[2]
        shift[0] = K[0] * (mx - x * mz) / z
        shift[1] = K[1] * (my - y * mz) / z
    return z


@kernel
def _residual(T: F64, X: F64, u: float, v: float, K: F64) -> tuple[float, float]:
    z = T[2, 0] * X[0] + T[2, 1] * X[1] + T[2, 2] * X[2] + T[2, 3]
    x = (T[0, 0] * X[0] + T[0, 1] * X[1] + T[0, 2] * X[2] + T[0, 3]) / z
    y = (T[1, 0] * X[0] + T[1, 1] * X[1] + T[1, 2] * X[2] + T[1, 3]) / z
    return u - K[0] * x - K[2], v - K[1] * y - K[3]


def off_epipolar_line(
    T_world_camera: F64, points_world: F64, spread: F64, points_px: F32, camera: PinholeCamera
) -> F64:
    """(N,) px by which observations points_px (N, 2) miss the epipolar lines of provisional points,
    which no depth explains; 0 for what is behind the camera.   points_world, spread: (N, 3).
    """
    K = camera.intrinsics
    off = np.empty(len(points_px))
    _off_lines(inverse(T_world_camera)[:3], points_world, spread, points_px, K, off)
    return off


@kernel
def _off_lines(T: F64, X: F64, spread: F64, px: F32, K: F64, off: F64) -> None:
    shift = np.empty(2)
    for n in range(X.shape[0]):
        off[n] = 0.0
        if _project(T, X[n], spread[n], K, shift) > _MIN_DEPTH:
            du, dv = _residual(T, X[n], px[n, 0], px[n, 1], K)
            along = du * shift[0] + dv * shift[1]
            uncertain = shift[0] ** 2 + shift[1] ** 2
            share = _ANY_DEPTH**2 / (1.0 + _ANY_DEPTH**2 * uncertain)
            off[n] = np.sqrt(max(du * du + dv * dv - share * along * along, 0.0))


def refine_moving_or_standing(
    T_world_camera: F64,
    seen: Correspondences,
    standing: F64,
    camera: PinholeCamera,
    parameters: BundleParameters,
    inlier_px: float,
) -> tuple[PoseEstimate, bool]:
    """Refine a pose (4, 4) with points of uncertain depth.  Returns whether the camera stands.

    It is at ``standing`` (3,) unless the points tell that it has moved: over a view of some 60
    degrees a translation and a rotation differ so little that errors which tracks have in common,
    small as they are, look like one.
    """
    still = T_world_camera.copy()
    still[:3, 3] = standing
    fixed = seen._replace(prior=seen.prior.with_fixed_centre())
    moved = refine_pose(T_world_camera, seen, camera, parameters, inlier_px=inlier_px)
    rotated = refine_pose(still, fixed, camera, parameters, inlier_px=inlier_px)
    stands = rotated.cost - moved.cost <= _COMMON_PX**2 * len(seen.points_px)
    return rotated if stands else moved, stands

"""Which keyframes tell most of the depth that another one sees.

Two images tell depth by their parallax: too small it drowns in the noise of matching, too large
and the same surface looks different (Merrell et al. 2007 take neighbours in time; here revisited
places count as well).
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from pliant.algorithms.arrays import F64, I64, Shape
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import inverse

SAMPLES = 128
"""Points of a keyframe by which others are judged."""
_BEST_ANGLE = 0.10
_MIN_ANGLE, _MAX_ANGLE = 0.03, 0.25
"""Of the rays that two keyframes send to a point, radians."""
_ANGLE_SPREAD = 0.5
"""Standard deviation of the logarithm of a good angle."""
_MIN_OVERLAP = 0.2
_MOST_CANDIDATES = 64
_LIKE_RAD = 0.05
"""Two sources whose parallaxes differ by less say much the same."""
_LIKE_COST = 0.7


@dataclass(frozen=True)
class Viewpoints:
    """T_world_camera: of keyframes.    sharpness: of their images, in any unit."""

    camera: PinholeCamera
    T_world_camera: Annotated[F64, Shape("N", 4, 4)]
    sharpness: Annotated[F64, Shape("N")]


def choose_sources(views: Viewpoints, row: int, points_world: F64, count: int) -> I64:
    """Rows of at most ``count`` keyframes, the most informative first.

    points_world: (P, 3) some of what keyframe ``row`` sees.  Each that is taken lowers those which
    see the points from much the same side.
    """
    score, parallax = _scores(views, row, points_world)
    chosen: list[int] = []
    while len(chosen) < count:
        best = int(score.argmax())
        if not score[best] > 0.0:
            break
        chosen.append(best)
        apart = np.square(parallax - parallax[best]).sum(axis=1) / _LIKE_RAD**2
        score = score * (1.0 - _LIKE_COST * np.exp(-0.5 * apart))
        score[best] = 0.0
    return np.array(chosen, np.int64)


def _scores(views: Viewpoints, row: int, points_world: F64) -> tuple[F64, F64]:
    """(N,) of all keyframes, 0: of no use; (N, 3) centre of each from here, over the depth."""
    poses = views.T_world_camera
    T_camera_world = inverse(poses[row])
    local = points_world @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
    points_world, depth = points_world[local[:, 2] > 0.0], local[local[:, 2] > 0.0, 2]
    score, parallax = np.zeros(len(poses)), np.zeros((len(poses), 3))
    if not len(depth):
        return score, parallax
    parallax = (poses[:, :3, 3] - poses[row, :3, 3]) / np.median(depth)
    # What is too near or too far off has no good angle to most points: no need to look closer.
    away = np.linalg.norm(parallax, axis=1)
    near = np.flatnonzero((away > 0.5 * _MIN_ANGLE) & (away < 4.0 * _MAX_ANGLE))
    if not len(near):
        return score, parallax
    # However many keyframes a place has, each costs the same.
    promise = _goodness(away[near]) * (poses[near, :3, 2] @ poses[row, :3, 2])
    near = near[np.sort(np.argsort(-promise, kind="stable")[:_MOST_CANDIDATES])]
    there = points_world - poses[near, None, :3, 3]  # (M, P, 3)
    in_camera = there @ poses[near, :3, :3]
    z = in_camera[..., 2]
    with np.errstate(all="ignore"):
        pixels = views.camera.project(in_camera.reshape(-1, 3)).reshape(*z.shape, 2)
    size = views.camera.width, views.camera.height
    seen = (z > 0.0) & (pixels > -0.5).all(axis=2) & (pixels < np.array(size) - 0.5).all(axis=2)
    here = points_world - poses[row, :3, 3]
    far = np.linalg.norm(there, axis=2)
    cosines = (there * here).sum(axis=2) / (far * np.linalg.norm(here, axis=1))
    angles = np.arccos(np.clip(cosines, -1.0, 1.0))
    overlap = seen.mean(axis=1)
    for m in np.flatnonzero(overlap >= _MIN_OVERLAP):
        angle = float(np.median(angles[m, seen[m]]))
        if not _MIN_ANGLE <= angle <= _MAX_ANGLE:
            continue
        size_ratio = float(np.median(z[m, seen[m]] / depth[seen[m]]))
        good = float(_goodness(np.array(angle)))
        j = near[m]
        sharp = min(1.0, views.sharpness[j] / max(views.sharpness[row], 1e-9))
        score[j] = overlap[m] * good * min(size_ratio, 1.0 / size_ratio) * sharp
    score[row] = 0.0
    return score, parallax


def _goodness(angles: F64) -> F64:
    """1 at the best angle, falling to either side."""
    return np.exp(-0.5 * (np.log(angles / _BEST_ANGLE) / _ANGLE_SPREAD) ** 2)

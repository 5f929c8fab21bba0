"""Relative pose of two views: rotation alone, and the essential matrix.

``R_b_a`` and ``t_b_a`` map points of camera a to camera b; t has unit length, for the scale of two
views is unknown.  Points are on the plane z = 1, so errors are in units of the focal length.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import cv2
import numpy as np

from pliant.algorithms.arrays import F64, BoolArray
from pliant.algorithms.geometry import hat

_ROTATION_ITERATIONS = 6
_CONFIDENCE = 0.9999

_SAMPLES = 300
"""Enough for 50 % outliers; with more of them nothing good can start."""

_SAMPLED = 1000
"""Points, evenly of all, by which motions are found that are judged by all."""


@dataclass(frozen=True, kw_only=True)
class RelativePose:
    """Two views by the essential matrix.

    T_b_a: (4, 4), translation of length 1.  inliers: (N,) points that agree and lie before both
    cameras.  misfit: mean of Geman-McClure's kernel, at the gate's scale, over all points.
    rays_a, rays_b: (N, 3) of the points.
    """

    T_b_a: F64
    inliers: BoolArray
    misfit: float
    rays_a: F64
    rays_b: F64

    @cached_property
    def parallax_rad(self) -> F64:
        """(N,) angle between the two rays of each point, computed on demand."""
        return parallax(self.T_b_a, self.rays_a, self.rays_b)


def rays(points_n: F64) -> F64:
    """(..., 2) points on the plane z = 1 to (..., 3) unit rays."""
    homogeneous = _homogeneous(points_n)
    return homogeneous / np.linalg.norm(homogeneous, axis=-1, keepdims=True)


def _homogeneous(points_n: F64) -> F64:
    """(..., 2) points on the plane z = 1 to (..., 3)."""
    return np.concatenate([points_n, np.ones((*points_n.shape[:-1], 1))], axis=-1)


def rotation_between(points_a: F64, points_b: F64, *, scale: float) -> tuple[F64, F64]:
    """The rotation R_b_a that explains two views best, as if the camera had only turned.

    Weighted Kabsch with Geman-McClure weights of the given scale, from the least squares start.
    points_a, points_b: (..., N, 2), the same points on the plane z = 1 of each view.  Returns R_b_a
    (..., 3, 3) and the residual of each point (..., N) on b's plane z = 1, inf where the turned ray
    points backwards.
    """
    rays_a, rays_b = rays(points_a), rays(points_b)
    weights = np.ones(rays_a.shape[:-1])
    rotation, residuals = np.eye(3), np.zeros(weights.shape)
    for _ in range(_ROTATION_ITERATIONS):
        U, _, Vt = np.linalg.svd(np.swapaxes(rays_b * weights[..., None], -1, -2) @ rays_a)
        U[..., 2] *= np.sign(np.linalg.det(U) * np.linalg.det(Vt))[..., None]
        rotation = U @ Vt
        turned = rays_a @ np.swapaxes(rotation, -1, -2)
        ahead = turned[..., 2] > 1e-3
        z = np.where(ahead, turned[..., 2], 1.0)
        difference = np.linalg.norm(turned[..., :2] / z[..., None] - points_b, axis=-1)
        residuals = np.where(ahead, difference, np.inf)
        # The scale shrinks from the spread of the residuals to the given one.
        spread = np.maximum(scale, 1.5 * np.median(residuals, axis=-1, keepdims=True))
        weights = 1.0 / (1.0 + (residuals / spread) ** 2) ** 2
    return rotation, residuals


def relative_poses(points_a: F64, points_b: F64, *, gate: float) -> list[RelativePose]:
    """Motions that may explain two views: several, because noise and planes allow more than
    one, and only further views decide.

    The essential matrix by two estimators, and the motions that a homography allows.  Both
    estimators improve each sample on all points that agree with it, because the noise dominates in
    the few points of a sample (Ma et al. 2004, section 5.3): of a plane there are two.

    points_a, points_b: (N, 2), the same points on the plane z = 1 of each view.  ``gate`` is the
    largest epipolar error of an inlier.  OpenCV seeds its samples itself at every call, so the
    result depends on the arguments alone.  Empty where nothing fits.
    """
    if len(points_a) < 8:
        return []
    views = _views(points_a, points_b, gate)
    every = max(1, len(points_a) // _SAMPLED)
    few = _views(points_a[::every], points_b[::every], gate)
    motions = [_by_essential(few, method) for method in (cv2.USAC_ACCURATE, cv2.USAC_MAGSAC)]
    motions += _by_homography(few)
    found = [_two_views(T_b_a, views) for T_b_a in motions if T_b_a is not None]
    return sorted((each for each in found if each.inliers.any()), key=lambda each: each.misfit)


def likely_pose(points_a: F64, points_b: F64, *, gate: float) -> RelativePose | None:
    """One of ``relative_poses``, in a tenth of the time and not always the best; None if there
    is none."""
    if len(points_a) < 8:
        return None
    views = _views(points_a, points_b, gate)
    T_b_a = _by_essential(views, cv2.USAC_ACCURATE)
    found = None if T_b_a is None else _two_views(T_b_a, views)
    return found if found is not None and found.inliers.any() else None


class _Views(NamedTuple):
    """What two views have in common: a, b: (N, 3) points on the plane z = 1; rays (N, 3), the
    gate."""

    a: F64
    b: F64
    rays_a: F64
    rays_b: F64
    gate: float


def _views(points_a: F64, points_b: F64, gate: float) -> _Views:
    a, b = _homogeneous(points_a), _homogeneous(points_b)
    return _Views(a, b, rays(points_a), rays(points_b), gate)


def _by_essential(views: _Views, method: int) -> F64 | None:
    """Of the motions that an essential matrix allows, that which puts most points before both
    cameras."""
    a, b = (np.ascontiguousarray(each[:, :2]) for each in (views.a, views.b))
    E: Any = cv2.findEssentialMat(
        a, b, np.eye(3), method=method, prob=_CONFIDENCE, threshold=views.gate, maxIters=_SAMPLES
    )[0]
    if E is None or E.shape != (3, 3) or not np.isfinite(E).all():
        return None
    return max(decompose_essential(E), key=lambda each: _two_views(each, views).inliers.sum())


def _by_homography(views: _Views) -> list[F64]:
    a, b = (np.ascontiguousarray(each[:, :2]) for each in (views.a, views.b))
    H: Any = cv2.findHomography(
        a, b, cv2.RANSAC, views.gate, maxIters=_SAMPLES, confidence=_CONFIDENCE
    )[0]
    return decompose_homography(H) if H is not None and np.isfinite(H).all() else []


def _two_views(T_b_a: F64, views: _Views) -> RelativePose:
    depth_a, depth_b = two_view_depths(T_b_a, views.rays_a, views.rays_b)
    a, b, gate = views.a, views.b, views.gate
    E = hat(T_b_a[:3, 3]) @ T_b_a[:3, :3]
    lines_b, lines_a = a @ E.T, b @ E
    slopes = np.hypot(np.hypot(*lines_b.T[:2]), np.hypot(*lines_a.T[:2]))
    errors = np.abs((b * lines_b).sum(axis=1)) / np.maximum(slopes, 1e-12)  # Sampson's distance
    before = (depth_a > 0.0) & (depth_b > 0.0)
    fit = np.where(before, 1.0 / (1.0 + (errors / gate) ** 2), 0.0)
    return RelativePose(
        T_b_a=T_b_a,
        inliers=(errors < gate) & before,
        misfit=1.0 - float(fit.mean()),
        rays_a=views.rays_a,
        rays_b=views.rays_b,
    )


def decompose_homography(H: F64) -> list[F64]:
    """The (4, 4) motions T_b_a, of unit translation, that a plane's homography allows."""
    _, rotations, translations, _ = cv2.decomposeHomographyMat(H, np.eye(3))
    motions: list[F64] = []
    for rotation, translation in zip(rotations, translations, strict=True):
        length = float(np.linalg.norm(translation))
        if length > 1e-9:
            T = np.eye(4)
            T[:3, :3], T[:3, 3] = rotation, translation.ravel() / length
            motions.append(T)
    return motions


def decompose_essential(E: F64) -> list[F64]:
    """The four (4, 4) motions T_b_a, of unit translation, that an essential matrix allows."""
    U, _, Vt = np.linalg.svd(E)
    W = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    motions: list[F64] = []
    for turn in (W, W.T):
        rotation = U @ turn @ Vt
        rotation *= np.sign(np.linalg.det(rotation))
        for sign in (1.0, -1.0):
            T = np.eye(4)
            T[:3, :3], T[:3, 3] = rotation, sign * U[:, 2]
            motions.append(T)
    return motions


def two_view_depths(T_b_a: F64, rays_a: F64, rays_b: F64) -> tuple[F64, F64]:
    """Lengths (N,) along unit rays (N, 3) of a and b of the nearest points of each pair.

    Parallel rays have length 0, which is never before the camera.
    """
    a = rays_a @ T_b_a[:3, :3].T
    t = T_b_a[:3, 3]
    cosine = (a * rays_b).sum(axis=1)
    sine2 = 1.0 - cosine**2
    apart = sine2 > 1e-12
    safe = np.where(apart, sine2, 1.0)
    ta, tb = a @ t, rays_b @ t
    length_a = np.where(apart, (cosine * tb - ta) / safe, 0.0)
    length_b = np.where(apart, (tb - cosine * ta) / safe, 0.0)
    return length_a, length_b


def parallax(T_b_a: F64, rays_a: F64, rays_b: F64) -> F64:
    """(N,) angle, in radians, between the unit rays (N, 3) of each pair."""
    a = rays_a @ T_b_a[:3, :3].T
    cosine = (a * rays_b).sum(axis=1)
    return np.arctan2(np.linalg.norm(np.cross(a, rays_b), axis=1), cosine)

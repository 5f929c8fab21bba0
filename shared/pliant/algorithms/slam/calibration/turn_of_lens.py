"""Whether a rotation explains two views of an uncertain camera.

A wrong focal length or distortion makes parallax of every rotation: the residual flow of a rotation
is evidence of translation only if no likely lens explains it.
"""

import numpy as np

from pliant.algorithms.arrays import F64
from pliant.algorithms.geometry import hat, so3_exp
from pliant.algorithms.slam.estimate.epipolar import rotation_between

_ITERATIONS = 6
_BEGINNINGS = (-1.0, 0.0, 1.0)
"""Log focal lengths to begin with, in standard deviations."""

_WIDEST = 2.0
"""Standard deviations that a log focal length may be off."""

_HELD = 1e-5
"""Standard deviation of a certain parameter."""


def turn_of_lens(
    points_a: F64, points_b: F64, *, scale: float, focal_sigma: float, lens_sigma: float
) -> F64:
    """(..., N) residuals, as of ``rotation_between``, that no rotation explains with any lens.

    Gauss-Newton with Geman-McClure weights over the rotation, the log focal length s and two
    coefficients of distortion, from several s and the turn that explains most with each.  A point u
    of the assumed camera's plane z = 1 is taken to u e^-s (1 + k1 r^2 + k2 r^4), r = |u e^-s|.

    points_a, points_b: (..., N, 2) as of ``rotation_between``.   focal_sigma, lens_sigma: standard
    deviations of s, and of k1 and k2.
    """
    sigmas = np.maximum([focal_sigma, lens_sigma, lens_sigma], _HELD)
    prior = np.diag([0.0, 0.0, 0.0, *sigmas**-2])
    best = np.full(points_a.shape[:-1], np.inf)
    for beginning in _BEGINNINGS:
        lens = np.zeros((*points_a.shape[:-2], 3))
        lens[..., 0] = beginning * sigmas[0]
        rotation, _ = rotation_between(
            _ideal(points_a, lens)[0], _ideal(points_b, lens)[0], scale=scale
        )
        for iteration in range(_ITERATIONS + 1):
            errors, J = _errors(points_a, points_b, rotation, lens)
            residuals = np.linalg.norm(errors, axis=-1)
            spread = np.median(residuals, axis=-1)[..., None]
            best = np.where(spread < np.median(best, axis=-1)[..., None], residuals, best)
            if iteration == _ITERATIONS:
                break
            spread = np.maximum(scale, 1.5 * spread)
            weights = 1.0 / (1.0 + (residuals / spread) ** 2) ** 2 / spread**2
            weighted = (J * weights[..., None, None]).reshape(*J.shape[:-3], -1, 6)
            H = np.swapaxes(weighted, -1, -2) @ J.reshape(weighted.shape) + prior
            known = np.concatenate([np.zeros_like(lens), lens], axis=-1)
            g = (weighted * errors.reshape(*weighted.shape[:-1], 1)).sum(axis=-2) + known @ prior
            step = -np.linalg.solve(H, g[..., None])[..., 0]
            rotation = so3_exp(step[..., :3]) @ rotation
            lens = lens + step[..., 3:]
            lens[..., 0] = np.clip(lens[..., 0], -_WIDEST * sigmas[0], _WIDEST * sigmas[0])
    return best


def _errors(points_a: F64, points_b: F64, R: F64, lens: F64) -> tuple[F64, F64]:
    """(..., N, 2) errors in units of the assumed focal length, and (..., N, 2, 6) derivatives."""
    a, by_a = _ideal(points_a, lens)
    b, by_b = _ideal(points_b, lens)
    turned = a @ np.swapaxes(R[..., :2], -1, -2) + R[..., None, :, 2]
    z = np.maximum(turned[..., 2:], 1e-3)
    there = turned[..., :2] / z
    # The derivative of the projection by the turned ray.
    by_ray = np.zeros((*there.shape, 3))
    by_ray[..., 0, 0] = by_ray[..., 1, 1] = 1.0
    by_ray[..., 2] = -there
    by_ray /= z[..., None]
    by_lens = by_ray @ R[..., None, :, :2] @ by_a - by_b
    errors = there - b
    by_lens[..., 0] += errors
    magnified = np.exp(lens[..., :1])[..., None]
    J = np.concatenate([-by_ray @ hat(turned), by_lens], axis=-1)
    return magnified * errors, magnified[..., None] * J


def _ideal(points: F64, lens: F64) -> tuple[F64, F64]:
    """(..., N, 2) points without the lens, and (..., N, 2, 3) their derivatives by it."""
    shrunk = points * np.exp(-lens[..., :1])[..., None]
    k1, k2 = lens[..., 1:2], lens[..., 2:]
    r2 = (shrunk**2).sum(axis=-1)
    g = 1.0 + (k1 + k2 * r2) * r2
    by_focal = -(g + 2.0 * r2 * (k1 + 2.0 * k2 * r2))
    by = np.stack([by_focal, r2, r2**2], axis=-1)
    return shrunk * g[..., None], shrunk[..., None] * by[..., None, :]

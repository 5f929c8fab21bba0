"""The focal length of one frame beside its pose, points fixed: where zoom or focus change it.

The image of a frame is that of the calibrated camera, magnified by e^d about a centre c:

    p = c + e^d (pi(X') - c),     X' = exp(theta) X + rho,     pi: the pinhole projection.

With (x, y) = X'/Z' on the plane z = 1 and F = e^d diag(fx, fy) the Jacobian by (rho, theta, d) is

    F (1/Z'  0   -x/Z'  -x y       1 + x^2  -y)      d p / d d = p - c.
      (0   1/Z'  -y/Z'  -(1 + y^2)  x y       x)

Gauss-Newton with Geman-McClure weights ``1 / (1 + r^2 / sigma^2)^2``, from a wide kernel to a
narrow one, and a prior d ~ N(0, deviation^2) at residuals of 1 px: without parallax or depth that
differs across the image a magnification looks like a step ahead.
"""

import numpy as np

from pliant.algorithms.arrays import F32, F64
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import inverse, so3_exp

_SIGMAS_PX = (8.0, 8.0, 2.0, 2.0)
_MIN_DEPTH = 1e-6
_MOST = 250
"""Points are taken out evenly down to twice as many at most: they tell it well enough."""

_MEDIAN_OF_TWO = 1.386
"""The median of chi-square with two degrees of freedom."""

UNKNOWNS = 7


def refine_focal(
    T_world_camera: F64,
    points_world: F64,
    points_px: F32,
    camera: PinholeCamera,
    centre: tuple[float, float],
    deviation: float,
) -> tuple[float, float]:
    """The log d of the magnification of a frame, and its standard deviation by the residuals, as if
    all points had been looked at.

    T_world_camera: (4, 4) to start from.  points_world: (N, 3).  points_px: (N, 2).  deviation:
    standard deviation of d.
    """
    every = max(1, len(points_px) // _MOST)
    some = points_world[::every], points_px[::every]
    pose, d = inverse(T_world_camera), 0.0
    normal, residuals = np.eye(UNKNOWNS), np.zeros((1, 2))
    for sigma in _SIGMAS_PX:
        residuals, J = linearise(pose, d, *some, camera, centre)
        weights = 1.0 / (1.0 + (residuals**2).sum(axis=1) / sigma**2) ** 2
        weighted = (weights[:, None, None] * J).reshape(-1, UNKNOWNS)
        normal = weighted.T @ J.reshape(-1, UNKNOWNS)
        g = weighted.T @ residuals.reshape(-1)
        normal[6, 6] += deviation**-2
        g[6] -= d * deviation**-2
        normal[np.diag_indices(6)] *= 1.0 + 1e-9
        normal[np.diag_indices(6)] += 1e-9
        step = np.linalg.solve(normal, g)
        pose, d = moved(pose, step), d + float(step[6])
    variance = np.median((residuals**2).sum(axis=1)) / _MEDIAN_OF_TWO if len(residuals) else np.inf
    return d, float(np.sqrt(variance / every * np.linalg.inv(normal)[6, 6]))


def linearise(
    T: F64, d: float, points_world: F64, points_px: F32, camera: PinholeCamera,
    centre: tuple[float, float],
) -> tuple[F64, F64]:  # fmt: skip
    """Residuals ``points_px - p`` (n, 2) and the Jacobian (n, 2, 7) of p, of points in front.

    T: (4, 4) from the world to the camera.
    """
    in_camera = points_world @ T[:3, :3].T + T[:3, 3]
    front = in_camera[:, 2] > _MIN_DEPTH
    iz = 1.0 / in_camera[front, 2]
    x, y = in_camera[front, 0] * iz, in_camera[front, 1] * iz
    F = np.exp(d) * np.array([camera.fx, camera.fy])
    c, zero = np.asarray(centre), np.zeros_like(x)
    from_centre = F * np.column_stack([x, y]) + np.exp(d) * ([camera.cx, camera.cy] - c)
    rows = np.array([
        [iz, zero, -x * iz, -x * y, 1.0 + x * x, -y],
        [zero, iz, -y * iz, -1.0 - y * y, x * y, x],
    ])  # fmt: skip
    J = np.empty((len(x), 2, UNKNOWNS))
    J[:, :, :6] = F[:, None] * rows.transpose(2, 0, 1)
    J[:, :, 6] = from_centre
    return points_px[front] - (c + from_centre), J


def moved(T: F64, step: F64) -> F64:
    """T (4, 4) after a step whose first six are (rho, theta)."""
    after = np.eye(4)
    after[:3, :3] = so3_exp(step[3:6]) @ T[:3, :3]
    after[:3, 3] = so3_exp(step[3:6]) @ T[:3, 3] + step[:3]
    return after

"""The focal length and pose of one frame with fixed points, if zoom or focus change it.

The image of a frame is that of the calibrated camera, magnified by e^d about a centre c:

    p = c + e^d (pi(X') - c),     X' = exp(theta) X + rho,     pi: the pinhole projection.

With (x, y) = X'/Z' on the plane z = 1 and F = e^d diag(fx, fy) the Jacobian by (rho, theta, d) is

    F (1/Z'  0   -x/Z'  -x y       1 + x^2  -y)      d p / d d = p - c.
      (0   1/Z'  -y/Z'  -(1 + y^2)  x y       x)

Gauss-Newton with Geman-McClure weights ``1 / (1 + r^2 / sigma^2)^2``, from a wide kernel to a
narrow one, and a prior d ~ N(0, deviation^2) at residuals of 1 px: without parallax or depth that
differs across the image a magnification looks like a forward motion.
"""

import numpy as np

from pliant.algorithms.arrays import F32, F64
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import inverse
from pliant.algorithms.slam.estimate.projection import move_camera
from pliant.compiler.kernel import kernel

_SIGMAS_PX = (8.0, 8.0, 2.0, 2.0)
_MIN_DEPTH = 1e-6
_ENOUGH = 250
"""Points to which they are thinned evenly; nearly twice as many stay at most."""

_MEDIAN_OF_TWO = 1.386
"""The median of chi-square with two degrees of freedom."""

UNKNOWNS = 7


def thinning(count: int) -> int:
    """Of how many of a frame's points one is enough."""
    return max(1, count // _ENOUGH)


def refine_focal(
    T_world_camera: F64,
    points_world: F64,
    points_px: F32,
    camera: PinholeCamera,
    centre: tuple[float, float],
    deviation: float,
    every: int = 1,
) -> tuple[float, float]:
    """Return the log magnification d of a frame, and its standard deviation by the residuals,
    scaled to all points.

    T_world_camera: (4, 4) to start from.  points_world: (N, 3).  points_px: (N, 2).  deviation:
    standard deviation of d.   every: of how many points one is given, as of ``thinning``.
    """
    px = points_px.astype(np.float64)
    lens = np.array([*camera.intrinsics, *centre])
    T_camera_world = inverse(T_world_camera)
    motion = np.concatenate([T_camera_world[:3, :3].ravel(), T_camera_world[:3, 3]])
    normal, squared = np.empty((UNKNOWNS, UNKNOWNS)), np.empty(len(px))
    d, count = _adjust(motion, points_world, px, lens, deviation**-2, normal, squared)
    variance = np.median(squared[:count]) / _MEDIAN_OF_TWO if count else np.inf
    # d is the last unknown, so its variance is that of the last pivot of L L^T.
    return d, float(np.sqrt(variance / every) / normal[-1, -1])


@kernel
def _adjust(
    motion: F64,
    points_world: F64,
    points_px: F64,
    lens: F64,
    precision: float,
    normal: F64,
    squared: F64,
) -> tuple[float, int]:
    """Move the camera (12,); returns d and the number n of points in front.

    precision: of the prior.   normal: (7, 7) receives L of the last step.   squared: (N,) receives
    n squared residuals.
    """
    d, count = 0.0, 0
    for sigma in _SIGMAS_PX:
        residuals, J = linearise(motion, d, points_world, points_px, lens)
        count = len(residuals)
        normal[:] = 0.0
        step = np.zeros(UNKNOWNS)
        for n in range(count):
            squared[n] = residuals[n, 0] ** 2 + residuals[n, 1] ** 2
            weight = 1.0 / (1.0 + squared[n] / sigma**2) ** 2
            for k in range(2):
                for a in range(UNKNOWNS):
                    weighted = weight * J[n, k, a]
                    step[a] += weighted * residuals[n, k]
                    for b in range(a + 1):
                        normal[a, b] += weighted * J[n, k, b]
        normal[-1, -1] += precision
        step[-1] -= d * precision
        for a in range(UNKNOWNS - 1):
            normal[a, a] += 1e-9 * (1.0 + normal[a, a])
        _solve(normal, step)
        move_camera(motion, step[:6], motion)
        d += step[-1]
    return d, count


@kernel
def _solve(A: F64, x: F64) -> None:
    """Solve ``A x = b`` in place of b by Cholesky's L, which replaces the lower triangle of A."""
    for a in range(x.size):
        for b in range(a + 1):
            for k in range(b):
                A[a, b] -= A[a, k] * A[b, k]
            if a > b:
                A[a, b] /= A[b, b]
        A[a, a] = np.sqrt(A[a, a])
        for k in range(a):
            x[a] -= A[a, k] * x[k]
        x[a] /= A[a, a]
    for a in range(x.size - 1, -1, -1):
        for k in range(a + 1, x.size):
            x[a] -= A[k, a] * x[k]
        x[a] /= A[a, a]


@kernel
def linearise(
    motion: F64, d: float, points_world: F64, points_px: F64, lens: F64
) -> tuple[F64, F64]:
    """Residuals ``points_px - p`` (n, 2) and the Jacobian (n, 2, 7) of p, of points in front.

    motion: (12,) R_camera_world by rows, then t_camera_world.   lens: fx, fy, cx, cy and c.
    """
    N = len(points_world)
    residuals, J = np.empty((N, 2)), np.zeros((N, 2, UNKNOWNS))
    magnified, n = np.exp(d), 0
    for i in range(N):
        X = np.empty(3)
        for k in range(3):
            X[k] = motion[9 + k]
            for m in range(3):
                X[k] += motion[3 * k + m] * points_world[i, m]
        if X[2] <= _MIN_DEPTH:
            continue
        x, y, iz = X[0] / X[2], X[1] / X[2], 1.0 / X[2]
        f, g = magnified * lens[0], magnified * lens[1]
        J[n, 0, 0], J[n, 0, 2], J[n, 0, 3] = f * iz, -f * x * iz, -f * x * y
        J[n, 0, 4], J[n, 0, 5] = f * (1.0 + x * x), -f * y
        J[n, 1, 1], J[n, 1, 2], J[n, 1, 3] = g * iz, -g * y * iz, -g * (1.0 + y * y)
        J[n, 1, 4], J[n, 1, 5] = g * x * y, g * x
        J[n, 0, 6] = f * x + magnified * (lens[2] - lens[4])
        J[n, 1, 6] = g * y + magnified * (lens[3] - lens[5])
        residuals[n, 0] = points_px[i, 0] - lens[4] - J[n, 0, 6]
        residuals[n, 1] = points_px[i, 1] - lens[5] - J[n, 1, 6]
        n += 1
    return residuals[:n], J[:n]

"""Hill climbing on curvature with a pull to the prediction (VITAMIN-E, section 2.3, Eq. 5)."""

import numpy as np

from pliant.algorithms.arrays import F32
from pliant.algorithms.kernel import fast_kernel, leaf_kernel
from pliant.algorithms.tracking.best_neighbour import STEPS_X, STEPS_Y, best_neighbour
from pliant.algorithms.tracking.curvature import CURVATURE_BORDER

MAX_STEPS = 24
"""Steps after which a climb gives up; it ends by itself, as the value rises at every step."""


@leaf_kernel
def climb(
    kappa: F32,
    width: int,
    height: int,
    u: np.float32,
    v: np.float32,
    sign: np.float32,
    weight: np.float32,
    sigma: np.float32,
) -> int:
    """Climb F = sign * kappa + weight * w(distance to (u, v)), w = 1 - rho of Eq. 3.

    kappa: flat (H * W), DN^3.  weight: lambda of Eq. 5, DN^3.  sigma: scale of w, px.  Returns the
    flat index of the pixel on which it stops, -1 where (u, v) is outside or on the border.
    """
    border = CURVATURE_BORDER
    x, y = int(np.floor(u + np.float32(0.5))), int(np.floor(v + np.float32(0.5)))
    if x < border or y < border or x >= width - border or y >= height - border:
        return -1
    square = sigma * sigma
    pull = weight * square
    du, dv = np.float32(x) - u, np.float32(y) - v
    best = sign * kappa[y * width + x] + pull / (du * du + dv * dv + square)
    for _ in range(MAX_STEPS):
        value, step = best_neighbour(
            kappa,
            np.uint64(y * width + x),
            np.uint64(width),
            np.float32(x) - u,
            np.float32(y) - v,
            sign,
            pull,
            square,
        )
        if value <= best:
            break
        best = value
        x += STEPS_X[step]
        y += STEPS_Y[step]
        if x < border or y < border or x >= width - border or y >= height - border:
            return -1
    return y * width + x


@fast_kernel
def climb_points(kappa: F32, points: F32, predictions: F32, kappas: F32, sigma: np.float32) -> F32:
    """Climb from (N, 2) predictions, lambda being each point's own |kappa|.

    kappa: (H, W).  kappas: (N,) signed.  Returns (M, 4) rows (u, v, u', v') of the points that
    stayed inside: where each was, and the pixel that it climbed to.
    """
    height, width = kappa.shape
    pairs = np.empty((len(points), 4), np.float32)
    count = 0
    for i in range(len(points)):
        sign = np.float32(1.0) if kappas[i] >= np.float32(0.0) else np.float32(-1.0)
        pixel = climb(
            kappa.reshape(-1),
            width,
            height,
            predictions[i, 0],
            predictions[i, 1],
            sign,
            abs(kappas[i]),
            sigma,
        )
        if pixel >= 0:
            pairs[count, 0], pairs[count, 1] = points[i, 0], points[i, 1]
            pairs[count, 2], pairs[count, 3] = pixel % width, pixel // width
            count += 1
    return pairs[:count].copy()

"""Validation of surfels: ZNCC, visibility and uncertainty (DSDT, sections IV and VI-A)."""

import math

import numpy as np

from pliant.algorithms.arrays import F32, F64, U8
from pliant.algorithms.surfels import deformation_models as models
from pliant.algorithms.surfels.patch_sampling import (
    BIAS,
    GAIN,
    MARGIN,
    Level,
    homography,
    sample_patch,
)
from pliant.algorithms.surfels.photometric import correlation, first_inner
from pliant.algorithms.surfels.surfel_alignment import (
    OMEGA_E,
    Matcher,
    add_isometry,
    factorise,
    inverse_diagonal,
)
from pliant.compiler.kernel import fast_kernel

FRONT, INSIDE, VISIBLE, ZNCC, SIGMA, U, V, COLUMNS = 0, 1, 2, 3, 4, 5, 6, 7
"""Columns of a validation: in front of the camera (0 or 1), shares of the texture inside of the
image and seen, ZNCC, standard deviation of the position (metres), pixel of the centre."""

_MIN_NOISE = 0.5  # DN: quantisation alone makes this much of a difference of two images
_MAX_SIGMA = 1e3
_FAR = 1e6


@fast_kernel
def validate_all(poses: F64, active: U8, matcher: Matcher, out: F64) -> None:
    """Fill a row of ``out`` (N, COLUMNS) for every active surfel.

    The pixel is left alone where a surfel is not in front.
    """
    level, templates, limits, work = matcher
    parameters = models.parameter_count(limits.model)
    grid, at = work.grid, first_inner(work.grid)
    for s in range(len(poses)):
        if not active[s]:
            continue
        pose, row = poses[s], out[s]
        row[FRONT] = row[INSIDE] = row[VISIBLE] = row[ZNCC] = 0.0
        if not homography(pose, level, work.h):
            continue
        if not sample_patch(work.h, level, grid, limits.highlight):
            continue
        row[FRONT] = 1.0
        row[U], row[V] = work.h[2] / work.h[8], work.h[5] / work.h[8]
        t, count = templates.images[s, 0], templates.counts[s]
        values = grid.values[at : at + len(t)]
        row[INSIDE] = _inside(t, grid.x[at:], grid.y[at:], level) / count
        seen, squares = _agreeing(
            t, values, templates.means[s], pose[GAIN], pose[BIAS], limits.saturation
        )
        row[VISIBLE] = seen / count
        row[ZNCC], _ = correlation(t, values)
        if seen < parameters:
            continue
        models.mixing(pose, level, limits.model, work.mix)
        # Information shrinks with the visible share of the patch.
        models.hessian(
            templates.matrices[s], row[VISIBLE], work.mix, parameters, work.product, work.H
        )
        noise = max(squares / seen, _MIN_NOISE * _MIN_NOISE)
        # The soft isometry is known in DN^2 of variance OMEGA_E, whatever the noise of the image.
        add_isometry(pose, limits, noise / OMEGA_E, work.H, work.g)
        if factorise(work.H, parameters, parameters, 0.0, work.L, work.inverse):
            trace = inverse_diagonal(work.L, work.inverse, parameters, 3, work.step)
            row[SIGMA] = min(math.sqrt(noise * trace), _MAX_SIGMA)


@fast_kernel
def _inside(t: F32, x: F32, y: F32, level: Level) -> float:
    """How many samples of a texture lie in the image."""
    zero, one, far = np.float32(0.0), np.float32(1.0), np.float32(_FAR)
    right, bottom = np.float32(level.width - 1.0), np.float32(level.height - 1.0)
    count = zero
    for k in range(len(t)):
        good = (x[k] > -MARGIN) & (y[k] > -MARGIN) & (x[k] < right) & (y[k] < bottom)
        count += one if good & (t[k] < far) else zero
    return float(count)


@fast_kernel
def _agreeing(
    t: F32, values: F32, mean: float, gain: float, bias: float, tau: float
) -> tuple[float, float]:
    """How many samples are not saturated, and the sum of their squared residuals."""
    m, g, b, limit = np.float32(mean), np.float32(gain), np.float32(bias), np.float32(tau)
    zero, one = np.float32(0.0), np.float32(1.0)
    seen = squares = zero
    for k in range(len(t)):
        r = g * (values[k] - m) + b - t[k]
        good = abs(r) < limit
        seen += one if good else zero
        squares += r * r if good else zero
    return float(seen), float(squares)


def new_validations(count: int) -> F64:
    """Rows of zeros for ``validate_all``."""
    return np.zeros((count, COLUMNS))

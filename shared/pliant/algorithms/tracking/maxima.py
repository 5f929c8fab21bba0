"""Local maxima of curvature, in scan order, with a sub-pixel fit."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pliant.algorithms.arrays import F32, I32
from pliant.algorithms.kernel import leaf_kernel
from pliant.algorithms.tracking.curvature import (
    CURVATURE_BORDER,
    GaussianTaps,
    clear_border,
    curvature,
    curve_row,
    gaussian_taps,
    row_scratch,
)
from pliant.algorithms.tracking.extremum_bits import (
    RUN,
    count_bits,
    extremum_bits,
    first_bit,
    write_extremum,
)

_LEAST_WIDTH = RUN + 2 * CURVATURE_BORDER
"""Of an image in which a run that begins inside ends inside of the array, if not of its row."""

_AT_ONCE = 4
"""Extrema of a run that are written without looking whether there are as many."""


def curvature_and_maxima(
    image: NDArray[Any],
    sigma_px: float,
    min_curvature: float,
    *,
    both_signs: bool,
    smooth: F32 | None = None,
    kappa: F32 | None = None,
) -> tuple[F32, F32, I32, F32]:
    """``curvature`` and its ``find_maxima`` in one pass, while the rows are still in cache.

    Returns (smooth, kappa, pixels, maxima) as those two do.
    """
    height, width = image.shape
    if width < _LEAST_WIDTH:
        smooth, kappa = curvature(image, sigma_px, smooth, kappa)
        return smooth, kappa, *find_maxima(kappa, min_curvature, both_signs=both_signs)
    smooth = np.empty((height, width), np.float32) if smooth is None else smooth
    kappa = np.empty((height, width), np.float32) if kappa is None else kappa
    scratch = row_scratch(width)
    pixels, maxima = _room_for_all(height, width)
    lowest, highest = _limits(min_curvature, both_signs=both_signs)
    count = _curvature_and_maxima(
        image, gaussian_taps(sigma_px), lowest, highest, scratch, smooth, kappa, pixels, maxima
    )
    return smooth, kappa, pixels[:count].copy(), maxima[:count].copy()


def find_maxima(kappa: F32, min_curvature: float, *, both_signs: bool) -> tuple[I32, F32]:
    """Find the pixels whose curvature exceeds that of all eight neighbours and a threshold.

    kappa: (H, W) from ``curvature``.  min_curvature: DN^3, >= 0.  both_signs: minima below
    -min_curvature count too.  Among equal neighbours the last in scan order wins, so that a
    plateau has at most one.  Returns (M,) flat pixel indices in scan order, and (M, 3) rows
    (u, v, kappa) with the sub-pixel position of a separable parabola, within 0.5 px of the pixel.
    """
    height, width = kappa.shape
    if width < _LEAST_WIDTH:
        kappa = np.pad(kappa, ((0, 0), (0, _LEAST_WIDTH - width)))
    pixels, maxima = _room_for_all(height, width)
    lowest, highest = _limits(min_curvature, both_signs=both_signs)
    count = _find_maxima(kappa, width, lowest, highest, pixels, maxima)
    return pixels[:count].copy(), maxima[:count].copy()


def _room_for_all(height: int, width: int) -> tuple[I32, F32]:
    """Of four pixels in a square one is a maximum at most, and one a minimum."""
    most = height * width // 2 + RUN
    return np.empty(most, np.int32), np.empty((most, 3), np.float32)


def _limits(min_curvature: float, *, both_signs: bool) -> tuple[np.float32, np.float32]:
    """What minima must be less than, and maxima more than."""
    return np.float32(-min_curvature if both_signs else -np.inf), np.float32(min_curvature)


@leaf_kernel
def subpixel_offset(before: np.float32, centre: np.float32, after: np.float32) -> np.float32:
    """Vertex of the parabola through three samples at -1, 0, 1, clamped to +-0.5 px."""
    curve = before - np.float32(2.0) * centre + after
    # Branch-free, so that it vectorises: a straight line has its vertex nowhere, and stays.
    rise = np.float32(0.5) * (before - after) if curve != np.float32(0.0) else np.float32(0.0)
    offset = rise / (curve if curve != np.float32(0.0) else np.float32(1.0))
    return min(max(offset, np.float32(-0.5)), np.float32(0.5))


@leaf_kernel
def _curvature_and_maxima(
    image: NDArray[Any],
    taps: GaussianTaps,
    lowest: np.float32,
    highest: np.float32,
    scratch: F32,
    smooth: F32,
    kappa: F32,
    pixels: I32,
    maxima: F32,
) -> int:
    """Write the extrema.  Returns their number."""
    height, width = image.shape
    clear_border(kappa)
    flat = kappa.reshape(-1)
    count = 0
    for y in range(height):
        curve_row(image, y, taps, scratch, smooth, kappa)
        # The curvature has come to row y - 1, and the row above that has both its neighbours.
        if CURVATURE_BORDER <= y - 2 < height - CURVATURE_BORDER:
            count = _extrema_of_row(
                flat, width, width, y - 2, lowest, highest, pixels, maxima, count
            )
    return count


@leaf_kernel
def _find_maxima(
    kappa: F32, width: int, lowest: np.float32, highest: np.float32, pixels: I32, maxima: F32
) -> int:
    """Write the extrema in the first ``width`` columns.  Returns their number."""
    height, stride = kappa.shape
    flat = kappa.reshape(-1)
    count = 0
    for y in range(CURVATURE_BORDER, height - CURVATURE_BORDER):
        count = _extrema_of_row(flat, width, stride, y, lowest, highest, pixels, maxima, count)
    return count


@leaf_kernel
def _extrema_of_row(
    kappa: F32,
    width: int,
    stride: int,
    y: int,
    lowest: np.float32,
    highest: np.float32,
    pixels: I32,
    maxima: F32,
    count: int,
) -> int:
    """Write the extrema of a row of the flat kappa after ``count`` others; returns their number."""
    border = CURVATURE_BORDER
    one, step = np.uint64(1), np.uint64(stride)
    n = np.uint64(count)
    for x in range(border, width - border, RUN):
        bits = extremum_bits(kappa, np.uint64(y * stride + x), step, highest, lowest)
        inside = width - border - x
        if inside < RUN:
            bits &= (one << np.uint64(inside)) - one
        first = np.int32(y * width + x)
        end = n + count_bits(bits)
        # A few at a time, wanted or not: a branch for each would be foretold wrongly.
        while True:
            for k in range(_AT_ONCE):
                pixels[n + np.uint64(k)] = first + np.int32(first_bit(bits))
                bits &= bits - one
            n += np.uint64(_AT_ONCE)
            if n >= end:
                break
        n = end
    for i in range(np.uint64(count), n):
        column = pixels[i] - np.int32(y * width)
        at = np.uint64(y * stride) + np.uint64(column)
        write_extremum(kappa, at, step, np.float32(column), np.float32(y), maxima, i)
    # A signed count, as the callers have it.
    return int(np.int64(n))

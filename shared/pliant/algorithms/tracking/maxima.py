"""Local maxima of curvature, in scan order, with a sub-pixel fit."""

from typing import Any, cast

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from pliant.algorithms.arrays import F32, I32, U8
from pliant.algorithms.image.masks import EDGE_PX
from pliant.algorithms.image.patch_sums import PATCH_SIZE
from pliant.algorithms.image.vector_code import count_bits, first_bit, load, splat, vector_type
from pliant.algorithms.tracking.curvature import (
    CURVATURE_BORDER,
    GaussianTaps,
    clear_border,
    curvature,
    curve_row,
    gaussian_taps,
    row_scratch,
)
from pliant.algorithms.tracking.parameters import TrackingParameters
from pliant.compiler.kernel import fast_kernel

REACH_PX = PATCH_SIZE // 2 + EDGE_PX
"""Distance to a masked area within which a full-size patch overlaps it."""

RUN = 32
"""Pixels per word of bits."""

_LANES = 8
"""Pixels at a time: with more the eight neighbours do not fit into registers."""

_FLAGS = ("reassoc", "contract", "nsz", "arcp")
_I64 = ir.IntType(64)


_LEAST_WIDTH = RUN + 2 * CURVATURE_BORDER
"""Of an image in which a run that begins inside ends inside of the array, if not of its row."""

_AT_ONCE = 4
"""Extrema of a run that are written without a test of their number."""


def curvature_and_maxima(
    image: NDArray[Any],
    sigma_px: float,
    min_curvature: float,
    *,
    smooth: F32 | None = None,
    kappa: F32 | None = None,
) -> tuple[F32, F32, I32, F32]:
    """``curvature`` and its ``find_maxima`` in one pass, while the rows are still in cache.

    Returns (smooth, kappa, pixels, maxima) as those two do.
    """
    height, width = image.shape
    if width < _LEAST_WIDTH:
        smooth, kappa = curvature(image, sigma_px, smooth, kappa)
        return smooth, kappa, *find_maxima(kappa, min_curvature)
    smooth = np.empty((height, width), np.float32) if smooth is None else smooth
    kappa = np.empty((height, width), np.float32) if kappa is None else kappa
    scratch = row_scratch(width)
    pixels, maxima = _room_for_all(height, width)
    limit = np.float32(min_curvature)
    count = _curvature_and_maxima(
        image, gaussian_taps(sigma_px), -limit, limit, scratch, smooth, kappa, pixels, maxima
    )
    return smooth, kappa, pixels[:count].copy(), maxima[:count].copy()


def maxima_of(image: U8, parameters: TrackingParameters, clearance: F32 | None = None) -> F32:
    """The maxima (M, 3) of an image, as the tracker finds them.

    image: (H, W), filled where its mask covers it.    clearance: (H, W) of the mask, see
    ``image.masks``; None: without one.
    """
    _, _, pixels, maxima = curvature_and_maxima(
        image, parameters.blur_sigma_px, parameters.min_curvature
    )
    return uncovered(pixels, maxima, clearance)[1]


def uncovered(pixels: I32, maxima: F32, clearance: F32 | None) -> tuple[I32, F32]:
    """Return the maxima of a frame, as of ``find_maxima``, whose patches do not overlap its
    mask.
    """
    if clearance is None:
        return pixels, maxima
    kept = np.flatnonzero(clearance.reshape(-1)[pixels] > REACH_PX)
    return pixels[kept], maxima[kept]


def find_maxima(kappa: F32, min_curvature: float) -> tuple[I32, F32]:
    """Find the pixels whose curvature exceeds that of all eight neighbours and a threshold, or is
    below all and minus the threshold: dark features and bright ones.

    kappa: (H, W) from ``curvature``.  min_curvature: DN^3, >= 0.  Among equal neighbours the last
    in scan order wins, so that a plateau has at most one.  Returns (M,) flat pixel indices in scan
    order, and (M, 3) rows (u, v, kappa) with the sub-pixel position of a separable parabola, within
    0.5 px of the pixel.
    """
    height, width = kappa.shape
    if width < _LEAST_WIDTH:
        kappa = np.pad(kappa, ((0, 0), (0, _LEAST_WIDTH - width)))
    pixels, maxima = _room_for_all(height, width)
    limit = np.float32(min_curvature)
    count = _find_maxima(kappa, width, -limit, limit, pixels, maxima)
    return pixels[:count].copy(), maxima[:count].copy()


def _room_for_all(height: int, width: int) -> tuple[I32, F32]:
    """Of four pixels in a square one is a maximum at most, and one a minimum."""
    most = height * width // 2 + RUN
    return np.empty(most, np.int32), np.empty((most, 3), np.float32)


@fast_kernel
def subpixel_offset(before: np.float32, centre: np.float32, after: np.float32) -> np.float32:
    """Vertex of the parabola through three samples at -1, 0, 1, clamped to +-0.5 px."""
    curve = before - np.float32(2.0) * centre + after
    # Branch-free, so that it vectorises: a straight line has no vertex, and is unchanged.
    rise = np.float32(0.5) * (before - after) if curve != np.float32(0.0) else np.float32(0.0)
    offset = rise / (curve if curve != np.float32(0.0) else np.float32(1.0))
    return min(max(offset, np.float32(-0.5)), np.float32(0.5))


@fast_kernel
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


@fast_kernel
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


@fast_kernel
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
        # A few at a time, needed or not: a branch for each would be mispredicted.
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


@cast(Any, intrinsic)
def extremum_bits(
    typing_context: Any, kappa: Any, base: Any, stride: Any, highest: Any, lowest: Any
) -> Any:
    """Bits of the RUN pixels from ``base`` on that are extrema among their eight neighbours.

    kappa: flat float32 with rows of ``stride`` (uint64).  base: uint64; one more row above and
    below, and one more pixel on either side, are read too, and nothing is checked.  highest,
    lowest: float32: a maximum must be more than the one, a minimum less than the other.  Among
    equal neighbours the last in scan order counts.  Bit 0 is the first pixel.
    """
    signature = types.uint64(kappa, types.uint64, types.uint64, types.float32, types.float32)

    def codegen(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        kappa, base, stride, highest, lowest = arguments
        data = context.make_array(sig.args[0])(context, builder, kappa).data
        above, below = builder.sub(base, stride), builder.add(base, stride)

        highest, lowest = splat(builder, highest, _LANES), splat(builder, lowest, _LANES)

        def extreme(values: list[Any], order: str) -> Any:
            first, *others = values
            for other in others:
                first = builder.select(builder.fcmp_ordered(order, first, other), first, other)
            return first

        def bits_from(shift: int) -> Any:
            def beside(row: Any, column: int) -> Any:
                index = builder.add(row, ir.Constant(_I64, shift + column))
                return load(builder, data, index, _LANES)

            centre = beside(base, 0)
            before = [beside(above, -1), beside(above, 0), beside(above, 1), beside(base, -1)]
            after = [beside(base, 1), beside(below, -1), beside(below, 0), beside(below, 1)]

            def is_extremum(more: str, limit: Any) -> Any:
                last = builder.fcmp_ordered(more + "=", centre, extreme(before, more))
                only = builder.fcmp_ordered(more, centre, extreme(after, more))
                enough = builder.fcmp_ordered(more, centre, limit)
                return builder.and_(builder.and_(last, only), enough)

            found = builder.or_(is_extremum(">", highest), is_extremum("<", lowest))
            word = builder.zext(builder.bitcast(found, ir.IntType(_LANES)), _I64)
            return builder.shl(word, ir.Constant(_I64, shift))

        word = bits_from(0)
        for shift in range(_LANES, RUN, _LANES):
            word = builder.or_(word, bits_from(shift))
        return word

    return signature, codegen


@cast(Any, intrinsic)
def write_extremum(
    typing_context: Any, kappa: Any, at: Any, stride: Any, u: Any, v: Any, maxima: Any, row: Any
) -> Any:
    """Write (u, v, kappa) of an extremum, placed by ``subpixel_offset`` along both axes.

    kappa, stride: as in ``extremum_bits``.  at: uint64 index of the extremum, whose pixel is
    (u, v), float32.  maxima: (N, 3) float32; ``row`` (uint64) of it is written, and the first
    number of the next row spoilt, which must exist.
    """
    signature = types.void(
        kappa, types.uint64, types.uint64, types.float32, types.float32, maxima, types.uint64
    )

    def codegen(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        kappa, at, stride, u, v, maxima, row = arguments
        data = context.make_array(sig.args[0])(context, builder, kappa).data
        out = context.make_array(sig.args[5])(context, builder, maxima).data

        def quad(*numbers: Any) -> Any:
            lanes = ir.Constant(vector_type(4), [0.0] * 4)
            for lane, number in enumerate(numbers):
                lanes = builder.insert_element(lanes, number, ir.Constant(ir.IntType(32), lane))
            return lanes

        def constant(number: float) -> Any:
            return ir.Constant(vector_type(4), [number] * 4)

        def sample(index: Any) -> Any:
            return builder.load(builder.gep(data, [index]))

        one = ir.Constant(_I64, 1)
        centre = sample(at)
        before = quad(sample(builder.sub(at, one)), sample(builder.sub(at, stride)))
        after = quad(sample(builder.add(at, one)), sample(builder.add(at, stride)))
        twice = builder.fmul(constant(-2.0), splat(builder, centre, 4), flags=_FLAGS)
        curve = builder.fadd(twice, builder.fadd(before, after, flags=_FLAGS), flags=_FLAGS)
        rise = builder.fmul(constant(0.5), builder.fsub(before, after, flags=_FLAGS), flags=_FLAGS)
        # A straight line has no vertex, and is unchanged.
        straight = builder.fcmp_ordered("==", curve, constant(0.0))
        curve = builder.select(straight, constant(1.0), curve)
        offset = builder.fdiv(builder.select(straight, constant(0.0), rise), curve)
        for limit, order in ((-0.5, ">"), (0.5, "<")):
            kept = builder.fcmp_ordered(order, offset, constant(limit))
            offset = builder.select(kept, offset, constant(limit))
        placed = builder.fadd(offset, quad(u, v))
        placed = builder.insert_element(placed, centre, ir.Constant(ir.IntType(32), 2))
        start = builder.gep(out, [builder.mul(row, ir.Constant(_I64, 3))])
        builder.store(placed, builder.bitcast(start, ir.PointerType(vector_type(4))), align=4)
        return context.get_dummy_value()

    return signature, codegen

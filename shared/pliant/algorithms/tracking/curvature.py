"""Image curvature (VITAMIN-E, section 2.1, Eq. 1), and climbing its hills (section 2.3, Eq. 5).

Curvature is computed on a float Gaussian, in one pass over the image.  An 8-bit Gaussian makes four
times as many maxima, most of them by rounding; hence floats throughout.  A climb goes to a nearby
extremum, with a pull towards the prediction of the track.
"""

import math
from typing import Any, TypeAlias, cast

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from pliant.algorithms.arrays import F32
from pliant.algorithms.image.pixels import Pixels
from pliant.algorithms.image.vector_code import call_llvm, load, splat, vector_type
from pliant.compiler.kernel import fast_kernel

BLUR_RADIUS = 3
"""Half-width of the Gaussian in pixels: enough for a sigma up to about 1.3 px."""
CURVATURE_BORDER = 4
"""Pixels at the edge without a curvature: the blur and the derivatives reach outside there."""

GaussianTaps: TypeAlias = tuple[np.float32, np.float32, np.float32, np.float32]

NEIGHBOURS = 8
STEPS_X = (-1, 0, 1, -1, 1, -1, 0, 1)
STEPS_Y = (-1, -1, -1, 0, 0, 1, 1, 1)
"""Of the neighbours, in scan order."""

_I32 = ir.IntType(32)
_I64 = ir.IntType(64)
_FLAGS = ("nnan", "reassoc", "contract", "nsz", "arcp")

MAX_STEPS = 24
"""Maximum steps of a climb; it ends by itself, because the value rises at every step."""


def gaussian_taps(sigma_px: float) -> GaussianTaps:
    """Weights of a 7-tap Gaussian, centre first, with sum w0 + 2 (w1 + w2 + w3) = 1."""
    weights = [math.exp(-0.5 * (i / sigma_px) ** 2) for i in range(BLUR_RADIUS + 1)]
    total = weights[0] + 2.0 * sum(weights[1:])
    w0, w1, w2, w3 = (np.float32(w / total) for w in weights)
    return w0, w1, w2, w3


def curvature(
    image: NDArray[Any], sigma_px: float, smooth: F32 | None = None, kappa: F32 | None = None
) -> tuple[F32, F32]:
    """Smooth an image and take the curvature of its level lines, kappa of Eq. 1.

    image: (H, W) uint8 or float32 grey levels.  sigma_px: of the Gaussian.  smooth, kappa: buffers
    of (H, W) float32 to write into.  Returns (smooth, kappa): grey levels, and DN^3 under
    normalised Sobel stencils; kappa is 0 on the border of CURVATURE_BORDER pixels.
    """
    if smooth is None:
        smooth = np.empty(image.shape, np.float32)
    if kappa is None:
        kappa = np.empty(image.shape, np.float32)
    _curvature(image, gaussian_taps(sigma_px), row_scratch(image.shape[1]), smooth, kappa)
    return smooth, kappa


def row_scratch(width: int) -> F32:
    """Return the memory in which ``curve_row`` stores a row."""
    return np.empty((4, width + 2 * BLUR_RADIUS), np.float32)


@fast_kernel
def _curvature(
    image: NDArray[Any],
    taps: GaussianTaps,
    scratch: F32,
    smooth: F32,
    kappa: F32,
) -> None:
    clear_border(kappa)
    for y in range(image.shape[0]):
        curve_row(image, y, taps, scratch, smooth, kappa)


@fast_kernel
def clear_border(kappa: F32) -> None:
    """Set the first and the last rows to 0."""
    height = kappa.shape[0]
    kappa[: min(CURVATURE_BORDER, height)] = 0.0
    kappa[max(height - CURVATURE_BORDER, 0) :] = 0.0


@fast_kernel
def curve_row(
    image: NDArray[Any], y: int, taps: GaussianTaps, scratch: F32, smooth: F32, kappa: F32
) -> None:
    """Smooth row y, and take the curvature of the row before, which has its neighbours then.

    Rows come in order, so that what a row needs of others is still in cache.  scratch: from
    ``row_scratch``.
    """
    height, width = image.shape
    last = height - 1
    border = CURVATURE_BORDER
    # One vertically blurred row, its ends replicated on each side.
    padded = scratch[0]
    middle = padded[BLUR_RADIUS : BLUR_RADIUS + width]
    _blur_column(
        image[y],
        image[max(y - 1, 0)],
        image[min(y + 1, last)],
        image[max(y - 2, 0)],
        image[min(y + 2, last)],
        image[max(y - 3, 0)],
        image[min(y + 3, last)],
        taps,
        middle,
    )
    for x in range(BLUR_RADIUS):
        padded[x] = middle[0]
        padded[BLUR_RADIUS + width + x] = middle[width - 1]
    _blur_row(padded, taps, smooth[y])
    if border <= y - 1 < height - border:
        k = kappa[y - 1]
        k[: min(border, width)] = 0.0
        k[max(width - border, 0) :] = 0.0
        if width > 2 * border:
            first, end = border - 1, width - border + 1
            _curvature_row(
                smooth[y - 2, first:end],
                smooth[y - 1, first:end],
                smooth[y, first:end],
                scratch[1:],
                k[border : width - border],
            )


@fast_kernel
def _blur_column(
    r0: NDArray[Any],
    a1: NDArray[Any],
    b1: NDArray[Any],
    a2: NDArray[Any],
    b2: NDArray[Any],
    a3: NDArray[Any],
    b3: NDArray[Any],
    taps: GaussianTaps,
    out: F32,
) -> None:
    """Blur seven rows into one."""
    w0, w1, w2, w3 = taps
    for x in range(len(out)):
        out[x] = (
            w0 * np.float32(r0[x])
            + w1 * (np.float32(a1[x]) + np.float32(b1[x]))
            + w2 * (np.float32(a2[x]) + np.float32(b2[x]))
            + w3 * (np.float32(a3[x]) + np.float32(b3[x]))
        )


@fast_kernel
def _blur_row(padded: F32, taps: GaussianTaps, out: F32) -> None:
    """Blur along a row that is padded by BLUR_RADIUS on both sides."""
    w0, w1, w2, w3 = taps
    for x in range(len(out)):
        out[x] = (
            w0 * padded[x + 3]
            + w1 * (padded[x + 2] + padded[x + 4])
            + w2 * (padded[x + 1] + padded[x + 5])
            + w3 * (padded[x] + padded[x + 6])
        )


@fast_kernel
def _curvature_row(above: F32, centre: F32, below: F32, columns: F32, out: F32) -> None:
    """Eq. 1 for a row.  The inputs begin one pixel before the output, and end one after it.

    columns: (3, W) scratch.  The stencils are separable: first down each column, then across.
    """
    n = len(out) + 2
    blurred, sloped, bent = columns[0, :n], columns[1, :n], columns[2, :n]
    two = np.float32(2.0)
    for x in range(n):
        outer, twice = above[x] + below[x], two * centre[x]
        blurred[x] = outer + twice
        sloped[x] = below[x] - above[x]
        bent[x] = outer - twice
    # Each of the two slopes still wants a factor of 1/8, and what it meets of 1/4.
    scale = np.float32(1.0 / 256.0)
    for x in range(len(out)):
        fx = blurred[x + 2] - blurred[x]
        fy = sloped[x] + two * sloped[x + 1] + sloped[x + 2]
        fxx = blurred[x] - two * blurred[x + 1] + blurred[x + 2]
        fyy = bent[x] + two * bent[x + 1] + bent[x + 2]
        fxy = sloped[x + 2] - sloped[x]
        out[x] = scale * (fy * fy * fxx - two * fx * fy * fxy + fx * fx * fyy)


def _lanes(*indices: int) -> Any:
    return ir.Constant(ir.VectorType(_I32, len(indices)), list(indices))


@cast(Any, intrinsic)
def best_neighbour(
    typing_context: Any,
    kappa: Any,
    base: Any,
    width: Any,
    off_u: Any,
    off_v: Any,
    sign: Any,
    pull: Any,
    square: Any,
) -> Any:
    """The highest of F = sign * kappa + pull / (distance^2 + square) over eight neighbours.

    kappa: flat float32 with rows of ``width`` (uint64).  base: uint64, the pixel; two pixels beside
    it and the rows above and below are read, and nothing is checked.  (off_u, off_v): float32, the
    pixel relative to the prediction.  sign, pull, square: float32.  Returns F and the index of
    the neighbour, the first in scan order among equals.
    """
    scalar = types.float32
    signature = types.Tuple((types.float32, types.uint64))(
        kappa, types.uint64, types.uint64, scalar, scalar, scalar, scalar, scalar
    )

    def codegen(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        kappa, base, width, off_u, off_v, sign, pull, square = arguments
        data = context.make_array(sig.args[0])(context, builder, kappa).data

        def row(start: Any) -> Any:
            return load(builder, data, builder.sub(start, ir.Constant(_I64, 1)), 4)

        above, below = row(builder.sub(base, width)), row(builder.add(base, width))
        upper = builder.shuffle_vector(above, row(base), _lanes(0, 1, 2, 4))
        lower = builder.shuffle_vector(row(base), below, _lanes(2, 4, 5, 6))
        heights = builder.shuffle_vector(upper, lower, _lanes(*range(NEIGHBOURS)))

        def squared_distance(offset: Any, steps: tuple[int, ...]) -> Any:
            constant = ir.Constant(vector_type(NEIGHBOURS), [float(step) for step in steps])
            moved = builder.fadd(splat(builder, offset, NEIGHBOURS), constant, flags=_FLAGS)
            return builder.fmul(moved, moved, flags=_FLAGS)

        distances = builder.fadd(
            builder.fadd(
                squared_distance(off_u, STEPS_X), squared_distance(off_v, STEPS_Y), flags=_FLAGS
            ),
            splat(builder, square, NEIGHBOURS),
            flags=_FLAGS,
        )
        pulls = builder.fdiv(splat(builder, pull, NEIGHBOURS), distances, flags=("nnan", "nsz"))
        signed = builder.fmul(heights, splat(builder, sign, NEIGHBOURS), flags=_FLAGS)
        values = builder.fadd(signed, pulls, flags=_FLAGS)
        best = call_llvm(
            builder, "llvm.vector.reduce.fmax.v8f32", ir.FloatType(), [values], fastmath=_FLAGS
        )
        equal = builder.fcmp_ordered("==", values, splat(builder, best, NEIGHBOURS))
        bits = builder.zext(builder.bitcast(equal, ir.IntType(NEIGHBOURS)), _I64)
        first = builder.cttz(bits, ir.Constant(ir.IntType(1), 1))
        return context.make_tuple(builder, sig.return_type, [best, first])

    return signature, codegen


@fast_kernel
def climb(
    kappa: Pixels, u: np.float32, v: np.float32, sign: np.float32, weight: np.float32,
    sigma: np.float32,
) -> int:  # fmt: skip
    """Climb F = sign * kappa + weight * w(distance to (u, v)), w = 1 - rho of Eq. 3.

    kappa: DN^3.  weight: lambda of Eq. 5, DN^3.  sigma: scale of w, px.  Returns the flat index of
    the pixel on which it stops, -1 where (u, v) is outside or on the border.
    """
    border, width, height = CURVATURE_BORDER, kappa.width, kappa.height
    x, y = int(np.floor(u + np.float32(0.5))), int(np.floor(v + np.float32(0.5)))
    if x < border or y < border or x >= width - border or y >= height - border:
        return -1
    square = sigma * sigma
    pull = weight * square
    du, dv = np.float32(x) - u, np.float32(y) - v
    best = sign * kappa.values[y * width + x] + pull / (du * du + dv * dv + square)
    for _ in range(MAX_STEPS):
        value, step = best_neighbour(
            kappa.values,
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

"""The inner loop of patch alignment, written as vector instructions.

LLVM's own vectoriser makes 90 to 300 ns of this loop, whichever way it is written; the explicit
8-wide form takes 40 ns, and refinement and its checks run it tens of thousands of times a frame.
"""

from typing import Any, cast

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from pliant.algorithms.arrays import F32
from pliant.algorithms.image.vector_code import (
    CACHE_LINE_FLOATS,
    call_llvm,
    load,
    prefetch,
    splat,
    vector_type,
)
from pliant.compiler.kernel import fast_kernel

PATCH_SIZE = 8
"""Side of a patch in pixels: one row is one vector."""
PATCH_PIXELS = PATCH_SIZE * PATCH_SIZE
TEMPLATE_FLOATS = 3 * PATCH_PIXELS
"""Floats of one template: grey levels and two steepest-descent images."""

BIRTH_MARGIN = 6
"""Pixels around a patch that are kept from the frame of birth, to be sampled when it turns."""
BIRTH_SIZE = PATCH_SIZE + 2 * BIRTH_MARGIN
BIRTH_FLOATS = BIRTH_SIZE * BIRTH_SIZE

WINDOW_SIGMA_PX = 2.0
"""Of the Gaussian weights: a contour at the edge of a patch must not drag its centre along."""


def _gaussian() -> F32:
    offsets = np.arange(PATCH_SIZE) - 0.5 * (PATCH_SIZE - 1)
    profile = np.exp(-0.5 * (offsets / WINDOW_SIGMA_PX) ** 2)
    weights = np.outer(profile, profile)
    weights *= PATCH_PIXELS / weights.sum()
    return weights.ravel().astype(np.float32)


GAUSSIAN: F32 = _gaussian()
"""Weights of a patch's pixels, row by row; their sum is PATCH_PIXELS."""
UNIFORM: F32 = np.ones(PATCH_PIXELS, np.float32)
"""All pixels count alike: for a single step from near, where noise matters most."""

_FLAGS = ("reassoc", "contract", "nsz", "arcp")
_ROW = vector_type(PATCH_SIZE)
_I64 = ir.IntType(64)


def _multiply_add(builder: Any, a: Any, b: Any, c: Any) -> Any:
    return builder.fadd(builder.fmul(a, b, flags=_FLAGS), c, flags=_FLAGS)


def _window_row(builder: Any, window: Any, row: int) -> Any:
    return load(builder, window, ir.Constant(_I64, row * PATCH_SIZE), PATCH_SIZE)


def _sum_lanes(builder: Any, vector: Any) -> Any:
    name = f"llvm.vector.reduce.fadd.v{PATCH_SIZE}f32"
    zero = ir.Constant(ir.FloatType(), 0.0)
    return call_llvm(builder, name, ir.FloatType(), [zero, vector], fastmath=_FLAGS)


@cast(Any, intrinsic)
def patch_sums(
    typing_context: Any,
    image: Any,
    base: Any,
    width: Any,
    du: Any,
    dv: Any,
    templates: Any,
    offset: Any,
    window: Any,
) -> Any:
    """Sums over a bilinearly interpolated patch v of an image, against a template.

    image: flat float32 with rows of ``width`` (uint64).  base: uint64 index of the pixel above
    and left of the patch's first sample; (du, dv) float32 in [0, 1): where between.  templates:
    flat float32, three images of PATCH_PIXELS from ``offset`` (uint64) on.  window: weights of the
    pixels.  Nothing is checked:
    the patch and one more row and column must lie inside of the image.

    Returns (sum w v, sum w v^2, sum t0 v, sum t1 v, sum t2 v), w being the window.
    """
    signature = types.UniTuple(types.float32, 5)(
        image, types.uint64, types.uint64, types.float32, types.float32, templates, types.uint64,
        window,
    )  # fmt: skip

    def codegen(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        image, base, width, du, dv, templates, offset, window = arguments
        pixels = context.make_array(sig.args[0])(context, builder, image).data
        weights = context.make_array(sig.args[5])(context, builder, templates).data
        window_data = context.make_array(sig.args[7])(context, builder, window).data
        across, down = splat(builder, du, PATCH_SIZE), splat(builder, dv, PATCH_SIZE)

        def blended_row(row: int) -> Any:
            left_index = builder.add(base, builder.mul(width, ir.Constant(_I64, row)))
            left = load(builder, pixels, left_index, PATCH_SIZE)
            right_index = builder.add(left_index, ir.Constant(_I64, 1))
            right = load(builder, pixels, right_index, PATCH_SIZE)
            step = builder.fsub(right, left, flags=_FLAGS)
            return _multiply_add(builder, across, step, left)

        zero = ir.Constant(_ROW, [0.0] * PATCH_SIZE)
        sums = [zero] * 5
        above = blended_row(0)
        for row in range(PATCH_SIZE):
            below = blended_row(row + 1)
            step = builder.fsub(below, above, flags=_FLAGS)
            v = _multiply_add(builder, down, step, above)
            above = below
            weighted = builder.fmul(_window_row(builder, window_data, row), v, flags=_FLAGS)
            sums[0] = builder.fadd(sums[0], weighted, flags=_FLAGS)
            sums[1] = _multiply_add(builder, weighted, v, sums[1])
            for image_index in range(3):
                shift = ir.Constant(_I64, image_index * PATCH_PIXELS + row * PATCH_SIZE)
                t = load(builder, weights, builder.add(offset, shift), PATCH_SIZE)
                sums[2 + image_index] = _multiply_add(builder, v, t, sums[2 + image_index])
        return context.make_tuple(
            builder, sig.return_type, [_sum_lanes(builder, total) for total in sums]
        )

    return signature, codegen


@cast(Any, intrinsic)
def tensor_sums(
    typing_context: Any, image: Any, base: Any, width: Any, level: Any, window: Any
) -> Any:
    """Weighted sums over a patch and its central differences, for its structure tensor.

    image: flat float32 with rows of ``width`` (uint64).  base: uint64 index of the first pixel of
    the patch, which must lie one pixel or more inside.  level: float32 grey level that is taken
    off, near the patch's own, against rounding.

    Returns sums of the window times (t, x, y, t t, t x, t y, x x, x y, y y) with t the grey level
    and (x, y) the gradient, DN per pixel.
    """
    signature = types.UniTuple(types.float32, 9)(
        image, types.uint64, types.uint64, types.float32, window
    )

    def codegen(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        image, base, width, level, window = arguments
        pixels = context.make_array(sig.args[0])(context, builder, image).data
        window_data = context.make_array(sig.args[4])(context, builder, window).data
        rows = _PatchRows(builder, pixels, base, width)
        offset = splat(builder, level, PATCH_SIZE)
        sums = [ir.Constant(_ROW, [0.0] * PATCH_SIZE)] * 9
        for row in range(PATCH_SIZE):
            value, x, y = rows.value_and_gradient(row)
            t = builder.fsub(value, offset, flags=_FLAGS)
            weight = _window_row(builder, window_data, row)
            wt, wx, wy = (builder.fmul(weight, v, flags=_FLAGS) for v in (t, x, y))
            for i, weighted in enumerate((wt, wx, wy)):
                sums[i] = builder.fadd(sums[i], weighted, flags=_FLAGS)
            for i, (a, b) in enumerate(((wt, t), (wt, x), (wt, y), (wx, x), (wx, y), (wy, y))):
                sums[3 + i] = _multiply_add(builder, a, b, sums[3 + i])
        return context.make_tuple(
            builder, sig.return_type, [_sum_lanes(builder, total) for total in sums]
        )

    return signature, codegen


@cast(Any, intrinsic)
def write_template(
    typing_context: Any,
    image: Any,
    base: Any,
    width: Any,
    weights: Any,
    templates: Any,
    offset: Any,
    window: Any,
) -> Any:
    """Write the three images of a template as combinations of a patch and its gradients.

    image, base, width: as in ``tensor_sums``.  weights: 12 float32 numbers, four to each image:
    its pixels are the window times (constant + a grey level + b x + c y).
    """
    if not isinstance(weights, types.UniTuple):
        return None
    signature = types.void(
        image, types.uint64, types.uint64, weights, templates, types.int64, window
    )

    def codegen(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        image, base, width, weights, templates, offset, window = arguments
        pixels = context.make_array(sig.args[0])(context, builder, image).data
        out = context.make_array(sig.args[4])(context, builder, templates).data
        window_data = context.make_array(sig.args[6])(context, builder, window).data
        rows = _PatchRows(builder, pixels, base, width)
        factors = [splat(builder, builder.extract_value(weights, i), PATCH_SIZE) for i in range(12)]
        for row in range(PATCH_SIZE):
            terms = rows.value_and_gradient(row)
            weight = _window_row(builder, window_data, row)
            for image_index in range(3):
                total = factors[4 * image_index]
                for i, term in enumerate(terms):
                    total = _multiply_add(builder, factors[4 * image_index + 1 + i], term, total)
                shift = ir.Constant(_I64, image_index * PATCH_PIXELS + row * PATCH_SIZE)
                pointer = builder.gep(out, [builder.add(offset, shift)])
                pointer = builder.bitcast(pointer, ir.PointerType(_ROW))
                builder.store(builder.fmul(weight, total, flags=_FLAGS), pointer, align=4)
        return context.get_dummy_value()

    return signature, codegen


class _PatchRows:
    """Emits the loads of a patch's rows, shifted ones among them."""

    def __init__(self, builder: Any, pixels: Any, base: Any, width: Any) -> None:
        self._builder, self._pixels, self._base, self._width = builder, pixels, base, width

    def _load(self, row: int, column: int) -> Any:
        builder = self._builder
        start = builder.add(self._base, builder.mul(self._width, ir.Constant(_I64, row)))
        index = builder.add(start, ir.Constant(_I64, column))
        return load(builder, self._pixels, index, PATCH_SIZE)

    def value_and_gradient(self, row: int) -> tuple[Any, Any, Any]:
        """Grey levels of a row, and their central differences."""
        builder = self._builder
        half = ir.Constant(_ROW, [0.5] * PATCH_SIZE)
        across = builder.fsub(self._load(row, 1), self._load(row, -1), flags=_FLAGS)
        down = builder.fsub(self._load(row + 1, 0), self._load(row - 1, 0), flags=_FLAGS)
        return (
            self._load(row, 0),
            builder.fmul(half, across, flags=_FLAGS),
            builder.fmul(half, down, flags=_FLAGS),
        )


@fast_kernel
def prefetch_template(templates: F32, offset: int) -> None:
    """Prefetch the template at ``offset`` of flat templates, without waiting."""
    for start in range(0, TEMPLATE_FLOATS, CACHE_LINE_FLOATS):
        prefetch(templates, offset + start)

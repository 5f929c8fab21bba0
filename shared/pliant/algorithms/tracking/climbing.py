"""Hill climbing on curvature with a pull to the prediction (VITAMIN-E, section 2.3, Eq. 5)."""

from typing import Any, cast

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from pliant.algorithms.image.pixels import Pixels
from pliant.algorithms.image.vector_code import call_llvm, load, splat, vector_type
from pliant.algorithms.tracking.curvature import CURVATURE_BORDER
from pliant.compiler.kernel import fast_kernel

NEIGHBOURS = 8
STEPS_X = (-1, 0, 1, -1, 1, -1, 0, 1)
STEPS_Y = (-1, -1, -1, 0, 0, 1, 1, 1)
"""Of the neighbours, in scan order."""

_I32 = ir.IntType(32)
_I64 = ir.IntType(64)
_FLAGS = ("nnan", "reassoc", "contract", "nsz", "arcp")

MAX_STEPS = 24
"""Steps after which a climb gives up; it ends by itself, as the value rises at every step."""


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

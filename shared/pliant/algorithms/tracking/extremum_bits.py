"""Which of a run of pixels are extrema, as the bits of one word, and where, in vector code."""

from typing import Any, cast

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from pliant.algorithms.tracking.vector_code import load, splat, vector_type

RUN = 32
"""Pixels that one word speaks of."""

_LANES = 8
"""Pixels at a time: with more the eight neighbours do not fit into registers."""

_FLAGS = ("reassoc", "contract", "nsz", "arcp")
_I64 = ir.IntType(64)


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
def first_bit(typing_context: Any, word: Any) -> Any:
    """Number of the lowest bit that is set in a uint64; 64 of 0."""
    signature = types.uint64(types.uint64)

    def codegen(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        return builder.cttz(arguments[0], ir.Constant(ir.IntType(1), 0))

    return signature, codegen


@cast(Any, intrinsic)
def count_bits(typing_context: Any, word: Any) -> Any:
    """How many bits of a uint64 are set."""
    signature = types.uint64(types.uint64)

    def codegen(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        return builder.ctpop(arguments[0])

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
        # A straight line has its vertex nowhere, and stays.
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

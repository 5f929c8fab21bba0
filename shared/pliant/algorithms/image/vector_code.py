"""Common parts of the kernels' hand-written vector instructions, and prefetching."""

from typing import Any, cast

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

CACHE_LINE_FLOATS = 16

_I32 = ir.IntType(32)


def vector_type(lanes: int) -> Any:
    """Type of a vector of that many float32 lanes."""
    return ir.VectorType(ir.FloatType(), lanes)


def load(builder: Any, data: Any, index: Any, lanes: int) -> Any:
    """Lanes from consecutive floats of ``data`` from ``index`` (int64) on; nothing is checked."""
    pointer = builder.bitcast(builder.gep(data, [index]), ir.PointerType(vector_type(lanes)))
    return builder.load(pointer, align=4)


def splat(builder: Any, scalar: Any, lanes: int) -> Any:
    """The same float32 in every lane."""
    undefined = ir.Constant(vector_type(lanes), ir.Undefined)
    first = builder.insert_element(undefined, scalar, ir.Constant(_I32, 0))
    zeros = ir.Constant(ir.VectorType(_I32, lanes), [0] * lanes)
    return builder.shuffle_vector(first, undefined, zeros)


def call_llvm(builder: Any, name: str, result: Any, arguments: list[Any], **options: Any) -> Any:
    """Call an intrinsic of LLVM by its full name."""
    function = builder.module.globals.get(name)
    if function is None:
        signature = ir.FunctionType(result, [argument.type for argument in arguments])
        function = ir.Function(builder.module, signature, name)
    return builder.call(function, arguments, **options)


@cast(Any, intrinsic)
def prefetch(typing_context: Any, array: Any, index: Any) -> Any:
    """Prefetch the cache line of element ``index`` (int64) of a flat array, without waiting.

    An index outside of the array does no harm.
    """
    signature = types.void(array, types.int64)

    def codegen(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        array, index = arguments
        data = context.make_array(sig.args[0])(context, builder, array).data
        address = builder.bitcast(builder.gep(data, [index]), ir.PointerType(ir.IntType(8)))
        to_read, near, of_data = ir.Constant(_I32, 0), ir.Constant(_I32, 3), ir.Constant(_I32, 1)
        call_llvm(builder, "llvm.prefetch.p0i8", ir.VoidType(), [address, to_read, near, of_data])
        return context.get_dummy_value()

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

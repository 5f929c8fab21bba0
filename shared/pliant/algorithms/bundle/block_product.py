"""The update of a 6 x 6 block in vector registers, for kernels.

``S -= A C^T`` is the whole price of the Schur complement: with 6 x 3 matrices that of eliminating
points, with 6 x 6 matrices that of factoring what is left.  numba vectorises loops, which here are
too short, and leaves straight code scalar; so this one update is written in LLVM's own vectors,
which any processor has or can imitate.
"""

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

_DOUBLE: Any = ir.DoubleType()
_INT: Any = ir.IntType(32)
_FAST = ("reassoc", "contract", "nsz")
_PARTS = ((0, 4), (4, 2))
"""First column and width of the two vectors that make up a row of six."""


def _subtraction(depth: int) -> Callable[..., tuple[Any, Any]]:
    def subtract(typing_context: Any, S: Any, at: Any, U: Any, a: Any, c: Any) -> tuple[Any, Any]:
        del typing_context, at, a, c
        signature: Any = types.void(S, types.uintp, U, types.uintp, types.uintp)

        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            def row(k: int, index: Any) -> Any:
                array = context.make_array(signature.args[k])(context, builder, args[k])
                stride = cgutils.unpack_tuple(builder, array.strides, 2)[0]
                address = builder.ptrtoint(array.data, index.type)
                return builder.inttoptr(
                    builder.add(address, builder.mul(stride, index)), _DOUBLE.as_pointer()
                )

            _emit(builder, row(0, args[1]), row(2, args[3]), row(2, args[4]), depth)
            return context.get_dummy_value()

        return signature, generate

    return subtract


def _emit(builder: Any, S: Any, A: Any, C: Any, depth: int) -> None:
    def place(base: Any, offset: int, width: int) -> Any:
        pointer = builder.gep(base, [_INT(offset)])
        return builder.bitcast(pointer, ir.VectorType(_DOUBLE, width).as_pointer())

    def spread(number: Any, width: int) -> Any:
        nothing = ir.Constant(ir.VectorType(_DOUBLE, width), ir.Undefined)
        first = builder.insert_element(nothing, number, _INT(0))
        zeros = ir.Constant(ir.VectorType(_INT, width), [0] * width)
        return builder.shuffle_vector(first, nothing, zeros)

    columns = {
        (k, first): builder.load(place(C, 6 * k + first, width), align=8)
        for k in range(depth)
        for first, width in _PARTS
    }
    for r in range(6):
        numbers = [builder.load(builder.gep(A, [_INT(6 * k + r)])) for k in range(depth)]
        for first, width in _PARTS:
            target = place(S, 6 * r + first, width)
            total = builder.load(target, align=8)
            for k in range(depth):
                product = builder.fmul(spread(numbers[k], width), columns[k, first], flags=_FAST)
                total = builder.fsub(total, product, flags=_FAST)
            builder.store(total, target, align=8)


subtract_product3: Any = intrinsic(_subtraction(3))
"""``subtract_product3(S, at, U, a, c)``: ``S[at] -= A C^T``, A and C the rows a and c of U.

S: (K, 36) float64, blocks by rows.     U: (M, 18) float64, column k of a 6 x 3 matrix at ``6 k``.
Indices are unsigned (np.uintp) and not checked.
"""

subtract_product6: Any = intrinsic(_subtraction(6))
"""The same for 6 x 6 matrices: U (K, 36), column k at ``6 k``.  U may be S."""

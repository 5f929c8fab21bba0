"""The reduced system of the cameras (Eq. 9): its sparsity pattern and its solution.

Two cameras have a block in the system if they observe a common point, so a long path has few
blocks.  A calibration that all cameras share is one more camera with a block for each of them: it
borders the matrix, and is eliminated last.  ``S = L L^T`` by blocks, for the columns j in their
order:

    L_jj L_jj^T = S_jj      L_ij = S_ij L_jj^-T      S_ik -= L_ij L_kj^T   for all i >= k below j.

The last step fills in the blocks of all pairs of cameras that have one with camera j.  The order
determines the fill-in: next is always the camera with the fewest blocks (minimum degree, Tinney and
Walker 1967; George and Liu 1989).  All kernels are our own and run in one thread.

``S -= A C^T`` is nearly all of the cost of the Schur complement: with 6 x 3 matrices of eliminating
points, with 6 x 6 matrices of factoring the rest.  numba vectorises loops, which are too short
here, and leaves straight code scalar.  So this update is written in LLVM's own vectors, which any
processor supports or emulates.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

from pliant.algorithms.arrays import F64, I32, I64, BoolArray
from pliant.compiler.kernel import fast_kernel, kernel

_DOUBLE: Any = ir.DoubleType()
_INT: Any = ir.IntType(32)
_FAST = ("reassoc", "contract", "nsz")
_PARTS = {6: ((0, 4), (4, 2)), 7: ((0, 4), (4, 3))}
"""First column and width of the two vectors that make up a row of six, or of seven."""

LOWER = np.tril_indices(6)


def _subtraction(size: int, depth: int) -> Callable[..., tuple[Any, Any]]:
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

            _emit(builder, row(0, args[1]), row(2, args[3]), row(2, args[4]), size, depth)
            return context.get_dummy_value()

        return signature, generate

    return subtract


def _emit(builder: Any, S: Any, A: Any, C: Any, size: int, depth: int) -> None:
    def place(base: Any, offset: int, width: int) -> Any:
        pointer = builder.gep(base, [_INT(offset)])
        return builder.bitcast(pointer, ir.VectorType(_DOUBLE, width).as_pointer())

    def spread(number: Any, width: int) -> Any:
        nothing = ir.Constant(ir.VectorType(_DOUBLE, width), ir.Undefined)
        first = builder.insert_element(nothing, number, _INT(0))
        zeros = ir.Constant(ir.VectorType(_INT, width), [0] * width)
        return builder.shuffle_vector(first, nothing, zeros)

    columns = {
        (k, first): builder.load(place(C, size * k + first, width), align=8)
        for k in range(depth)
        for first, width in _PARTS[size]
    }
    for r in range(size):
        numbers = [builder.load(builder.gep(A, [_INT(size * k + r)])) for k in range(depth)]
        for first, width in _PARTS[size]:
            target = place(S, size * r + first, width)
            total = builder.load(target, align=8)
            for k in range(depth):
                product = builder.fmul(spread(numbers[k], width), columns[k, first], flags=_FAST)
                total = builder.fsub(total, product, flags=_FAST)
            builder.store(total, target, align=8)


subtract_product3: Any = intrinsic(_subtraction(6, 3))
"""``subtract_product3(S, at, U, a, c)``: ``S[at] -= A C^T``, A and C the rows a and c of U.

S: (K, 36) float64, blocks by rows.     U: (M, 18) float64, column k of a 6 x 3 matrix at ``6 k``.
Indices are unsigned (np.uintp) and not checked.
"""

subtract_product6: Any = intrinsic(_subtraction(6, 6))
subtract_product7: Any = intrinsic(_subtraction(7, 7))
"""The same for n x n matrices: S, U (K, n^2), column k at ``n k``.  U may be S."""


class Pattern(NamedTuple):
    """The blocks of L, which include those of S.

    position: (F,) of each movable camera in the order of elimination.
    block: (N, N) index of the block of two positions, row >= column; -1 without one.
    start: (N + 1,) blocks of each column, the one on the diagonal first.     row: of each block.
    """

    position: I32
    block: I32
    start: I64
    row: I32


def find_pattern(meetings: BoolArray, *, borders: int) -> Pattern:
    """Order the F cameras.  meetings: (F, F) symmetric, whether two of them observe a common point.

    borders: number of further positions, the last ones, which have a block with all of them.
    """
    F = len(meetings)
    N = F + borders
    filled = np.ones((N, N), np.bool_)
    filled[:F, :F] = meetings
    position = _order(filled, F)
    block, start, row = _lay_out(filled, position)
    return Pattern(position=position[:F], block=block, start=start, row=row)


@kernel
def _order(filled: BoolArray, F: int) -> I32:
    """(N,) position of each camera; blocks that fill in are marked in ``filled`` (N, N)."""
    N = filled.shape[0]
    degree = np.zeros(N, np.int64)
    for m in range(N):
        degree[m] = filled[m].sum()
    position = np.full(N, -1, np.int32)
    met = np.empty(N, np.int64)
    for step in range(F):
        best = -1
        for m in range(F):
            if position[m] < 0 and (best < 0 or degree[m] < degree[best]):
                best = m
        position[best] = step
        count = 0
        for m in range(N):
            if position[m] < 0 and filled[best, m]:
                met[count] = m
                count += 1
                degree[m] -= 1
        for a in range(count):
            for c in range(a):
                i, k = met[a], met[c]
                if not filled[i, k]:
                    filled[i, k] = filled[k, i] = True
                    degree[i] += 1
                    degree[k] += 1
    for m in range(F, N):
        position[m] = m
    return position


@kernel
def _lay_out(filled: BoolArray, position: I32) -> tuple[I32, I64, I32]:
    """``block``, ``start`` and ``row`` of the pattern."""
    N = position.size
    camera = np.empty(N, np.int64)
    for m in range(N):
        camera[position[m]] = m
    block = np.full((N, N), -1, np.int32)
    start = np.zeros(N + 1, np.int64)
    row = np.empty((filled.sum() + N) // 2 + N, np.int32)
    at = 0
    for j in range(N):
        for i in range(j, N):
            if i == j or filled[camera[i], camera[j]]:
                block[i, j] = at
                row[at] = i
                at += 1
        start[j + 1] = at
    return block, start, row[:at].copy()


def solve_reduced(pattern: Pattern, S: F64, b: F64, damping: F64) -> F64 | None:
    """Solve ``(S + diag(damping)) x = b``: (N, n), None if that is not positive definite.

    S: (K, n^2) blocks of the pattern by rows, those on the diagonal in their lower triangles; it is
    overwritten.     b, damping: (N, n), n 6 or 7.  An unknown without observations has an empty
    row: the identity keeps it unchanged.
    """
    return substitute_reduced(pattern, S, b) if factor_reduced(pattern, S, damping) else None


def factor_reduced(pattern: Pattern, S: F64, damping: F64) -> bool:
    """Overwrite S with the L of ``S + diag(damping)``; False if that is not positive definite.

    As of ``solve_reduced``.
    """
    size = damping.shape[1]
    at = pattern.start[:-1, None], (size + 1) * np.arange(size)
    S[at] += np.where(S[at] == 0.0, 1.0, damping)
    return bool(_factor(pattern.start, pattern.row, pattern.block, S, (0,) * size))


def substitute_reduced(pattern: Pattern, L: F64, b: F64) -> F64 | None:
    """Solve ``L L^T x = b``: (N, n), None if that is not finite."""
    x = b.copy()
    _substitute(pattern.start, pattern.row, L, x, (0,) * b.shape[1])
    return x if np.isfinite(x).all() else None


@fast_kernel
def _factor(start: I64, row: I32, block: I32, S: F64, unknowns: Any) -> bool:
    """Overwrite S with L: its blocks below the diagonal by columns; False if it has none.

    unknowns: n of any numbers: their count is known when numba compiles.
    """
    n = len(unknowns)
    for j in range(start.size - 1):
        first, last = start[j], start[j + 1]
        D = S[first]
        for r in range(n):
            for c in range(r + 1):
                total = D[n * r + c]
                for k in range(c):
                    total -= D[n * r + k] * D[n * c + k]
                if r > c:
                    D[n * r + c] = total * D[(n + 1) * c]
                elif total > 0.0:
                    D[(n + 1) * r] = 1.0 / np.sqrt(total)
                else:
                    return False
        for at in range(first + 1, last):
            _divide(S[at], D, unknowns)
        for upper in range(first + 1, last):
            i = np.uintp(row[upper])
            for lower in range(first + 1, upper + 1):
                k = np.uintp(row[lower])
                _subtract_product(
                    S, np.uintp(block[i, k]), np.uintp(upper), np.uintp(lower), unknowns
                )
    return True


@fast_kernel(inline=True)
def _subtract_product(S: F64, at: Any, a: Any, c: Any, unknowns: Any) -> None:
    if len(unknowns) == 6:
        subtract_product6(S, at, S, a, c)
    else:
        subtract_product7(S, at, S, a, c)


@fast_kernel
def _divide(A: F64, D: F64, unknowns: Any) -> None:
    """``A D^-T`` of a block by rows, written by columns.  D has its reciprocal diagonal."""
    n = len(unknowns)
    for r in range(n):
        for c in range(n):
            total = A[n * r + c]
            for k in range(c):
                total -= A[n * r + k] * D[n * c + k]
            A[n * r + c] = total * D[(n + 1) * c]
    for r in range(n):
        for c in range(r):
            A[n * r + c], A[n * c + r] = A[n * c + r], A[n * r + c]


@fast_kernel
def _substitute(start: I64, row: I32, L: F64, x: F64, unknowns: Any) -> None:
    """Solve ``L L^T x = b`` in place."""
    n, N = len(unknowns), start.size - 1
    for j in range(N):
        own = L[start[j]]
        for r in range(n):
            total = x[j, r]
            for k in range(r):
                total -= own[n * r + k] * x[j, k]
            x[j, r] = total * own[(n + 1) * r]
        for at in range(start[j] + 1, start[j + 1]):
            i = row[at]
            for k in range(n):
                for r in range(n):
                    x[i, r] -= L[at, n * k + r] * x[j, k]
    for j in range(N - 1, -1, -1):
        own = L[start[j]]
        for at in range(start[j] + 1, start[j + 1]):
            i = row[at]
            for k in range(n):
                total = 0.0
                for r in range(n):
                    total += L[at, n * k + r] * x[i, r]
                x[j, k] -= total
        for r in range(n - 1, -1, -1):
            total = x[j, r]
            for k in range(r + 1, n):
                total -= own[n * k + r] * x[j, k]
            x[j, r] = total * own[(n + 1) * r]

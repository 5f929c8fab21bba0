"""The products ``U U^T`` of the Schur complement, for blocks that many or few cameras see.

U holds one row of 6 x 3 x BLOCK numbers for each camera that sees the block.
"""

from pliant.algorithms.arrays import F32, F64, I32, I64
from pliant.algorithms.bundle.layout import BLOCK
from pliant.algorithms.kernel import fast_kernel, kernel

DEPTH = 3 * BLOCK
SPARSE_PAIR = 8
"""Twice the price of a pair of cameras at one point over its share of a dense pair (measured)."""


@kernel
def count_seen(w: F32, slots: I64, lo: int, cameras_of: I32, counts: I32) -> int:
    """List which of the slots see each point of a block; returns the pairs of cameras in all."""
    pairs = 0
    counts[:] = 0
    for a in range(slots.size):
        wm = w[slots[a], lo : lo + BLOCK]
        for i in range(BLOCK):
            if wm[i] > 0.0:
                cameras_of[i, counts[i]] = a
                counts[i] += 1
    for i in range(BLOCK):
        pairs += counts[i] * (counts[i] + 1) // 2
    return pairs


@kernel
def multiply_points(U: F64, rows: I64, cameras_of: I32, counts: I32, packed: F64, S: F64) -> None:
    """Subtract ``U U^T`` point by point: for blocks in which cameras share few points.

    packed: (M, 18) room for the rows of one point, three numbers for each of a camera's six.
    """
    for i in range(BLOCK):
        for a in range(counts[i]):
            row = U[cameras_of[i, a]]
            for r in range(6):
                for k in range(3):
                    packed[a, 3 * r + k] = row[r * DEPTH + k * BLOCK + i]
        for a in range(counts[i]):
            at = int(6 * rows[cameras_of[i, a]])
            for c in range(a + 1):
                column = int(6 * rows[cameras_of[i, c]])
                subtract_block(S, at, column, packed[a], packed[c])


@fast_kernel
def subtract_block(S: F64, at: int, column: int, A: F64, C: F64) -> None:
    """Subtract the 6 x 6 product of two (6, 3) matrices; one of them stays in registers."""
    a0, a1, a2, b0, b1, b2 = C[0], C[1], C[2], C[3], C[4], C[5]
    c0, c1, c2, d0, d1, d2 = C[6], C[7], C[8], C[9], C[10], C[11]
    e0, e1, e2, f0, f1, f2 = C[12], C[13], C[14], C[15], C[16], C[17]
    for r in range(6):
        x, y, z = A[3 * r], A[3 * r + 1], A[3 * r + 2]
        S[at + r, column] -= x * a0 + y * a1 + z * a2
        S[at + r, column + 1] -= x * b0 + y * b1 + z * b2
        S[at + r, column + 2] -= x * c0 + y * c1 + z * c2
        S[at + r, column + 3] -= x * d0 + y * d1 + z * d2
        S[at + r, column + 4] -= x * e0 + y * e1 + z * e2
        S[at + r, column + 5] -= x * f0 + y * f1 + z * f2


@kernel
def multiply_pairs(U: F64, rows: I64, count: int, S: F64) -> None:
    """Subtract ``U U^T`` camera pair by camera pair, over all points of the block at once."""
    for a in range(count):
        for c in range(a + 1):
            row, column = 6 * rows[a], 6 * rows[c]
            multiply_pair(U[a], U[c], 0, S[row:, column:])
            multiply_pair(U[a], U[c], 3 * DEPTH, S[row:, column + 3 :])


@fast_kernel
def multiply_vector(U: F64, y: F64, b: F64) -> None:
    """Subtract ``U y`` from b (6,); y is ``- L^-1 g_p`` here."""
    for r in range(6):
        total = 0.0
        at = r * DEPTH
        for i in range(DEPTH):
            total += U[at + i] * y[i]
        b[r] -= total


@fast_kernel
def multiply_pair(A: F64, C: F64, at: int, S: F64) -> None:
    """Subtract the (6, 3) product of A and three rows of C; sums stay in registers."""
    s00 = s01 = s02 = s10 = s11 = s12 = s20 = s21 = s22 = 0.0
    s30 = s31 = s32 = s40 = s41 = s42 = s50 = s51 = s52 = 0.0
    for i in range(DEPTH):
        x, y, z = C[at + i], C[at + DEPTH + i], C[at + 2 * DEPTH + i]
        r0, r1, r2 = A[i], A[DEPTH + i], A[2 * DEPTH + i]
        r3, r4, r5 = A[3 * DEPTH + i], A[4 * DEPTH + i], A[5 * DEPTH + i]
        s00 += r0 * x
        s01 += r0 * y
        s02 += r0 * z
        s10 += r1 * x
        s11 += r1 * y
        s12 += r1 * z
        s20 += r2 * x
        s21 += r2 * y
        s22 += r2 * z
        s30 += r3 * x
        s31 += r3 * y
        s32 += r3 * z
        s40 += r4 * x
        s41 += r4 * y
        s42 += r4 * z
        s50 += r5 * x
        s51 += r5 * y
        s52 += r5 * z
    sums = (
        s00, s01, s02, s10, s11, s12, s20, s21, s22,
        s30, s31, s32, s40, s41, s42, s50, s51, s52,
    )  # fmt: skip
    for r in range(18):
        S[r // 3, r % 3] -= sums[r]

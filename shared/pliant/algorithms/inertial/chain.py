"""Least squares over a chain of nodes, of which each is tied to the next, and common unknowns."""

import numpy as np

from pliant.algorithms.arrays import F64


def solve_chain(diagonal: F64, upper: F64, right: F64) -> F64:
    """Solve ``A X = right`` for a symmetric positive definite, block tridiagonal A.

    diagonal: (N, n, n) blocks.  upper: (N - 1, n, n) blocks of row i and column i + 1.
    right: (N, n, k).  Returns X (N, n, k).  Raises LinAlgError for a singular A.

    Cyclic reduction: every other node is eliminated, all at once, until one is left (Golub and Van
    Loan, Matrix Computations, 4th edition, 4.5.4).
    """
    if len(diagonal) == 1:
        return np.asarray(np.linalg.solve(diagonal, right), np.float64)
    n = diagonal.shape[1]
    # Node 2 i + 1 lies between the nodes 2 i and 2 i + 2, of which the last may not exist.
    to_left, to_right = upper[0::2], upper[1::2]
    lost = len(to_left)
    last = len(to_right) < lost
    to_right = np.concatenate([to_right, np.zeros((1, n, n))]) if last else to_right
    known = np.concatenate([to_left.swapaxes(1, 2), to_right, right[1::2]], axis=2)
    solved = np.linalg.solve(diagonal[1::2], known)
    left, after, constant = solved[:, :, :n], solved[:, :, n : 2 * n], solved[:, :, 2 * n :]
    kept, forces = diagonal[0::2].copy(), right[0::2].copy()
    kept[:lost] -= to_left @ left
    forces[:lost] -= to_left @ constant
    beyond = lost - last
    from_right = to_right[:beyond].swapaxes(1, 2)
    kept[1 : beyond + 1] -= from_right @ after[:beyond]
    forces[1 : beyond + 1] -= from_right @ constant[:beyond]
    X = np.empty(right.shape)
    X[0::2] = solve_chain(kept, -(to_left @ after)[:beyond], forces)
    X[1::2] = constant - left @ X[0::2][:lost]
    X[1::2][:beyond] -= after[:beyond] @ X[2::2]
    return X

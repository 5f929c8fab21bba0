"""How well the observations determine each point."""

import numpy as np

from pliant.algorithms.arrays import F32, F64, U8
from pliant.algorithms.bundle.cost import Limits, limits_of
from pliant.algorithms.bundle.layout import BLOCK, build_layout
from pliant.algorithms.bundle.problem import AnyProblem, BundleParameters
from pliant.algorithms.bundle.schur_kernels import linearise_block
from pliant.algorithms.kernel import kernel

LOWER = np.tril_indices(3)


def point_information(problem: AnyProblem, parameters: BundleParameters) -> F64:
    """(N, 3, 3) Hessian of every point with the cameras held, world frame, px^2 / unit^2.

    Robust weights included.  Its inverse times the variance of a pixel coordinate (px^2) is the
    point's covariance; the largest eigenvalue of that lies along the rays.  0 where nothing is
    seen.
    """
    layout = build_layout(problem)
    V = _accumulate(
        layout.cameras, layout.pinholes, layout.lenses, layout.points, layout.u, layout.v,
        layout.w, layout.seen, limits_of(parameters),
    )  # fmt: skip
    out = np.zeros((len(problem.points_world), 3, 3))
    out[:, LOWER[0], LOWER[1]] = V[:, layout.column].T
    out[:, LOWER[1], LOWER[0]] = V[:, layout.column].T
    return out


@kernel
def _accumulate(
    cameras: F64,
    pinholes: F64,
    lenses: F64,
    points: F64,
    u: F32,
    v: F32,
    w: F32,
    seen: U8,
    limits: Limits,
) -> F64:
    """(6, P) lower triangles of H_pp by rows."""
    out = np.empty((6, points.shape[1]))
    local, V = np.empty(8 * BLOCK), np.empty(9 * BLOCK)
    for block in range(seen.shape[1]):
        lo = block * BLOCK
        V[:] = 0.0
        for m in range(cameras.shape[0]):
            if seen[m, block] != 0:
                linearise_block(cameras, pinholes, lenses, m, lo, points, u, v, w, limits, local, V)
        for r in range(6):
            for i in range(BLOCK):
                out[r, lo + i] = V[r * BLOCK + i]
    return out

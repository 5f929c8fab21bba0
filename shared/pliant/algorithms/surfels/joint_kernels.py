"""Normal equations of the camera before surfels that stand still, or stay where they are."""

import numpy as np

from pliant.algorithms.arrays import F64, U8
from pliant.algorithms.kernel import fast_kernel, leaf_kernel
from pliant.algorithms.surfels import motion
from pliant.algorithms.surfels.align import Limits, Templates, Workspace, evaluate
from pliant.algorithms.surfels.sampling import Level, X


@leaf_kernel
def evaluate_all(
    poses: F64, active: U8, level: Level, templates: Templates, limits: Limits, work: Workspace,
    costs: F64, sums: F64,
) -> None:  # fmt: skip
    """Photometric cost (N,) and sums (N, FEATURES) of surfels.

    Surfels that are not in front of the camera, or have no template here, become inactive.
    """
    for s in range(len(poses)):
        if not active[s]:
            continue
        if not templates.usable[s]:
            active[s] = 0
            continue
        images, mean = templates.images[s], templates.means[s]
        cost, _ = evaluate(poses[s], level, images, mean, limits, work, sums[s])
        if cost < 0.0:
            active[s] = 0
        else:
            costs[s] = cost


@fast_kernel
def rigid_system(
    poses: F64, active: U8, level: Level, work: Workspace, sums: F64,
    matrices: F64, light: F64, M: F64, v: F64,
) -> None:  # fmt: skip
    """Add up M zeta = v of a rigid scene.  light: (N, 2, 7): gain and bias from (1, zeta).

    A rigid scene has the surfels' steps p = Ad zeta, with the adjoint of each surfel's position.
    """
    n = 8
    A, Q, QA = np.zeros((6, 6)), np.zeros((6, 6)), np.zeros((6, 6))
    q = np.zeros(6)
    M[:] = 0.0
    v[:] = 0.0
    for s in range(len(poses)):
        if not active[s]:
            continue
        motion.mixing(poses[s], level, motion.ISOMETRIC, work.mix)
        motion.hessian(matrices[s], 1.0, work.mix, n, work.product, work.H)
        motion.gradient(sums[s], work.mix, n, work.g)
        H, g = work.H, work.g
        # Gain and bias, the last two, are eliminated from the surfel's block.
        det = H[6, 6] * H[7, 7] - H[6, 7] * H[7, 6]
        if not det > 1e-6 * H[6, 6] * H[7, 7]:
            light[s] = 0.0
            continue
        i00, i01, i11 = H[7, 7] / det, -H[6, 7] / det, H[6, 6] / det
        b0, b1 = i00 * g[6] + i01 * g[7], i01 * g[6] + i11 * g[7]
        _adjoint(poses[s], A)
        for r in range(6):
            q[r] = g[r] - H[r, 6] * b0 - H[r, 7] * b1
            for c in range(6):
                w0 = i00 * H[6, c] + i01 * H[7, c]
                w1 = i01 * H[6, c] + i11 * H[7, c]
                Q[r, c] = H[r, c] - H[r, 6] * w0 - H[r, 7] * w1
        light[s, 0, 0], light[s, 1, 0] = -b0, -b1
        for c in range(6):
            l0 = l1 = 0.0
            for k in range(6):
                l0 -= (i00 * H[6, k] + i01 * H[7, k]) * A[k, c]
                l1 -= (i01 * H[6, k] + i11 * H[7, k]) * A[k, c]
            light[s, 0, 1 + c], light[s, 1, 1 + c] = l0, l1
        for r in range(6):
            for c in range(6):
                total = 0.0
                for k in range(6):
                    total += Q[r, k] * A[k, c]
                QA[r, c] = total
        for r in range(6):
            for k in range(6):
                v[r] -= A[k, r] * q[k]
                for c in range(6):
                    M[r, c] += A[k, r] * QA[k, c]


@leaf_kernel
def _adjoint(pose: F64, A: F64) -> None:
    """Step of a surfel that stands still in the world: (rho + phi x X, phi)."""
    x, y, z = pose[X], pose[X + 1], pose[X + 2]
    A[:] = 0.0
    for k in range(6):
        A[k, k] = 1.0
    A[0, 4], A[0, 5] = z, -y
    A[1, 3], A[1, 5] = -z, x
    A[2, 3], A[2, 4] = y, -x


@leaf_kernel
def register_system(poses: F64, active: U8, equilibrium: F64, weights: F64, M: F64, v: F64) -> None:
    """Add up M zeta = v of a camera that fits surfels which stay where they are.

    equilibrium: (N, 3), weights: (N, 3, 3) of a ``Rest``.  M: (6, 6), v: (6,), overwritten.
    """
    M[:] = 0.0
    v[:] = 0.0
    for s in range(len(poses)):
        if not active[s]:
            continue
        W = weights[s]
        # W turns with the camera, too: so a step is about where the surfel is, not where it rests.
        x, y, z = poses[s, X], poses[s, X + 1], poses[s, X + 2]
        p, q, r = x - equilibrium[s, 0], y - equilibrium[s, 1], z - equilibrium[s, 2]
        a = W[0, 0] * p + W[0, 1] * q + W[0, 2] * r
        b = W[1, 0] * p + W[1, 1] * q + W[1, 2] * r
        c = W[2, 0] * p + W[2, 1] * q + W[2, 2] * r
        v[0] += a
        v[1] += b
        v[2] += c
        v[3] += y * c - z * b
        v[4] += z * a - x * c
        v[5] += x * b - y * a
        for k in range(3):
            # W is symmetric: its columns are its rows, and turned by [x]x they make the rest.
            a, b, c = W[k, 0], W[k, 1], W[k, 2]
            M[k, 0] += a
            M[k, 1] += b
            M[k, 2] += c
            M[3, k] += y * c - z * b
            M[4, k] += z * a - x * c
            M[5, k] += x * b - y * a
        for k in range(3):
            k1, k2 = (k + 1) % 3, (k + 2) % 3
            x1, x2 = poses[s, X + k1], poses[s, X + k2]
            a = x1 * W[k2, 0] - x2 * W[k1, 0]
            b = x1 * W[k2, 1] - x2 * W[k1, 1]
            c = x1 * W[k2, 2] - x2 * W[k1, 2]
            M[3 + k, 3] += c * y - b * z
            M[3 + k, 4] += a * z - c * x
            M[3 + k, 5] += b * x - a * y
    for k in range(3):
        for m in range(3):
            M[k, 3 + m] = M[3 + m, k]

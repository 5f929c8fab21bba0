"""Kernels of ``together``: a surfel's own system, the pairs, conjugate gradients over all."""

import numpy as np

from pliant.algorithms.arrays import F64, U8
from pliant.algorithms.kernel import fast_kernel
from pliant.algorithms.surfels import motion
from pliant.algorithms.surfels.align import Limits, Templates, Workspace, evaluate
from pliant.algorithms.surfels.damped import factorise, solve
from pliant.algorithms.surfels.neighbours import Edges, own_vector
from pliant.algorithms.surfels.sampling import GAIN, POSE_FLOATS, Level, X

_RIGID = motion.RIGID
_MIN_GAIN = 0.05


@fast_kernel
def reduce_all(
    poses: F64, active: U8, level: Level, limits: Limits, work: Workspace, sums: F64,
    matrices: F64, S: F64, b: F64, inner: F64, follow: F64,
) -> None:  # fmt: skip
    """Each surfel's 6 x 6 system of its motion, with F, gain and bias eliminated.

    S: (N, 6, 6), b: (N, 6): S x = -b without neighbours.  inner: (N, 5), follow: (N, 5, 6): the
    eliminated parameters step by -inner - follow x.
    """
    n = motion.parameter_count(limits.model)
    m = n - _RIGID
    C, L, scale = np.zeros((m, m)), np.zeros((m, m)), np.zeros(m)
    rhs, x = np.zeros(m), np.zeros(m)
    for s in range(len(poses)):
        S[s] = 0.0
        b[s] = 0.0
        inner[s] = 0.0
        follow[s] = 0.0
        if not active[s]:
            continue
        H, g = work.H, work.g
        motion.mixing(poses[s], level, limits.model, limits.by_template, work.mix)
        motion.normal_equations(matrices[s], sums[s], work.mix, n, work.product, H, g)
        motion.add_deformation_energy(poses[s], limits.model, limits.omega_i, H, g)
        C[:] = H[_RIGID:n, _RIGID:n]
        if not factorise(C, m, 0, 0.0, L, scale):
            continue
        for k in range(m):
            rhs[k] = -g[_RIGID + k]
        solve(L, scale, m, rhs, x)
        inner[s, :m] = x
        for c in range(_RIGID):
            for k in range(m):
                rhs[k] = -H[_RIGID + k, c]
            solve(L, scale, m, rhs, x)
            follow[s, :m, c] = x
        for r in range(_RIGID):
            total = g[r]
            for k in range(m):
                total -= H[r, _RIGID + k] * inner[s, k]
            b[s, r] = total
            for c in range(_RIGID):
                total = H[r, c]
                for k in range(m):
                    total -= H[r, _RIGID + k] * follow[s, k, c]
                S[s, r, c] = total


@fast_kernel
def edge_rows(
    poses: F64, edges: Edges, tear: float, weights: F64, residuals: F64, arms: F64
) -> None:
    """Residuals (E, 2, 3), arms (E, 2, 3) R_i d and R_j d, and robust weights (E,) of all pairs.

    tear: strain at which a quarter of the weight is left (Geman and McClure).
    """
    for e in range(len(edges.ends)):
        i, j = edges.ends[e, 0], edges.ends[e, 1]
        own_vector(poses[i], edges.first[e], arms[e, 0])
        own_vector(poses[j], edges.second[e], arms[e, 1])
        squares = 0.0
        for k in range(3):
            p, q = arms[e, 0, k], arms[e, 1, k]
            r = poses[j, X + k] - poses[i, X + k] - 0.5 * (p + q)
            residuals[e, 0, k], residuals[e, 1, k] = r, q - p
            squares += r * r
        ratio = squares / (tear * edges.lengths[e]) ** 2
        weights[e] = 1.0 / (1.0 + ratio) ** 2


@fast_kernel
def _edge_times(arms: F64, xi: F64, xj: F64, r: F64, c: F64) -> None:
    """The two residuals' change under steps of both ends: omega x v is the change of an arm."""
    for k in range(3):
        k1, k2 = (k + 1) % 3, (k + 2) % 3
        turn_i = xi[3 + k1] * arms[0, k2] - xi[3 + k2] * arms[0, k1]
        turn_j = xj[3 + k1] * arms[1, k2] - xj[3 + k2] * arms[1, k1]
        r[k] = xj[k] - xi[k] - 0.5 * (turn_i + turn_j)
        c[k] = turn_j - turn_i


@fast_kernel
def _edge_back(arms: F64, r: F64, c: F64, yi: F64, yj: F64) -> None:
    """Adds the transpose of ``_edge_times``."""
    for k in range(3):
        k1, k2 = (k + 1) % 3, (k + 2) % 3
        yi[k] -= r[k]
        yj[k] += r[k]
        # u . (omega x v) = omega . (v x u)
        ui1, ui2 = -0.5 * r[k1] - c[k1], -0.5 * r[k2] - c[k2]
        uj1, uj2 = -0.5 * r[k1] + c[k1], -0.5 * r[k2] + c[k2]
        yi[3 + k] += arms[0, k1] * ui2 - arms[0, k2] * ui1
        yj[3 + k] += arms[1, k1] * uj2 - arms[1, k2] * uj1


@fast_kernel
def _times(S: F64, edges: Edges, arms: F64, w: F64, bend: F64, x: F64, y: F64) -> None:
    r, c = np.empty(3), np.empty(3)
    for s in range(len(x)):
        for row in range(_RIGID):
            total = 0.0
            for column in range(_RIGID):
                total += S[s, row, column] * x[s, column]
            y[s, row] = total
    for e in range(len(edges.ends)):
        i, j = edges.ends[e, 0], edges.ends[e, 1]
        _edge_times(arms[e], x[i], x[j], r, c)
        for k in range(3):
            r[k] *= w[e]
            c[k] *= bend[e]
        _edge_back(arms[e], r, c, y[i], y[j])


@fast_kernel
def _start(
    S: F64, b: F64, edges: Edges, arms: F64, residuals: F64, w: F64, bend: F64, L: F64, scale: F64,
    q: F64,
) -> None:  # fmt: skip
    """Right-hand side q (N, 6), and factors of each surfel's own block with its pairs."""
    blocks = S.copy()
    unit, back = np.zeros((2, _RIGID)), np.zeros((2, _RIGID))
    r, c = np.zeros(3), np.zeros(3)
    for s in range(len(S)):
        for row in range(_RIGID):
            q[s, row] = -b[s, row]
    for e in range(len(edges.ends)):
        i, j = edges.ends[e, 0], edges.ends[e, 1]
        for k in range(3):
            r[k], c[k] = -w[e] * residuals[e, 0, k], -bend[e] * residuals[e, 1, k]
        _edge_back(arms[e], r, c, q[i], q[j])
        for end in range(2):
            s = i if end == 0 else j
            for column in range(_RIGID):
                unit[:] = 0.0
                unit[end, column] = 1.0
                back[:] = 0.0
                _edge_times(arms[e], unit[0], unit[1], r, c)
                for k in range(3):
                    r[k] *= w[e]
                    c[k] *= bend[e]
                _edge_back(arms[e], r, c, back[0], back[1])
                for row in range(_RIGID):
                    blocks[s, row, column] += back[end, row]
    for s in range(len(S)):
        factorise(blocks[s], _RIGID, 0, 0.0, L[s], scale[s])


@fast_kernel
def _precondition(L: F64, scale: F64, q: F64, z: F64) -> float:
    """z = M^-1 q; returns q . z."""
    total = 0.0
    rhs = np.empty(_RIGID)
    for s in range(len(q)):
        for k in range(_RIGID):
            rhs[k] = -q[s, k]
        solve(L[s], scale[s], _RIGID, rhs, z[s])
        for k in range(_RIGID):
            total += q[s, k] * z[s, k]
    return float(np.float64(total))


@fast_kernel
def solve_together(
    S: F64, b: F64, edges: Edges, arms: F64, residuals: F64, w: F64, bend: F64, iterations: int,
    tolerance: float, x: F64,
) -> int:  # fmt: skip
    """Conjugate gradients, preconditioned by each surfel's own block.

    S: (N, 6, 6), b: (N, 6) from ``reduce_all``, damped.  w, bend: (E,) weights of the two
    residuals, DN^2 / m^2.  tolerance: of the squared residual, relative.  x: (N, 6) receives the
    steps.  Returns iterations.
    """
    n = len(S)
    L, scale = np.zeros((n, _RIGID, _RIGID)), np.zeros((n, _RIGID))
    q, z = np.zeros((n, _RIGID)), np.zeros((n, _RIGID))
    p, y = np.zeros((n, _RIGID)), np.zeros((n, _RIGID))
    _start(S, b, edges, arms, residuals, w, bend, L, scale, q)
    x[:] = 0.0
    rho = _precondition(L, scale, q, z)
    first = rho
    p[:] = z
    for iteration in range(iterations):
        if not rho > tolerance * first:
            return iteration
        _times(S, edges, arms, w, bend, p, y)
        curvature = (p * y).sum()
        if not curvature > 0.0:
            return iteration
        alpha = rho / curvature
        x += alpha * p
        q -= alpha * y
        before = rho
        rho = _precondition(L, scale, q, z)
        p[:] = z + (rho / before) * p
    return iterations


@fast_kernel
def step_together(
    poses: F64, active: U8, level: Level, templates: Templates, limits: Limits, work: Workspace,
    S: F64, b: F64, inner: F64, follow: F64, x: F64, damping: F64, costs: F64, sums: F64,
    matrices: F64,
) -> None:  # fmt: skip
    """Take the steps of all surfels whose images agree; the others' damping grows."""
    n = motion.parameter_count(limits.model)
    step = np.zeros(motion.MOST_PARAMETERS)
    for s in range(len(poses)):
        step[:_RIGID] = x[s]
        for k in range(n - _RIGID):
            step[_RIGID + k] = -inner[s, k]
            for c in range(_RIGID):
                step[_RIGID + k] -= follow[s, k, c] * x[s, c]
        candidate = work.pose
        motion.apply_step(poses[s], step, limits.model, candidate)
        candidate[GAIN] = max(candidate[GAIN], _MIN_GAIN)
        if not active[s]:
            poses[s, :POSE_FLOATS] = candidate
            continue
        if limits.by_template:
            work.next_matrix[:] = matrices[s]
        cost, _ = evaluate(
            candidate, level, templates.images[s], templates.means[s], limits, work,
            work.next_sums, work.next_matrix,
        )  # fmt: skip
        expected = 0.0
        for r in range(_RIGID):
            expected += 2.0 * b[s, r] * x[s, r]
            for c in range(_RIGID):
                expected += x[s, r] * S[s, r, c] * x[s, c]
        bound = costs[s] * (1.0 + limits.slack) + 2.0 * max(expected, 0.0)
        if cost >= 0.0 and cost < bound:
            poses[s, :POSE_FLOATS] = candidate
            costs[s] = cost
            sums[s] = work.next_sums
            matrices[s] = work.next_matrix
            damping[s] /= limits.lambda_down
        else:
            damping[s] *= 10.0 * limits.lambda_up

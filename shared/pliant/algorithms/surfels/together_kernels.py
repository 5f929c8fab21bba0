"""Kernels of ``together``: a surfel's own system, the pairs, conjugate gradients over all."""

import numpy as np

from pliant.algorithms.arrays import F64, U8
from pliant.algorithms.kernel import fast_kernel, leaf_kernel
from pliant.algorithms.surfels import motion
from pliant.algorithms.surfels.align import (
    Limits,
    Templates,
    Workspace,
    curvature,
    evaluate,
    patch_step_px,
)
from pliant.algorithms.surfels.damped import copy, factorise, invert, solve
from pliant.algorithms.surfels.neighbours import Edges, own_vector
from pliant.algorithms.surfels.sampling import GAIN, Level, X, homography
from pliant.algorithms.surfels.sums import correlation, first_inner

_RIGID = motion.RIGID
_MIN_GAIN = 0.05


@leaf_kernel
def look_at_all(
    poses: F64, start: F64, active: U8, level: Level, templates: Templates, limits: Limits,
    work: Workspace, min_zncc: float, min_visible: float, costs: F64, sums: F64, matrices: F64,
) -> None:  # fmt: skip
    """Costs, sums and matrices where the image shows a surfel near its present pose.

    Where it does not, ``active`` becomes 0 and the pose that of ``start``.
    """
    for s in range(len(poses)):
        images, mean = templates.images[s], templates.means[s]
        cost, found = 0.0, active[s] > 0 and templates.usable[s] > 0
        if found:
            cost, seen = evaluate(poses[s], level, images, mean, limits, work, sums[s])
            found = cost >= 0.0 and seen >= min_visible * templates.counts[s]
            if found:
                at = first_inner(work.grid)
                zncc, _ = correlation(images[0], work.grid.values[at : at + images.shape[1]])
                found = zncc >= min_zncc
        if found:
            active[s] = 1
            costs[s] = cost
            curvature(poses[s], images, mean, limits, work, matrices[s])
        else:
            active[s] = 0
            copy(start[s], poses[s])


@leaf_kernel
def reduce_all(
    poses: F64, active: U8, level: Level, limits: Limits, work: Workspace, sums: F64,
    matrices: F64, S: F64, b: F64, inner: F64, follow: F64,
) -> None:  # fmt: skip
    """Each surfel's 6 x 6 system of its motion, with F, gain and bias eliminated.

    S: (N, 6, 6), b: (N, 6): S x = -b without neighbours.  inner: (N, 5), follow: (N, 5, 6): the
    eliminated parameters step by -inner - follow x.
    """
    for s in range(len(poses)):
        S[s] = 0.0
        b[s] = 0.0
        inner[s] = 0.0
        follow[s] = 0.0
        if active[s]:
            _reduce(
                poses[s], level, limits, work, sums[s], matrices[s], S[s], b[s], inner[s], follow[s]
            )


@leaf_kernel
def _reduce(
    pose: F64, level: Level, limits: Limits, work: Workspace, sums: F64, matrix: F64, S: F64,
    b: F64, inner: F64, follow: F64,
) -> None:  # fmt: skip
    n = motion.parameter_count(limits.model)
    m = n - _RIGID
    H, g, rhs, x = work.H, work.g, work.step, work.inverse[m:]
    motion.mixing(pose, level, limits.model, work.mix)
    motion.hessian(matrix, 1.0, work.mix, n, work.product, H)
    motion.gradient(sums, work.mix, n, g)
    if not factorise(H[_RIGID:n, _RIGID:n], m, 0, 0.0, work.L, work.inverse):
        return
    for k in range(m):
        rhs[k] = -g[_RIGID + k]
    solve(work.L, work.inverse, m, rhs, x)
    for k in range(m):
        inner[k] = x[k]
    for c in range(_RIGID):
        for k in range(m):
            rhs[k] = -H[_RIGID + k, c]
        solve(work.L, work.inverse, m, rhs, x)
        for k in range(m):
            follow[k, c] = x[k]
    for r in range(_RIGID):
        total = g[r]
        for k in range(m):
            total -= H[r, _RIGID + k] * inner[k]
        b[r] = total
        for c in range(_RIGID):
            total = H[r, c]
            for k in range(m):
                total -= H[r, _RIGID + k] * follow[k, c]
            S[r, c] = total


@leaf_kernel
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


@leaf_kernel
def _add_edges(
    edges: Edges, arms: F64, w: F64, bend: F64, residuals: F64, x: F64, sign: float, y: F64
) -> None:
    """y += sign J' W (J x + residuals), J being the derivative of all pairs' residuals.

    omega x v is the change of an arm v under a turn omega, and u . (omega x v) = omega . (v x u).
    """
    for e in range(len(edges.ends)):
        i, j = edges.ends[e, 0], edges.ends[e, 1]
        p0, p1, p2 = arms[e, 0, 0], arms[e, 0, 1], arms[e, 0, 2]
        q0, q1, q2 = arms[e, 1, 0], arms[e, 1, 1], arms[e, 1, 2]
        i3, i4, i5, j3, j4, j5 = x[i, 3], x[i, 4], x[i, 5], x[j, 3], x[j, 4], x[j, 5]
        a0, a1, a2 = i4 * p2 - i5 * p1, i5 * p0 - i3 * p2, i3 * p1 - i4 * p0
        b0, b1, b2 = j4 * q2 - j5 * q1, j5 * q0 - j3 * q2, j3 * q1 - j4 * q0
        pull, turn = sign * w[e], sign * bend[e]
        r0 = pull * (x[j, 0] - x[i, 0] - 0.5 * (a0 + b0) + residuals[e, 0, 0])
        r1 = pull * (x[j, 1] - x[i, 1] - 0.5 * (a1 + b1) + residuals[e, 0, 1])
        r2 = pull * (x[j, 2] - x[i, 2] - 0.5 * (a2 + b2) + residuals[e, 0, 2])
        c0 = turn * (b0 - a0 + residuals[e, 1, 0])
        c1 = turn * (b1 - a1 + residuals[e, 1, 1])
        c2 = turn * (b2 - a2 + residuals[e, 1, 2])
        y[i, 0] -= r0
        y[i, 1] -= r1
        y[i, 2] -= r2
        y[j, 0] += r0
        y[j, 1] += r1
        y[j, 2] += r2
        u0, u1, u2 = -0.5 * r0 - c0, -0.5 * r1 - c1, -0.5 * r2 - c2
        v0, v1, v2 = -0.5 * r0 + c0, -0.5 * r1 + c1, -0.5 * r2 + c2
        y[i, 3] += p1 * u2 - p2 * u1
        y[i, 4] += p2 * u0 - p0 * u2
        y[i, 5] += p0 * u1 - p1 * u0
        y[j, 3] += q1 * v2 - q2 * v1
        y[j, 4] += q2 * v0 - q0 * v2
        y[j, 5] += q0 * v1 - q1 * v0


@leaf_kernel
def _times(S: F64, edges: Edges, arms: F64, w: F64, bend: F64, none: F64, x: F64, y: F64) -> None:
    """y = (S + J' W J) x.  none: residuals that are all zero."""
    for s in range(len(x)):
        x0, x1, x2, x3, x4, x5 = x[s, 0], x[s, 1], x[s, 2], x[s, 3], x[s, 4], x[s, 5]
        for k in range(_RIGID):
            m = S[s, k]
            y[s, k] = m[0] * x0 + m[1] * x1 + m[2] * x2 + m[3] * x3 + m[4] * x4 + m[5] * x5
    _add_edges(edges, arms, w, bend, none, x, 1.0, y)


@leaf_kernel
def _add_block(v: F64, w: float, bend: float, side: float, block: F64) -> None:
    """Add a pair's J' W J of one end alone.  v: its arm.  side: -1 for the first end, else 1."""
    squares = v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
    turn, cross = 0.25 * w + bend, 0.5 * side * w
    for k in range(3):
        k1, k2 = (k + 1) % 3, (k + 2) % 3
        block[k, k] += w
        block[3 + k, 3 + k] += turn * squares
        for m in range(3):
            block[3 + k, 3 + m] -= turn * v[k] * v[m]
        # [v]x: row k has -v[k2] in column k1 and v[k1] in column k2.
        block[k, 3 + k1] -= cross * v[k2]
        block[3 + k1, k] -= cross * v[k2]
        block[k, 3 + k2] += cross * v[k1]
        block[3 + k2, k] += cross * v[k1]


@leaf_kernel
def _inverses(
    edges: Edges, arms: F64, w: F64, bend: F64, blocks: F64, L: F64, scale: F64, out: F64
) -> None:
    """Inverse of each surfel's own block with its pairs.  blocks: (N, 6, 6) S, overwritten.

    L: (6, 6), scale: (2, 6), scratch.  out: (N, 6, 6).
    """
    for e in range(len(edges.ends)):
        i, j = edges.ends[e, 0], edges.ends[e, 1]
        _add_block(arms[e, 0], w[e], bend[e], -1.0, blocks[i])
        _add_block(arms[e, 1], w[e], bend[e], 1.0, blocks[j])
    for s in range(len(blocks)):
        if factorise(blocks[s], _RIGID, 0, 0.0, L, scale[0]):
            invert(L, scale[0], _RIGID, scale[1], out[s])


@leaf_kernel
def _precondition(inverses: F64, q: F64, z: F64) -> float:
    """z = -M^-1 q; returns -q . z."""
    total = 0.0
    for s in range(len(q)):
        q0, q1, q2, q3, q4, q5 = q[s, 0], q[s, 1], q[s, 2], q[s, 3], q[s, 4], q[s, 5]
        for k in range(_RIGID):
            m = inverses[s, k]
            value = m[0] * q0 + m[1] * q1 + m[2] * q2 + m[3] * q3 + m[4] * q4 + m[5] * q5
            z[s, k] = -value
            total += q[s, k] * value
    return float(np.float64(total))


@leaf_kernel
def _dot(a: F64, b: F64) -> float:
    total = 0.0
    for s in range(len(a)):
        for k in range(_RIGID):
            total += a[s, k] * b[s, k]
    return float(np.float64(total))


@leaf_kernel
def _add(factor: float, a: F64, out: F64) -> None:
    """out += factor a, without an array in between."""
    for s in range(len(a)):
        for k in range(_RIGID):
            out[s, k] += factor * a[s, k]


@leaf_kernel
def _scale_and_add(factor: float, a: F64, out: F64) -> None:
    """out = factor out + a."""
    for s in range(len(a)):
        for k in range(_RIGID):
            out[s, k] = factor * out[s, k] + a[s, k]


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
    inverses = np.zeros((n, _RIGID, _RIGID))
    z, p, y = np.zeros((n, _RIGID)), np.zeros((n, _RIGID)), np.zeros((n, _RIGID))
    none = np.zeros_like(residuals)
    _inverses(
        edges, arms, w, bend, S.copy(), np.zeros((_RIGID, _RIGID)), np.zeros((2, _RIGID)), inverses
    )
    x[:] = 0.0
    # q is the gradient at x, and z the preconditioned descent.
    q = b.copy()
    _add_edges(edges, arms, w, bend, residuals, x, 1.0, q)
    rho = _precondition(inverses, q, z)
    first = rho
    p[:] = z
    for iteration in range(iterations):
        if not rho > tolerance * first:
            return iteration
        _times(S, edges, arms, w, bend, none, p, y)
        energy = _dot(p, y)
        if not energy > 0.0:
            return iteration
        alpha = rho / energy
        _add(alpha, p, x)
        _add(alpha, y, q)
        before = rho
        rho = _precondition(inverses, q, z)
        _scale_and_add(rho / before, z, p)
    return iterations


@leaf_kernel
def step_together(
    poses: F64, active: U8, level: Level, templates: Templates, limits: Limits, work: Workspace,
    S: F64, b: F64, inner: F64, follow: F64, x: F64, damping: F64, travelled: F64, costs: F64,
    sums: F64, matrices: F64,
) -> None:  # fmt: skip
    """Take the steps of all surfels whose images agree; the others' damping grows."""
    n = motion.parameter_count(limits.model)
    step, half = work.step, float((work.grid.side - 2) // 2)
    for s in range(len(poses)):
        copy(x[s], step[:_RIGID])
        for k in range(n - _RIGID):
            step[_RIGID + k] = -inner[s, k]
            for c in range(_RIGID):
                step[_RIGID + k] -= follow[s, k, c] * x[s, c]
        candidate = work.pose
        motion.apply_step(poses[s], step, limits.model, candidate)
        candidate[GAIN] = max(candidate[GAIN], _MIN_GAIN)
        if not active[s]:
            copy(candidate, poses[s])
            continue
        images, mean = templates.images[s], templates.means[s]
        cost, _ = evaluate(candidate, level, images, mean, limits, work, work.next_sums)
        expected = 0.0
        for r in range(_RIGID):
            expected += 2.0 * b[s, r] * x[s, r]
            for c in range(_RIGID):
                expected += x[s, r] * S[s, r, c] * x[s, c]
        bound = costs[s] * (1.0 + limits.slack) + 2.0 * max(expected, 0.0)
        if cost >= 0.0 and cost < bound:
            if homography(poses[s], level, work.before):
                travelled[s] += patch_step_px(work.before, work.h, half)
            copy(candidate, poses[s])
            costs[s] = cost
            copy(work.next_sums, sums[s])
            if travelled[s] > limits.stale_px:
                curvature(candidate, images, mean, limits, work, matrices[s])
                travelled[s] = 0.0
            damping[s] /= limits.lambda_down
        else:
            damping[s] *= 10.0 * limits.lambda_up

"""Joint steps of all surfels of a deformation graph (not in the paper).

A surfel's depth comes from its size in the image alone, so a patch that stretches by one per cent
is wrong by one per cent of its depth.  Over a surface such strains average out.  So two surfels
that were born as neighbours, d apart, cost omega_E w times

    |X_j - X_i - (R_i + R_j) d / 2|^2 / (strain |d|)^2 + |(R_j - R_i) d|^2 / (bend |d|)^2

in addition to Eq. 11: as rigid as possible, at the middle of the pair, where curvature cancels.  w
releases torn pairs.  Each surfel keeps its own six parameters and its own image; F, gain and bias
are eliminated from its block (Schur complement), and preconditioned conjugate gradients move all.
An invisible surfel follows its neighbours.
"""

from typing import NamedTuple

import numpy as np

from pliant.algorithms.arrays import F64, I64, U8, BoolArray
from pliant.algorithms.surfels import deformation_models as models
from pliant.algorithms.surfels.brightness import add_light, measured_brightness
from pliant.algorithms.surfels.deformation_graph import Edges, edge_rows, pull_of_edges, torn_off
from pliant.algorithms.surfels.deformation_models import RIGID
from pliant.algorithms.surfels.parameters import SurfelParameters
from pliant.algorithms.surfels.patch_sampling import GAIN, Level, X
from pliant.algorithms.surfels.surfel_alignment import (
    MIN_GAIN,
    OMEGA_E,
    Equilibrium,
    Evaluation,
    Limits,
    Matcher,
    Workspace,
    add_isometry,
    align_all,
    copy,
    evaluate_all,
    factorise,
    invert,
    patch_steps_px,
    solve,
)
from pliant.compiler.kernel import fast_kernel

STEPS, COARSE_STEPS = 3, 2
"""Steps of all surfels, at full size and at half the size."""
_GRAPH_LAMBDA_UP = 10.0
"""A surfel whose image does not follow the others is left behind sooner than an independent one."""
_CG_ITERATIONS = 60
_CG_TOLERANCE = 1e-4
_BRIGHTNESS_SIGMA = 0.01
"""Relative standard deviation of what brightness tells: 5 and 95 % of the surfels of a rendered
scene with tilting sheets are off by 0.02."""
_MADE_UP_BEND = 1.0 / 3.0
"""Share of ``bend`` on made-up depth: there a turn is a distortion in the image, which neighbours
share."""
_DIAGONAL = np.arange(RIGID)
_OTHERS = models.MOST_PARAMETERS - RIGID


class Eliminated(NamedTuple):
    """N surfels' own systems S x = -b of their motion, with F, gain and bias eliminated.

    The eliminated parameters step by -inner - follow x.
    """

    S: F64  # (N, 6, 6)
    b: F64  # (N, 6)
    inner: F64  # (N, 5)
    follow: F64  # (N, 5, 6)


class Springs(NamedTuple):
    """E pairs of surfels at their poses: what both residuals cost, and how they change."""

    ends: I64  # (E, 2) rows of the two surfels
    arms: F64  # (E, 2, 3) R_i d and R_j d, metres
    pull: F64  # (E,) weight of the first residual, DN^2 / m^2
    bend: F64  # (E,) weight of the second
    residuals: F64  # (E, 2, 3) metres


def eliminate_all(poses: F64, active: U8, matcher: Matcher, sums: F64, matrices: F64) -> Eliminated:
    """The systems of active surfels from their sums and matrices; zeros for the others."""
    n = len(poses)
    out = Eliminated(
        np.zeros((n, RIGID, RIGID)), np.zeros((n, RIGID)), np.zeros((n, _OTHERS)),
        np.zeros((n, _OTHERS, RIGID)),
    )  # fmt: skip
    level, _, limits, work = matcher
    _eliminate_all(poses, active, level, limits, work, sums, matrices, out)
    return out


@fast_kernel
def _eliminate_all(
    poses: F64, active: U8, level: Level, limits: Limits, work: Workspace, sums: F64, matrices: F64,
    out: Eliminated,
) -> None:  # fmt: skip
    model = limits.model
    n = models.parameter_count(model)
    m = n - RIGID
    H, g, block, rhs, x = work.H, work.g, work.photometric, work.step, work.inverse[m:]
    for s in range(len(poses)):
        if not active[s]:
            continue
        S, b, inner, follow = out.S[s], out.b[s], out.inner[s], out.follow[s]
        models.mixing(poses[s], level, model, work.mix)
        models.hessian(matrices[s], 1.0, work.mix, n, work.product, H)
        models.gradient(sums[s], work.mix, n, g)
        add_isometry(poses[s], limits, 1.0, H, g)
        for r in range(m):
            for c in range(m):
                block[r, c] = H[RIGID + r, RIGID + c]
        if not factorise(block, m, m, 0.0, work.L, work.inverse):
            continue
        for k in range(m):
            rhs[k] = -g[RIGID + k]
        solve(work.L, work.inverse, m, rhs, x)
        for k in range(m):
            inner[k] = x[k]
        for c in range(RIGID):
            for k in range(m):
                rhs[k] = -H[RIGID + k, c]
            solve(work.L, work.inverse, m, rhs, x)
            for k in range(m):
                follow[k, c] = x[k]
        for r in range(RIGID):
            total = g[r]
            for k in range(m):
                total -= H[r, RIGID + k] * inner[k]
            b[r] = total
            for c in range(RIGID):
                total = H[r, c]
                for k in range(m):
                    total -= H[r, RIGID + k] * follow[k, c]
                S[r, c] = total


@fast_kernel
def _add_edges(springs: Springs, x: F64, sign: float, y: F64) -> None:
    """y += sign J' W (J x + residuals), J being the derivative of all pairs' residuals.

    omega x v is the change of an arm v under a turn omega, and u . (omega x v) = omega . (v x u).
    """
    ends, arms, w, bend, residuals = springs
    for e in range(len(ends)):
        i, j = ends[e, 0], ends[e, 1]
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


@fast_kernel
def _times(S: F64, relaxed: Springs, x: F64, y: F64) -> None:
    """y = (S + J' W J) x.  relaxed: their residuals are all zero."""
    for s in range(len(x)):
        x0, x1, x2, x3, x4, x5 = x[s, 0], x[s, 1], x[s, 2], x[s, 3], x[s, 4], x[s, 5]
        for k in range(RIGID):
            m = S[s, k]
            y[s, k] = m[0] * x0 + m[1] * x1 + m[2] * x2 + m[3] * x3 + m[4] * x4 + m[5] * x5
    _add_edges(relaxed, x, 1.0, y)


@fast_kernel
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


@fast_kernel
def _inverses(springs: Springs, blocks: F64, L: F64, scale: F64, out: F64) -> None:
    """Inverse of each surfel's own block with its pairs.  blocks: (N, 6, 6) S, overwritten.

    L: (6, 6), scale: (2, 6), scratch.  out: (N, 6, 6).
    """
    ends, arms, w, bend, _ = springs
    for e in range(len(ends)):
        i, j = ends[e, 0], ends[e, 1]
        _add_block(arms[e, 0], w[e], bend[e], -1.0, blocks[i])
        _add_block(arms[e, 1], w[e], bend[e], 1.0, blocks[j])
    n = blocks.shape[1]
    for s in range(len(blocks)):
        if factorise(blocks[s], n, n, 0.0, L, scale[0]):
            invert(L, scale[0], n, scale[1], out[s])


@fast_kernel
def _precondition(inverses: F64, q: F64, z: F64) -> float:
    """z = -M^-1 q; returns -q . z."""
    total = 0.0
    for s in range(len(q)):
        q0, q1, q2, q3, q4, q5 = q[s, 0], q[s, 1], q[s, 2], q[s, 3], q[s, 4], q[s, 5]
        for k in range(RIGID):
            m = inverses[s, k]
            value = m[0] * q0 + m[1] * q1 + m[2] * q2 + m[3] * q3 + m[4] * q4 + m[5] * q5
            z[s, k] = -value
            total += q[s, k] * value
    return float(np.float64(total))


@fast_kernel
def _dot(a: F64, b: F64) -> float:
    total = 0.0
    for s in range(len(a)):
        for k in range(RIGID):
            total += a[s, k] * b[s, k]
    return float(np.float64(total))


@fast_kernel
def _add(factor: float, a: F64, out: F64) -> None:
    """out += factor a, without an array in between."""
    for s in range(len(a)):
        for k in range(RIGID):
            out[s, k] += factor * a[s, k]


@fast_kernel
def _scale_and_add(factor: float, a: F64, out: F64) -> None:
    """out = factor out + a."""
    for s in range(len(a)):
        for k in range(RIGID):
            out[s, k] = factor * out[s, k] + a[s, k]


@fast_kernel
def solve_graph(S: F64, b: F64, springs: Springs, iterations: int, tolerance: float, x: F64) -> int:
    """Conjugate gradients, preconditioned by each surfel's own block.

    S: (N, 6, 6), b: (N, 6) from ``eliminate_all``, damped.  tolerance: of the squared residual,
    relative.  x: (N, 6) receives the steps.  Returns iterations.
    """
    n = len(S)
    inverses = np.zeros((n, RIGID, RIGID))
    z, p, y = np.zeros((n, RIGID)), np.zeros((n, RIGID)), np.zeros((n, RIGID))
    ends, arms, pull, bend, residuals = springs
    relaxed = Springs(ends, arms, pull, bend, np.zeros(residuals.shape))
    _inverses(springs, S.copy(), np.zeros((RIGID, RIGID)), np.zeros((2, RIGID)), inverses)
    x[:] = 0.0
    # q is the gradient at x, and z the preconditioned descent.
    q = b.copy()
    _add_edges(springs, x, 1.0, q)
    rho = _precondition(inverses, q, z)
    first = rho
    p[:] = z
    for iteration in range(iterations):
        if not rho > tolerance * first:
            return iteration
        _times(S, relaxed, p, y)
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


def align_graph(
    poses: F64, start: F64, active: U8, edges: Edges, equilibrium: Equilibrium, matcher: Matcher,
    parameters: SurfelParameters, steps: int, births: F64 | None = None,
) -> BoolArray:  # fmt: skip
    """Move all surfels as one, from the present poses, which are overwritten.

    poses: (N, POSE_FLOATS) in the camera's frame.  start: the same of the last frame: from there
    what is not seen is carried.  active: (N,) 1 where the image may be looked at.  equilibrium: of
    Eq. 20 for a camera that is held; the pairs know nothing of it, since a motion of all leaves
    them as they are.  births: (N,) brightness at birth (``brightness``), where the lamp is at the
    camera.  Returns (N,) which surfels have torn themselves off their neighbours: their
    pose is that of ``start``.
    """
    p, n = parameters, len(poses)
    templates, limits = matcher.templates, matcher.limits
    now = evaluate_all(poses, active, matcher, zncc=True, matrices=True)
    found = (now.costs >= 0.0) & (now.seen >= p.min_visible * templates.counts)
    found &= now.zncc >= p.min_zncc
    poses[~found] = start[~found]
    seen, x = found.astype(np.uint8), np.zeros((n, RIGID))
    damping, travelled = np.full(n, limits.start_lambda), np.zeros(n)
    bend = p.bend * (_MADE_UP_BEND if p.depth_from == "flat" else 1.0)
    # What is not seen goes where its neighbours do.
    weights = equilibrium.weights * found
    for _ in range(steps):
        own = eliminate_all(poses, seen, matcher, now.sums, now.matrices)
        w, residuals, arms = edge_rows(poses, edges)
        damped, descent = own.S.copy(), own.b.copy()
        damped[:, _DIAGONAL, _DIAGONAL] *= 1.0 + damping[:, None]
        damped[:, _DIAGONAL[:3], _DIAGONAL[:3]] += weights[:, None]
        descent[:, :3] += weights[:, None] * (poses[:, X : X + 3] - equilibrium.points)
        if births is not None:
            residuals_dn = now.sums[:, -1] / np.maximum(now.seen, 1.0)
            measured = measured_brightness(
                poses, births, templates.means, residuals_dn, found & (p.light == "camera")
            )
            weight = OMEGA_E / _BRIGHTNESS_SIGMA**2
            add_light(poses, measured, weight, seen, damped, descent)
        pull = OMEGA_E * w / edges.lengths**2
        springs = Springs(edges.ends, arms, pull / p.strain**2, pull / bend**2, residuals)
        solve_graph(damped, descent, springs, _CG_ITERATIONS, _CG_TOLERANCE, x)
        if not np.isfinite(x).all():
            break
        bound_turns(x)
        _step(poses, x, own, seen, now, damping, travelled, matcher)
    torn = torn_off(edges, edge_rows(poses, edges)[0], n)
    poses[torn] = start[torn]
    return torn


def bound_turns(x: F64) -> None:
    """Bound the turns in steps (N, 6) by half a turn, as the series of ``apply_step`` needs it.

    A surfel that only torn pairs carry hardly knows its turn.  Beyond half a turn the series would
    change the lengths of its tangents, and more so with every frame.
    """
    turns = np.linalg.norm(x[:, 3:], axis=1)
    rows = turns > np.pi
    x[rows, 3:] *= (np.pi / turns[rows])[:, None]


def _step(
    poses: F64, x: F64, own: Eliminated, seen: U8, now: Evaluation, damping: F64, travelled: F64,
    matcher: Matcher,
) -> None:  # fmt: skip
    """Take the steps of all surfels whose images agree; the others' damping grows.

    seen: (N,) 0 where a surfel is carried whatever the image shows.  now: of the present poses,
    updated with them.
    """
    limits, candidates = matcher.limits, poses.copy()
    _step_all(poses, x, own, limits.model, matcher.work.step, candidates)
    new = evaluate_all(candidates, seen, matcher)
    expected = np.einsum("nr,nr->n", x, 2.0 * own.b + np.einsum("nrc,nc->nr", own.S, x))
    bound = now.costs * (1.0 + limits.slack) + 2.0 * np.maximum(expected, 0.0)
    looked_at: BoolArray = seen > 0
    better = looked_at & (new.costs >= 0.0) & (new.costs < bound)
    moved = np.zeros(len(poses))
    patch_steps_px(now.homographies, new.homographies, 0.5 * (matcher.level.side - 1), moved)
    travelled[better] += moved[better]
    taken = better | ~looked_at
    poses[taken] = candidates[taken]
    for old, value in zip(now[:4], new[:4], strict=True):
        old[better] = value[better]
    stale = better & (travelled > limits.stale_px)
    if stale.any():
        again = evaluate_all(poses, stale.astype(np.uint8), matcher, matrices=True)
        now.matrices[stale] = again.matrices[stale]
        travelled[stale] = 0.0
    damping[better] /= limits.lambda_down
    damping[looked_at & ~better] *= _GRAPH_LAMBDA_UP * limits.lambda_up


@fast_kernel
def _step_all(poses: F64, x: F64, own: Eliminated, model: int, step: F64, candidates: F64) -> None:
    others = models.parameter_count(model) - RIGID
    for s in range(len(poses)):
        copy(x[s], step[:RIGID])
        for k in range(others):
            step[RIGID + k] = -own.inner[s, k]
            for c in range(RIGID):
                step[RIGID + k] -= own.follow[s, k, c] * x[s, c]
        models.apply_step(poses[s], step, model, candidates[s])
        candidates[s, GAIN] = max(candidates[s, GAIN], MIN_GAIN)


def relocate(poses: F64, wanted: U8, edges: Edges, matcher: Matcher, strain: float) -> None:
    """Align surfels alone at full size if the image did not show them at the expected position.

    ``align_graph`` uses the image only where it already fits.  A surfel that the coarse scales left
    a pixel or two off, as with fine texture, would follow its neighbours from frame to frame
    without its image.  So it is aligned alone, from the position of its neighbours, and tied to it
    as firmly as they hold it: Eq. 21 with that position as the equilibrium.

    poses: (N, POSE_FLOATS) in the camera's frame; those that are wanted are overwritten.  wanted:
    (N,) 1 or 0.  strain: of the pairs, relative.
    """
    pulls = pull_of_edges(edges, len(poses), OMEGA_E, strain)
    carried = Equilibrium(np.ascontiguousarray(poses[:, X : X + 3]), pulls)
    align_all(poses, wanted, carried, matcher)

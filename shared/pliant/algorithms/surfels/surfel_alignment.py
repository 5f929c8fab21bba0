"""Levenberg-Marquardt of independent surfels in one level of the pyramid (DSDT, section IV).

With a moving camera this is Eq. 21 for a fixed camera, with the regulariser of Eq. 20,

    omega_E (X - X^0)' Sigma^-1 (X - X^0),

whose Sigma is the same in all directions.
"""

import math
from typing import NamedTuple

import numpy as np

from pliant.algorithms.arrays import F32, F64, U8
from pliant.algorithms.surfels import deformation_models as models
from pliant.algorithms.surfels.patch_sampling import (
    BIAS,
    GAIN,
    POSE_FLOATS,
    F,
    Grid,
    Level,
    X,
    homography,
    make_grid,
    sample_patch,
)
from pliant.algorithms.surfels.photometric import (
    FEATURES,
    Comparison,
    correlation,
    feature_matrix,
    first_inner,
    make_features,
    photometric_sums,
)
from pliant.compiler.kernel import fast_kernel

MIN_GAIN = 0.05
_N = models.MOST_PARAMETERS
_RIDGE = 1e-9
"""Share of the diagonal that is added to it, and the least of it that a pivot keeps: directions in
which nothing is seen must not blow up."""
OMEGA_E = 25.0
"""omega_E, DN^2: the variance of a residual that is as likely as a surfel one Sigma off its
equilibrium."""


class Templates(NamedTuple):
    """What is kept of N surfels for one level."""

    images: F32  # (N, 3, padded(side)) grey levels without their mean, derivatives along i and j
    means: F64  # (N,) grey levels
    counts: F64  # (N,) samples that the template has
    matrices: F64  # (N, FEATURES, FEATURES) sums of products of the template's features
    usable: U8  # (N,) 1 where enough of the patch lay in the image at birth


class Limits(NamedTuple):
    """Settings of the minimisation, as kernels read them.  DSDT leaves all of them open."""

    model: int
    blend: float  # share of the frame in the derivatives of the patch
    highlight: float  # DN
    iterations: int  # most steps
    min_step_px: float  # a step that moves no corner farther ends a level
    saturation: float = 40.0  # a residual beyond this counts as this, DN
    damped_steps: int = 1  # how many accepted steps of a level are the first ones
    first_lambda: float = 1.0  # lambda is at least this in the first steps
    start_lambda: float = 0.01
    lambda_up: float = 4.0  # multiplies lambda after a failure
    lambda_down: float = 10.0  # divides lambda after a success
    stale_px: float = 0.3  # how far a surfel moves until its matrix is made anew
    # Share by which a success may raise the cost: noise that interpolation smooths more or less
    # moves the cost by as much.
    slack: float = 0.1
    isometry: float = 0.0  # 1 / sigma^2 of the soft isometry; 0: none


class Workspace(NamedTuple):
    """Scratch of one thread."""

    grid: Grid  # one sample wider than a texture on each side
    features: F32
    h: F64
    before: F64  # (9,) homography of the last accepted pose
    sums: F64
    next_sums: F64
    matrix: F64
    mix: F64
    product: F64
    H: F64
    photometric: F64  # H without the equilibrium
    L: F64
    inverse: F64  # of the pivots of L
    g: F64
    step: F64
    pose: F64


def make_workspace(side: int) -> Workspace:
    """Scratch for patches of side x side samples."""
    return Workspace(
        make_grid(side + 2), make_features(side),
        np.zeros(9), np.zeros(9), np.zeros(FEATURES), np.zeros(FEATURES),
        np.zeros((FEATURES, FEATURES)), np.zeros((FEATURES, _N)), np.zeros((FEATURES, _N)),
        np.zeros((_N, _N)), np.zeros((_N, _N)), np.zeros((_N, _N)),
        np.zeros(_N), np.zeros(_N), np.zeros(_N),
        np.zeros(POSE_FLOATS),
    )  # fmt: skip


class Matcher(NamedTuple):
    """Aligns surfels in one level of an image."""

    level: Level
    templates: Templates
    limits: Limits
    work: Workspace


class Equilibrium(NamedTuple):
    """Equilibria of N surfels in a camera's frame (Eq. 20)."""

    points: F64  # (N, 3) metres, camera's frame
    weights: F64  # (N,) omega_E / sigma^2, DN^2 / m^2


def no_equilibrium(count: int) -> Equilibrium:
    """Return no equilibria, for a static camera."""
    return Equilibrium(np.zeros((count, 3)), np.zeros(count))


class Evaluation(NamedTuple):
    """The photometric state of N surfels at their poses.  The last two may be empty."""

    costs: F64  # (N,) DN^2, photometric; negative behind the camera, or not requested
    seen: F64  # (N,) samples that are not saturated
    homographies: F64  # (N, 9)
    sums: F64  # (N, FEATURES)
    zncc: F64  # (N,) or (0,)
    matrices: F64  # (N, FEATURES, FEATURES) or (0, ...)


@fast_kernel(inline=True)
def copy(source: F64, target: F64) -> None:
    """Fill ``target``.  An assignment to a slice makes a copy in between."""
    for k in range(len(target)):
        target[k] = source[k]


@fast_kernel
def factorise(H: F64, n: int, damped: int, damping: float, L: F64, inverse: F64) -> bool:
    """L D L' = H + lambda D_w, with ones on the diagonal of L.

    D_w is the diagonal of the first ``damped`` rows of H: the ellipsoidal trust region bounds the
    models.  Gain and bias stand last; the cost is quadratic in them and they need no bound.
    L: below the diagonal; what stands above is scratch.  inverse: (n,) receives that of D.
    Returns False where H is not a number.
    """
    for k in range(n):
        s = H[k, k] * (1.0 + (damping if k < damped else 0.0))
        if not (s >= 0.0 and s < 1e300):
            return False
        inverse[k] = s
    for row in range(n):
        s = inverse[row]
        total = s * (1.0 + _RIDGE)
        for column in range(row):
            v = H[row, column]
            for k in range(column):
                v -= L[k, row] * L[column, k]
            L[column, row] = v
            L[row, column] = v * inverse[column]
            total -= v * L[row, column]
        # An undetermined parameter is unchanged: its gradient is zero.
        inverse[row] = 1.0 / max(total, _RIDGE * s) if s > 1e-30 else 0.0
    return True


@fast_kernel
def solve(L: F64, inverse: F64, n: int, g: F64, step: F64) -> None:
    """step = -(L D L')^-1 g, for a factor from ``factorise``."""
    for row in range(n):
        total = -g[row]
        for k in range(row):
            total -= L[row, k] * step[k]
        step[row] = total
    for row in range(n - 1, -1, -1):
        total = step[row] * inverse[row]
        for k in range(row + 1, n):
            total -= L[k, row] * step[k]
        step[row] = total


@fast_kernel
def invert(L: F64, inverse: F64, n: int, scratch: F64, out: F64) -> None:
    """out = (L D L')^-1, the inverse of the factored matrix: many solves are products."""
    for column in range(n):
        for row in range(n):
            scratch[row] = -1.0 if row == column else 0.0
        solve(L, inverse, n, scratch, out[column])


@fast_kernel
def inverse_diagonal(L: F64, inverse: F64, n: int, count: int, scratch: F64) -> float:
    """Trace of the leading ``count`` x ``count`` block of the inverse of the factored matrix."""
    trace = 0.0
    for column in range(count):
        # L y = e_column, starting at that row: above it y is zero.
        for row in range(column, n):
            value = 1.0 if row == column else 0.0
            for k in range(column, row):
                value -= L[row, k] * scratch[k]
            scratch[row] = value
            trace += value * value * inverse[row]
    return float(np.float64(trace))


@fast_kernel(inline=True)
def evaluate(
    pose: F64, level: Level, images: F32, mean: float, limits: Limits, work: Workspace, sums: F64
) -> tuple[float, int]:
    """Saturated photometric cost of Eq. 5 at a pose, and how many samples are not saturated.

    sums: (FEATURES,), filled.  A negative cost: not in front of the camera.
    """
    if not homography(pose, level, work.h):
        return -1.0, 0
    if not sample_patch(work.h, level, work.grid, limits.highlight):
        return -1.0, 0
    return photometric_sums(images, work.grid, _comparison(pose, mean, limits), sums)


@fast_kernel(inline=True)
def _comparison(pose: F64, mean: float, limits: Limits) -> Comparison:
    return Comparison(mean, pose[GAIN], pose[BIAS], limits.saturation, limits.blend)


@fast_kernel(inline=True)
def curvature(
    pose: F64, images: F32, mean: float, limits: Limits, work: Workspace, matrix: F64
) -> None:
    """Fill the (FEATURES, FEATURES) matrix of the pose that was evaluated last."""
    feature_matrix(images, work.grid, _comparison(pose, mean, limits), work.features, matrix)


@fast_kernel
def _evaluate_all(poses: F64, active: U8, matcher: Matcher, out: Evaluation) -> None:
    level, templates, limits, work = matcher
    for s in range(len(poses)):
        if not active[s] or not templates.usable[s]:
            continue
        images, mean = templates.images[s], templates.means[s]
        cost, seen = evaluate(poses[s], level, images, mean, limits, work, out.sums[s])
        out.costs[s], out.seen[s] = cost, seen
        copy(work.h, out.homographies[s])
        if cost < 0.0:
            continue
        if len(out.zncc) > 0:
            at = first_inner(work.grid)
            out.zncc[s], _ = correlation(images[0], work.grid.values[at : at + images.shape[1]])
        if len(out.matrices) > 0:
            curvature(poses[s], images, mean, limits, work, out.matrices[s])


def evaluate_all(
    poses: F64, active: U8, matcher: Matcher, *, zncc: bool = False, matrices: bool = False
) -> Evaluation:
    """Evaluate active surfels with a template of this level at their poses."""
    n = len(poses)
    k, m = n if zncc else 0, n if matrices else 0
    out = Evaluation(
        np.full(n, -1.0), np.zeros(n), np.zeros((n, 9)), np.zeros((n, FEATURES)),
        np.zeros(k), np.zeros((m, FEATURES, FEATURES)),
    )  # fmt: skip
    _evaluate_all(poses, active, matcher, out)
    return out


@fast_kernel
def patch_steps_px(before: F64, after: F64, half: float, out: F64) -> None:
    """``_patch_step_px`` of N patches.  before, after: (N, 9).  out: (N,)."""
    for s in range(len(before)):
        out[s] = _patch_step_px(before[s], after[s], half)


@fast_kernel(inline=True)
def _patch_step_px(before: F64, after: F64, half: float) -> float:
    """How far the farthest of the centre and four corners of a patch moves, pixels."""
    farthest = 0.0
    for corner in range(5):
        i = 0.0 if corner == 4 else (half if corner & 1 else -half)
        j = 0.0 if corner == 4 else (half if corner & 2 else -half)
        wb = 1.0 / (before[6] * i + before[7] * j + before[8])
        wa = 1.0 / (after[6] * i + after[7] * j + after[8])
        for row in range(0, 6, 3):
            b = (before[row] * i + before[row + 1] * j + before[row + 2]) * wb
            a = (after[row] * i + after[row + 1] * j + after[row + 2]) * wa
            farthest = max(farthest, abs(a - b))
    return farthest


@fast_kernel
def align_all(poses: F64, active: U8, equilibrium: Equilibrium, matcher: Matcher) -> None:
    """Minimise Eq. 11, or 21 for a camera that is held, for every active surfel by itself.

    poses: (N, POSE_FLOATS) in the camera's frame, overwritten; that of a surfel which is not in
    front of the camera, or has no template of this level, stays.
    """
    level, templates, limits, work = matcher
    before, candidate = work.before, work.pose
    n = models.parameter_count(limits.model)
    half = float((work.grid.side - 2) // 2)
    for s in range(len(poses)):
        if not active[s] or not templates.usable[s]:
            continue
        pose, images, mean = poses[s], templates.images[s], templates.means[s]
        point, weight = equilibrium.points[s], equilibrium.weights[s]
        sums, next_sums = work.sums, work.next_sums
        cost, _ = evaluate(pose, level, images, mean, limits, work, sums)
        if cost < 0.0:
            continue
        copy(work.h, before)
        cost += _rest_cost(pose, point, weight) + isometry_cost(pose, limits)
        # Samples that the template lacks cost the same everywhere; slack is a share of the others.
        lacking = limits.saturation * limits.saturation * (images.shape[1] - templates.counts[s])
        damping, accepted, fresh, travelled = limits.start_lambda, 0, True, 1e9
        for _ in range(limits.iterations):
            if fresh:
                models.mixing(pose, level, limits.model, work.mix)
                models.gradient(sums, work.mix, n, work.g)
                if travelled > limits.stale_px:
                    curvature(pose, images, mean, limits, work, work.matrix)
                    models.hessian(work.matrix, 1.0, work.mix, n, work.product, work.photometric)
                    travelled = 0.0
                for row in range(n):
                    copy(work.photometric[row], work.H[row])
                _add_rest(pose, point, weight, work.H, work.g)
                add_isometry(pose, limits, 1.0, work.H, work.g)
            bound = max(damping, limits.first_lambda) if accepted < limits.damped_steps else damping
            if not factorise(work.H, n, n - 2, bound, work.L, work.inverse):
                break
            solve(work.L, work.inverse, n, work.g, work.step)
            models.apply_step(pose, work.step, limits.model, candidate)
            candidate[GAIN] = max(candidate[GAIN], MIN_GAIN)
            next_cost, _ = evaluate(candidate, level, images, mean, limits, work, next_sums)
            front = next_cost >= 0.0
            next_cost += _rest_cost(candidate, point, weight) + isometry_cost(candidate, limits)
            moved = _patch_step_px(before, work.h, half) if front else 1e9
            if front and next_cost < cost + limits.slack * (cost - lacking):
                copy(candidate, pose)
                copy(work.h, before)
                cost, fresh, accepted = next_cost, True, accepted + 1
                travelled += moved
                sums, next_sums = next_sums, sums
                damping = bound / limits.lambda_down
            else:
                fresh = False
                damping = bound * limits.lambda_up
            # While damping limits steps, a short step does not mean convergence.
            if moved * (1.0 + bound) < limits.min_step_px or moved < 0.1 * limits.min_step_px:
                break


@fast_kernel
def _rest_cost(pose: F64, point: F64, weight: float) -> float:
    """omega_E times Eq. 20, DN^2.  point: (3,)."""
    x, y, z = pose[X] - point[0], pose[X + 1] - point[1], pose[X + 2] - point[2]
    return float(weight * (x * x + y * y + z * z))


@fast_kernel
def _add_rest(pose: F64, point: F64, weight: float, H: F64, g: F64) -> None:
    """Add its matrix and half of its gradient; the position is the first three parameters."""
    for k in range(3):
        g[k] += weight * (pose[X + k] - point[k])
        H[k, k] += weight


@fast_kernel
def isometry_cost(pose: F64, limits: Limits) -> float:
    """Soft isometry, DN^2: 4 omega_E ((1 + f)^(1/4) - 1), f = |F - 1|^2 / sigma^2.

    Unlike that of Eq. 12-13 it gives way beyond sigma, to what really stretches.
    """
    f = _squared_strain(pose) * limits.isometry
    return float(4.0 * OMEGA_E * (math.sqrt(math.sqrt(1.0 + f)) - 1.0))


@fast_kernel(inline=True)
def _squared_strain(pose: F64) -> float:
    a, b, c = pose[F] - 1.0, pose[F + 1], pose[F + 2] - 1.0
    return float(a * a + 2.0 * b * b + c * c)


@fast_kernel
def add_isometry(pose: F64, limits: Limits, weight: float, H: F64, g: F64) -> None:
    """Add ``weight`` times its matrix and half of its gradient, for the general model."""
    if limits.model != models.GENERAL or limits.isometry == 0.0:
        return
    f = 1.0 + _squared_strain(pose) * limits.isometry
    w = weight * OMEGA_E * limits.isometry * math.sqrt(math.sqrt(f)) / f
    for k, share, rest in ((0, w, 1.0), (1, 2.0 * w, 0.0), (2, w, 1.0)):
        g[models.RIGID + k] += share * (pose[F + k] - rest)
        H[models.RIGID + k, models.RIGID + k] += share

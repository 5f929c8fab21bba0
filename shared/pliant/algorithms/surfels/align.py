"""Levenberg-Marquardt of one surfel in one level of the pyramid (DSDT, section IV)."""

from typing import NamedTuple

import numpy as np

from pliant.algorithms.arrays import F32, F64, U8
from pliant.algorithms.kernel import inner_kernel, leaf_kernel
from pliant.algorithms.surfels import motion
from pliant.algorithms.surfels.damped import copy, factorise, solve
from pliant.algorithms.surfels.rest import Rest, add_rest, rest_cost
from pliant.algorithms.surfels.sampling import (
    BIAS,
    GAIN,
    POSE_FLOATS,
    Grid,
    Level,
    homography,
    make_grid,
    sample_patch,
)
from pliant.algorithms.surfels.sums import FEATURES, feature_matrix, make_features, photometric_sums

_N = motion.MOST_PARAMETERS
_MIN_GAIN = 0.05


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


@inner_kernel
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
    return photometric_sums(
        images, work.grid, mean, pose[GAIN], pose[BIAS], limits.saturation, limits.blend, sums
    )


@inner_kernel
def curvature(
    pose: F64, images: F32, mean: float, limits: Limits, work: Workspace, matrix: F64
) -> None:
    """Fill the (FEATURES, FEATURES) matrix of the pose that was evaluated last."""
    feature_matrix(
        images, work.grid, mean, pose[GAIN], pose[BIAS], limits.saturation, limits.blend,
        work.features, matrix,
    )  # fmt: skip


@leaf_kernel
def patch_step_px(before: F64, after: F64, half: float) -> float:
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


@inner_kernel
def align(
    pose: F64, level: Level, images: F32, mean: float, count: float, point: F64, weight: F64,
    limits: Limits, work: Workspace,
) -> tuple[float, int]:  # fmt: skip
    """Minimise Eq. 11 from ``pose``, which is overwritten.

    point, weight: of its ``Rest``; with it this is Eq. 21 for a camera that is held.  Returns
    (cost DN^2, evaluations); the cost is negative where the patch is not in front of the camera,
    and the pose is then unchanged.
    """
    sums, next_sums = work.sums, work.next_sums
    before, candidate = work.before, work.pose
    n = motion.parameter_count(limits.model)
    half = float((work.grid.side - 2) // 2)
    cost, _ = evaluate(pose, level, images, mean, limits, work, sums)
    if cost < 0.0:
        return cost, 1
    copy(work.h, before)
    cost += rest_cost(pose, point, weight)
    # Samples that the template lacks cost the same everywhere; slack is a share of the others.
    lacking = limits.saturation * limits.saturation * (images.shape[1] - count)
    damping, accepted, fresh, travelled = limits.start_lambda, 0, True, 1e9
    for iteration in range(limits.iterations):
        if fresh:
            motion.mixing(pose, level, limits.model, work.mix)
            motion.gradient(sums, work.mix, n, work.g)
            if travelled > limits.stale_px:
                curvature(pose, images, mean, limits, work, work.matrix)
                motion.hessian(work.matrix, 1.0, work.mix, n, work.product, work.photometric)
                travelled = 0.0
            for row in range(n):
                copy(work.photometric[row], work.H[row])
            add_rest(pose, point, weight, work.H, work.g)
        bound = max(damping, limits.first_lambda) if accepted < limits.damped_steps else damping
        if not factorise(work.H, n, n - 2, bound, work.L, work.inverse):
            return cost, iteration + 1
        solve(work.L, work.inverse, n, work.g, work.step)
        motion.apply_step(pose, work.step, limits.model, candidate)
        candidate[GAIN] = max(candidate[GAIN], _MIN_GAIN)
        next_cost, _ = evaluate(candidate, level, images, mean, limits, work, next_sums)
        front = next_cost >= 0.0
        next_cost += rest_cost(candidate, point, weight)
        moved = patch_step_px(before, work.h, half) if front else 1e9
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
        # While steps are held short by policy, a short step does not mean that the end is near.
        if moved * (1.0 + bound) < limits.min_step_px or moved < 0.1 * limits.min_step_px:
            return cost, iteration + 2
    return cost, limits.iterations + 1


@leaf_kernel
def align_all(
    poses: F64, active: U8, rest: Rest, level: Level, templates: Templates, limits: Limits,
    work: Workspace,
) -> int:  # fmt: skip
    """``align`` for every active surfel with a template of this level; returns evaluations."""
    evaluations = 0
    for k in range(len(poses)):
        if active[k] and templates.usable[k]:
            _, used = align(
                poses[k], level, templates.images[k], templates.means[k], templates.counts[k],
                rest.points[k], rest.weights[k], limits, work,
            )  # fmt: skip
            evaluations += used
    return evaluations

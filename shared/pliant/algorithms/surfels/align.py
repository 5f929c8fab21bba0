"""Levenberg-Marquardt of one surfel in one level of the pyramid (DSDT, section IV)."""

from typing import NamedTuple

import numpy as np

from pliant.algorithms.arrays import F32, F64, U8
from pliant.algorithms.kernel import fast_kernel
from pliant.algorithms.surfels import motion
from pliant.algorithms.surfels.damped import factorise, solve
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
from pliant.algorithms.surfels.sums import FEATURES, frame_sums, make_features, template_sums

_N = motion.MOST_PARAMETERS
_MIN_GAIN = 0.05


class Templates(NamedTuple):
    """What is kept of N surfels for one level."""

    images: F32  # (N, 3, n) grey levels without their mean, derivatives along i and j
    means: F64  # (N,) grey levels
    counts: F64  # (N,) samples that the template has
    matrices: F64  # (N, FEATURES, FEATURES) sums of products of the template's features
    usable: U8  # (N,) 1 where enough of the patch lay in the image at birth


class Limits(NamedTuple):
    """Parameters of the minimisation, as kernels read them."""

    model: int
    by_template: bool
    tau: float
    highlight: float
    omega_i: float
    damped_steps: int
    first_lambda: float
    start_lambda: float
    lambda_up: float
    lambda_down: float
    iterations: int
    min_step_px: float
    slack: float  # share by which a success may raise the cost


class Workspace(NamedTuple):
    """Scratch of one thread."""

    grid: Grid
    features: F32
    h: F64
    sums: F64
    next_sums: F64
    matrix: F64
    next_matrix: F64
    mix: F64
    product: F64
    H: F64
    L: F64
    scale: F64
    g: F64
    step: F64
    pose: F64


def make_workspace(side: int, *, by_template: bool) -> Workspace:
    """Scratch for patches of side x side samples."""
    return Workspace(
        make_grid(side if by_template else side + 2),
        make_features(side),
        np.zeros(9), np.zeros(FEATURES), np.zeros(FEATURES),
        np.zeros((FEATURES, FEATURES)), np.zeros((FEATURES, FEATURES)),
        np.zeros((FEATURES, _N)), np.zeros((FEATURES, _N)),
        np.zeros((_N, _N)), np.zeros((_N, _N)), np.zeros(_N), np.zeros(_N), np.zeros(_N),
        np.zeros(POSE_FLOATS),
    )  # fmt: skip


@fast_kernel
def evaluate(
    pose: F64, level: Level, images: F32, mean: float, limits: Limits, work: Workspace,
    sums: F64, matrix: F64,
) -> tuple[float, int]:  # fmt: skip
    """Saturated photometric cost of Eq. 5 at a pose and its sums; negative cost: not in front."""
    if not homography(pose, level, work.h):
        return -1.0, 0
    if not sample_patch(work.h, level, work.grid, limits.highlight):
        return -1.0, 0
    if limits.by_template:
        return template_sums(images, work.grid, mean, pose[GAIN], pose[BIAS], limits.tau, sums)
    return frame_sums(
        images, work.grid, mean, pose[GAIN], pose[BIAS], limits.tau, work.features, matrix, sums
    )


@fast_kernel
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


@fast_kernel
def align(
    pose: F64, level: Level, images: F32, mean: float, count: float, template_matrix: F64,
    limits: Limits, work: Workspace,
) -> tuple[float, int]:  # fmt: skip
    """Minimise Eq. 11 (hard) or Eq. 13 (soft) from ``pose``, which is overwritten.

    Returns (cost DN^2, evaluations); the cost is negative where the patch is not in front of the
    camera, and the pose is then unchanged.
    """
    sums, next_sums = work.sums, work.next_sums
    matrix, next_matrix = work.matrix, work.next_matrix
    before, candidate = np.empty(9), work.pose
    n = motion.parameter_count(limits.model)
    half = float(limits_side(images) // 2)
    cost, _ = evaluate(pose, level, images, mean, limits, work, sums, matrix)
    if cost < 0.0:
        return cost, 1
    before[:] = work.h
    cost += limits.omega_i * motion.deformation_energy(pose)
    # Samples that the template lacks cost the same everywhere; slack is a share of the others.
    lacking = limits.tau * limits.tau * (images.shape[1] - count)
    damping, accepted, fresh = limits.start_lambda, 0, True
    for iteration in range(limits.iterations):
        if fresh:
            motion.mixing(pose, level, limits.model, limits.by_template, work.mix)
            used = template_matrix if limits.by_template else matrix
            motion.normal_equations(used, sums, work.mix, n, work.product, work.H, work.g)
            motion.add_deformation_energy(pose, limits.model, limits.omega_i, work.H, work.g)
        bound = max(damping, limits.first_lambda) if accepted < limits.damped_steps else damping
        if not factorise(work.H, n, n - 2, bound, work.L, work.scale):
            return cost, iteration + 1
        solve(work.L, work.scale, n, work.g, work.step)
        motion.apply_step(pose, work.step, limits.model, candidate)
        candidate[GAIN] = max(candidate[GAIN], _MIN_GAIN)
        next_cost, _ = evaluate(
            candidate, level, images, mean, limits, work, next_sums, next_matrix
        )
        front = next_cost >= 0.0
        next_cost += limits.omega_i * motion.deformation_energy(candidate)
        moved = patch_step_px(before, work.h, half) if front else 1e9
        if front and next_cost < cost + limits.slack * (cost - lacking):
            pose[:POSE_FLOATS] = candidate
            before[:] = work.h
            cost, fresh, accepted = next_cost, True, accepted + 1
            sums, next_sums = next_sums, sums
            matrix, next_matrix = next_matrix, matrix
            damping = bound / limits.lambda_down
        else:
            fresh = False
            damping = bound * limits.lambda_up
        # While steps are held short by policy, a short step does not mean that the end is near.
        if moved * (1.0 + bound) < limits.min_step_px or moved < 0.1 * limits.min_step_px:
            return cost, iteration + 2
    return cost, limits.iterations + 1


@fast_kernel
def limits_side(images: F32) -> int:
    """Side of a square patch whose images are (3, side * side)."""
    return int(np.sqrt(np.float64(images.shape[1])) + 0.5)


@fast_kernel
def align_all(
    poses: F64, active: U8, level: Level, templates: Templates, limits: Limits, work: Workspace
) -> int:
    """``align`` for every active surfel with a template of this level; returns evaluations."""
    evaluations = 0
    for k in range(len(poses)):
        if active[k] and templates.usable[k]:
            _, used = align(
                poses[k], level, templates.images[k], templates.means[k], templates.counts[k],
                templates.matrices[k], limits, work,
            )  # fmt: skip
            evaluations += used
    return evaluations

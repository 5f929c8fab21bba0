"""The camera before surfels (DSDT, section V).

Everything is in the camera's frame.  What an image sees of a surfel is its motion relative to the
camera alone (the floating map ambiguity, Eq. 16-19), so that Eq. 20 alone ties the camera to the
surfels.  Camera and surfels take turns: surfels by Eq. 21 before a camera that is held, then the
camera that fits them, which needs no image.
"""

from dataclasses import dataclass

import numpy as np

from pliant.algorithms.arrays import F64, U8, BoolArray
from pliant.algorithms.geometry import hat, so3_exp
from pliant.algorithms.surfels import joint_kernels as kernels
from pliant.algorithms.surfels.align import Limits, Templates, Workspace
from pliant.algorithms.surfels.rest import Rest, no_rest, turn_rest
from pliant.algorithms.surfels.sampling import BIAS, GAIN, Level, X
from pliant.algorithms.surfels.sums import FEATURES
from pliant.algorithms.surfels.table import move_poses

_RIDGE = 1e-9
_REGISTER_STEPS = 3
_REGISTERED = 1e-6
"""A step that turns the camera, and moves it relative to the depth, by less than this is the last:
a thousandth of a pixel."""


@dataclass(frozen=True)
class Equilibrium:
    """Where N surfels rest and how far they may stray (Eq. 20)."""

    positions: F64  # (N, 3) metres, world
    weights: F64  # (N, 3, 3) omega_E Sigma^-1, world axes, DN^2 / m^2

    def seen_from(self, T_camera_world: F64) -> Rest:
        """Positions and weights in the axes of a camera."""
        seen = no_rest(len(self.positions))
        turn_rest(T_camera_world, self.positions, self.weights, seen.points, seen.weights)
        return seen


def se3_exp(zeta: F64) -> F64:
    """(4, 4) motion of a (6,) twist (rho, phi), Eq. 22."""
    T = np.eye(4)
    rho, phi = zeta[:3], zeta[3:]
    angle = float(np.linalg.norm(phi))
    T[:3, :3] = so3_exp(phi)
    W = hat(phi)
    small = angle < 1e-4
    b = 0.5 if small else (1.0 - np.cos(angle)) / angle**2
    c = 1.0 / 6.0 if small else (angle - np.sin(angle)) / angle**3
    T[:3, 3] = rho + b * (W @ rho) + c * (W @ W @ rho)
    return T


def align_rigid(
    poses: F64, active: U8, T_camera_world: F64, level: Level, templates: Templates,
    limits: Limits, work: Workspace,
) -> F64:  # fmt: skip
    """Move the camera alone: all surfels stand still in the world.

    The matrices are the textures' own, which shape the steps and not where they end.
    poses: (N, POSE_FLOATS) in the camera's frame, overwritten.  Returns T_camera_world.
    """
    n = len(poses)
    usable, costs, sums = active.copy(), np.zeros(n), np.zeros((n, FEATURES))
    kernels.evaluate_all(poses, usable, level, templates, limits, work, costs, sums)
    light = np.zeros((n, 2, 7))
    M, v = np.zeros((6, 6)), np.zeros(6)
    damping, accepted = limits.start_lambda, 0
    for _ in range(limits.iterations):
        rows: BoolArray = usable > 0
        if not rows.any():
            break
        kernels.rigid_system(poses, usable, level, work, sums, templates.matrices, light, M, v)
        bound = max(damping, limits.first_lambda) if accepted < limits.damped_steps else damping
        zeta = _solve(M, v, bound)
        motion, before = se3_exp(zeta), poses.copy()
        moved = move_poses(poses, motion)
        moved[:, GAIN] = np.maximum(moved[:, GAIN] + light[:, 0] @ np.r_[1.0, zeta], 0.05)
        moved[:, BIAS] += light[:, 1] @ np.r_[1.0, zeta]
        still_usable, new_costs, new_sums = usable.copy(), np.zeros(n), np.zeros((n, FEATURES))
        kernels.evaluate_all(
            moved, still_usable, level, templates, limits, work, new_costs, new_sums
        )
        both: BoolArray = still_usable > 0
        if 2 * np.count_nonzero(both) > np.count_nonzero(rows) and (
            new_costs[both].sum() < costs[both].sum() * (1.0 + limits.slack)
        ):
            poses[:] = np.where(active[:, None] > 0, moved, move_poses(poses, motion))
            T_camera_world = motion @ T_camera_world
            costs, sums, usable = new_costs, new_sums, still_usable
            accepted += 1
            damping = bound / limits.lambda_down
        else:
            damping = bound * limits.lambda_up
        moved_px = level.fx * float(np.median(_shift(before[rows], moved[rows])))
        if moved_px * (1.0 + bound) < limits.min_step_px:
            break
    return T_camera_world


def _shift(before: F64, after: F64) -> F64:
    """(N,) how far surfels move in the image, in units of the focal length."""
    a, b = before[:, X : X + 3], after[:, X : X + 3]
    return np.linalg.norm(b[:, :2] / b[:, 2:] - a[:, :2] / a[:, 2:], axis=1)


def register(poses: F64, active: U8, T_camera_world: F64, equilibrium: Equilibrium) -> F64:
    """Minimise Eq. 21 over the camera alone, which only Eq. 20 knows of; no image is needed.

    poses: (N, POSE_FLOATS) in the camera's frame: the images have found them, and they stay.
    Returns T_camera_world.
    """
    M, v = np.zeros((6, 6)), np.zeros(6)
    for _ in range(_REGISTER_STEPS):
        points, weights = equilibrium.seen_from(T_camera_world)
        kernels.register_system(poses, active, points, weights, M, v)
        zeta = _solve(M, v, 0.0)
        T_camera_world = se3_exp(zeta) @ T_camera_world
        depth = float(np.abs(points[:, 2]).mean())
        if np.abs(zeta[:3]).max() < _REGISTERED * depth and np.abs(zeta[3:]).max() < _REGISTERED:
            break
    return T_camera_world


def _solve(M: F64, v: F64, damping: float) -> F64:
    """Damped step, scaled by the diagonal (Eq. 14-15); zero where nothing is known."""
    diagonal: F64 = np.diag(M) * (1.0 + damping)
    finite = np.isfinite(M).all() and np.isfinite(v).all()
    if not finite or not bool(np.min(diagonal) > 0.0):
        return np.zeros(6)
    scale: F64 = np.sqrt(1.0 / diagonal)
    scaled = M * scale[:, None] * scale[None, :]
    np.fill_diagonal(scaled, 1.0 + _RIDGE)
    return scale * np.linalg.solve(scaled, scale * v)

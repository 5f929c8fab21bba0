"""The pose of a camera relative to surfels (DSDT, section V).

Everything is in the camera's frame.  An image shows only a surfel's motion relative to the camera
(the floating map ambiguity, Eq. 16-19), so Eq. 20 alone relates the camera to the surfels.  Camera
and surfels are solved alternately: surfels by Eq. 21 with a fixed camera, then the camera that fits
them, which needs no image.
"""

import numpy as np

from pliant.algorithms.arrays import F64, U8, BoolArray
from pliant.algorithms.geometry import hat, so3_exp, transform
from pliant.algorithms.surfels.deformation_models import ISOMETRIC, move_poses
from pliant.algorithms.surfels.graph_alignment import eliminate_all
from pliant.algorithms.surfels.patch_sampling import BIAS, GAIN, X
from pliant.algorithms.surfels.surfel_alignment import (
    MIN_GAIN,
    Matcher,
    evaluate_all,
)

_RIGID_SURFELS = 150
"""Number of surfels that determine the camera before each surfel is aligned."""
_RIDGE = 1e-9
_FIT_STEPS = 3
_FITTED = 1e-6
"""The last step rotates and moves the camera, relative to the depth, by less than this: a
thousandth of a pixel.
"""


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


def spread(rows: U8) -> U8:
    """Select ``_RIGID_SURFELS`` or up to twice as many rows, evenly, of those that are 1."""
    chosen = np.flatnonzero(rows)
    out = np.zeros_like(rows)
    out[chosen[:: max(1, len(chosen) // _RIGID_SURFELS)]] = 1
    return out


def align_rigid(poses: F64, active: U8, T_camera_world: F64, matcher: Matcher) -> F64:
    """Move the camera alone: all surfels are static in the world.

    The matrices are those of the textures, which affect the steps and not the result.
    poses: (N, POSE_FLOATS) in the camera's frame, overwritten.  Returns T_camera_world.
    """
    level, limits = matcher.level, matcher.limits
    now = evaluate_all(poses, active, matcher)
    damping, accepted = limits.start_lambda, 0
    for _ in range(limits.iterations):
        usable: BoolArray = now.costs >= 0.0
        if not usable.any():
            break
        rows = usable.astype(np.uint8)
        M, v, light = rigid_system(poses, rows, matcher, now.sums)
        bound = max(damping, limits.first_lambda) if accepted < limits.damped_steps else damping
        zeta = _solve(M, v, bound)
        motion, before = se3_exp(zeta), poses.copy()
        moved = move_poses(poses, motion)
        light_steps = light @ np.r_[1.0, zeta]
        moved[:, GAIN] = np.maximum(moved[:, GAIN] + light_steps[:, 0], MIN_GAIN)
        moved[:, BIAS] += light_steps[:, 1]
        new = evaluate_all(moved, rows, matcher)
        both: BoolArray = new.costs >= 0.0
        if 2 * np.count_nonzero(both) > np.count_nonzero(usable) and (
            new.costs[both].sum() < now.costs[both].sum() * (1.0 + limits.slack)
        ):
            poses[:] = np.where(active[:, None] > 0, moved, move_poses(poses, motion))
            T_camera_world = motion @ T_camera_world
            now = new
            accepted += 1
            damping = bound / limits.lambda_down
        else:
            damping = bound * limits.lambda_up
        moved_px = level.fx * float(np.median(_shift(before[usable], moved[usable])))
        if moved_px * (1.0 + bound) < limits.min_step_px:
            break
    return T_camera_world


def rigid_system(poses: F64, active: U8, matcher: Matcher, sums: F64) -> tuple[F64, F64, F64]:
    """M (6, 6) and v (6,) of a rigid scene, M zeta = v, and (N, 2, 7) gain and bias from (1, zeta).

    A surfel that is static in the world steps by its own adjoint times zeta.
    """
    rigid = matcher._replace(limits=matcher.limits._replace(model=ISOMETRIC))
    own = eliminate_all(poses, active, rigid, sums, matcher.templates.matrices)
    adjoints = np.tile(np.eye(6), (len(poses), 1, 1))
    adjoints[:, :3, 3:] = -hat(poses[:, X : X + 3])
    M = np.einsum("nji,njk,nkl->il", adjoints, own.S, adjoints)
    v = -np.einsum("nji,nj->i", adjoints, own.b)
    follow = np.einsum("nkj,nji->nki", own.follow[:, :2], adjoints)
    return M, v, -np.concatenate([own.inner[:, :2, None], follow], axis=2)


def _shift(before: F64, after: F64) -> F64:
    """(N,) how far surfels move in the image, in units of the focal length."""
    a, b = before[:, X : X + 3], after[:, X : X + 3]
    return np.linalg.norm(b[:, :2] / b[:, 2:] - a[:, :2] / a[:, 2:], axis=1)


def fit_camera(
    poses: F64, active: U8, T_camera_world: F64, equilibria: F64, weights: F64,
    *, across: bool = False,
) -> F64:  # fmt: skip
    """Minimise Eq. 21 over the camera alone, which depends only on Eq. 20; no image is needed.

    across: only errors across the rays count.  An image hardly determines depths: where all surfels
    tilt a little, a camera that takes their depths for measured turns about the surface.
    poses: (N, POSE_FLOATS) in the camera's frame, fixed at their aligned values.
    equilibria: (N, 3) metres, world.  weights: (N,) DN^2 / m^2.  Returns T_camera_world.
    """
    w, x = weights * active, poses[:, X : X + 3]
    kept = np.tile(np.eye(3), (len(x), 1, 1))
    if across:
        rays = x / np.maximum(np.linalg.norm(x, axis=1), 1e-300)[:, None]
        kept -= rays[:, :, None] * rays[:, None, :]
    weighted = w[:, None, None] * kept
    for _ in range(_FIT_STEPS):
        points = transform(T_camera_world, equilibria)
        # A step rotates Sigma's axes, too: about the surfel's position, not its equilibrium.
        G = np.concatenate([np.tile(np.eye(3), (len(x), 1, 1)), -hat(x)], axis=2)
        WG = weighted @ G
        M = np.einsum("nki,nkj->ij", G, WG)
        zeta = _solve(M, np.einsum("nki,nk->i", WG, x - points), 0.0)
        T_camera_world = se3_exp(zeta) @ T_camera_world
        depth = float(np.abs(points[:, 2]).mean())
        if np.abs(zeta[:3]).max() < _FITTED * depth and np.abs(zeta[3:]).max() < _FITTED:
            break
    return T_camera_world


def _solve(M: F64, v: F64, damping: float) -> F64:
    """Return the damped step, scaled by the diagonal (Eq. 14-15); zero where undetermined."""
    diagonal: F64 = np.diag(M) * (1.0 + damping)
    finite = np.isfinite(M).all() and np.isfinite(v).all()
    if not finite or not bool(np.min(diagonal) > 0.0):
        return np.zeros(6)
    scale: F64 = np.sqrt(1.0 / diagonal)
    scaled = M * scale[:, None] * scale[None, :]
    np.fill_diagonal(scaled, 1.0 + _RIDGE)
    return scale * np.linalg.solve(scaled, scale * v)

"""Surfels and a camera that moves: Eq. 16-22."""

import numpy as np
import pytest
from surfel_scene import EVERYWHERE, STEP_S, board_renderer, film, level_of, slanted_surfels, waves
from surfel_scene import motion as rigid_motion

from pliant.algorithms.arrays import F64
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import inverse, so3_log, transform
from pliant.algorithms.surfels import deformation_models as motion
from pliant.algorithms.surfels.births import make_templates
from pliant.algorithms.surfels.camera_alignment import fit_camera, rigid_system, se3_exp
from pliant.algorithms.surfels.deformation_models import move_poses
from pliant.algorithms.surfels.parameters import SurfelParameters
from pliant.algorithms.surfels.patch_sampling import X
from pliant.algorithms.surfels.surfel_alignment import (
    Equilibrium,
    Matcher,
    align_all,
    evaluate_all,
    make_workspace,
)
from pliant.algorithms.surfels.surfel_frame import SurfelState
from pliant.algorithms.surfels.surfel_tracker import SurfelTracker
from pliant.rendering.film import RenderedFrame

SMALL = SurfelParameters(max_surfels=80, levels=2, camera="moving")


@pytest.fixture(scope="module")
def board() -> tuple[list[RenderedFrame], PinholeCamera, list[F64]]:
    """A camera that moves before a rigid board, noise-free."""
    motions = [
        rigid_motion((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
        rigid_motion((0.003, -0.008, 0.01), (0.006, 0.004, -0.01)),
        rigid_motion((0.01, -0.016, 0.02), (0.015, 0.004, -0.03)),
        rigid_motion((0.01, -0.03, 0.03), (0.025, 0.01, -0.05)),
    ]
    renderer, camera = board_renderer(motions)
    return film(renderer, 4), camera, motions


@pytest.mark.parametrize("neighbours", [8, 0])
def test_camera_before_a_rigid_scene(
    board: tuple[list[RenderedFrame], PinholeCamera, list[F64]], neighbours: int
) -> None:
    frames, camera, motions = board
    tracker = SurfelTracker(SMALL.model_copy(update={"neighbours": neighbours}))
    first = tracker.start(frames[0].image, frames[0].depth_m, camera)
    for frame, T in zip(frames[1:], motions[1:], strict=True):
        result = tracker.track(frame.image, STEP_S)
        off = inverse(T) @ result.T_world_camera
        assert np.linalg.norm(off[:3, 3]) < 0.002
        assert np.linalg.norm(so3_log(off[None, :3, :3])[0]) < 0.002
        good = result.state == SurfelState.TRACKED
        assert good.mean() > 0.95
        error = np.linalg.norm(result.positions - first.positions, axis=1)[good]
        # Neighbours hold the depth of each other.
        assert np.median(error) < (0.0007 if neighbours else 0.003)


def test_static_camera_mode_keeps_the_camera(
    board: tuple[list[RenderedFrame], PinholeCamera, list[F64]],
) -> None:
    frames, camera, _ = board
    tracker = SurfelTracker(SMALL.model_copy(update={"camera": "static"}))
    tracker.start(frames[0].image, frames[0].depth_m, camera)
    np.testing.assert_array_equal(tracker.track(frames[1].image, STEP_S).T_world_camera, np.eye(4))


def problem(seed: int = 0, count: int = 12) -> dict[str, object]:
    """Surfels a little off their pose in a smooth image, with all sums."""
    parameters = SurfelParameters(camera="moving")
    tracker = SurfelTracker(parameters)
    level, poses = level_of(waves()), slanted_surfels(count, seed)
    templates = make_templates(poses, level, 1e6, 0.5, EVERYWHERE, np.inf)
    rng = np.random.default_rng(seed)
    poses[:, X : X + 3] += 0.002 * rng.standard_normal((count, 3))
    work, limits = make_workspace(23), tracker._frames.limits(fine=True)
    active = np.ones(count, np.uint8)
    matcher = Matcher(level, templates, limits, work)
    found = evaluate_all(poses, active, matcher)
    assert (found.costs >= 0.0).all()
    return {
        "poses": poses, "active": active, "level": level, "work": work, "sums": found.sums,
        "matrices": templates.matrices, "matcher": matcher,
    }  # fmt: skip


def blocks(p: dict, k: int) -> tuple[F64, F64]:
    """The 8x8 normal equations of one surfel."""
    mix, H, g = np.zeros((10, 11)), np.zeros((11, 11)), np.zeros(11)
    motion.mixing(p["poses"][k], p["level"], 0, mix)
    motion.hessian(p["matrices"][k], 1.0, mix, 8, np.zeros((10, 11)), H)
    motion.gradient(p["sums"][k], mix, 8, g)
    return H[:8, :8], g[:8]


def adjoint(x: F64) -> F64:
    out = np.eye(6)
    out[:3, 3:] = [[0.0, x[2], -x[1]], [-x[2], 0.0, x[0]], [x[1], -x[0], 0.0]]
    return out


def test_adjoint_by_finite_differences() -> None:
    pose = slanted_surfels(seed=3)[:1]
    A, out = adjoint(pose[0, X : X + 3]), np.zeros(14)
    for k in range(6):
        zeta = np.zeros(6)
        zeta[k] = 1e-6
        step = np.zeros(11)
        step[:6] = A @ zeta
        motion.apply_step(pose[0], step, 0, out)
        np.testing.assert_allclose(out[:9], move_poses(pose, se3_exp(zeta))[0, :9], atol=1e-11)


def test_rigid_camera_system_is_the_dense_one() -> None:
    p = problem()
    n = len(p["poses"])
    M, v, light = rigid_system(p["poses"], p["active"], p["matcher"], p["sums"])
    zeta = np.linalg.solve(M, v)
    dense, right = np.zeros((6 + 2 * n, 6 + 2 * n)), np.zeros(6 + 2 * n)
    for k in range(n):
        H, g = blocks(p, k)
        J = np.zeros((8, 6 + 2 * n))
        J[:6, :6] = adjoint(p["poses"][k, X : X + 3])
        J[6:, 6 + 2 * k : 8 + 2 * k] = np.eye(2)
        dense += J.T @ H @ J
        right -= J.T @ g
    x = np.linalg.solve(dense, right)
    np.testing.assert_allclose(zeta, x[:6], rtol=1e-4, atol=1e-6 * np.abs(x[:6]).max())
    np.testing.assert_allclose(light @ np.r_[1.0, zeta], x[6:].reshape(n, 2), rtol=1e-3, atol=1e-5)


def test_an_equilibrium_holds_as_firmly_as_its_weight() -> None:
    """Eq. 21 for a camera that is held: from free to fixed."""
    p = problem()
    n = len(p["poses"])
    points = p["poses"][:, X : X + 3] + (0.02, 0.0, 0.0)
    left = []
    for weight in (0.0, 1e8, 1e14):
        poses = p["poses"].copy()
        rest = Equilibrium(points, np.full(n, weight))
        align_all(poses, p["active"], rest, p["matcher"])
        left.append(float(np.median(np.linalg.norm(poses[:, X : X + 3] - points, axis=1))))
    assert left[0] > 0.01
    assert left[0] > left[1] > left[2]
    assert left[2] < 1e-5


def test_camera_that_fits_the_surfels() -> None:
    """The camera's turn: surfels are where the images have found them."""
    poses, rng = slanted_surfels(12, 4), np.random.default_rng(4)
    T = se3_exp(np.array([0.02, -0.01, 0.03, 0.01, 0.02, -0.03]))
    weights = 1e5 * rng.uniform(0.2, 2.0, 12)
    X0 = move_poses(poses, inverse(T))[:, X : X + 3]
    active = np.ones(12, np.uint8)
    # One that is not followed may be anywhere.
    active[5], X0[5] = 0, 9.0
    np.testing.assert_allclose(fit_camera(poses, active, np.eye(4), X0, weights), T, atol=1e-9)
    # With surfels that have moved it is a minimum of Eq. 20.
    moved = X0 + 0.01 * rng.standard_normal((12, 3))
    found = fit_camera(poses, active, T, moved, weights)

    def cost(camera: F64) -> float:
        off = poses[:, X : X + 3] - transform(camera, moved)
        return float((weights * active * (off**2).sum(axis=1)).sum())

    for k in range(6):
        for sign in (-1.0, 1.0):
            zeta = np.zeros(6)
            zeta[k] = sign * 1e-3
            assert cost(se3_exp(zeta) @ found) > cost(found)


def test_camera_that_fits_across_the_rays() -> None:
    """Depths that no image determines turn the camera, unless only errors across rays count."""
    poses = slanted_surfels(12, 4)
    weights, active = np.full(12, 1e5), np.ones(12, np.uint8)
    X0 = poses[:, X : X + 3].copy()
    # All tilt, along their rays: no pixel changes.
    poses[:, X : X + 3] *= 1.0 + 0.05 * X0[:, :1]
    with_depths = fit_camera(poses, active, np.eye(4), X0, weights)
    assert np.abs(with_depths - np.eye(4)).max() > 1e-3
    across = fit_camera(poses, active, np.eye(4), X0, weights, across=True)
    np.testing.assert_allclose(across, np.eye(4), atol=1e-9)

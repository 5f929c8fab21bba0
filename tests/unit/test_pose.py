"""One pose with fixed points: its equations by finite differences, and priors of it."""

from dataclasses import replace

import numpy as np
import pytest
from bundle_scene import make_scene, move, to_window
from mapping_scene import CAMERA, looking

from pliant.algorithms.geometry import inverse, so3_exp, so3_log, transform
from pliant.algorithms.slam.estimate.dense_layout import BLOCK, Table
from pliant.algorithms.slam.estimate.pose import Correspondences, Spread, refine_pose
from pliant.algorithms.slam.estimate.pose_prior import PosePrior, add_prior
from pliant.algorithms.slam.estimate.problem import BundleParameters
from pliant.algorithms.slam.estimate.projection import Cameras, limits_of, move_camera
from pliant.algorithms.slam.estimate.subspace import solve_subspace
from pliant.algorithms.slam.estimate.subspace_kernels import linearise_camera

PARAMETERS = BundleParameters(kernel_sigma_px=2.0)
TRUE = looking((0.1, -0.2, 0.05), (0.02, -0.03, 0.01))
MEAN = looking((0.15, -0.1, 0.0), (0.06, 0.01, -0.03))
"""Of the priors: elsewhere."""


def view(count=300, noise_px=0.3):
    """Correspondences of the true pose, with uncertain depths."""
    generator = np.random.default_rng(0)
    X = generator.uniform((-2, -2, 3), (2, 2, 8), (count, 3))
    spread = X * generator.uniform(0.0, 0.5, (count, 1))
    px = CAMERA.project(transform(inverse(TRUE), X))
    px += generator.normal(0, noise_px, px.shape)
    return Correspondences(X, px.astype(np.float32), spread=Spread(spread, np.zeros(3)))


def twelve(T_world_camera):
    T = inverse(T_world_camera)
    return np.concatenate([T[:3, :3].reshape(-1), T[:3, 3]])


def moved(pose, step):
    out = np.zeros(12)
    move_camera(pose, step[:6], out)
    return out


def test_the_equations_of_uncertain_depths_are_those_of_finite_differences():
    shared, (X, points_px, _, (spread, _), _) = 0.3, view(BLOCK, noise_px=2.0)
    u, v = np.ascontiguousarray(points_px.T)[:, None]
    table = Table(u, v, np.ones_like(u), np.ones((1, 1), np.uint8))
    pose, normal = twelve(TRUE), np.zeros(36)
    cameras = Cameras(pose[None], CAMERA.intrinsics[None], np.zeros(0)).single()
    depths = (np.ascontiguousarray(spread.T, np.float32),)
    linearise_camera(
        0, cameras, np.ascontiguousarray(X.T, np.float32), table,
        limits_of(PARAMETERS, np.float32), depths, np.float32(shared), normal,
    )  # fmt: skip

    def residuals(step):
        out, points = moved(pose, step), X + (shared + step[6]) * spread
        return points_px - CAMERA.project(points @ out[:9].reshape(3, 3).T + out[9:])

    J = np.stack([(residuals(-1e-6 * e) - residuals(1e-6 * e)) / 2e-6 for e in np.eye(7)], axis=2)
    e = J[:, :, 6]
    W = np.linalg.inv(np.eye(2) + np.einsum("ni,nj->nij", e, e))
    r = residuals(np.zeros(7))
    s = np.einsum("ni,nij,nj->n", r, W, r)
    assert normal[35] == pytest.approx((s / (1 + s / 4.0)).sum(), rel=1e-4)
    k = 1.0 / (1.0 + s / 4.0) ** 2
    H = np.einsum("n,nia,nij,njb->ab", k, J, W, J)
    lower = np.tril_indices(7)
    np.testing.assert_allclose(normal[:28], H[lower], rtol=1e-3, atol=1e-4 * H.max())
    g = np.einsum("n,nia,nij,nj->a", k, J, W, r)
    np.testing.assert_allclose(normal[28:35], g, rtol=2e-3, atol=1e-3 * abs(g).max())


def test_the_equations_of_a_prior_are_those_of_finite_differences():
    A = np.random.default_rng(1).normal(size=(6, 6))
    L, pose = A @ A.T, twelve(TRUE)

    def equations(step):
        normal = np.zeros(36)
        add_prior(moved(pose, step), twelve(MEAN), L, normal)
        return normal

    def difference(step):
        out, mean = moved(pose, step), twelve(MEAN)
        E = out[:9].reshape(3, 3) @ mean[:9].reshape(3, 3).T
        sines = 0.5 * np.array([E[2, 1] - E[1, 2], E[0, 2] - E[2, 0], E[1, 0] - E[0, 1]])
        return np.concatenate([E.T @ out[9:] - mean[9:], sines])

    J = np.stack([(difference(1e-6 * e) - difference(-1e-6 * e)) / 2e-6 for e in np.eye(6)], 1)
    normal, d = equations(np.zeros(6)), difference(np.zeros(6))
    assert normal[35] == pytest.approx(d @ L @ d)
    H = J.T @ L @ J
    np.testing.assert_allclose(normal[:21], H[np.tril_indices(6)], atol=1e-6 * H.max())
    np.testing.assert_allclose(normal[28:34], -J.T @ L @ d, atol=1e-6 * H.max())
    assert not normal[21:28].any()


def test_near_its_mean_a_prior_is_of_the_step_from_it():
    """So the information of an estimate is that of a prior."""
    step, normal = np.array([1e-5, -2e-5, 3e-5, 2e-5, -1e-5, 1e-5]), np.zeros(36)
    L = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    add_prior(moved(twelve(MEAN), step), twelve(MEAN), L, normal)
    assert normal[35] == pytest.approx(step @ L @ step, rel=1e-4)


@pytest.mark.parametrize("spread", [True, False])
def test_a_prior_pulls_as_far_as_it_is_certain(spread):
    seen = view() if spread else view()._replace(spread=None)
    start = looking((0.12, -0.18, 0.03), (0.03, -0.02, 0.0))
    alone = refine_pose(start, seen, CAMERA, PARAMETERS)

    def away(information, pose):
        """How far the estimate is from a pose."""
        prior = PosePrior(MEAN, information)
        found = refine_pose(start, seen._replace(prior=prior), CAMERA, PARAMETERS, iterations=50)
        return np.linalg.norm(inverse(pose) @ found.T_world_camera - np.eye(4))

    factors = (1e-3, 1e-1, 10.0, 1e3)
    distances = [away(factor * alone.information, MEAN) for factor in factors]
    assert (np.diff(distances) < 0.0).all()
    assert away(1e9 * np.eye(6), MEAN) < 1e-4
    assert away(1e-6 * np.eye(6), alone.T_world_camera) < 1e-4
    none = refine_pose(
        start, seen._replace(prior=PosePrior(MEAN, np.zeros((6, 6)))), CAMERA, PARAMETERS
    )
    assert np.array_equal(none.T_world_camera, alone.T_world_camera)
    assert none.cost == alone.cost


def test_a_prior_of_the_rotation_leaves_the_centre_to_the_points():
    information = np.diag([0.0] * 3 + [1e10] * 3)
    turned = TRUE.copy()
    turned[:3, :3] = MEAN[:3, :3]
    X, *_ = seen = view(noise_px=0.0)._replace(spread=None)
    px = CAMERA.project(transform(inverse(turned), X)).astype(np.float32)
    prior = PosePrior(MEAN, information)
    T, *_ = refine_pose(TRUE, seen._replace(points_px=px, prior=prior), CAMERA, PARAMETERS)
    np.testing.assert_allclose(T, turned, atol=1e-4)


def test_a_prior_is_left_out_of_a_pose_that_contradicts_it():
    information = np.diag([0.0] * 3 + [1e4] * 3)  # 10 mrad
    prior = PosePrior(MEAN, information)
    near, far = MEAN.copy(), MEAN.copy()
    near[:3, :3] = MEAN[:3, :3] @ so3_exp(np.array([0.03, 0.0, 0.0]))
    far[:3, :3] = MEAN[:3, :3] @ so3_exp(np.array([0.0, 0.05, 0.0]))
    near[:3, 3] += 10.0  # of which it says nothing
    assert prior.unless_contradicted(near) is prior
    assert not prior.unless_contradicted(far).information.any()


def test_a_fixed_centre_stays_exactly_and_the_rotation_follows_its_prior():
    start = looking((0.1, -0.2, 0.05), (0.0, 0.0, 0.0))
    for information, expected in ((np.zeros((6, 6)), TRUE), (1e12 * np.eye(6), MEAN)):
        prior = PosePrior(MEAN, information).with_fixed_centre()
        T, *_ = refine_pose(start, view()._replace(prior=prior), CAMERA, PARAMETERS)
        assert np.array_equal(T[:3, 3], start[:3, 3])
        assert np.linalg.norm(so3_log(T[:3, :3].T @ expected[:3, :3])) < 1e-3


def test_sweeps_respect_a_prior_of_the_last_camera_as_the_pose_alone_does():
    """With certain landmarks, held by four fixed cameras, both minimise nearly the same cost."""
    scene = make_scene(points=300, noise_px=0.5)
    problem = replace(scene.problem, T_world_camera=scene.T_world_camera)
    problem.fixed_cameras[:-1] = True
    last, sweeps = problem.camera_index == 4, PARAMETERS.model_copy(update={"max_sweeps": 50})
    px = np.full((300, 2), np.nan, np.float32)
    px[problem.point_index[last]] = problem.points_px[last]
    camera = replace(CAMERA, **dict(zip(("fx", "fy", "cx", "cy"), problem.intrinsics[0, :4])))
    seen = Correspondences(scene.points_world, px)
    start = scene.T_world_camera[4]
    mean = move(start, np.array([0.02, -0.03, 0.01, 0.02, -0.01, 0.015]))
    information = refine_pose(start, seen, camera, PARAMETERS).information
    for factor in (0.0, 1.0, 1e4):
        prior = PosePrior(mean, factor * information)
        found = solve_subspace(to_window(problem), sweeps, prior=prior)
        alone = refine_pose(start, seen._replace(prior=prior), camera, PARAMETERS, iterations=50)
        np.testing.assert_allclose(found.T_world_camera[4], alone.T_world_camera, atol=2e-3)
        assert (np.diff(found.costs) <= 1e-5 * found.costs[:-1]).all()
    assert np.linalg.norm(found.T_world_camera[4] - start) > 0.03
    np.testing.assert_allclose(found.T_world_camera[4], mean, atol=1e-3)

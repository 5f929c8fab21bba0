"""Kernels of bundle adjustment against finite differences and plain numpy."""

import numpy as np
import pytest
from bundle_scene import cost, dense_normal_equations, make_scene, move, residuals, to_window

from pliant.algorithms.geometry import inverse
from pliant.algorithms.slam.estimate.dense_layout import BLOCK, build_layout
from pliant.algorithms.slam.estimate.problem import BundleParameters
from pliant.algorithms.slam.estimate.projection import limits_of, move_camera, solve_camera
from pliant.algorithms.slam.estimate.subspace import squared_residuals, total_cost
from pliant.algorithms.slam.estimate.subspace_kernels import linearise_camera, sweep_points

LENSES = [(0.0, 0.0), (-0.2, 0.05)]
LOWER = np.tril_indices(6)


@pytest.mark.parametrize("distortion", LENSES)
@pytest.mark.parametrize("sigma", [0.0, 3.0])
def test_cost_and_residuals_agree_with_numpy(distortion, sigma):
    scene = make_scene(noise_px=0.5, distortion=distortion, visible=0.7)
    problem, parameters = scene.problem, BundleParameters(kernel_sigma_px=sigma)
    layout = build_layout(to_window(problem))
    expected = cost(problem, problem.T_world_camera, problem.points_world, parameters)
    motion = layout.cameras.motion
    assert total_cost(layout, motion, layout.points, parameters) == pytest.approx(expected)
    squared = squared_residuals(layout, motion, layout.points, parameters)
    r = residuals(problem, problem.T_world_camera, problem.points_world)
    found = squared[problem.camera_index, layout.column[problem.point_index]]
    np.testing.assert_allclose(found, (r**2).sum(axis=1), rtol=1e-5)
    assert np.isinf(squared).sum() == squared.size - len(r)


@pytest.mark.parametrize("distortion", LENSES)
def test_camera_blocks_agree_with_finite_differences(distortion):
    problem = make_scene(noise_px=1.0, distortion=distortion, visible=0.8).problem
    parameters = BundleParameters(kernel_sigma_px=8.0)
    layout = build_layout(to_window(problem))
    H, g = dense_normal_equations(problem, parameters)
    for m in range(len(layout.free)):
        out = np.zeros(36)
        linearise_camera(
            m, layout.cameras.single(), layout.points.astype(np.float32), layout.table,
            limits_of(parameters, np.float32), (), np.float32(0.0), out,
        )  # fmt: skip
        block = H[6 * m : 6 * m + 6, 6 * m : 6 * m + 6]
        np.testing.assert_allclose(out[:21], block[LOWER], rtol=1e-3, atol=1e-4 * block.max())
        part = g[6 * m : 6 * m + 6]
        np.testing.assert_allclose(out[28:34], part, rtol=2e-3, atol=1e-3 * abs(part).max())


@pytest.mark.parametrize("distortion", LENSES)
def test_point_sweep_takes_the_newton_step_of_every_point(distortion):
    problem = make_scene(noise_px=0.3, distortion=distortion, disturbance=0.2).problem
    parameters = BundleParameters(kernel_sigma_px=8.0)
    layout = build_layout(to_window(problem))
    H, g = dense_normal_equations(problem, parameters)
    M, N = len(problem.T_world_camera), len(problem.points_world)
    exact = layout.points.copy()
    before, after = sweep_points(
        layout.cameras.single(), layout.points.astype(np.float32), exact, layout.table,
        limits_of(parameters, np.float32), np.float32(0.0),
    )  # fmt: skip
    expected = np.empty((N, 3))
    for n in range(N):
        at = slice(6 * M + 3 * n, 6 * M + 3 * n + 3)
        expected[n] = np.linalg.solve(H[at, at], g[at])
    found = (exact - layout.points)[:, layout.column].T
    np.testing.assert_allclose(found, expected, atol=2e-3 * abs(expected).max())
    assert after < before
    start = cost(problem, problem.T_world_camera, problem.points_world, parameters)
    assert before == pytest.approx(start, rel=1e-4)
    points = problem.points_world + found
    assert after == pytest.approx(
        cost(problem, problem.T_world_camera, points, parameters), rel=1e-3
    )


def test_camera_solve_and_motion_agree_with_numpy():
    rng = np.random.default_rng(3)
    A = rng.normal(size=(9, 6))
    H, g = A.T @ A, rng.normal(size=6)
    step = np.empty(6)
    assert solve_camera(H[LOWER], g, 0.1, step)
    np.testing.assert_allclose(step, np.linalg.solve(H + 0.1 * np.diag(np.diag(H)), g))
    for scale in (1.0, 1e-9):
        T = make_scene().T_world_camera[3]
        T_camera_world = inverse(T)
        camera = np.concatenate([T_camera_world[:3, :3].reshape(-1), T_camera_world[:3, 3]])
        out = np.empty(12)
        move_camera(camera, scale * step, out)
        expected = inverse(move(T, scale * step))
        np.testing.assert_allclose(out[:9].reshape(3, 3), expected[:3, :3], atol=1e-14)
        np.testing.assert_allclose(out[9:], expected[:3, 3], atol=1e-14)


def test_camera_solve_refuses_a_singular_system():
    step = np.ones(6)
    H, g = np.zeros(21), np.zeros(6)
    assert not solve_camera(H, g, 0.1, step)
    assert (step == 0.0).all()
    H[:] = np.nan
    assert not solve_camera(H, g, 0.1, step)


def test_layout_pads_points():
    problem = make_scene(points=BLOCK + 5, visible=0.3).problem
    layout = build_layout(to_window(problem))
    assert layout.table.u.shape == (5, 2 * BLOCK)
    assert (layout.table.w.sum(axis=1) == np.bincount(problem.camera_index)).all()
    k = 17
    m, n = problem.camera_index[k], layout.column[problem.point_index[k]]
    assert (layout.table.u[m, n], layout.table.v[m, n]) == tuple(problem.points_px[k])

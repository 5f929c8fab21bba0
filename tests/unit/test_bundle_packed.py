"""The packed Schur complement against finite differences, plain numpy and the dense path."""

import dataclasses

import numpy as np
import pytest
from bundle_scene import cost, dense_normal_equations, make_scene, residuals
from hypothesis import given, settings
from hypothesis import strategies as st

from pliant.algorithms.bundle import BundleParameters, solve_schur
from pliant.algorithms.bundle.layout import BLOCK, build_layout
from pliant.algorithms.bundle.outer_product import subtract_product
from pliant.algorithms.bundle.packed import PackedSystem, solve_packed
from pliant.algorithms.bundle.packed_layout import build_packed_layout, is_sparse
from pliant.algorithms.bundle.reduced import solve_reduced
from pliant.algorithms.bundle.schur import schur_iterations
from pliant.algorithms.kernel import leaf_kernel

LENSES = [(0.0, 0.0), (-0.2, 0.05)]
TIGHT = BundleParameters(kernel_sigma_px=4.0, min_relative_decrease=1e-12, max_iterations=60)


@leaf_kernel
def subtract_all(S, U):
    for a in range(U.shape[0]):
        for c in range(U.shape[0]):
            subtract_product(S, np.uintp(a * U.shape[0] + c), U, np.uintp(a), np.uintp(c))


def test_outer_products_agree_with_numpy():
    rng = np.random.default_rng(0)
    U, S = rng.normal(size=(4, 18)), rng.normal(size=(16, 36))
    matrices = U.reshape(4, 3, 6)
    expected = S.reshape(4, 4, 6, 6) - np.einsum("akr,cks->acrs", matrices, matrices)
    subtract_all(S, U)
    np.testing.assert_allclose(S.reshape(4, 4, 6, 6), expected, atol=1e-14)


@pytest.mark.parametrize("distortion", LENSES)
@pytest.mark.parametrize("sigma", [0.0, 3.0])
def test_cost_and_residuals_agree_with_numpy(distortion, sigma):
    problem = make_scene(noise_px=0.5, distortion=distortion, visible=0.7).problem
    parameters = BundleParameters(kernel_sigma_px=sigma)
    layout = build_packed_layout(problem)
    system = PackedSystem(layout, parameters)
    state = system.linearise(layout.cameras, layout.points)
    expected = cost(problem, problem.T_world_camera, problem.points_world, parameters)
    assert state.cost == pytest.approx(expected)
    r = residuals(problem, problem.T_world_camera, problem.points_world)
    np.testing.assert_allclose(system.squared_residuals(state), (r**2).sum(axis=1), rtol=1e-5)


@pytest.mark.parametrize("distortion", LENSES)
def test_step_solves_the_whole_system_and_foretells_its_decrease(distortion):
    """Eq. 9 and 10 together are the solution of the damped dense system of Eq. 7."""
    problem = make_scene(points=20, noise_px=1.0, distortion=distortion, visible=0.8).problem
    parameters, damping = BundleParameters(kernel_sigma_px=8.0), 1e-3
    M = len(problem.T_world_camera)
    H, g = dense_normal_equations(problem, parameters)
    damped = H + damping * np.diag(np.diag(H))
    moving = np.arange(len(H)) >= 12
    expected = np.zeros(len(H))
    expected[moving] = np.linalg.solve(damped[np.ix_(moving, moving)], g[moving])
    layout = build_packed_layout(problem)
    system = PackedSystem(layout, parameters)
    start = system.linearise(layout.cameras, layout.points)
    trial = system.step(start, damping)
    assert trial is not None
    change = (trial.points - start.points)[:, layout.column].T
    np.testing.assert_allclose(change.reshape(-1), expected[6 * M :], rtol=1e-3, atol=1e-6)
    translation = expected[: 6 * M].reshape(M, 6)[:, :3]
    turned = trial.cameras[:, :9].reshape(M, 3, 3) @ np.swapaxes(
        start.cameras[:, :9].reshape(M, 3, 3), 1, 2
    )
    old = start.cameras[:, 9:]
    moved = trial.cameras[:, 9:] - np.einsum("mij,mj->mi", turned, old)
    np.testing.assert_allclose(moved, translation, rtol=1e-3, atol=1e-6)
    decrease = g @ expected - 0.5 * expected @ H @ expected
    assert trial.foretold == pytest.approx(decrease, rel=1e-4)


@pytest.mark.parametrize("distortion", LENSES)
def test_packed_and_dense_paths_find_the_same_minimum(distortion):
    problem = make_scene(
        cameras=8, points=300, visible=0.4, noise_px=0.5, distortion=distortion, outliers=0.02
    ).problem
    packed = solve_packed(problem, TIGHT)
    layout = build_layout(problem)
    _, points, costs, _ = schur_iterations(layout, layout.cameras, layout.points, TIGHT)
    assert packed.initial_cost == pytest.approx(costs[0], rel=1e-12)
    assert packed.final_cost == pytest.approx(costs[-1], rel=1e-6)
    dense = points[:, layout.column].T + layout.origin
    np.testing.assert_allclose(packed.points_world, dense, atol=2e-3)


def test_a_repeated_observation_replaces_the_earlier_one():
    problem = make_scene(noise_px=0.5, visible=0.5).problem
    repeated = dataclasses.replace(
        problem,
        camera_index=np.concatenate([problem.camera_index[:5], problem.camera_index]),
        point_index=np.concatenate([problem.point_index[:5], problem.point_index]),
        points_px=np.concatenate([problem.points_px[:5] + np.float32(90.0), problem.points_px]),
    )
    once, twice = solve_packed(problem, TIGHT), solve_packed(repeated, TIGHT)
    assert twice.points_world.tobytes() == once.points_world.tobytes()
    assert (twice.squared_residuals[:5] == once.squared_residuals[:5]).all()
    assert (twice.squared_residuals[5:] == once.squared_residuals).all()


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**31), count=st.integers(0, 400), cameras=st.integers(2, 7))
def test_every_observation_has_a_slot_and_a_place(seed, count, cameras):
    scene = make_scene(cameras=cameras, points=30, seed=seed % 1000).problem
    rng = np.random.default_rng(seed)
    problem = dataclasses.replace(
        scene,
        camera_index=rng.integers(0, cameras, count).astype(np.int32),
        point_index=rng.integers(0, 30, count).astype(np.int32),
        points_px=rng.uniform(0.0, 500.0, (count, 2)).astype(np.float32),
        weights=rng.choice([0.0, 1.0, 2.0], count).astype(np.float32),
    )
    layout = build_packed_layout(problem)
    last = {}
    for k in range(count):
        if problem.weights[k] > 0.0:
            last[problem.camera_index[k], problem.point_index[k]] = k
    used = layout.w > 0.0
    assert used.sum() == len(last)
    found = {}
    for block, i in zip(*np.nonzero(used), strict=True):
        n = int(np.flatnonzero(layout.column == layout.points_seen[block, i])[0])
        found[layout.block_camera[block], n] = (
            layout.u[block, i],
            layout.v[block, i],
            layout.w[block, i],
        )
    assert found == {key: (*problem.points_px[k], problem.weights[k]) for key, k in last.items()}
    for n in range(30):
        c = layout.column[n]
        seen_by = layout.camera[layout.start[c] : layout.stop[c]].tolist()
        assert seen_by == sorted(m for m, point in last if point == n)
    assert layout.w.shape[1] == BLOCK


def test_sparse_problems_take_the_packed_path():
    sparse = make_scene(cameras=12, points=300, visible=0.1, noise_px=0.5).problem
    dense = make_scene(cameras=5, points=100, noise_px=0.5).problem
    assert is_sparse(sparse)
    assert not is_sparse(dense)
    a = solve_packed(sparse, TIGHT)
    assert solve_schur(sparse, TIGHT).points_world.tobytes() == a.points_world.tobytes()


def test_reduced_system_is_solved_or_refused():
    rng = np.random.default_rng(0)
    A = rng.normal(size=(9, 7))
    S, b, d = A.T @ A, rng.normal(size=7), rng.uniform(0.1, 1.0, 7)
    S[3], S[:, 3], b[3] = 0.0, 0.0, 0.0
    full = S + np.diag(np.where(np.arange(7) == 3, 1.0, d))
    found = solve_reduced(np.tril(S), b, d)
    np.testing.assert_allclose(found, np.linalg.solve(full, b))
    assert found is not None
    assert found[3] == 0.0
    assert solve_reduced(-np.eye(4), np.ones(4), np.zeros(4)) is None

"""The Schur complement solver against finite differences and plain numpy."""

import dataclasses

import numpy as np
import pytest
from bundle_scene import cost, dense_normal_equations, make_scene, residuals
from hypothesis import given, settings
from hypothesis import strategies as st

from pliant.algorithms.slam.estimate.dense_layout import BLOCK
from pliant.algorithms.slam.estimate.packed_layout import build_packed_layout
from pliant.algorithms.slam.estimate.problem import BundleParameters
from pliant.algorithms.slam.estimate.reduced import (
    find_pattern,
    solve_reduced,
    subtract_product3,
    subtract_product6,
)
from pliant.algorithms.slam.estimate.schur import SchurSystem, solve_schur
from pliant.compiler.kernel import fast_kernel

LENSES = [(0.0, 0.0), (-0.2, 0.05)]
TIGHT = BundleParameters(kernel_sigma_px=4.0, min_relative_decrease=1e-12, max_iterations=60)


@fast_kernel
def subtract_all3(S, U):
    for a in range(U.shape[0]):
        for c in range(U.shape[0]):
            subtract_product3(S, np.uintp(a * U.shape[0] + c), U, np.uintp(a), np.uintp(c))


@fast_kernel
def subtract_all6(S, U):
    for a in range(U.shape[0]):
        for c in range(U.shape[0]):
            subtract_product6(S, np.uintp(a * U.shape[0] + c), U, np.uintp(a), np.uintp(c))


@pytest.mark.parametrize(("depth", "subtract_all"), [(3, subtract_all3), (6, subtract_all6)])
def test_block_products_agree_with_numpy(depth, subtract_all):
    rng = np.random.default_rng(0)
    U, S = rng.normal(size=(4, 6 * depth)), rng.normal(size=(16, 36))
    matrices = U.reshape(4, depth, 6)
    expected = S.reshape(4, 4, 6, 6) - np.einsum("akr,cks->acrs", matrices, matrices)
    subtract_all(S, U)
    np.testing.assert_allclose(S.reshape(4, 4, 6, 6), expected, atol=1e-14)


@pytest.mark.parametrize("distortion", LENSES)
@pytest.mark.parametrize("sigma", [0.0, 3.0])
def test_cost_and_residuals_agree_with_numpy(distortion, sigma):
    problem = make_scene(noise_px=0.5, distortion=distortion, visible=0.7).problem
    parameters = BundleParameters(kernel_sigma_px=sigma)
    layout = build_packed_layout(problem)
    system = SchurSystem(layout, parameters)
    state = system.start()
    expected = cost(problem, problem.T_world_camera, problem.points_world, parameters)
    assert state.cost == pytest.approx(expected)
    r = residuals(problem, problem.T_world_camera, problem.points_world)
    np.testing.assert_allclose(system.squared_residuals(state), (r**2).sum(axis=1), rtol=1e-5)


@pytest.mark.parametrize("distortion", LENSES)
def test_step_solves_the_whole_system(distortion):
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
    system = SchurSystem(layout, parameters)
    start = system.start()
    trial = system.step(start, damping)
    assert trial is not None
    change = (trial.points - start.points)[:, layout.column].T
    np.testing.assert_allclose(change.reshape(-1), expected[6 * M :], rtol=1e-3, atol=1e-6)
    translation = expected[: 6 * M].reshape(M, 6)[:, :3]
    turned = trial.motion[:, :9].reshape(M, 3, 3) @ np.swapaxes(
        start.motion[:, :9].reshape(M, 3, 3), 1, 2
    )
    old = start.motion[:, 9:]
    moved = trial.motion[:, 9:] - np.einsum("mij,mj->mi", turned, old)
    np.testing.assert_allclose(moved, translation, rtol=1e-3, atol=1e-6)


def test_a_repeated_observation_replaces_the_earlier_one():
    problem = make_scene(noise_px=0.5, visible=0.5).problem
    repeated = dataclasses.replace(
        problem,
        camera_index=np.concatenate([problem.camera_index[:5], problem.camera_index]),
        point_index=np.concatenate([problem.point_index[:5], problem.point_index]),
        points_px=np.concatenate([problem.points_px[:5] + np.float32(90.0), problem.points_px]),
    )
    once, twice = solve_schur(problem, TIGHT), solve_schur(repeated, TIGHT)
    assert twice.points_world.tobytes() == once.points_world.tobytes()
    assert (twice.squared_residuals[:5] == once.squared_residuals[:5]).all()
    assert (twice.squared_residuals[5:] == once.squared_residuals).all()


@settings(max_examples=25)
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
    slots, places = layout.slots, layout.places
    used = slots.w > 0.0
    assert used.sum() == len(last)
    found = {}
    for block, i in zip(*np.nonzero(used), strict=True):
        n = int(np.flatnonzero(layout.column == slots.point[block, i])[0])
        found[slots.camera[block], n] = (
            slots.u[block, i],
            slots.v[block, i],
            slots.w[block, i],
        )
    assert found == {key: (*problem.points_px[k], problem.weights[k]) for key, k in last.items()}
    for n in range(30):
        c = layout.column[n]
        seen_by = places.camera[places.start[c] : places.stop[c]].tolist()
        assert seen_by == sorted(m for m, point in last if point == n)
    assert slots.w.shape[1] == BLOCK


def random_meetings(rng, cameras, share):
    """Cameras that meet their neighbours, and some others at random."""
    apart = np.abs(np.arange(cameras)[:, None] - np.arange(cameras))
    met = np.tril((apart <= 2) | (rng.random((cameras, cameras)) < share))
    return met | met.T


@settings(max_examples=25)
@given(seed=st.integers(0, 2**31), cameras=st.integers(1, 30), share=st.floats(0.0, 0.3))
@pytest.mark.parametrize(("borders", "size"), [(0, 6), (1, 6), (2, 6), (0, 7)])
def test_reduced_system_is_solved_as_numpy_solves_it(borders, size, seed, cameras, share):
    rng = np.random.default_rng(seed)
    met = random_meetings(rng, cameras, share)
    pattern = find_pattern(met, borders=borders)
    N = cameras + borders
    full = np.ones((N, N), bool)
    full[:cameras, :cameras] = met
    A = np.where(
        np.kron(full, np.ones((size, size))) > 0.0, rng.normal(size=(size * N, size * N)), 0.0
    )
    A = A + A.T + 40.0 * N * np.eye(size * N)
    empty = size * int(rng.integers(N)) + 2  # an unknown without observations
    A[empty], A[:, empty] = 0.0, 0.0
    b, damping = rng.normal(size=(N, size)), rng.uniform(0.0, 1.0, (N, size))
    b.reshape(-1)[empty] = 0.0
    position = np.append(pattern.position, cameras + np.arange(borders))
    S = np.zeros((len(pattern.row), size * size))
    moved = np.empty_like(b), np.empty_like(b)
    for i in range(N):
        moved[0][position[i]], moved[1][position[i]] = b[i], damping[i]
        for k in range(N):
            if full[i, k] and position[i] >= position[k]:
                block = A[size * i : size * (i + 1), size * k : size * (k + 1)]
                S[pattern.block[position[i], position[k]]] = block.reshape(-1)
    found = solve_reduced(pattern, S, *moved)
    extra = damping.reshape(-1).copy()
    extra[empty] = 1.0
    expected = np.linalg.solve(A + np.diag(extra), b.reshape(-1)).reshape(N, size)
    assert found is not None
    np.testing.assert_allclose(found[position], expected, rtol=1e-9, atol=1e-12)


def test_a_system_that_is_not_positive_definite_is_refused():
    pattern = find_pattern(np.ones((2, 2), bool), borders=0)
    S = np.zeros((3, 36))
    S[pattern.start[:-1], ::7] = -1.0
    assert solve_reduced(pattern, S, np.ones((2, 6)), np.zeros((2, 6))) is None


def test_a_path_fills_in_no_more_than_it_must():
    """Cameras in a row that meet two neighbours each, and the calibration: no fill at all."""
    apart = np.abs(np.arange(200)[:, None] - np.arange(200))
    pattern = find_pattern(apart <= 2, borders=1)
    assert len(pattern.row) == (200 + 199 + 198) + 201
    loop = (apart <= 2) | (apart >= 198)
    assert len(find_pattern(loop, borders=1).row) < 2 * len(pattern.row)


def test_cameras_that_meet_few_others_take_the_same_step_in_any_order():
    """Sparse elimination in an order of its own is the dense system's solution (Eq. 9)."""
    scene = make_scene(cameras=14, points=60, noise_px=1.0).problem
    rank = np.random.default_rng(2).permutation(14)  # along the path
    near = np.abs(rank[scene.camera_index] - scene.point_index % 12 - 1) <= 1
    problem = dataclasses.replace(
        scene, camera_index=scene.camera_index[near], point_index=scene.point_index[near],
        points_px=scene.points_px[near],
    )  # fmt: skip
    parameters, damping = BundleParameters(kernel_sigma_px=8.0), 1e-3
    H, g = dense_normal_equations(problem, parameters)
    damped = H + damping * np.diag(np.diag(H))
    moving = np.arange(len(H)) >= 12
    expected = np.zeros(len(H))
    expected[moving] = np.linalg.solve(damped[np.ix_(moving, moving)], g[moving])
    layout = build_packed_layout(problem)
    system = SchurSystem(layout, parameters)
    assert (np.diff(system.pattern.position) != 1).any()
    trial = system.step(system.start(), damping)
    assert trial is not None
    change = (trial.points - layout.points)[:, layout.column].T
    np.testing.assert_allclose(change.reshape(-1), expected[6 * 14 :], rtol=2e-3, atol=1e-5)


def test_doubled_steps_settle_in_fewer_iterations_where_the_kernel_is_robust():
    """Where it is not, a step leads to where twice the step leads away from again."""
    problem = make_scene(cameras=6, points=200, noise_px=0.8, visible=0.8).problem
    settled = BundleParameters(kernel_sigma_px=2.0, max_iterations=200, min_relative_decrease=1e-9)
    plain, doubled = solve_schur(problem, settled), solve_schur(problem, settled, doubled=True)
    assert doubled.final_cost <= plain.final_cost * (1.0 + 1e-6)
    assert doubled.iterations <= 0.7 * plain.iterations
    assert (np.diff(doubled.costs) <= 0.0).all()
    squares = settled.model_copy(update={"kernel_sigma_px": 0.0, "max_iterations": 20})
    plain, doubled = solve_schur(problem, squares), solve_schur(problem, squares, doubled=True)
    assert doubled.final_cost == pytest.approx(plain.final_cost, rel=1e-6)

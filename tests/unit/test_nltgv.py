"""NLTGV against linear programming and a plain solver, and what it does to planes and steps."""

import numpy as np
import pytest
from benchmarks.smoothing_scene import NOISE, Scene, make_scene, rmse
from scipy.optimize import linprog

from pliant.algorithms.arrays import F32, F64, I32
from pliant.algorithms.meshing.delaunay import triangulate
from pliant.algorithms.meshing.nltgv import NltgvResult, NltgvStart, carry_duals, smooth
from pliant.algorithms.meshing.nltgv_start import Graph, choose_sides, rings
from pliant.algorithms.meshing.parameters import NltgvParameters

CONVEX = {"edge_sigmas": 0.0, "data_sigmas": 0.0, "reweightings": 1}
EXACT = {"min_change_sigmas": 0.0, "max_iterations": 40_000}


def laplacian(scene: Scene, turns: int) -> F64:
    """Every vertex becomes the mean of its ring and itself, again and again."""
    values = scene.data.astype(np.float64)
    i, j = scene.mesh.edges.T
    count = len(values)
    degree = np.bincount(i, minlength=count) + np.bincount(j, minlength=count)
    for _ in range(turns):
        ring = np.bincount(i, values[j], count) + np.bincount(j, values[i], count)
        values = (values + ring) / (1.0 + degree)
    return values


def small_problem(count: int, seed: int) -> tuple[F32, F32, F32, I32]:
    generator = np.random.default_rng(seed)
    points = generator.uniform(0, 60, (count, 2)).astype(np.float32)
    mesh = triangulate(points)
    points = points[mesh.vertices]
    data = np.where(points[:, 0] > 30, 1.0, 0.5) + 0.002 * points[:, 1]
    data += generator.normal(0.0, 0.02, count)
    data[::7] += 0.4
    sigmas = generator.uniform(0.01, 0.03, count)
    return points, data.astype(np.float32), sigmas.astype(np.float32), mesh.edges


def plain_terms(
    points: F32, sigmas: F32, edges: I32, p: NltgvParameters
) -> tuple[F64, F64, float, float]:
    """Weighted K (3E, 3M) on (inverse depth, slope u, slope v), data weights, both units."""
    rise = (points[edges[:, 1]] - points[edges[:, 0]]).astype(np.float64)
    length = np.hypot(*rise.T)
    unit_px, unit = float(np.median(length)), float(np.median(sigmas))
    rise, length = rise / unit_px, length / unit_px
    M, E = len(points), len(edges)
    K = np.zeros((3 * E, 3 * M))
    for e, (i, j) in enumerate(edges):
        a = 1.0 / max(length[e], 0.2)
        K[e, [i, j]] = -a, a
        for axis in (1, 2):
            K[e, [axis * M + i, axis * M + j]] = -a * rise[e, axis - 1] / 2.0
            row = axis * E + e
            K[row, [axis * M + i, axis * M + j]] = -p.slope_weight, p.slope_weight
    return K, p.data_weight * unit / sigmas.astype(np.float64), unit, unit_px


def plain_energy(x: F64, K: F64, weights: F64, data: F64, bend: F64) -> float:
    off = np.abs(x[: len(data)] - data)
    huber = np.where(off <= bend, off**2 / np.maximum(2.0 * bend, 1e-30), off - bend / 2.0)
    return float(np.abs(K @ x).sum() + (weights * huber).sum())


def state_of(result: NltgvResult, unit: float, unit_px: float) -> F64:
    slopes = result.slopes.astype(np.float64) * unit_px / unit
    return np.concatenate([result.inverse_depths / unit, slopes[:, 0], slopes[:, 1]])


@pytest.mark.parametrize("seed", range(4))
def test_reaches_the_optimum_of_the_linear_program(seed: int) -> None:
    points, data, sigmas, edges = small_problem(30, seed)
    parameters = NltgvParameters(huber_sigmas=0.0, **CONVEX, **EXACT)
    result = smooth(points, data, sigmas, edges, parameters)
    K, weights, unit, unit_px = plain_terms(points, sigmas, edges, parameters)
    z = data / unit
    # min 1 t + d r   subject to   |K x| <= t,  |x - z| <= r
    rows, columns = K.shape
    D = np.eye(len(z), columns)
    cost = np.concatenate([np.zeros(columns), np.ones(rows), weights])
    zero_k, zero_d = np.zeros((rows, len(z))), np.zeros((len(z), rows))
    A = np.block([
        [K, -np.eye(rows), zero_k], [-K, -np.eye(rows), zero_k],
        [D, zero_d, -np.eye(len(z))], [-D, zero_d, -np.eye(len(z))],
    ])  # fmt: skip
    b = np.concatenate([np.zeros(2 * rows), z, -z])
    bounds = [(None, None)] * columns + [(0, None)] * (rows + len(z))
    reference = linprog(cost, A_ub=A, b_ub=b, bounds=bounds, method="highs")
    energy = plain_energy(state_of(result, unit, unit_px), K, weights, z, np.zeros(len(z)))
    assert energy == pytest.approx(reference.fun, rel=2e-4)
    assert energy >= reference.fun * (1.0 - 1e-5)


@pytest.mark.parametrize("seed", range(2))
def test_reaches_the_optimum_of_the_huber_energy(seed: int) -> None:
    points, data, sigmas, edges = small_problem(14, seed)
    parameters = NltgvParameters(**CONVEX, **EXACT)
    result = smooth(points, data, sigmas, edges, parameters)
    K, weights, unit, unit_px = plain_terms(points, sigmas, edges, parameters)
    z, bend = data / unit, sigmas / unit
    # Chambolle and Pock with one step for all, in float64.
    x, q = np.concatenate([z, np.zeros(2 * len(z))]).astype(np.float64), np.zeros(len(K))
    step = 0.99 / np.linalg.norm(K, 2)
    for _ in range(60_000):
        moved = x - step * (K.T @ q)
        off, force = moved[: len(z)] - z, step * weights
        inner = off * bend / (bend + force)
        outer = off - np.sign(off) * force
        moved[: len(z)] = z + np.where(np.abs(off) <= bend + force, inner, outer)
        q = np.clip(q + step * (K @ (2.0 * moved - x)), -1.0, 1.0)
        x = moved
    reference = plain_energy(x, K, weights, z, bend)
    energy = plain_energy(state_of(result, unit, unit_px), K, weights, z, bend)
    assert energy == pytest.approx(reference, rel=2e-4)
    # The Huber data term makes inverse depths (nearly) unique.
    assert rmse(result.inverse_depths / unit - x[: len(z)]) < 0.05


def test_planes_and_steps_with_outliers_come_out_far_nearer_to_the_truth() -> None:
    raw, smoothed, averaged = [], [], []
    for seed in range(8):
        scene = make_scene(10_000, seed)
        result = smooth(
            scene.points_px, scene.data, scene.sigmas, scene.mesh.edges, NltgvParameters()
        )
        assert result.converged
        error = result.inverse_depths - scene.true
        raw.append(rmse(scene.data - scene.true))
        smoothed.append(rmse(error))
        averaged.append(min(rmse(laplacian(scene, turns) - scene.true) for turns in (1, 3, 10)))
        near = scene.distance_px < 3.0
        good = ~scene.outliers
        # Vertices with good data stay on their side of a step, and no other is far worse.
        at_steps, elsewhere = np.abs(error[near & good]), np.abs(error[~near & good])
        assert np.quantile(at_steps, 0.95) <= 2.0 * np.quantile(elsewhere, 0.95)
        assert np.median(np.abs(error[near])) <= 2.0 * np.median(np.abs(error[~near]))
        assert rmse(error[good]) < 0.5 * NOISE
        # Outliers are known as such but for those that fell on the surface by chance.
        assert np.mean(result.inliers[good]) > 0.99
        assert np.mean(result.inliers[scene.outliers]) < 0.1
    assert np.median(np.array(raw) / smoothed) >= 8.0
    assert np.median(np.array(averaged) / smoothed) >= 3.0


def test_vertices_without_data_come_to_the_side_of_a_step_on_which_they_lie() -> None:
    generator = np.random.default_rng(0)
    points = generator.uniform((0, 0), (2000, 1500), (30_000, 2)).astype(np.float32)
    mesh = triangulate(points)
    points = points[mesh.vertices]
    beyond = points @ np.array([0.8, 0.6]) - 1200.0  # px, over a slanted border
    slope = np.array([0.05, -0.02], np.float32)
    surfaces = points @ slope + np.array([[0.0], [300.0]], np.float32)
    right = np.where(beyond > 0.0, surfaces[1], surfaces[0])
    wrong = np.where(beyond > 0.0, surfaces[0], surfaces[1])
    lost = generator.random(len(points)) < 0.3
    swapped = lost & (generator.random(len(points)) < 0.5)
    state = np.zeros((len(points), 4), np.float32)
    state[:, 0], state[:, 1:3] = np.where(swapped, wrong, right), slope
    sigma = np.where(lost, np.inf, 1.0).astype(np.float32)
    data = np.where(lost, 0.0, right).astype(np.float32)
    scaled = points / np.float32(10.0)
    u, v = scaled[:, 0].copy(), scaled[:, 1].copy()
    graph = Graph(u, v, data, sigma, *rings(mesh.edges, len(points)))
    state[:, 1:3] *= 10.0
    moved = choose_sides(graph, state, 3.0)
    assert moved == pytest.approx(np.count_nonzero(swapped), rel=0.01)
    # Vertices are 10 px apart, and a third of them is lost.
    doubtful = lost & (np.abs(beyond) > 2.0) & (np.abs(beyond) < 8.0)
    good = np.abs(state[:, 0] - right) < 1.0
    assert np.mean(good[doubtful & swapped]) > 0.8
    assert np.mean(good[doubtful & ~swapped]) > 0.8
    # At the hull a few have no neighbour with data.
    assert np.mean(good[np.abs(beyond) > 30.0]) > 0.999
    assert good[~lost].all()


def test_a_slanted_plane_stays_a_plane_at_its_border() -> None:
    generator = np.random.default_rng(0)
    mesh = triangulate(generator.uniform((0, 0), (640, 480), (3000, 2)).astype(np.float32))
    points = np.random.default_rng(0).uniform((0, 0), (640, 480), (3000, 2)).astype(np.float32)
    points = points[mesh.vertices]
    true = 0.2 + 0.001 * points[:, 0] - 0.0005 * points[:, 1]
    # Steep against the noise: 50 sigmas from vertex to vertex.
    sigmas = np.full(3000, 2e-4, np.float32)
    data = (true + generator.normal(0.0, 2e-4, 3000)).astype(np.float32)
    result = smooth(points, data, sigmas, mesh.edges, NltgvParameters())
    assert rmse(result.inverse_depths - true) < 1e-4
    np.testing.assert_allclose(np.median(result.slopes, axis=0), [0.001, -0.0005], rtol=0.01)
    assert np.median(result.edge_weights) > 0.9


def test_order_of_points_does_not_matter() -> None:
    scene = make_scene(1000, 1)
    order = np.random.default_rng(0).permutation(1000)
    mesh = triangulate(scene.points_px[order])
    at = order[mesh.vertices]
    first = smooth(scene.points_px, scene.data, scene.sigmas, scene.mesh.edges, NltgvParameters())
    second = smooth(
        scene.points_px[at], scene.data[at], scene.sigmas[at], mesh.edges, NltgvParameters()
    )
    assert first.inverse_depths.tobytes() == second.inverse_depths.tobytes()
    assert first.duals.tobytes() == second.duals.tobytes()


def test_scale_of_the_scene_and_of_the_image_do_not_matter() -> None:
    scene = make_scene(1000, 2)
    first = smooth(scene.points_px, scene.data, scene.sigmas, scene.mesh.edges, NltgvParameters())
    second = smooth(
        scene.points_px * np.float32(4.0), scene.data * np.float32(0.125),
        scene.sigmas * np.float32(0.125), scene.mesh.edges, NltgvParameters(),
    )  # fmt: skip
    np.testing.assert_allclose(second.inverse_depths * 8.0, first.inverse_depths, rtol=1e-6)
    np.testing.assert_allclose(second.slopes * 32.0, first.slopes, atol=1e-8)


def test_warm_start_needs_fewer_iterations() -> None:
    scene = make_scene(4000, 3)
    parameters = NltgvParameters(min_change_sigmas=0.01)
    cold = smooth(scene.points_px, scene.data, scene.sigmas, scene.mesh.edges, parameters)
    # A tenth of the vertices is new, and all data have moved a little.
    known = cold.inverse_depths.copy()
    known[::10] = np.nan
    start = NltgvStart(inverse_depths=known, slopes=cold.slopes, duals=cold.duals)
    noise = np.random.default_rng(0).normal(0.0, 0.2 * NOISE, len(known)).astype(np.float32)
    again = smooth(
        scene.points_px, scene.data + noise, scene.sigmas, scene.mesh.edges, parameters, start
    )
    assert again.converged
    assert again.iterations < 0.6 * cold.iterations
    assert rmse(again.inverse_depths - scene.true) < 1.1 * rmse(cold.inverse_depths - scene.true)


def test_duals_follow_their_edges() -> None:
    edges = np.array([[0, 1], [0, 2], [1, 2]], np.int32)
    duals = np.arange(9, dtype=np.float32).reshape(3, 3)
    ids = np.array([7, 3, 5], np.int32)
    new_ids = np.array([5, 3, 9, 7], np.int32)
    new_edges = np.array([[0, 1], [0, 3], [1, 2], [1, 3]], np.int32)
    carried = carry_duals(duals, edges, ids, new_edges, new_ids)
    np.testing.assert_array_equal(carried, [-duals[2], -duals[1], [0, 0, 0], -duals[0]])
    none = np.zeros((0, 2), np.int32)
    assert carry_duals(duals[:0], none, ids, new_edges, new_ids).shape == (4, 3)
    assert carry_duals(duals, edges, ids, none, new_ids).shape == (0, 3)


def test_vertices_without_data_follow_their_neighbours() -> None:
    scene = make_scene(4000, 4, outlier_share=0.0)
    data, sigmas = scene.data.copy(), scene.sigmas.copy()
    data[::5] = np.nan
    sigmas[1::50] = np.inf
    sigmas[2::50] = 0.0
    result = smooth(scene.points_px, data, sigmas, scene.mesh.edges, NltgvParameters())
    assert np.isfinite(result.inverse_depths).all()
    inside = scene.distance_px > 30.0
    assert rmse((result.inverse_depths - scene.true)[inside]) < 0.5 * NOISE


def test_nothing_to_smooth() -> None:
    none = np.zeros((0, 2), np.int32)
    one = np.ones(1, np.float32)
    result = smooth(np.zeros((1, 2), np.float32), one, one, none, NltgvParameters())
    assert result.inverse_depths.tolist() == [1.0]
    scene = make_scene(50, 0)
    nan = np.full(50, np.nan, np.float32)
    result = smooth(scene.points_px, nan, nan, scene.mesh.edges, NltgvParameters())
    assert np.isnan(result.inverse_depths).all()
    assert not result.inliers.any()
    with pytest.raises(ValueError, match="50 points"):
        smooth(scene.points_px, one, one, scene.mesh.edges, NltgvParameters())

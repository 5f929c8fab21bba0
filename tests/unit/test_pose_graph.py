"""The graph of similarities: Jacobians, the solver, drift that a loop takes out, false loops."""

import numpy as np
import pytest

from pliant.algorithms.geometry import matrix_to_pose, similarity_to_matrix, so3_exp
from pliant.algorithms.slam.estimate.pose_graph import (
    Edges,
    jacobians,
    optimise_pose_graph,
    residuals,
    step_by,
)


def similarity(omega, t, log_scale=0.0):
    S = np.eye(4)
    S[:3, :3] = np.exp(log_scale) * so3_exp(np.array(omega, np.float64))
    S[:3, 3] = t
    return S


def some_similarities(count, seed, size=1.0):
    generator = np.random.default_rng(seed)
    steps = size * generator.normal(size=(count, 7)) * ([1.0] * 6 + [0.3])
    return step_by(np.tile(np.eye(4), (count, 1, 1)), steps)


def edges_of(S, pairs, sigma=0.01, doubtful=()):
    i, j = np.array(pairs, np.int32).T
    return Edges(
        i=i.copy(), j=j.copy(), Z=np.linalg.inv(S[i]) @ S[j],
        sigmas=np.full((len(i), 7), sigma), doubtful=np.isin(np.arange(len(i)), doubtful),
    )  # fmt: skip


@pytest.mark.parametrize("of", [0, 1])
def test_jacobians_are_those_of_finite_differences(of):
    S = some_similarities(6, 0)
    edges = edges_of(S, [(0, 1), (2, 3), (5, 4)])
    moved = step_by(S, 0.4 * np.random.default_rng(1).normal(size=(6, 7)))
    found = jacobians(moved, edges)[of]
    for k in range(7):
        steps, h = np.zeros((6, 7)), 1e-6
        steps[(edges.i, edges.j)[of], k] = h
        after, before = (residuals(step_by(moved, sign * steps), edges) for sign in (1, -1))
        np.testing.assert_allclose(found[:, :, k], (after - before) / (2 * h), atol=1e-8)


def test_a_graph_that_agrees_is_found_from_afar():
    """Some poses held; edges in any order, between any poses."""
    true = some_similarities(20, 2)
    generator = np.random.default_rng(3)
    pairs = [(k, k + 1) for k in range(19)]
    pairs += [tuple(generator.permutation(20)[:2].tolist()) for _ in range(30)]
    fixed = np.arange(20) % 9 == 4
    start = np.where(
        fixed[:, None, None], true, step_by(true, 0.1 * generator.normal(size=(20, 7)))
    )
    found, weights = optimise_pose_graph(start, edges_of(true, pairs), fixed)
    np.testing.assert_allclose(found, true, atol=1e-6)
    np.testing.assert_array_equal(weights, 1.0)


def test_a_step_is_that_of_dense_normal_equations():
    true = some_similarities(8, 4)
    pairs = [(k, k + 1) for k in range(7)] + [(6, 1), (2, 5), (0, 7)]
    edges = edges_of(true, pairs)
    noisy = edges.Z @ some_similarities(len(pairs), 5, 0.02)
    edges = Edges(**{**vars(edges), "Z": noisy})
    found, _ = optimise_pose_graph(true, edges, np.arange(8) == 0)
    r, (of_i, of_j) = residuals(found, edges), jacobians(found, edges)
    J = np.zeros((len(pairs), 7, 8, 7))
    for e, (i, j) in enumerate(pairs):
        J[e, :, i], J[e, :, j] = of_i[e], of_j[e]
    gradient = J.reshape(-1, 56).T @ r.ravel()
    assert np.abs(gradient[7:]).max() < 1e-4 * np.abs(J.reshape(-1, 56).T).max()
    assert np.linalg.norm(r) < np.linalg.norm(residuals(true, edges))


def by_gtsam(S, edges, fixed):
    """The least squares of the same graph by GTSAM's Levenberg-Marquardt: (M, 4, 4).

    Its similarities are ``p -> s (R p + t)``, with 1/s in the last element of their matrices.
    """
    gtsam = pytest.importorskip("gtsam", reason="GTSAM has no wheel here")

    def as_gtsam(S):
        scale = np.cbrt(np.linalg.det(S[:3, :3]))
        return gtsam.Similarity3(gtsam.Rot3(S[:3, :3] / scale), S[:3, 3] / scale, scale)

    graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for k, each in enumerate(S):
        start.insert(k, as_gtsam(each))
        if fixed[k]:
            graph.add(gtsam.NonlinearEqualitySimilarity3(k, as_gtsam(each)))
    for i, j, Z, sigmas in zip(edges.i, edges.j, edges.Z, edges.sigmas, strict=True):
        noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
        graph.add(gtsam.BetweenFactorSimilarity3(int(i), int(j), as_gtsam(Z), noise))
    limits = gtsam.LevenbergMarquardtParams()
    limits.setRelativeErrorTol(1e-12)
    limits.setAbsoluteErrorTol(1e-15)
    found = gtsam.LevenbergMarquardtOptimizer(graph, start, limits).optimize()
    homogeneous = np.array([found.atSimilarity3(k).matrix() for k in range(len(S))])
    return homogeneous / homogeneous[:, 3:, 3:]


def test_what_is_found_is_what_gtsam_finds():
    """Its residual is the logarithm of the whole similarity, which is ours to first order."""
    true = some_similarities(30, 11)
    generator = np.random.default_rng(12)
    pairs = [(k, k + n) for n in (1, 3) for k in range(30 - n)] + [(29, 0), (4, 21), (17, 2)]
    edges = edges_of(true, pairs)
    sigmas = 1e-3 * generator.uniform(0.3, 3.0, (len(pairs), 7))
    noisy = step_by(edges.Z, sigmas * generator.normal(size=sigmas.shape))
    edges = Edges(**{**vars(edges), "Z": noisy, "sigmas": sigmas})
    start = step_by(true, 0.05 * generator.normal(size=(30, 7)))
    fixed = np.arange(30) % 20 == 3
    start[fixed] = true[fixed]
    found, _ = optimise_pose_graph(start, edges, fixed)
    theirs = by_gtsam(start, edges, fixed)
    away = np.abs(found - theirs).max()
    assert away < 0.01 * np.abs(found - true).max()
    assert np.square(residuals(found, edges) / sigmas).sum() < 7 * len(pairs)


def circle(count):
    """Keyframes on a circle of 1 m that look outward, and what odometry with drift makes of it."""
    angles = np.linspace(0.0, 2.0 * np.pi, count)
    true = np.array([similarity((0, -a, 0), (np.sin(a), 0, np.cos(a))) for a in angles])
    generator = np.random.default_rng(7)
    bias = np.array([0.0, 3e-4, 2e-4, 4e-4, 0.0, 3e-4, 2e-3])
    noise = bias + 1e-4 * generator.normal(size=(count - 1, 7))
    steps = step_by(np.linalg.inv(true[:-1]) @ true[1:], noise)
    drifted = [true[0]]
    for step in steps:
        drifted.append(drifted[-1] @ step)
    return true, np.array(drifted)


def error(S, true):
    return np.sqrt(np.square(S[:, :3, 3] - true[:, :3, 3]).sum(axis=1).mean())


@pytest.mark.parametrize("count", [20, 300])
def test_a_loop_takes_out_drift_of_scale_and_direction(count):
    true, drifted = circle(count)
    pairs = [(k, k + n) for n in (1, 2, 5) for k in range(count - n)]
    chain, loop = edges_of(drifted, pairs, 0.02), edges_of(true, [(0, count - 1)], 0.005, [0])
    edges = Edges(**{n: np.concatenate([a, getattr(loop, n)]) for n, a in vars(chain).items()})
    found, weights = optimise_pose_graph(drifted, edges, np.arange(count) == 0)
    assert error(found, true) < 0.25 * error(drifted, true)
    assert weights[-1] > 0.9


def test_a_loop_that_others_contradict_is_ignored():
    true, drifted = circle(60)
    pairs = [(k, k + n) for n in (1, 2, 5) for k in range(60 - n)]
    chain = edges_of(drifted, pairs, 0.02)
    loops = edges_of(true, [(0, 59), (1, 58), (2, 57), (10, 40)], 0.005, range(4))
    loops.Z[3] = np.eye(4)  # another place that looks alike
    edges = Edges(**{n: np.concatenate([a, getattr(loops, n)]) for n, a in vars(chain).items()})
    found, weights = optimise_pose_graph(drifted, edges, np.arange(60) == 0)
    assert (weights[-4:-1] > 0.9).all()
    assert weights[-1] < 1e-3
    assert error(found, true) < 0.25 * error(drifted, true)
    held = edges_of(drifted, pairs, 1e-3)
    assert len(residuals(found, held)) == len(pairs)


def test_nothing_to_do_changes_nothing():
    S = some_similarities(3, 1)
    none = edges_of(S, [(0, 1)])
    none = Edges(**{name: value[:0] for name, value in vars(none).items()})
    np.testing.assert_array_equal(optimise_pose_graph(S, none, np.arange(3) == 0)[0], S)
    every = np.ones(3, np.bool_)
    np.testing.assert_array_equal(optimise_pose_graph(S, edges_of(S, [(0, 1)]), every)[0], S)


def test_poses_with_a_scale_go_through_eight_numbers():
    S = some_similarities(4, 9)
    scale = np.cbrt(np.linalg.det(S[:, :3, :3]))
    T = S.copy()
    T[:, :3, :3] /= scale[:, None, None]
    packed = np.column_stack([matrix_to_pose(T), scale])
    np.testing.assert_allclose(similarity_to_matrix(packed), S, atol=1e-12)

"""Neighbouring surfels that hold on to each other."""

import numpy as np
import pytest
from surfel_scene import slanted_surfels

from pliant.algorithms.arrays import F64
from pliant.algorithms.surfels import deformation_models as motion
from pliant.algorithms.surfels.deformation_graph import (
    Edges,
    edge_rows,
    find_edges,
    join_edges,
    keep_rows,
    median_strains,
    no_edges,
    torn_off,
)
from pliant.algorithms.surfels.graph_alignment import Springs, bound_turns, solve_graph
from pliant.algorithms.surfels.patch_sampling import A, B, F, X

N = 12


def plane(count: int = N, seed: int = 0) -> F64:
    """Surfels of one plane, z = 1 m."""
    poses = slanted_surfels(count, seed)
    poses[:, X + 2] = 1.0
    poses[:, A : A + 3], poses[:, B : B + 3] = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)
    return poses


def pairs_of(poses: F64, count: int = 3) -> Edges:
    return find_edges(poses, np.ones(len(poses), np.int64), 0, count)


def stepped(poses: F64, x: F64) -> F64:
    out = poses.copy()
    step = np.zeros(motion.MOST_PARAMETERS)
    for s in range(len(poses)):
        step[:6] = x[s]
        motion.apply_step(poses[s], step, motion.ISOMETRIC, out[s])
    return out


def test_neighbours_are_the_nearest_of_the_same_surface() -> None:
    poses = plane()
    poses[N // 2 :, X + 2] = 1.5
    edges = pairs_of(poses)
    assert ((edges.ends < N // 2).sum(axis=1) != 1).all()
    d = poses[edges.ends[:, 1], X : X + 3] - poses[edges.ends[:, 0], X : X + 3]
    np.testing.assert_allclose(edges.lengths, np.linalg.norm(d, axis=1))
    points = poses[: N // 2, X : X + 3]
    distance = np.linalg.norm(points[:, None] - points[None], axis=2)
    nearest = {tuple(sorted((i, int(j)))) for i in range(6) for j in np.argsort(distance[i])[1:4]}
    assert nearest == {(int(i), int(j)) for i, j in edges.ends if i < N // 2}


def test_pairs_follow_their_rows() -> None:
    poses = plane()
    old = pairs_of(poses)
    rows = np.arange(2, N)
    kept = keep_rows(old, rows, N)
    assert 0 < len(kept.ends) < len(old.ends)
    w, residuals, _ = edge_rows(poses[rows], kept)
    np.testing.assert_allclose(residuals, 0.0, atol=1e-12)
    np.testing.assert_allclose(w, 1.0)
    new = find_edges(poses, np.ones(N, np.int64), N - 2, 3)
    assert (new.ends.max(axis=1) >= N - 2).all()
    assert len(join_edges(old, new).ends) == len(old.ends) + len(new.ends)


def test_a_new_surfel_is_joined_to_those_around_it_alone() -> None:
    """Not to all others, none of which has another new one that is nearer."""
    poses = plane(60)
    new, count = len(poses) - 1, 3
    edges = find_edges(poses, np.ones(len(poses), np.int64), new, count)
    distance = np.linalg.norm(poses[:, None, X : X + 3] - poses[None, :, X : X + 3], axis=2)
    nearest = np.argsort(distance, axis=1)[:, 1 : count + 1]
    mutual = {i for i in range(new) if i in nearest[new] or new in nearest[i]}
    assert {(int(i), int(j)) for i, j in edges.ends} == {(i, new) for i in mutual}
    widely = find_edges(poses, np.ones(len(poses), np.int64), new, count, widely=True)
    assert {(int(i), int(j)) for i, j in widely.ends} == {(i, new) for i in range(new)}


def test_a_stretch_that_surfels_know_of_costs_nothing() -> None:
    poses = plane()
    edges = pairs_of(poses)
    pulled = poses.copy()
    stretch = np.array([[1.2, 0.05], [0.05, 0.9]])
    pulled[:, X : X + 2] = poses[:, X : X + 2] @ stretch
    pulled[:, F : F + 3] = (1.2, 0.05, 0.9)
    _, residuals, _ = edge_rows(pulled, edges)
    np.testing.assert_allclose(residuals, 0.0, atol=1e-12)
    pulled[:, F : F + 3] = (1.0, 0.0, 1.0)
    assert np.abs(edge_rows(pulled, edges)[1]).max() > 1e-3


def test_the_median_strain_is_that_of_plain_numpy() -> None:
    poses = plane()
    edges = pairs_of(poses)
    poses[:, X : X + 3] += np.random.default_rng(2).normal(0.0, 0.01, (N, 3))
    residuals = edge_rows(poses, edges)[1][:, 0]
    strains = np.linalg.norm(residuals, axis=1) / edges.lengths
    known = np.ones(N, np.bool_)
    known[3] = False
    compared = (edges.ends != 3).all(axis=1)
    expected = [
        np.median(strains[(edges.ends == row).any(axis=1) & compared]) if known[row] else np.nan
        for row in range(N)
    ]
    np.testing.assert_allclose(median_strains(poses, edges, known), expected)
    # A surfel that is added has no edges yet.
    more, known = np.concatenate([poses, poses[:1]]), np.ones(N + 1, np.bool_)
    assert np.isnan(median_strains(more, edges, known)).tolist() == [False] * N + [True]
    assert np.isnan(median_strains(poses, no_edges(), known[:N])).all()


def test_steps_turn_by_half_a_turn_at_most() -> None:
    """As of a surfel that only torn pairs carry: its tangents keep their lengths."""
    x = np.array([(1.0, 2.0, 3.0, 1e6, -1e5, 3e5), (4.0, 5.0, 6.0, 0.1, -3.0, 0.2)])
    before = slanted_surfels()
    bounded = x.copy()
    bound_turns(bounded)
    np.testing.assert_array_equal(bounded[1], x[1])
    np.testing.assert_array_equal(bounded[0, :3], x[0, :3])
    np.testing.assert_allclose(np.cross(bounded[0, 3:], x[0, 3:]), 0.0, atol=1e-6)
    after = stepped(before, bounded[:1])
    for tangent in (A, B):
        lengths = [np.linalg.norm(pose[0, tangent : tangent + 3]) for pose in (before, after)]
        assert lengths[1] == pytest.approx(lengths[0], rel=1e-12)


def test_a_rigid_motion_costs_nothing() -> None:
    poses = plane()
    edges = pairs_of(poses)
    turn, shift = np.array([0.02, -0.03, 0.01]), np.array([0.1, 0.0, 0.05])
    x = np.zeros((N, 6))
    x[:, 3:] = turn
    moved = stepped(poses, x)
    c = np.cross(moved[0, A : A + 3], moved[0, B : B + 3])
    rotation = np.stack([moved[0, A : A + 3], moved[0, B : B + 3], c], axis=1)
    moved[:, X : X + 3] = poses[:, X : X + 3] @ rotation.T + shift
    _, residuals, _ = edge_rows(moved, edges)
    np.testing.assert_allclose(residuals, 0.0, atol=1e-12)


def test_solution_against_dense_least_squares() -> None:
    """Finite differences of the residuals, solved densely, give the same steps."""
    rng = np.random.default_rng(1)
    poses = plane()
    edges = pairs_of(poses)
    moved = stepped(poses, 0.003 * rng.standard_normal((N, 6)))
    w, residuals, arms = edge_rows(moved, edges)
    pull, bend = w * 40.0 / edges.lengths**2, w * 3.0 / edges.lengths**2
    roots = np.linalg.cholesky(np.eye(6) + 0.1)
    S = np.broadcast_to(roots @ roots.T, (N, 6, 6)).copy()
    b = rng.standard_normal((N, 6)) * 1e-3
    x = np.zeros((N, 6))
    solve_graph(S, b, Springs(edges.ends, arms, pull, bend, residuals), 500, 1e-24, x)
    J = np.zeros((residuals.size, 6 * N))
    for k in range(6 * N):
        step = np.zeros(6 * N)
        step[k] = 1e-6
        ahead = edge_rows(stepped(moved, step.reshape(N, 6)), edges)[1]
        behind = edge_rows(stepped(moved, -step.reshape(N, 6)), edges)[1]
        J[:, k] = (ahead - behind).ravel() / 2e-6
    W = np.repeat(np.stack([pull, bend], axis=1).ravel(), 3)
    H = J.T @ (W[:, None] * J) + np.kron(np.eye(N), roots @ roots.T)
    expected = -np.linalg.solve(H, J.T @ (W * residuals.ravel()) + b.ravel())
    np.testing.assert_allclose(x.ravel(), expected, atol=1e-6 * np.abs(expected).max() + 1e-9)


def test_who_leaves_all_neighbours_is_torn_off() -> None:
    poses = plane()
    edges = pairs_of(poses, 4)
    assert not torn_off(edges, edge_rows(poses, edges)[0], N).any()
    poses[3, X : X + 3] *= 1.3
    torn = torn_off(edges, edge_rows(poses, edges)[0], N)
    assert torn[3]
    assert torn.sum() == 1

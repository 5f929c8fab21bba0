"""Cameras, rest shape and displacements of a scene that deforms, against exact ground truth."""

import numpy as np
import pytest

from pliant.algorithms.arrays import F64, I64
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.deformable.adjustment import adjust_deforming
from pliant.algorithms.deformable.conjugate_gradients import conjugate_gradients
from pliant.algorithms.deformable.held_out import triangulate, weigh
from pliant.algorithms.deformable.linearised import (
    CAMERA,
    accumulate,
    linearise,
    times,
    times_transposed,
)
from pliant.algorithms.deformable.moving_landmarks import DeformingMap, TrackedPoints
from pliant.algorithms.deformable.node_graph import no_nodes, node_graph
from pliant.algorithms.deformable.priors import Prior
from pliant.algorithms.deformable.track_choice import choose_tracks
from pliant.algorithms.geometry import align_umeyama, so3_exp

CAMERA_640 = PinholeCamera(width=640, height=480, fx=525.0, fy=525.0, cx=319.5, cy=239.5)
KEYFRAMES = 24


def breathing(amplitude: float) -> tuple[F64, F64]:
    """(K, L, 3) points of a hilly sheet 0.6 m away whose middle rises and falls, and poses.

    The camera goes aside and back, and looks to the middle.
    """
    rng = np.random.default_rng(4)
    xy = rng.uniform((-0.33, -0.22), (0.33, 0.22), (300, 2))
    z = 0.6 + 0.03 * np.cos(13.0 * xy[:, 0]) * np.cos(16.0 * xy[:, 1])
    hill = np.exp(-0.5 * ((xy[:, 0] / 0.11) ** 2 + (xy[:, 1] / 0.09) ** 2))
    time = np.arange(KEYFRAMES) / KEYFRAMES
    rise = amplitude * np.sin(6.0 * np.pi * time)
    points = np.repeat(np.column_stack([xy, z])[None], KEYFRAMES, axis=0)
    points[:, :, 2] -= rise[:, None] * hill
    T = np.repeat(np.eye(4)[None], KEYFRAMES, axis=0)
    T[:, 0, 3] = 0.25 * np.sin(2.0 * np.pi * time)
    T[:, 1, 3] = 0.06 * np.sin(4.0 * np.pi * time)
    T[:, :3, :3] = so3_exp(np.outer(-0.25 * np.sin(2.0 * np.pi * time), [0.0, 1.0, 0.0]))
    return points, T


def tracked(points: F64, T: F64, noise_px: float = 0.2) -> TrackedPoints:
    """What the cameras see of points (K, L, 3)."""
    rng = np.random.default_rng(5)
    keyframes: list[I64] = []
    landmarks: list[I64] = []
    pixels: list[F64] = []
    for k in range(len(T)):
        seen = CAMERA_640.project((points[k] - T[k, :3, 3]) @ T[k, :3, :3])
        seen += noise_px * rng.standard_normal(seen.shape)
        rows = np.flatnonzero(((seen > 0.0) & (seen < (639.0, 479.0))).all(axis=1))
        keyframes.append(np.full(len(rows), k))
        landmarks.append(rows)
        pixels.append(seen[rows])
    observed, index = np.unique(np.concatenate(landmarks), return_inverse=True)
    assert len(observed) == points.shape[1]
    return TrackedPoints(
        keyframes=np.concatenate(keyframes),
        landmarks=index.astype(np.int64),
        points_px=np.concatenate(pixels),
    )


def disturbed(T: F64) -> F64:
    """A rigid map's poses: a centimetre and half a degree off."""
    rng = np.random.default_rng(6)
    out = T.copy()
    out[1:, :3, 3] += 0.01 * rng.standard_normal((len(T) - 1, 3))
    out[1:, :3, :3] = out[1:, :3, :3] @ so3_exp(0.01 * rng.standard_normal((len(T) - 1, 3)))
    return out


def errors(found: DeformingMap, points: F64, T: F64) -> tuple[float, float]:
    """RMSE of the landmarks and of the camera as shares of the depth, scale and world aligned."""
    positions = np.stack([found.positions(k) for k in range(len(T))])
    scale, R, t = align_umeyama(positions.reshape(-1, 3), points.reshape(-1, 3), with_scale=True)
    off = scale * positions @ R.T + t - points
    camera = scale * found.T_world_camera[:, :3, 3] @ R.T + t - T[:, :3, 3]
    return (
        float(np.sqrt((off**2).sum(axis=2).mean())) / 0.6,
        float(np.sqrt((camera**2).sum(axis=1).mean())) / 0.6,
    )


def test_camera_and_deformation_are_separated() -> None:
    points, T = breathing(0.018)
    found = adjust_deforming(tracked(points, T), disturbed(T), CAMERA_640)
    landmarks, camera = errors(found, points, T)
    still = float(np.sqrt(((points - points.mean(axis=0)) ** 2).sum(axis=2).mean())) / 0.6
    assert still > 0.005  # what a map that does not move would be wrong by, at best
    assert landmarks < 0.004
    assert camera < 0.004
    assert found.reliable.mean() > 0.9


def test_a_rigid_scene_stays_rigid() -> None:
    points, T = breathing(0.0)
    found = adjust_deforming(tracked(points, T), disturbed(T), CAMERA_640)
    assert np.abs(found.displacements).max() < 1.5e-3
    assert max(errors(found, points, T)) < 0.002


def test_the_unit_of_the_start_does_not_matter() -> None:
    points, T = breathing(0.018)
    large = disturbed(T)
    large[:, :3, 3] *= 7.0
    tracks = tracked(points, T)
    once, again = (adjust_deforming(tracks, start, CAMERA_640) for start in (disturbed(T), large))
    np.testing.assert_allclose(again.rest, 7.0 * once.rest, rtol=2e-3, atol=2e-3)
    np.testing.assert_allclose(again.T_world_camera[0], large[0], atol=1e-6)


def test_a_landmark_with_wrong_pixels_is_not_reliable() -> None:
    points, T = breathing(0.018)
    tracks = tracked(points, T)
    wrong = np.isin(tracks.landmarks, np.arange(0, 300, 30))
    pixels = tracks.points_px.copy()
    pixels[wrong] += np.random.default_rng(7).uniform(-20.0, 20.0, (int(wrong.sum()), 2))
    bad = TrackedPoints(keyframes=tracks.keyframes, landmarks=tracks.landmarks, points_px=pixels)
    found = adjust_deforming(bad, disturbed(T), CAMERA_640)
    assert not found.reliable[::30].any()
    assert np.delete(found.reliable, np.arange(0, 300, 30)).mean() > 0.85
    assert errors(found, points, T)[1] < 0.006


def test_tracks_without_parallax_are_not_reliable() -> None:
    points, T = breathing(0.0)
    T[:, :3, 3] = 0.0
    T[:, 0, 3] = 2e-4 * np.arange(KEYFRAMES) / KEYFRAMES
    T[:, :3, :3] = so3_exp(np.outer(0.01 * np.arange(KEYFRAMES), [0.0, 1.0, 0.0]))
    rows = np.flatnonzero(np.abs(points[0, :, 0]) < 0.2)
    found = adjust_deforming(tracked(points[:, rows], T), T, CAMERA_640)
    assert found.reliable.mean() < 0.1


def test_held_out_tracks_are_predicted_by_the_map_that_moves() -> None:
    points, T = breathing(0.018)
    mine, others = tracked(points[:, ::2], T), tracked(points[:, 1::2], T)
    found = adjust_deforming(mine, disturbed(T), CAMERA_640)
    evidence = weigh(found, others, CAMERA_640)
    assert evidence.predicted > 0.98
    assert evidence.by_rigid < 0.95
    assert evidence.gain > 0.5
    assert 0.5 < evidence.stiff < 0.9
    wrong = TrackedPoints(
        keyframes=others.keyframes,
        landmarks=others.landmarks,
        points_px=others.points_px[::-1],
    )
    assert weigh(found, wrong, CAMERA_640).predicted < 0.1


def test_rigid_tracks_are_predicted_as_well_without_displacements() -> None:
    points, T = breathing(0.0)
    mine, others = tracked(points[:, ::2], T), tracked(points[:, 1::2], T)
    evidence = weigh(adjust_deforming(mine, disturbed(T), CAMERA_640), others, CAMERA_640)
    assert evidence.predicted == evidence.by_rigid == evidence.stiff == 1.0
    assert evidence.gain < 0.1


def test_triangulation() -> None:
    rng = np.random.default_rng(6)
    points, centres = rng.uniform(1.0, 2.0, (5, 3)), rng.uniform(-1.0, 0.0, (5, 4, 3))
    rays = (points[:, None] - centres) * rng.uniform(0.5, 2.0, (5, 4, 1))
    found = triangulate(np.repeat(np.arange(5), 4), rays.reshape(-1, 3), centres.reshape(-1, 3), 5)
    np.testing.assert_allclose(found, points, atol=1e-6)


def test_too_few_landmarks_are_refused() -> None:
    points, T = breathing(0.0)
    middle = np.argsort(np.abs(points[0, :, :2]).sum(axis=1))[:3]
    with pytest.raises(ValueError, match="too few"):
        adjust_deforming(tracked(points[:, middle], T), T, CAMERA_640)


def problem(seed: int = 1) -> tuple[TrackedPoints, F64, F64, F64, I64, F64]:
    """Observations, poses, landmarks, displacements, carriers and weights near a solution."""
    points, T = (whole[:6] for whole in breathing(0.018))
    points = points[:, :60]
    tracks = tracked(points, T, noise_px=1.0)
    rest = points.mean(axis=0)
    graph = node_graph(rest, 0.2)
    d = 0.01 * np.random.default_rng(seed).standard_normal((len(T), len(graph.nodes), 3))
    return tracks, disturbed(T), rest, d, graph.carriers, graph.weights


def linear(
    tracks: TrackedPoints, T: F64, rest: F64, d: F64, carriers: I64, weights: F64
) -> tuple[F64, F64, F64]:
    """J_camera, J_point and errors."""
    count = len(tracks.keyframes)
    out = np.zeros((count, 2, CAMERA)), np.zeros((count, 2, 3)), np.zeros((count, 2))
    squares = np.zeros(count)
    linearise(
        *(tracks.keyframes, tracks.landmarks, tracks.points_px, CAMERA_640.intrinsics),
        *(T, rest, d, carriers, weights, 0.5, 1e6, *out, squares),
    )
    return out


def test_derivatives_by_finite_differences() -> None:
    tracks, T, rest, d, carriers, weights = problem()
    J_camera, J_point, _ = linear(tracks, T, rest, d, carriers, weights)
    step = 1e-6

    def slope(T_plus: F64, T_minus: F64, rest_plus: F64, rest_minus: F64) -> F64:
        plus = linear(tracks, T_plus, rest_plus, d, carriers, weights)[2]
        minus = linear(tracks, T_minus, rest_minus, d, carriers, weights)[2]
        return (plus - minus) / (2.0 * step)

    for axis in range(3):
        turn = np.eye(3)[axis] * step
        plus, minus = T.copy(), T.copy()
        plus[:, :3, :3] = T[:, :3, :3] @ so3_exp(turn)
        minus[:, :3, :3] = T[:, :3, :3] @ so3_exp(-turn)
        np.testing.assert_allclose(
            J_camera[:, :, axis], slope(plus, minus, rest, rest), rtol=1e-4, atol=1e-2
        )
        plus, minus = T.copy(), T.copy()
        plus[:, axis, 3] += step
        minus[:, axis, 3] -= step
        np.testing.assert_allclose(
            J_camera[:, :, 3 + axis], slope(plus, minus, rest, rest), rtol=1e-4, atol=1e-2
        )
        np.testing.assert_allclose(
            J_point[:, :, axis], slope(T, T, rest + turn, rest - turn), rtol=1e-4, atol=1e-2
        )


def test_products_as_with_the_dense_matrix() -> None:
    tracks, T, rest, d, carriers, weights = problem()
    J_camera, J_point, r = linear(tracks, T, rest, d, carriers, weights)
    k, i = tracks.keyframes, tracks.landmarks
    K, L, B = len(T), len(rest), CAMERA + 3 * d.shape[1]
    M = len(k)
    by_block, by_landmark = np.zeros((M, 2, K, B)), np.zeros((M, 2, L, 3))
    for m in range(M):
        by_block[m, :, k[m], :CAMERA] = J_camera[m]
        by_landmark[m, :, i[m]] = J_point[m]
        for node, w in zip(carriers[i[m]], weights[i[m]], strict=True):
            at = CAMERA + 3 * node
            by_block[m, :, k[m], at : at + 3] += w * J_point[m]
    J, Jx = by_block.reshape(2 * M, K * B), by_landmark.reshape(2 * M, 3 * L)
    H, g = np.zeros((K, B, B)), np.zeros((K, B))
    H_point, g_point = np.zeros((L, 3, 3)), np.zeros((L, 3))
    table = (k, i, carriers, weights, J_camera, J_point)
    accumulate(*table, r, H, g, H_point, g_point)
    np.testing.assert_allclose(g.ravel(), J.T @ r.ravel(), rtol=1e-9, atol=1e-3)
    np.testing.assert_allclose(g_point.ravel(), Jx.T @ r.ravel(), rtol=1e-9, atol=1e-3)
    for row in (0, K - 1):
        part = J[:, row * B : (row + 1) * B]
        np.testing.assert_allclose(H[row], part.T @ part, rtol=1e-9, atol=1e-3)
    part = Jx[:, :3]
    np.testing.assert_allclose(H_point[0], part.T @ part, rtol=1e-9, atol=1e-3)
    rng = np.random.default_rng(2)
    v, x = rng.standard_normal((K, B)), rng.standard_normal((L, 3))
    u, by_point, out = np.zeros((M, 2)), np.zeros((L, 3)), np.zeros((K, B))
    times(*table, v, u, by_point)
    np.testing.assert_allclose(u.ravel(), J @ v.ravel(), rtol=1e-9, atol=1e-6)
    np.testing.assert_allclose(by_point.ravel(), Jx.T @ (J @ v.ravel()), rtol=1e-9, atol=1e-2)
    times_transposed(*table, u, x, out)
    expected = J.T @ (J @ v.ravel() - Jx @ x.ravel())
    np.testing.assert_allclose(out.ravel(), expected, rtol=1e-9, atol=1e-2)


def test_prior_of_a_rigid_motion_and_of_a_stretch() -> None:
    graph = node_graph(breathing(0.0)[0][0], 0.2)
    prior = Prior(graph)
    moved = np.full((1, len(graph.nodes), 3), 1.0)
    prior.update_rigidity(moved)  # far beyond what is stiff: hardly pulled
    cost = float(np.vdot(moved, prior.gradient(moved)))
    assert cost < 1e-3
    stretched = 0.02 * graph.nodes[None]
    prior.update_rigidity(1e3 * stretched)
    along = float(np.vdot(stretched, prior.gradient(stretched)))
    # Each edge costs one for the strain, and a little for the gradient.
    assert along == pytest.approx(len(graph.edges) * (1.0 + (0.02 / 0.3) ** 2), rel=1e-3)


def test_weights_of_landmarks_and_no_nodes() -> None:
    rest = breathing(0.0)[0][0]
    graph = node_graph(rest, 0.2)
    np.testing.assert_allclose(graph.weights.sum(axis=1), 1.0)
    gaps = np.linalg.norm(graph.nodes[:, None] - graph.nodes[None], axis=2)
    assert (gaps + np.eye(len(gaps)) > 0.2).all()
    assert len(node_graph(rest, 0.001).nodes) <= 150
    assert no_nodes(5).carriers.shape == (5, 0)


def test_conjugate_gradients() -> None:
    rng = np.random.default_rng(3)
    root = rng.standard_normal((30, 30))
    A, b = root @ root.T + np.eye(30), rng.standard_normal(30)
    x = conjugate_gradients(
        lambda v: A @ v, lambda v: v / np.diag(A), b, tolerance=1e-10, limit=200
    )
    np.testing.assert_allclose(A @ x, b, atol=1e-6)
    zero = conjugate_gradients(lambda v: A @ v, lambda v: v, 0.0 * b, tolerance=1e-3, limit=9)
    assert not zero.any()


def test_choice_of_tracks() -> None:
    """Long tracks come first; one cell has one track; short ones are left out."""
    ids = [np.array([1, 2, 3, 4]) for _ in range(4)] + [np.array([1, 3]) for _ in range(3)]
    at = {1: (100.0, 100.0), 2: (102.0, 101.0), 3: (400.0, 300.0), 4: (600.0, 400.0)}
    pixels = [np.array([at[track] for track in each]) for each in ids]
    ids[3], pixels[3] = ids[3][:3], pixels[3][:3]  # 4 is tracked in three keyframes only
    found, tracks = choose_tracks(ids, pixels, 640, 480)
    assert tracks.tolist() == [1, 3]
    assert np.bincount(found.landmarks).tolist() == [7, 7]
    assert (np.diff(found.keyframes) >= 0).all()
    np.testing.assert_array_equal(found.points_px[found.landmarks == 1][0], at[3])

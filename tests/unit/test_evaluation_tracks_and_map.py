"""Tracks and map points against exact depth, on planes where the answer is known."""

import numpy as np
import pytest

from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.map_density import count_distinct, well_observed
from pliant.algorithms.tracks import FrameTracks
from pliant.evaluation.criteria import Similarity
from pliant.evaluation.map_truth import evaluate_map, format_map
from pliant.evaluation.tracks_truth import TracksTruth, format_tracks
from pliant.evaluation.visible_depth import DepthView

CAMERA = PinholeCamera(width=64, height=48, fx=50.0, fy=50.0, cx=31.5, cy=23.5)
IDENTITY = Similarity(scale=1.0, R=np.eye(3), t=np.zeros(3))


def pixel_grid() -> np.ndarray:
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    return np.stack([u.ravel(), v.ravel()], axis=1).astype(np.float64)


def plane_depth(normal: tuple[float, float, float], offset: float) -> np.ndarray:
    """Depth of the plane n.p = offset at every pixel, camera at the origin."""
    xy = CAMERA.normalise(pixel_grid())
    inverse = (xy @ np.array(normal[:2]) + normal[2]) / offset
    return (1.0 / inverse).reshape(CAMERA.height, CAMERA.width)


def shifted(x: float) -> np.ndarray:
    T = np.eye(4)
    T[0, 3] = x
    return T


def tracks_at(ids: list[int], points: np.ndarray, age: int) -> FrameTracks:
    n = len(ids)
    return FrameTracks(
        ids=np.array(ids, np.int64),
        points_px=np.asarray(points, np.float32).reshape(-1, 2),
        ages=np.full(n, age, np.int32),
        kappas=np.ones(n, np.float32),
        states=np.zeros(n, np.uint8),
        dominant_flow=np.eye(2, 3),
    )


def test_lift_is_exact_on_a_slanted_plane() -> None:
    view = DepthView.of(CAMERA, shifted(0.5), plane_depth((0.4, -0.3, 1.0), 2.0))
    assert not view.broken.any()
    points_px = np.random.default_rng(0).uniform((0, 0), (63, 47), (50, 2))
    points, good = view.lift(points_px)
    assert good.all()
    in_camera = points - (0.5, 0.0, 0.0)
    assert np.allclose(in_camera @ np.array([0.4, -0.3, 1.0]), 2.0)
    again, depths = view.project(points)
    assert np.allclose(again, points_px)
    assert view.visible(again, depths).all()


def test_no_truth_beside_a_jump_or_without_surface() -> None:
    depth = np.full((48, 64), 2.0)
    depth[:, 32:] = 4.0
    depth[10, 5] = 0.0
    view = DepthView.of(CAMERA, np.eye(4), depth)
    columns = np.flatnonzero(view.broken[30])
    assert columns.tolist() == [30, 31, 32, 33]
    assert view.broken[9:12, 4:7].all()
    _, good = view.lift(np.array([[28.9, 30.0], [29.1, 30.0], [34.0, 30.0], [-0.1, 30.0]]))
    assert good.tolist() == [True, False, True, False]


def test_hidden_points() -> None:
    depth = np.full((48, 64), 2.0)
    depth[:, 32:] = 4.0
    view = DepthView.of(CAMERA, np.eye(4), depth)
    px = np.array([[10.0, 10.0], [10.0, 10.0], [31.5, 10.0], [50.0, 10.0], [np.nan, 1.0]])
    depths = np.array([2.01, 2.03, 4.0, 4.0, -1.0])
    assert view.visible(px, depths).tolist() == [True, False, True, True, False]


def test_tracks_with_a_known_fate() -> None:
    """Points of a wall and a sideways camera: right, drifting, dying, leaving, hidden, edge."""
    truth = TracksTruth(CAMERA, ages=(1, 10))
    depth = np.full((48, 64), 2.0)
    births = np.array([[40, 10], [40, 20], [40, 30], [5, 10], [50, 40], [0.2, 0.2]], np.float64)
    births[5] = (-0.4, 5.0)  # outside the pixel centres: no truth
    for frame in range(11):
        true_px = births - (frame * 1.0, 0.0)  # 0.04 m at 2 m and f = 50 is one pixel
        px = true_px.copy()
        px[1, 0] += 0.3 * frame  # 3 px off at age 10, 0.3 at age 1
        ids = [0, 1, 2, 3, 4, 5] if frame < 5 else [0, 1, 4]
        here = depth.copy()
        if frame >= 8:
            here[36:, :] = 1.0  # something passes before point 4
        truth.add(tracks_at(ids, px[ids], frame), here, shifted(0.04 * frame))
    result = truth.evaluation()
    assert (result.births, result.births_without_truth, result.frames) == (6, 1, 11)
    one, ten = result.ages
    assert (one.living, one.right, one.followable, one.alive) == (5, 5, 5, 5)
    # Point 3 left the image; point 4 is hidden but its track still is where it would be seen.
    assert (ten.living, ten.right) == (3, 2)
    assert (ten.followable, ten.alive, ten.alive_right) == (3, 2, 1)
    assert ten.median_px == pytest.approx(0.0, abs=1e-4)
    assert result.living_median == 3
    assert result.mature_right == pytest.approx(2 / 3)
    assert "66.67 %" in format_tracks(result)


def test_tracks_of_nothing() -> None:
    truth = TracksTruth(CAMERA)
    truth.add(FrameTracks.empty(), np.zeros((48, 64)), np.eye(4))
    result = truth.evaluation()
    assert result.births == 0
    assert np.isnan(result.ages[0].share_right)
    format_tracks(result)


def test_map_points_against_depth() -> None:
    depth = plane_depth((0.2, 0.1, 1.0), 3.0)
    depth[:, 40:] = 6.0
    view = DepthView.of(CAMERA, np.eye(4), depth)
    px = np.array([[10.0, 10.0], [20.3, 30.7], [25.0, 5.0], [39.5, 20.0], [60.0, 20.0]])
    true = np.array([1 / (view.corners(px)[0][i] @ view.corners(px)[1][i]) for i in range(5)])
    true[3] = 6.0  # on the jump: either side is right
    z = true * (1.0, 1.04, 1.06, 1.0, 1.0)
    points = np.concatenate([CAMERA.normalise(px), np.ones((5, 1))], axis=1) * z[:, None]
    behind = np.array([[0.0, 0.0, -1.0]])
    given = np.concatenate([points, behind])
    # The map lives in a world of its own, half as large.
    mine = (given - (1.0, 2.0, 3.0)) / 2.0
    alignment = Similarity(scale=2.0, R=np.eye(3), t=np.array([1.0, 2.0, 3.0]))
    result = evaluate_map(
        mine,
        np.zeros(6, np.int64),
        alignment=alignment,
        camera=CAMERA,
        truth=lambda _: (depth, np.eye(4)),
    )
    assert (result.points, result.in_view, result.at_jumps, result.within) == (6, 5, 1, 4)
    assert result.share == pytest.approx(4 / 6)
    assert result.median_error == pytest.approx(0.0, abs=1e-9)
    assert "66.7 %" in format_map(result)
    empty = evaluate_map(
        mine[:0],
        np.zeros(0, np.int64),
        alignment=IDENTITY,
        camera=CAMERA,
        truth=lambda _: (depth, np.eye(4)),
    )
    assert np.isnan(empty.share)


def test_duplicates_merge() -> None:
    rays = np.concatenate([CAMERA.normalise(pixel_grid()[::97]), np.ones((32, 1))], axis=1)
    points = rays * np.linspace(2.0, 4.0, 32)[:, None]
    near = points[:10] + (0.5 * points[:10, 2:] / 50.0) * (1.0, 0.0, 0.0)  # 0.5 px to the right
    far = points[10:20] + (3.0 * points[10:20, 2:] / 50.0) * (1.0, 0.0, 0.0)  # 3 px
    deep = points[20:25] * 1.2  # the same pixel, another depth
    everything = np.concatenate([points, near, far, deep])
    frames = np.concatenate([np.zeros(32, np.int64), np.full(25, 3, np.int64)])
    poses = {0: np.eye(4), 3: np.eye(4)}
    count = count_distinct(everything, frames, camera=CAMERA, T_world_camera=poses)
    assert count == 32 + 10 + 5
    # Seen from one side only: the pose of the other frame is not known.
    assert count_distinct(everything, frames, camera=CAMERA, T_world_camera={3: np.eye(4)}) == count
    assert count_distinct(everything, frames, camera=CAMERA, T_world_camera={}) == 57


def test_duplicates_equal_a_plain_search() -> None:
    rng = np.random.default_rng(4)
    px, z = rng.uniform((0, 0), (63, 47), (600, 2)), rng.uniform(2.0, 2.4, 600)
    points = np.concatenate([CAMERA.normalise(px), np.ones((600, 1))], axis=1) * z[:, None]
    count = count_distinct(
        points, np.zeros(600, np.int64), camera=CAMERA, T_world_camera={0: np.eye(4)}
    )
    close = np.linalg.norm(px[:, None] - px[None], axis=2) <= 1.0
    close &= np.abs(z[:, None] - z[None]) <= 0.05 * np.minimum(z[:, None], z[None])
    groups = pytest.importorskip("scipy.sparse.csgraph").connected_components(close)[0]
    assert count == groups < 600


def test_well_observed() -> None:
    keyframes, parallax = np.array([2, 3, 9], np.int32), np.radians([5.0, 1.001, 0.9])
    assert well_observed(keyframes, parallax).tolist() == [False, True, False]

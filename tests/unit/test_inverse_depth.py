"""Points without parallax: where they are put, what they say of a pose, and what comes of it."""

from dataclasses import replace

import numpy as np
import pytest
from mapped_scene import Published, run, similarity, trajectory_error
from mapping_scene import CAMERA, INTERVAL_NS, Scene, looking, sideways

from pliant.algorithms.geometry import inverse, so3_exp, so3_log, transform
from pliant.algorithms.map_delta import LOST, TRACKING, MapMoves
from pliant.algorithms.slam.active.frame_pose import localise
from pliant.algorithms.slam.estimate.pose import Correspondences, Spread
from pliant.algorithms.slam.estimate.problem import BundleParameters
from pliant.algorithms.slam.frame import Frame, IdealFrame
from pliant.algorithms.slam.locate.inverse_depth import (
    at_infinity,
    off_epipolar_line,
    place,
    placed_candidates,
    refine_moving_or_standing,
)
from pliant.algorithms.slam.map.landmarks import MAPPED
from pliant.algorithms.slam.mapper import Mapper
from pliant.algorithms.slam.parameters import MappingParameters


def surroundings(count=20000, **kwargs):
    """Points on all sides, at 3 to 8 times the unit."""
    generator = np.random.default_rng(3)
    points = generator.normal(size=(count, 3))
    points *= generator.uniform(3.0, 8.0, (count, 1)) / np.linalg.norm(points, axis=1)[:, None]
    kappas = generator.uniform(5.0, 500.0, count).astype(np.float32)
    return Scene(points, kappas, **kwargs)


def seen_from(poses, points):
    px = np.array([CAMERA.project(transform(inverse(T), points)) for T in poses])
    u, v = np.ascontiguousarray(np.moveaxis(px, 2, 0)).astype(np.float32)
    return u, v


def test_a_point_without_parallax_is_as_far_as_the_map_and_uncertain():
    points = np.array([[0.3, 0.2, 2.0], [-0.5, 0.1, 9.0]])
    poses = np.array([looking((0, 0, 0), (0.0, 0.1 * k, 0.0)) for k in range(3)])
    u, v = seen_from(poses, points)
    seen = np.ones((3, 3), np.bool_)
    u, v = (np.pad(each, ((0, 0), (0, 1))) for each in (u, v))
    seen[:, 2] = False
    xyz, spread = place(poses, u, v, seen, np.arange(3, dtype=np.int32), CAMERA, 0.2)
    np.testing.assert_allclose(np.linalg.norm(xyz[:2], axis=1), 5.0, rtol=1e-3)
    np.testing.assert_allclose(spread[:2], 0.5 * xyz[:2], rtol=1e-3)
    np.testing.assert_allclose(np.cross(xyz[:2], points), 0.0, atol=1e-3)
    assert np.isnan(xyz[2]).all()
    assert np.isnan(spread[2]).all()


def test_parallax_determines_the_distance_and_its_sigma():
    points = np.array([[0.3, 0.2, 2.0], [-0.5, 0.1, 9.0], [0.0, 0.0, 1e4]])
    poses = np.array([looking((0.2 * k, 0, 0)) for k in range(4)])
    u, v = seen_from(poses, points)
    xyz, spread = place(
        poses, u, v, np.ones_like(u, np.bool_), np.arange(3, dtype=np.int32), CAMERA, 0.2
    )
    np.testing.assert_allclose(xyz[:2], points[:2], rtol=2e-2)
    share = np.linalg.norm(spread, axis=1) / np.linalg.norm(xyz, axis=1)
    assert share[0] < share[1] < 0.1
    assert xyz[2, 2] > 50.0


def test_no_depth_is_off_the_epipolar_line_and_what_moves_by_itself_is():
    generator = np.random.default_rng(2)
    X = generator.uniform((-2, -2, 3), (2, 2, 8), (200, 3))
    T = looking((0.3, -0.2, 0.1), (0.02, -0.03, 0.01))
    px = CAMERA.project(transform(inverse(T), X))
    placed = X * generator.uniform(0.6, 2.0, (200, 1))  # as the first camera sees it, elsewhere
    spread = 0.5 * placed
    off = off_epipolar_line(T, placed, spread, px.astype(np.float32), CAMERA)
    assert off.max() < 0.5
    lines = CAMERA.project(transform(inverse(T), 1.01 * X)) - px
    across = np.stack([-lines[:, 1], lines[:, 0]], axis=1)
    across /= np.linalg.norm(across, axis=1)[:, None]
    moved = (px + 5.0 * across).astype(np.float32)
    off = off_epipolar_line(T, placed, spread, moved, CAMERA)
    np.testing.assert_allclose(off, 5.0, atol=0.5)
    turned = looking((0, 0, 0), (0.02, -0.03, 0.01))
    moved = (CAMERA.project(transform(inverse(turned), X)) + np.array([3.0, 4.0])).astype(
        np.float32
    )
    np.testing.assert_allclose(
        off_epipolar_line(turned, placed, spread, moved, CAMERA), 5.0, atol=1e-2
    )


def refined(true, X, spread, noise_px=0.2):
    generator = np.random.default_rng(1)
    px = CAMERA.project(transform(inverse(true), X)) + generator.normal(0, noise_px, (len(X), 2))
    return refined_from(looking((0, 0, 0), (0.01, 0.0, 0.0)), X, spread, px)


def refined_from(start, X, spread, px):
    standing = np.zeros(3)
    return refine_moving_or_standing(
        start, Correspondences(X, px.astype(np.float32), spread=Spread(spread, standing)),
        standing, CAMERA, BundleParameters(kernel_sigma_px=2.0), 1.0,
    )  # fmt: skip


def test_a_camera_that_rotates_among_directions_has_no_translation():
    X = np.random.default_rng(0).uniform((-2, -2, 3), (2, 2, 8), (500, 3))
    true = looking((0, 0, 0), (0.02, -0.03, 0.04))
    (T, inliers, *_), stands = refined(true, X, 0.5 * X)
    assert stands
    assert not T[:3, 3].any()
    assert np.linalg.norm(so3_log(T[:3, :3].T @ true[:3, :3])) < 1e-4
    assert inliers.mean() > 0.99


def test_landmarks_determine_a_step_and_wrong_depths_do_not_bend_it():
    X = np.random.default_rng(0).uniform((-2, -2, 3), (2, 2, 8), (500, 3))
    true = looking((0.2, 0, 0.05), (0.02, -0.03, 0.04))
    spread = 0.5 * X
    spread[:100] = 0.0
    seen_at = X.copy()
    generator = np.random.default_rng(1)
    seen_at[100:] *= generator.uniform(0.7, 1.4, (400, 1))
    px = CAMERA.project(transform(inverse(true), X)) + generator.normal(0, 0.2, (500, 2))
    (T, *_), stands = refined_from(looking((0.15, 0, 0)), seen_at, spread, px)
    assert not stands
    assert np.linalg.norm(T[:3, 3] - true[:3, 3]) < 5e-3
    assert np.linalg.norm(so3_log(T[:3, :3].T @ true[:3, :3])) < 1e-3


@pytest.mark.parametrize("nearer", [0.5, 0.7, 1.5, 2.5])
def test_depths_that_err_together_do_not_bend_a_step_of_few_points(nearer):
    """As where the camera looks at what is not mapped, and it is not as far as the map."""
    generator = np.random.default_rng(0)
    X = generator.uniform((-2, -2, 3), (2, 2, 8), (4000, 3))
    true = looking((0.01, 0, 0.0), (0.002, -0.003, 0.004))
    spread, taken = 0.5 * X * nearer, X * nearer
    spread[:100], taken[:100] = 0.0, X[:100]
    px = CAMERA.project(transform(inverse(true), X)) + generator.normal(0, 0.1, (4000, 2))
    (T, *_), stands = refined_from(np.eye(4), taken, spread, px)
    assert not stands
    assert np.linalg.norm(T[:3, 3] - true[:3, 3]) < 1e-3


def full_turn(axis, before=20, turn=90, after=20):
    axis = np.array(axis, np.float64)
    walk = [(0.06 * k, 0.01 * np.sin(k), 0.0) for k in range(before + after)]
    poses = [looking(p) for p in walk[:before]]
    for k in range(1, turn + 1):
        T = looking(walk[before - 1])
        T[:3, :3] = so3_exp(2.0 * np.pi * k / turn * axis)
        poses.append(T)
    return poses + [looking(p) for p in walk[before:]]


@pytest.mark.parametrize("axis", [(0, 1, 0), (1, 0, 0), (0, 0, 1)])
def test_a_full_turn_on_the_spot_stays_in_one_map(axis):
    poses = full_turn(axis)
    published, _ = run(surroundings().frames(poses))
    assert sorted(published.poses) == list(range(len(poses)))
    assert {segment for _, _, segment in published.poses.values()} == {0}
    error, _ = trajectory_error(published, poses)
    assert error < 1e-3


@pytest.mark.parametrize(("count", "state"), [(45, LOST), (80, TRACKING)])
def test_a_direction_has_half_the_information_of_a_point(count, state):
    *frames, last = surroundings().frames(full_turn((0, 1, 0))[:65])
    mapper = Mapper(CAMERA, MappingParameters(), 0)
    states = [mapper.process(Frame(k, k * INTERVAL_NS, t)).state for k, t in enumerate(frames)]
    assert states[-1] == TRACKING
    shared = np.flatnonzero(np.isin(last.ids, frames[-1].ids))[:count]
    few = {name: getattr(last, name)[shared] for name in ("ids", "points_px", "ages", "kappas")}
    left = replace(last, **few, states=last.states[shared], maxima=last.maxima[:0])
    delta = mapper.process(Frame(len(frames), len(frames) * INTERVAL_NS, left))
    assert delta.state == state


def test_frames_that_turned_before_the_map_started_get_poses():
    turned = [looking((0, 0, 0), (0.0, 0.04 * (k - 150), 0.0)) for k in range(150)]
    poses = turned + [looking((0.06 * k, 0.02 * k * k / 20, 0.0)) for k in range(20)]
    published, _ = run(surroundings().frames(poses))
    assert sorted(published.poses) == list(range(len(poses)))
    error, (_, R, _) = trajectory_error(published, poses)
    assert error < 2e-3
    for k in (0, 75, 149):
        turn = poses[k][:3, :3].T @ R @ published.pose(k)[:3, :3]
        assert np.degrees(np.linalg.norm(so3_log(turn))) < 0.5


def test_directions_move_with_the_map_and_are_where_an_adjustment_leaves_it():
    mapper = Mapper(CAMERA, MappingParameters(), 0)
    for frame, tracks in enumerate(Scene.box(death=0.1).frames(sideways(45))):
        mapper.process(Frame(frame, frame * INTERVAL_NS, tracks))
    active = mapper.atlas.active
    last, points = active.keyframes[-1], active.points
    rows = active.window.rows[placed_candidates(points, active.window.rows)]
    assert len(rows) > 50

    mapped = active.segment.mapped_rows()

    def seen(rows):
        """(N, 3) of the newest keyframe."""
        return transform(inverse(last.T_world_camera), points.xyz[rows])

    def grown(rows, before):
        return np.linalg.norm(seen(rows), axis=1) / np.linalg.norm(before, axis=1)

    before, map_before, spread = (
        seen(rows),
        seen(mapped),
        np.linalg.norm(points.spread[rows], axis=1),
    )
    # The second half of the map, as it drifts.
    half = active.keyframes[len(active.keyframes) // 2].id
    drift = [similarity(1.0, (0, 0, 0), (0, 0, 0)), similarity(1.05, (0, 0.02, 0), (0.1, 0, 0.05))]
    ids = np.array([active.keyframes[0].id, half])
    active.move(MapMoves(keyframe_ids=ids, moves=np.array(drift)))
    np.testing.assert_allclose(seen(rows), 1.05 * before, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(points.spread[rows], axis=1), 1.05 * spread)
    active.adjust_all(mapper.calibration)
    np.testing.assert_allclose(CAMERA.project(seen(rows)), CAMERA.project(before), atol=0.5)
    scale = np.median(grown(mapped, map_before))
    np.testing.assert_allclose(grown(rows, before), scale, rtol=0.02)


def test_a_point_that_an_adjustment_takes_to_infinity_is_a_direction_again():
    """Of the map that remains every point has a place, and its track tells of turns."""
    mapper, published = Mapper(CAMERA, MappingParameters(), 0), Published()
    for frame, tracks in enumerate(Scene.box(death=0.02).frames(sideways(60))):
        published.apply(mapper.process(Frame(frame, frame * INTERVAL_NS, tracks)))
        if frame == 30:
            points, active = mapper.atlas.points, mapper.atlas.active
            seen = active.window.current_rows()
            row = seen[points.state[seen] == MAPPED][0]
            told = points.ids[row]
            centre = active.keyframes[-1].T_world_camera[:3, 3]
            points.xyz[row] = centre + 1e9 * (points.xyz[row] - centre)
            for keyframe in active.keyframes:
                T_camera_world = inverse(keyframe.T_world_camera)
                px = CAMERA.project(transform(T_camera_world, points.xyz[row][None]))
                keyframe.points_px[keyframe.rows == row] = px
    assert told not in published.points
    published.apply(mapper.finish())
    xyz = np.array([xyz for xyz, _, _ in published.points.values()])
    assert np.abs(xyz).max() < 1e6


def test_a_map_without_points_has_none_at_infinity():
    far = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 2.0], [3e6, 0.0, 0.0], [np.inf, 0.0, 0.0]])
    assert at_infinity(far[:3], np.zeros(3)).tolist() == [False, False, True]
    assert at_infinity(far, np.zeros(3)).tolist()[:2] == [False, False]
    assert at_infinity(np.zeros((0, 3)), np.zeros(3)).tolist() == []


def test_candidates_that_helped_one_frame_are_not_missed_in_the_next():
    """Else every frame whose points suffice again would be looked up in all places."""
    frames = list(Scene.box().frames(sideways(31)))
    mapper = Mapper(CAMERA, MappingParameters(), 0)
    for frame, tracks in enumerate(frames[:30]):
        mapper.process(Frame(frame, frame * INTERVAL_NS, tracks))
    active, calibration, last = mapper.atlas.active, mapper.calibration, mapper._motion
    assert active is not None
    active.links.follow(frames[30].ids, active.points)
    frame = IdealFrame.of(Frame(30, 30 * INTERVAL_NS, frames[30]), calibration)

    def is_firm(**tracked):
        motion, generator = replace(last, **tracked), np.random.default_rng(0)
        located = localise(active, motion, frame, generator)
        assert located is not None
        return located.is_firm

    assert last.to_points > 300
    assert is_firm(tracked=10 * last.to_points)
    assert not is_firm(to_points=10 * last.to_points)

"""A place that is seen again: drift goes, and points that were mapped twice become one."""

from dataclasses import replace

import numpy as np
import pytest
from drifted_scene import AWAY, PARAMETERS, drifted, drifted_once, recognised, there_and_back, world
from mapped_scene import error_of, similarity, trajectory_error
from mapping_scene import CAMERA, INTERVAL_NS, looking

from pliant.algorithms.geometry import inverse
from pliant.algorithms.map_delta import TRACKING, MapMoves
from pliant.algorithms.slam.adjust.final_adjustment import ObservationList
from pliant.algorithms.slam.adjust.global_adjustment import GlobalAdjustment
from pliant.algorithms.slam.adjust.loops import Loop, close_loops
from pliant.algorithms.slam.frame import Frame
from pliant.algorithms.slam.map.landmarks import MAPPED, Landmarks
from pliant.algorithms.slam.mapper import Mapper
from pliant.algorithms.slam.parameters import (
    WholeMapParameters,
)
from pliant.state import load_state, save_state

__all__ = ["drifted", "drifted_once", "world"]  # fixtures


def error(active):
    return error_of(active, there_and_back())


def close(mapper):
    """By the graph, and by the adjustment where that is asked for."""
    answers = []
    for _ in range(2):
        mapper.atlas.request(2 * AWAY)
        if (result := mapper.global_adjustment.settle()) is not None:
            mapper.follow(mapper.atlas.take_over(result))
            answers.append(result)
    return answers[0]


def test_of_a_loop_that_waits_points_may_go_and_their_rows_be_of_others():
    points = Landmarks()
    rows = points.allocate(6)
    points.promote(rows)
    pairs = rows.reshape(3, 2)
    loop = Loop(old=0, new=9, S_old_new=np.eye(4), rows=pairs, ids=points.ids[pairs].copy())
    assert loop.living(points) is loop
    points.cull(rows[[2]])
    assert loop.living(points).rows.tolist() == pairs[[0, 2]].tolist()
    points.promote(points.allocate(1))  # the same row, another point
    assert loop.living(points).rows.tolist() == pairs[[0, 2]].tolist()


def test_a_loop_takes_out_the_drift_and_joins_the_points(drifted):
    scene, _, mapper, _ = drifted
    loop, active = recognised(scene, mapper), mapper.atlas.active
    assert len(loop.rows) > 100
    before, count = error(active), mapper.point_count
    mapper.global_adjustment.loops.append(loop)
    result = close(mapper)
    assert result.loops == [loop]
    assert len(result.moves.keyframe_ids) == len(active.keyframes)
    assert error(active) < 0.05 * before
    assert mapper.point_count == count - len(loop.rows)
    active.collect_garbage()
    shared = np.intersect1d(active.keyframes[0].rows, active.keyframes[-1].rows)
    assert np.isin(loop.rows[:, 0], shared).mean() > 0.9


def test_the_map_continues_and_readers_have_it(drifted):
    scene, frames, mapper, published = drifted
    loop, told = recognised(scene, mapper), []
    mapper.global_adjustment.loops.append(loop)
    mapper.atlas.request(2 * AWAY - 1)
    for k in range(2 * AWAY, 2 * AWAY + 10):
        mapper = load_state(save_state(mapper))
        delta = mapper.process(Frame(k, k * INTERVAL_NS, frames[k]))
        published.apply(delta)
        mapper.publish_keyframes()
        told += delta.same_places.tolist()
    assert told == [[loop.old, loop.new]]
    assert published.states[-1] == TRACKING
    active = mapper.atlas.active
    for keyframe in active.keyframes:
        np.testing.assert_allclose(
            published.keyframes[keyframe.id], keyframe.T_world_camera, atol=1e-9
        )
    assert len(published.points) == mapper.point_count
    share, _ = trajectory_error(published, [*there_and_back(), *there_and_back()[:10]])
    assert share < 2e-3


def test_a_loop_is_closed_sooner_than_the_map_is_adjusted(drifted):
    _, _, mapper, _ = drifted
    mapper.global_adjustment.loops.append(recognised(*drifted[::2]))
    mapper.atlas.request(0)
    limits = WholeMapParameters(distance_frames=30, observations_per_frame=500)
    parameters = PARAMETERS.model_copy(update={"whole_map": limits})
    closing = replace(mapper.global_adjustment.job, parameters=parameters)
    adjusting = replace(closing, loops=[])
    assert adjusting.distance_frames > 40
    assert closing.distance_frames == pytest.approx(0.1 * adjusting.distance_frames, abs=0.5)


def test_a_loop_of_the_last_frames_is_closed_at_the_end(drifted):
    scene, _, mapper, published = drifted
    mapper.global_adjustment.loops.append(recognised(scene, mapper))
    published.apply(mapper.finish())
    share, _ = trajectory_error(published, there_and_back())
    assert share < 1e-3


def test_a_loop_that_waits_moves_with_the_map(drifted):
    scene, _, mapper, _ = drifted
    loop = recognised(scene, mapper)
    mapper.global_adjustment.loops.append(loop)
    mapper.atlas.request(0)
    mapper.global_adjustment.loops.append(loop)
    mapper.atlas.take_over(mapper.global_adjustment.settle())
    (waiting,) = mapper.global_adjustment.loops
    before, after = (np.linalg.norm(each.S_old_new - np.eye(4)) for each in (loop, waiting))
    assert after < 0.1 * before


def test_a_loop_that_others_contradict_is_left_out(drifted):
    scene, _, mapper, _ = drifted
    good, bad = recognised(scene, mapper), recognised(scene, mapper, wrong=True)
    ids = [keyframe.id for keyframe in mapper.atlas.active.keyframes]
    others = [good._replace(old=ids[0], new=ids[-1]) for _ in range(2)]
    mapper.global_adjustment.loops += [bad, *others]
    result = close(mapper)
    assert result.loops == others
    assert error(mapper.atlas.active) < 0.03


def test_points_that_have_gone_are_not_joined(drifted):
    scene, _, mapper, _ = drifted
    loop = recognised(scene, mapper)
    count = mapper.point_count
    mapper.atlas.points.remove(loop.rows[:5, 0])
    mapper.atlas.active.join(loop)
    assert mapper.point_count == count - 5 - (len(loop.rows) - 5)


def test_moves_follow_each_other():
    first = MapMoves(
        keyframe_ids=np.array([2, 5]),
        moves=np.array([similarity(2.0, (0, 0, 1), (1, 0, 0)), similarity(0.5, (0, 1, 0), 0)]),
    )
    then = MapMoves(keyframe_ids=np.array([3]), moves=similarity(1.5, (1, 0, 0), (0, 2, 0))[None])
    some = np.arange(8)
    np.testing.assert_allclose(
        first.then(then).matrices(some), then.matrices(some) @ first.matrices(some), atol=1e-12
    )


def test_a_place_that_looks_alike_is_too_far_for_drift(world):
    """The same door at both ends of a wall: the map would have had to slip by its whole length."""
    _, frames = world
    mapper = Mapper(CAMERA, PARAMETERS, 0)
    for k, tracks in enumerate(frames[:AWAY]):
        mapper.process(Frame(k, k * INTERVAL_NS, tracks))
    active, points = mapper.atlas.active, mapper.atlas.points
    first, last = active.keyframes[0], active.keyframes[-1]
    S = first.T_world_camera @ inverse(last.T_world_camera)
    rows = np.column_stack([k.rows[points.state[k.rows] == MAPPED][:200] for k in (first, last)])
    before = error_of(active, there_and_back())
    loops = [
        Loop(old=first.id, new=k.id, S_old_new=S, rows=rows, ids=points.ids[rows])
        for k in active.keyframes[-2:]
    ]
    mapper.global_adjustment.loops += loops
    result = close(mapper)
    assert result.loops == []
    assert mapper.global_adjustment == GlobalAdjustment()  # and nothing has been asked for
    assert error_of(active, there_and_back()) == before


def test_a_recognised_camera_is_where_it_was_despite_similar_places():
    """Back in the first of two rooms that are alike, it sees little of what it saw there before."""
    cameras = [looking((x, 0.0, 0.0)) for x in (0.0, 0.2, 6.0, 12.0, 12.2, 0.1, 0.3)]
    generator = np.random.default_rng(0)
    groups = [(0, 1), (1, 2), (2, 3), (3, 4), (5, 6)]
    seen = [(group, 100) for group in groups] + [((0, 1, 5, 6), 8)]
    xyz, camera, point = [], [], []
    for group, count in seen:
        for _ in range(count):
            middle = np.mean([cameras[k][0, 3] for k in group])
            camera += group
            point += [len(xyz)] * len(group)
            xyz.append(generator.uniform((middle - 1, -1, 3), (middle + 1, 1, 5)))
    order = np.argsort(camera, kind="stable")
    listed = ObservationList(
        rows=np.arange(len(xyz), dtype=np.int32), xyz=np.array(xyz),
        T_world_camera=np.array(cameras), camera=np.array(camera, np.int32)[order],
        point=np.array(point, np.int32)[order], px=np.zeros((len(order), 2), np.float32),
        weights=np.ones(len(order), np.float32), fixed=np.arange(len(cameras)) == 0,
    )  # fmt: skip
    no_rows = np.zeros((0, 2), np.int32)
    loops = [
        Loop(old, new, looking((12.0, 0.0, 0.0)), no_rows, no_rows.astype(np.int64))
        for old, new in ((3, 5), (4, 6))
    ]
    ids = np.arange(len(cameras))
    moves, accepted = close_loops(listed, ids, np.full(len(xyz), 0.01), loops, 500.0)
    assert accepted == []
    np.testing.assert_allclose(moves.matrices(ids[5:]), [np.eye(4)] * 2, atol=1e-3)

"""What a map gives up that has more observations than room: nothing that adjusts it stops."""

from dataclasses import replace

import numpy as np
import pytest
from drifted_scene import drifted, drifted_once, recognised, there_and_back, world
from mapped_scene import Published, similarity, trajectory_error
from mapping_scene import CAMERA, INTERVAL_NS, Scene, sideways

from pliant.algorithms.map_delta import TRACKING, MapMoves
from pliant.algorithms.slam.adjust.segment import DroppedKeyframes, Segment
from pliant.algorithms.slam.atlas.atlas import Atlas
from pliant.algorithms.slam.calibration.self_calibration import SelfCalibration
from pliant.algorithms.slam.frame import Frame
from pliant.algorithms.slam.map.keyframe import Keyframe
from pliant.algorithms.slam.map.landmarks import FREE, MAPPED, Landmarks
from pliant.algorithms.slam.mapper import Mapper
from pliant.algorithms.slam.parameters import (
    MappingParameters,
    WholeMapParameters,
    WindowParameters,
)
from pliant.algorithms.slam.store import sparsification
from pliant.algorithms.slam.store.earlier_segments import EarlierSegments
from pliant.algorithms.slam.store.sparsification import observations_of, sparsify
from pliant.state import load_state, save_state

__all__ = ["drifted", "drifted_once", "world"]  # fixtures

NO_TRACK = np.zeros(0, np.int32)


def keyframe(number: int, rows: list[int]) -> Keyframe:
    return Keyframe(
        id=number,
        frame=number,
        segment=0,
        T_world_camera=np.eye(4),
        rows=np.array(rows, np.int32),
        points_px=np.zeros((len(rows), 2), np.float32),
        rolled_px=np.zeros((len(rows), 2), np.float32),
    )


def segment(seen: list[list[int]]) -> Segment:
    points = Landmarks()
    rows = points.allocate(1 + max(max(rows) for rows in seen))
    points.promote(rows)
    points.first_keyframe[rows] = [
        next((k for k, some in enumerate(seen) if row in some), 0) for row in rows
    ]
    keyframes = [keyframe(k, rows) for k, rows in enumerate(seen)]
    return Segment(id=0, points=points, keyframes=keyframes)


def seen_by(some: Segment) -> np.ndarray:
    """How many keyframes see each row."""
    rows = np.concatenate([keyframe.rows for keyframe in some.keyframes])
    return np.bincount(rows, minlength=len(some.points.state))


def limits(room: int, least: int) -> WindowParameters:
    return WindowParameters(kept_observations=max(room, 1000), kept_per_keyframe=least)


def test_rows_of_points_that_went_are_free() -> None:
    points = Landmarks()
    rows = points.allocate(6)
    points.promote(rows[:5])  # the last one is a candidate
    points.cull(rows[[0, 4]])
    assert points.culled == 2
    assert (points.state == MAPPED).sum() == 3
    again = points.allocate(2)
    assert sorted(again.tolist()) == [0, 4]  # no new memory
    points.promote(again)
    assert len(set(points.ids[[0, 1, 2, 3, 4]].tolist())) == 5  # ids are never reused


def test_points_that_few_keyframes_see_go_first_and_every_keyframe_keeps_its_share() -> None:
    long, short = list(range(10)), [list(range(10 + 20 * k, 40 + 20 * k)) for k in range(6)]
    some = segment([long + each for each in short])
    linked = np.array([35, -1], np.int32)  # of a point that only the first two see
    before = observations_of([some])
    sparsify(some, 180, limits(180, 10), linked, whole=1)
    assert observations_of([some]) <= 180 < before
    assert all(set(long) <= set(k.rows.tolist()) for k in some.keyframes)
    assert all(len(k.rows) >= 20 for k in some.keyframes)
    assert len(some.keyframes[-1].rows) == 40
    assert some.points.state[35] == MAPPED
    assert len(some.dropped) == 0
    assert some.points.culled == (some.points.state[:140] == FREE).sum() > 0
    assert some.sparsified


def test_a_map_that_has_room_stays_as_it_is() -> None:
    some = segment([[0, 1, 2], [1, 2, 3]])
    sparsify(some, 6, limits(6, 1), NO_TRACK, whole=1)
    assert observations_of([some]) == 6
    assert not some.sparsified


def test_a_visit_of_a_place_leaves_and_moves_as_another_one() -> None:
    place, way = list(range(30)), [list(range(30 + 15 * k, 60 + 15 * k)) for k in range(5)]
    some = segment([place, *way[:2], place, *way[2:4], place, way[4], way[4]])
    some.since = 5
    sparsify(some, 268, limits(268, 30), NO_TRACK, whole=1)
    assert [k.id for k in some.keyframes] == [0, 1, 2, 4, 5, 6, 7, 8]
    assert some.dropped.ids.tolist() == [3]
    assert some.dropped.hosts.tolist() == [0]
    assert some.since == 4


def test_keyframes_go_where_their_pairs_take_more_room_than_what_they_see(monkeypatch):
    some = segment([[0, k // 2 + 1] for k in range(30)])
    room = observations_of([some])
    sparsify(some, room, limits(room, 1), NO_TRACK, whole=1)
    assert len(some.keyframes) == 30
    monkeypatch.setattr(sparsification, "_PAIRS", 10)
    sparsify(some, room, limits(room, 1), NO_TRACK, whole=1)
    assert len(some.keyframes) == int(0.9 * int(np.sqrt(10 * room)))


def test_keyframes_go_where_each_has_too_many_neighbours() -> None:
    """Of a place that is seen again and again; a path of any length keeps all of them."""
    few = limits(10_000, 1).model_copy(update={"kept_neighbours": 20})
    place = segment([[0, 1, 2, 3, 10 + k // 2] for k in range(60)])
    sparsify(place, 10_000, few, NO_TRACK, whole=1, settled=False)
    assert len(place.keyframes) == 60
    sparsify(place, 10_000, few, NO_TRACK, whole=1)
    assert len(place.keyframes) == int(0.9 * int(60 * 20 / 59))
    path = segment([list(range(k, k + 5)) for k in range(60)])
    sparsify(path, 10_000, few, NO_TRACK, whole=1)
    assert len(path.keyframes) == 60


def test_points_that_one_keyframe_is_left_to_see_go_with_those_that_saw_them_too() -> None:
    """The final adjustment would take such points out of the results."""
    some = segment([list(range(10 * k, 10 * k + 25)) for k in range(60)])
    linked = np.array([some.keyframes[30].rows[3]], np.int32)
    alone = seen_by(some) == 1
    sparsify(some, 400, limits(400, 20), linked, whole=2)
    assert 0 < len(some.dropped) < 58
    needed = np.zeros(len(alone), np.bool_)
    needed[[*linked, *some.keyframes[-2].rows, *some.keyframes[-1].rows]] = True
    now = (some.points.state == MAPPED) & (seen_by(some) == 1)
    assert not (now & ~needed & ~alone).any()
    assert some.points.state[linked] == MAPPED


def test_the_newest_keyframes_stay_whole_also_where_there_are_no_others() -> None:
    """Of a segment that the camera leaves nobody has been told of them yet."""
    some = segment([list(range(10 * k, 10 * k + 25)) for k in range(5)])
    before = [keyframe.rows.copy() for keyframe in some.keyframes]
    sparsify(some, 30, limits(30, 5), NO_TRACK, whole=8)
    for keyframe, rows in zip(some.keyframes, before, strict=True):
        np.testing.assert_array_equal(keyframe.rows, rows)


def test_a_segment_that_is_left_keeps_what_is_not_published_yet() -> None:
    left = segment([list(range(10 * k, 10 * k + 25)) for k in range(30)])
    window = WindowParameters(keyframes=16, kept_observations=1000, kept_per_keyframe=5)
    earlier = EarlierSegments()
    earlier.keep(left, SelfCalibration(CAMERA, np.zeros(7), np.zeros((7, 7))))
    before = [keyframe.rows.copy() for keyframe in left.keyframes[-16:]]
    earlier.share_room(left.points, window)
    for keyframe, rows in zip(left.keyframes[-16:], before, strict=True):
        np.testing.assert_array_equal(keyframe.rows, rows)


def test_two_segments_that_become_one_have_not_been_adjusted_as_one() -> None:
    """Nothing of it is settled, so that nothing goes before its adjustment."""
    points = Landmarks()
    goes_on, rests = (Segment(id=i, points=points, keyframes=[keyframe(i, [])]) for i in (1, 0))
    goes_on.adjusted = 1
    goes_on.take_in(rests, 0)
    assert goes_on.adjusted == -1


def test_a_segment_without_room_is_dropped_with_what_it_had_dropped() -> None:
    left = segment([list(range(10 * k, 10 * k + 25)) for k in range(30)])
    atlas = Atlas(SelfCalibration(CAMERA, np.zeros(7), np.zeros((7, 7))), MappingParameters())
    atlas.points = left.points
    left.dropped.take_in(
        DroppedKeyframes(ids=np.array([30]), hosts=np.array([30]), centres=np.zeros((1, 3)))
    )
    atlas._earlier.keep(left, atlas.calibration)
    no_room = WindowParameters(kept_observations=1000).model_copy(update={"kept_observations": 20})
    atlas._earlier.share_room(left.points, no_room)
    assert atlas.everything() == []
    assert atlas.dropped == {"dropped_keyframes": 31, "dropped_points": 315}


def test_dropped_keyframes_move_with_their_neighbourhood() -> None:
    """In time, or in what it saw; also where that was given up later."""
    here = DroppedKeyframes()
    for ids, hosts in (([4, 7], [0, 0]), ([2, 8], [2, 4]), ([5], [5])):
        centres = np.column_stack([ids, np.zeros((len(ids), 2))])
        here.take_in(DroppedKeyframes(ids=np.array(ids), hosts=np.array(hosts), centres=centres))
    assert here.hosts.tolist() == [2, 0, 5, 0, 0]
    moves = MapMoves(
        keyframe_ids=np.array([0, 1, 3, 6, 9]),
        moves=np.array([similarity(1.0 + 0.3 * k, (0, 0, 0), (k, 0, 0)) for k in range(5)]),
    )
    told = here.together_with(moves)
    assert told.keyframe_ids.tolist() == list(range(10))
    S = told.matrices(np.arange(10))
    for kept in (0, 1, 3, 6, 9):
        np.testing.assert_array_equal(S[kept], moves.matrices(np.array([kept]))[0])
    for hosted in (4, 7, 8):
        np.testing.assert_array_equal(S[hosted], S[0])
    for gone, share in ((2, 0.5), (5, 2 / 3)):
        at = np.array([gone, 0, 0, 1])
        first, last = S[{2: 1, 5: 3}[gone]], S[{2: 3, 5: 6}[gone]]
        np.testing.assert_allclose(S[gone] @ at, (1 - share) * first @ at + share * last @ at)
    assert [here.host_of(k, moves.keyframe_ids) for k in (6, 2, 5, 8)] == [6, 1, 3, 0]


def test_the_map_keeps_its_size_where_the_camera_comes_back():
    """The same views many times: the state is bounded, poses are right, all published stays."""
    room = WindowParameters(keyframes=6, kept_observations=9000, kept_per_keyframe=100)
    once = sideways(45)
    poses = [*once, *once[-2:0:-1]] * 4
    mapper, published = Mapper(CAMERA, MappingParameters(window=room), 0), Published()
    rows, most = [], 0
    for frame, tracks in enumerate(Scene.box(death=0.01).frames(poses)):
        published.apply(mapper.process(Frame(frame, frame * INTERVAL_NS, tracks)))
        mapper.publish_keyframes()
        if mapper.atlas.active is not None:
            most = max(most, observations_of([mapper.atlas.active.segment]))
        rows.append(mapper.atlas.points.count)
    published.apply(mapper.finish())
    kept = mapper.atlas.active.segment
    assert len(kept.keyframes) + len(kept.dropped) == len(published.keyframes)
    assert len(kept.dropped) > len(kept.keyframes)
    assert most < 1.6 * room.kept_observations
    assert max(rows[len(rows) // 2 :]) <= 1.1 * max(rows[: len(rows) // 2])
    assert mapper.point_count == len(published.points)
    counts = {"dropped_keyframes": len(kept.dropped), "dropped_points": kept.points.culled}
    assert counts.items() <= mapper.counters.items()
    again = load_state(save_state(mapper)).atlas.active.segment
    np.testing.assert_array_equal(again.dropped.centres, kept.dropped.centres)
    assert trajectory_error(published, poses)[0] < 1e-3
    assert set(published.states[10:]) == {TRACKING}


def along(poses, window):
    """A camera along a wall of points, with noise: the mapper, what readers have at the end, and
    the keyframes that each adjustment moved once the map had given something up."""
    generator = np.random.default_rng(0)
    points = generator.uniform((-4.0, -3.0, 3.0), (11.0, 3.0, 9.0), (1500, 3))
    kappas = generator.uniform(5.0, 500.0, len(points)).astype(np.float32)
    parameters = MappingParameters(window=window, whole_map=WholeMapParameters(distance_frames=7))
    mapper, published, moved = Mapper(CAMERA, parameters, 0), Published(), []
    for frame, tracks in enumerate(Scene(points, kappas, death=0.02).frames(poses)):
        px = tracks.points_px + generator.normal(0.0, 0.3, tracks.points_px.shape)
        seen = replace(tracks, points_px=px.astype(np.float32))
        sparsified = mapper.atlas.active is not None and mapper.atlas.active.segment.sparsified
        delta = mapper.process(Frame(frame, frame * INTERVAL_NS, seen))
        published.apply(delta)
        moved += [delta.moved_keyframes] if sparsified and len(delta.moved_keyframes) else []
    published.apply(mapper.finish())
    return mapper, published, moved


WINDOW = WindowParameters(keyframes=6)


@pytest.fixture(scope="module")
def whole():
    return along(there_and_back(), WINDOW)


def map_error(published, poses):
    """As ``trajectory_error``, of the keyframes where the map has them: nothing is smoothed."""
    keyframes = Published()
    keyframes.keyframes = published.keyframes
    keyframes.poses = {frame: (i, np.eye(4), 0) for i, frame in published.frame_of_keyframe.items()}
    return trajectory_error(keyframes, poses)[0]


@pytest.mark.parametrize(("room", "least"), [(14000, 60), (14000, 400), (9000, 100)])
def test_beyond_its_room_the_map_is_adjusted_as_before(whole, room, least):
    """While it grows and at the end, and what has been given up moves, too."""
    poses, (unbounded, all_of_it, _) = there_and_back(), whole
    assert observations_of([unbounded.atlas.active.segment]) > 1.5 * room
    some = {"kept_observations": room, "kept_per_keyframe": least}
    mapper, published, moved = along(poses, WINDOW.model_copy(update=some))
    kept = mapper.atlas.active.segment
    assert len(kept.dropped) > 0
    assert kept.points.culled > 0
    assert len(published.keyframes) == len(kept.keyframes) + len(kept.dropped)
    assert len(moved) >= 1
    assert np.isin(kept.dropped.ids, moved[-1]).any()
    assert len(published.poses) == len(poses)
    assert map_error(published, poses) < 2.5 * map_error(all_of_it, poses)
    assert trajectory_error(published, poses)[0] < 2.5 * map_error(all_of_it, poses)


def test_a_loop_is_closed_in_a_map_with_dropped_keyframes(drifted):
    """Frames that hang on what is no more gain from it, too."""
    scene, _, mapper, published = drifted
    active = mapper.atlas.active
    before = observations_of([active.segment])
    sparsify(active.segment, before // 2, limits(1000, 200), active.links.rows, whole=6)
    assert len(active.segment.dropped) > 10
    loop = recognised(scene, mapper)
    mapper.global_adjustment.loops.append(loop)
    last = mapper.finish()
    assert last.same_places.tolist() == [[loop.old, loop.new]]
    assert np.isin(active.segment.dropped.ids, last.moved_keyframes).all()
    assert trajectory_error(published.apply(last), there_and_back())[0] < 3e-3


def test_a_loop_to_a_dropped_keyframe_is_one_to_its_host(drifted):
    scene, _, mapper, _ = drifted
    active, loop = mapper.atlas.active, recognised(scene, mapper)
    sparsify(active.segment, 12_000, limits(1000, 200), active.links.rows, whole=6)
    gone = active.segment.dropped
    mapper.global_adjustment.loops += [loop._replace(old=int(k)) for k in gone.ids[:2]]
    mapper.atlas.request(0)
    kept = np.array([keyframe.id for keyframe in active.keyframes])
    asked = [each.old for each in mapper.global_adjustment.job.loops]
    assert asked == [gone.host_of(int(k), kept) for k in gone.ids[:2]]
    assert np.isin(asked, kept).all()

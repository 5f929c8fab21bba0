"""Which keyframes are asked whether a place is seen again, and when that is believed."""

import numpy as np
import pytest
from mapped_scene import Published, trajectory_error
from mapping_scene import CAMERA, INTERVAL_NS, Scene, looking
from pictured_scene import picture, textures

from pliant.algorithms.slam.atlas import known_places
from pliant.algorithms.slam.atlas.known_places import Comparisons, LoopCandidates
from pliant.algorithms.slam.frame import Frame
from pliant.algorithms.slam.map.keyframe import Keyframe
from pliant.algorithms.slam.map.landmarks import Landmarks
from pliant.algorithms.slam.mapper import Mapper
from pliant.algorithms.slam.parameters import (
    MappingParameters,
    ReacquisitionParameters,
    WholeMapParameters,
    WindowParameters,
)
from pliant.algorithms.slam.places.place_match import PlaceMatch
from pliant.algorithms.slam.places.relocalisation import Place
from pliant.state import load_state, save_state

PARAMETERS = MappingParameters(window=WindowParameters(keyframes=3))
COUNT, EACH = 20, 50


@pytest.fixture
def segment():
    """Keyframes that share no points with each other, which lie 4 units ahead of each."""
    points = Landmarks()
    keyframes = []
    for number in range(COUNT):
        rows = points.allocate(EACH)
        points.promote(rows)
        points.xyz[rows] = (float(number), 0.0, 4.0)
        keyframes.append(
            Keyframe(
                id=number, frame=number, segment=0, rows=rows,
                T_world_camera=looking((float(number), 0.0, 0.0)),
                points_px=np.zeros((EACH, 2), np.float32),
                rolled_px=np.zeros((EACH, 2), np.float32),
            )
        )  # fmt: skip
    return points, keyframes


def drift(shift, scale=1.0):
    S = np.diag([scale, scale, scale, 1.0])
    S[0, 3] = shift
    return S


def look(own, monkeypatch, segment, newest, proves, alike=None, elsewhere=(), counted=None):
    """What the newest of the keyframes tells.  proves: the drift by id of the old one, or why not.
    Also who was asked."""
    points, keyframes = segment
    asked = []

    def match_places(old, new, *_):
        asked.append(old.keyframe.id)
        S = proves.get(old.keyframe.id)
        if S is None or isinstance(S, str):
            return S or "few_corners"
        rows = np.column_stack([old.keyframe.rows[:40], new.keyframe.rows[:40]])
        return PlaceMatch(S_old_new=S, rows=rows)

    monkeypatch.setattr(known_places, "match_places", match_places)
    known = keyframes[: newest + 1]
    places = [Place(keyframe=k, corners=None, segment=known) for k in known]
    some = [places[k] for k in alike or proves if k < newest]
    others = (places[k] for k in elsewhere)
    counted = Comparisons() if counted is None else counted
    told = own.search(places[-1], some, points, CAMERA, PARAMETERS, counted, elsewhere=others)
    return told, asked


def test_two_keyframes_must_agree(monkeypatch, segment):
    own = LoopCandidates()
    assert look(own, monkeypatch, segment, 10, {1: drift(-3.0)})[0] == []
    loops, _ = look(own, monkeypatch, segment, 11, {2: drift(-3.05)})
    assert [(loop.old, loop.new) for loop in loops] == [(1, 10), (2, 11)]
    points, _ = segment
    for loop in loops:
        np.testing.assert_array_equal(loop.ids, points.ids[loop.rows])
    assert own.waiting == []


@pytest.mark.parametrize(
    "other", [drift(-2.0), drift(-3.0, 1.2), looking((-3.0, 0, 0), (0, 0.1, 0))]
)
def test_keyframes_that_contradict_each_other_verify_nothing(monkeypatch, segment, other):
    own = LoopCandidates()
    look(own, monkeypatch, segment, 10, {1: drift(-3.0)})
    assert look(own, monkeypatch, segment, 11, {2: other})[0] == []
    # Whichever of them a third one agrees with.
    loops, _ = look(own, monkeypatch, segment, 12, {2: drift(-3.0)})
    assert [(loop.old, loop.new) for loop in loops] == [(1, 10), (2, 12)]


def test_what_looks_the_same_elsewhere_proves_neither(monkeypatch, segment):
    own, proves = LoopCandidates(), {1: drift(-3.0), 6: drift(2.0)}
    for newest in (10, 11):
        loops, asked = look(own, monkeypatch, segment, newest, proves, [1], elsewhere=[6])
        assert loops == []
        assert asked == [1, 6]
    assert own.waiting == []
    loops, asked = look(own, monkeypatch, segment, 12, {}, [1], elsewhere=[6])
    assert asked == [1]  # nothing is proved: nobody else is asked


def test_one_keyframe_is_no_witness_for_itself(monkeypatch, segment):
    own = LoopCandidates()
    for _ in range(2):
        assert look(own, monkeypatch, segment, 10, {1: drift(-3.0)})[0] == []


def test_old_loop_candidates_expire(monkeypatch, segment):
    own = LoopCandidates()
    look(own, monkeypatch, segment, 10, {1: drift(-3.0)})
    assert look(own, monkeypatch, segment, 14, {2: drift(-3.0)})[0] == []


def test_what_came_of_comparisons_is_counted(monkeypatch, segment):
    own, counted = LoopCandidates(), Comparisons()

    def compare(newest, proves, elsewhere=()):
        look(own, monkeypatch, segment, newest, proves, [1], elsewhere, counted)
        return {name: count for name, count in vars(counted).items() if count}

    assert compare(10, {1: "few_points"}) == {"compared": 1, "few_points": 1}
    told = compare(11, {1: drift(-3.0), 6: drift(2.0)}, [6])
    assert told == {"compared": 3, "few_points": 1, "contradicted": 2}
    told = compare(12, {1: drift(-3.0)})
    assert told == {"compared": 4, "few_points": 1, "contradicted": 2, "unconfirmed": 1}
    # By the next keyframe that tells the same they count both.
    told = compare(13, {1: drift(-3.0)})
    assert told == {"compared": 5, "few_points": 1, "contradicted": 2, "confirmed": 2}
    assert Comparisons(compared=5, confirmed=2).counters == {
        "places_compared": 5, "places_few_corners": 0, "places_few_points": 0,
        "places_one_spot": 0, "places_repeated": 0, "places_contradicted": 0,
        "places_unconfirmed": 0, "places_confirmed": 2, "places_refused": 0, "places_closed": 0,
    }  # fmt: skip


def test_neither_the_window_nor_covisible_keyframes_are_compared(monkeypatch, segment):
    points, keyframes = segment
    keyframes[10].rows = np.concatenate([keyframes[10].rows, keyframes[5].rows])
    _, asked = look(LoopCandidates(), monkeypatch, segment, 10, {}, alike=[9, 8, 5, 4, 3, 2, 1])
    assert asked == [4]
    points.state[keyframes[5].rows] = 0
    _, asked = look(LoopCandidates(), monkeypatch, segment, 10, {}, alike=[9, 8, 5, 4, 3, 2, 1])
    assert asked == [5]


@pytest.mark.slow
@pytest.mark.parametrize("killed", [False, True])
def test_the_mapper_closes_a_loop_that_it_sees(killed):
    """Along a wall and back, where lost points are never found: they are mapped twice, until
    the place is recognised."""
    generator = np.random.default_rng(0)
    points = generator.uniform((-4.0, -3.0, 3.0), (17.0, 3.0, 7.0), (1300, 3))
    scene = Scene(points, generator.uniform(5.0, 500.0, len(points)).astype(np.float32))
    poses = [looking((0.26 * min(k, 100 - k), 0.02 * np.sin(0.3 * k), 0.0)) for k in range(100)]
    squares = textures(len(points))
    parameters = MappingParameters(
        window=WindowParameters(keyframes=5),
        reacquisition=ReacquisitionParameters(radius_px=0.01),
        whole_map=WholeMapParameters(growth=0.0, distance_frames=3, observations_per_frame=20_000),
    )
    mapper, published, moved = Mapper(CAMERA, parameters, 0), Published(), []
    for k, tracks in enumerate(scene.frames(poses)):
        if killed and mapper.global_adjustment.closing:
            mapper = load_state(save_state(mapper))
        grey = picture(scene, squares, poses[k])
        delta = mapper.process(Frame(k, k * INTERVAL_NS, tracks, grey))
        published.apply(delta)
        moved.append(len(delta.moved_keyframes))
    assert sum(count > 0 for count in moved) >= 1
    keyframes = mapper.atlas.active.keyframes
    assert len(np.intersect1d(keyframes[0].rows, keyframes[-1].rows)) >= 30
    assert mapper.point_count < 1.3 * len(points)
    published.apply(mapper.finish())
    assert mapper.counters["places_closed"] == mapper.counters["places_confirmed"] >= 2
    assert trajectory_error(published, poses)[0] < 1e-3

"""What leaves the active map: keyframes that look like others, points that nobody sees."""

import numpy as np
from mapping_scene import CAMERA, INTERVAL_NS, Scene, sideways
from test_mapper import Published, trajectory_error

from pliant.algorithms.map_delta import TRACKING
from pliant.algorithms.mapping.covisibility import most_redundant, seen_by_none
from pliant.algorithms.mapping.map_store import MAPPED, Keyframe, PointRows
from pliant.algorithms.mapping.mapper import Mapper
from pliant.algorithms.mapping.parameters import MappingParameters, WindowParameters
from pliant.state import load_state, save_state


def keyframe(number: int, x: float, rows: list[int], focus: tuple[float, ...] | None) -> Keyframe:
    T_world_camera = np.eye(4)
    T_world_camera[0, 3] = x
    return Keyframe(
        id=number,
        frame=number,
        segment=0,
        T_world_camera=T_world_camera,
        rows=np.array(rows, np.int32),
        points_px=np.zeros((len(rows), 2), np.float32),
        rolled_px=np.zeros((len(rows), 2), np.float32),
        focus=None if focus is None else np.array(focus),
    )


def test_the_newer_of_the_two_that_look_most_alike_is_redundant() -> None:
    random = np.random.default_rng(3)
    centres, places = random.normal(size=(30, 3)), random.normal(size=(30, 3))
    keyframes = [keyframe(k, 0.0, [], tuple(place.tolist())) for k, place in enumerate(places)]
    for k, centre in zip(keyframes, centres, strict=True):
        k.T_world_camera[:3, 3] = centre
    apart = np.linalg.norm(places[:, None] - places[None], axis=2)
    apart += 0.5 * np.linalg.norm(centres[:, None] - centres[None], axis=2)
    i, j = np.unravel_index(np.argmin(apart + np.diag(np.full(30, np.inf))), apart.shape)
    assert most_redundant(keyframes) == max(i, j)


def test_keyframes_that_see_nothing_stand_where_the_camera_is() -> None:
    nan = (np.nan, np.nan, np.nan)
    keyframes = [keyframe(k, x, [], f) for k, (x, f) in enumerate([(0.0, nan), (9.0, None)])]
    assert most_redundant([*keyframes, keyframe(2, 9.1, [], nan)]) == 2


def test_points_go_that_no_keyframe_and_no_track_sees() -> None:
    points = PointRows()
    rows = points.allocate(6)
    points.promote(rows[:5])  # the last one is a candidate
    kept = [keyframe(1, 0.0, [1, 2], None)]
    gone = seen_by_none(rows, kept, np.array([3, -1], np.int32), points)
    assert gone.tolist() == [0, 4]
    points.cull(gone)
    assert points.culled == 2
    assert (points.state == MAPPED).sum() == 3
    again = points.allocate(2)
    assert sorted(again.tolist()) == [0, 4]  # no new memory
    points.promote(again)
    assert len(set(points.ids[[0, 1, 2, 3, 4]].tolist())) == 5  # ids are never reused


def test_the_active_map_stays_as_it_is_where_the_camera_comes_back() -> None:
    """The same views many times: the state is bounded, poses are right, all published stays."""
    once = sideways(45)
    poses = [*once, *once[-2:0:-1]] * 4
    window = WindowParameters(kept_keyframes=30, final_max_keyframes=10)
    mapper, published = Mapper(CAMERA, MappingParameters(window=window), 0), Published()
    rows, keyframes = [], 0
    for frame, tracks in enumerate(Scene.box(death=0.01).frames(poses)):
        delta = mapper.process(frame, frame * INTERVAL_NS, tracks, None, None)
        published.apply(delta)
        mapper.publish_keyframes()
        keyframes = len(published.keyframes)
        active = mapper.atlas.active
        assert active is None or len(active.keyframes) <= 30
        rows.append(mapper.atlas.points.count)
    published.apply(mapper.finish())
    assert keyframes > 45  # of which 30 are kept: else nothing had to leave
    assert max(rows[len(rows) // 2 :]) <= 1.05 * max(rows[: len(rows) // 2])
    assert mapper.point_count == len(published.points)
    assert len(load_state(save_state(mapper)).atlas.active.keyframes) <= 30
    assert trajectory_error(published, poses)[0] < 1e-3
    assert set(published.states[10:]) == {TRACKING}

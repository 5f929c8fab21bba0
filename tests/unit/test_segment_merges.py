"""Two segments that see the same place become one, for the map and for all who read of it."""

from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from mapped_scene import Published, trajectory_error
from mapping_scene import CAMERA, INTERVAL_NS
from pictured_scene import MERGING, WALL_POINTS, along, dark, film, textures, wall

from pliant.algorithms.geometry import align_umeyama, matrix_to_pose
from pliant.algorithms.map_delta import MapMoves
from pliant.algorithms.slam.adjust.global_adjustment import held
from pliant.algorithms.slam.adjust.segment import Moved
from pliant.algorithms.slam.frame import Frame
from pliant.algorithms.slam.mapper import Mapper
from pliant.algorithms.tracks import FrameExtrema
from pliant.map_history import MapHistory
from pliant.messages import topics
from pliant.messages.types import Header, MapUpdate
from pliant.state import load_state, save_state
from pliant.viewers.canvas import Canvas
from pliant.viewers.drawn_scene import Scene as Viewed

_DARK = 40


def run(shots, restored=()):
    """Frame by frame; what is published is checked against the map.  restored: frames before which
    the mapper is a restarted one."""
    mapper, published, history = Mapper(CAMERA, MERGING, 0), Published(), MapHistory()
    joined, deltas = {}, []
    for k, (tracks, grey) in enumerate(shots):
        if k in restored:
            mapper = load_state(save_state(mapper))
        delta = mapper.process(Frame(k, k * INTERVAL_NS, tracks, grey))
        mapper.publish_keyframes()
        deltas.append(delta)
        published.apply(delta)
        history.apply(delta, frame=k, stamp_ns=k)
        if len(delta.joined):
            joined[k] = delta.joined.tolist()
            agree(mapper, history)
    delta = mapper.finish()
    deltas.append(delta)
    published.apply(delta)
    history.apply(delta, frame=len(shots) - 1, stamp_ns=0, final=True)
    agree(mapper, history)
    return SimpleNamespace(
        mapper=mapper, published=published, history=history, joined=joined, deltas=deltas
    )


def agree(mapper, history):
    """What readers have is what the map is, of all segments."""
    active, points = mapper.atlas.active, mapper.atlas.points
    for keyframe in active.keyframes:
        told = history.keyframes[keyframe.id]
        assert told.segment == keyframe.segment == active.segment.id
        pose = matrix_to_pose(keyframe.T_world_camera)
        np.testing.assert_allclose(told.pose_world_camera, pose, atol=1e-9)
    rows = active.segment.mapped_rows()
    at, told = history.points_of(points.ids[rows])
    assert (told.segments == active.segment.id).all()
    rows, centre = rows[at], active.keyframes[-1].T_world_camera[:3, 3]
    far = np.linalg.norm(points.xyz[rows] - centre, axis=1)
    off = np.linalg.norm(told.positions - points.xyz[rows], axis=1)
    near = off < (0.003 + 0.3 * points.sigmas[rows]) * far  # so much need not be published
    assert near.mean() > 0.99  # nor what has moved since the last keyframe
    ids = [keyframe.id for keyframe in active.keyframes]
    assert ids == sorted(set(ids))


@pytest.fixture(scope="module")
def scene():
    scene = wall()
    return scene, textures(len(scene.points))


@pytest.fixture(scope="module", params=["a long one first", "a short one first"])
def two(request, scene):
    """A camera at one end of a wall, and after a while in the dark on its way from the other."""
    long = request.param == "a long one first"
    there, back = (
        ([*along(4, 0), *along(0, 4)], along(12, 4)) if long else (along(0, 2), along(11, 0.5))
    )
    shots = film(*scene, there, 0) + [dark(FrameExtrema.empty())] * _DARK + film(*scene, back, 1)
    return shots, [*there, *[np.eye(4)] * _DARK, *back], run(shots)


def test_segments_that_meet_become_one(two):
    shots, poses, made = two
    assert list(made.joined.values()) == [[[1, 0]]]
    joining = next(delta for delta in made.deltas if len(delta.joined))
    frames = {number: keyframe.frame for number, keyframe in made.history.keyframes.items()}
    night = next(k for k, (tracks, _) in enumerate(shots) if not len(tracks.ids))
    assert all(frames[old] < night < frames[new] for old, new in joining.same_places.tolist())
    assert len(joining.same_places) >= 2
    final = made.history.final()
    assert {segment for segment, _ in final.values()} == {0}
    assert sorted(final) == [k for k, (tracks, _) in enumerate(shots) if len(tracks.ids)]
    assert trajectory_error(made.published, poses)[0] < 2e-3
    points = made.history.points()
    assert set(points.segments.tolist()) == {0}


def test_common_points_of_two_segments_are_mapped_once(two):
    shots, _, made = two
    active = made.mapper.atlas.active
    before = [k for k in active.keyframes if k.frame < len(shots) // 2 - _DARK // 2]
    shared = [len(np.intersect1d(k.rows, active.keyframes[-1].rows)) for k in before]
    assert max(shared) >= 30
    assert len(made.history.points()) < 1.25 * WALL_POINTS


def test_online_poses_stay_as_estimated(two):
    shots, _, made = two
    (at,) = made.joined
    dark_at = next(k for k, (tracks, _) in enumerate(shots) if not len(tracks.ids))
    for frame, (segment, _) in made.history.online.items():
        assert segment == (1 if dark_at < frame < at else 0)


def test_a_restart_while_segments_are_joined_changes_nothing(two):
    shots, _, made = two
    (at,) = made.joined
    again = run(shots, restored=(at - 1, at, at + 2))
    for one, other in zip(made.history.final().items(), again.history.final().items(), strict=True):
        assert one[0] == other[0]
        np.testing.assert_array_equal(one[1][1], other[1][1])


def test_another_wall_is_not_joined(scene):
    other = wall(seed=3)
    shots = film(*scene, along(0, 3), 0) + [dark(FrameExtrema.empty())] * _DARK
    shots += film(other, textures(len(other.points))[::-1], along(4, 0), 1)
    made = run(shots)
    assert made.joined == {}
    assert {segment for segment, _ in made.history.final().values()} == {0, 1}


class Drawn:
    """A canvas that holds the worlds that are on it."""

    def __init__(self):
        self.clouds, self.paths = {}, {}

    def points(self, at, segment, points, changed):
        self.clouds[segment] = points

    def path(self, at, segment, positions):
        self.paths[segment] = positions

    def forget(self, at, segment):
        self.clouds.pop(segment, None)
        self.paths.pop(segment, None)

    def __getattr__(self, name):
        return lambda *_: None


def test_a_viewer_draws_one_world(two):
    shots, _, made = two
    canvas = Drawn()
    scene = Viewed(cast(Canvas, canvas))
    for k, delta in enumerate(made.deltas):
        topic = topics.MAP_UPDATE if k < len(shots) else topics.MAP_FINAL
        header = Header(frame=min(k, len(shots) - 1), stamp_ns=k, frame_id="world")
        scene.take(topic, MapUpdate.of(header, delta), k, k)
    scene.close()
    segment = made.mapper.atlas.active.segment.id
    assert list(canvas.clouds) == list(canvas.paths) == [segment]
    keyframes = made.history.keyframe_poses()
    path = np.array([keyframes[frame][1][:3] for frame in sorted(keyframes)])
    np.testing.assert_allclose(canvas.paths[segment], path, atol=1e-9)
    xyz, told = canvas.clouds[segment].everything()[0], made.history.points().positions
    np.testing.assert_allclose(xyz, told, atol=1e-3)


def stray(mapper, segment):
    """A segment strays, as adjustments of the whole map make it, and readers are told."""
    atlas = mapper.atlas
    first = np.array([segment.keyframes[0].id])
    far = np.array([[0.5, 0.2, 0.1, 0.0, 0.0, 0.0, 1.0, 1.3]])
    moves = held(MapMoves(keyframe_ids=first, moves=far), atlas._spans, segment.id)
    if atlas.active is not None and atlas.active.segment is segment:
        mapper.follow([atlas.move(moves)])
    else:
        segment.move(moves)
        mapper.follow([Moved(np.eye(4), moves)])


def followed(shots, strays):
    """As ``run``, without the end.   strays: frames after which the segment strays."""
    mapper, history = Mapper(CAMERA, MERGING, 0), MapHistory()
    for k, (tracks, grey) in enumerate(shots):
        delta = mapper.process(Frame(k, k * INTERVAL_NS, tracks, grey))
        mapper.publish_keyframes()
        history.apply(delta, frame=k, stamp_ns=k)
        if k in strays:
            stray(mapper, mapper.atlas.active.segment)
    return mapper, history


def ended(mapper, history, shots, poses):
    """The first keyframe of the first segment in the end, and the largest error of its frames, of
    which none is placed anew."""
    for segment, _ in mapper.atlas.everything():
        segment.ordinary.forget()
    history.apply(mapper.finish(), frame=len(shots) - 1, stamp_ns=0, final=True)
    final = history.final()
    frames = [k for k in sorted(final) if final[k][0] == 0]
    found = np.array([final[k][1][:3] for k in frames])
    true = np.array([poses[k][:3, 3] for k in frames])
    scale, R, t = align_umeyama(found, true, with_scale=True)
    return history.keyframes[0].pose_world_camera, np.abs(scale * found @ R.T + t - true).max()


@pytest.mark.parametrize("rests", [False, True])
def test_what_lies_on_both_sides_of_another_segment_goes_back_as_one(scene, rests):
    """A camera leaves a wall for another one, and comes back."""
    other = wall(seed=3)
    squares, night = textures(len(other.points))[::-1], [dark(FrameExtrema.empty())] * _DARK
    there, away, back = along(0, 4), along(4, 1.5), along(1, 9)
    shots = [*film(*scene, there, 0), *night, *film(other, squares, away, 1)]
    shots += [*film(*scene, back, 2), *(night if rests else [])]
    poses = [*there, *[np.eye(4)] * _DARK, *away, *back]
    mapper, history = followed(shots, [])
    assert [of for _, of in mapper.atlas._spans] == [0, 1, 0]
    segment = next(each for each, _ in mapper.atlas.everything() if each.id == 0)
    stray(mapper, segment)
    first, error = ended(mapper, history, shots, poses)
    np.testing.assert_allclose(first, matrix_to_pose(np.eye(4)), atol=1e-9)
    assert error < 0.01


def test_segments_that_drifted_and_meet_return_to_the_older_one(scene):
    there, back = along(0, 3), along(11, 1)
    night = len(there) + _DARK
    shots = film(*scene, there, 0) + [dark(FrameExtrema.empty())] * _DARK + film(*scene, back, 1)
    mapper, history = followed(shots, [len(there) - 1, night + 15])
    assert mapper.atlas.active.segment.id == 0
    first, error = ended(mapper, history, shots, [*there, *[np.eye(4)] * _DARK, *back])
    np.testing.assert_allclose(first, matrix_to_pose(np.eye(4)), atol=1e-9)
    assert error < 0.01

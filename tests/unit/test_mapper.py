"""The mapper from end to end on synthetic tracks: poses, map, start, loss, and bad input."""

from dataclasses import replace

import numpy as np
import pytest
from mapped_scene import PARAMETERS, Published, run, trajectory_error
from mapping_scene import CAMERA, INTERVAL_NS, Scene, looking, sideways

from pliant.algorithms.map_delta import LOST, TRACKING, WAITING
from pliant.algorithms.slam.calibration_bootstrap import BootstrapMapper
from pliant.algorithms.slam.frame import Frame
from pliant.algorithms.slam.mapper import Mapper
from pliant.algorithms.slam.parameters import (
    MappingParameters,
    WholeMapParameters,
    WindowParameters,
)
from pliant.algorithms.slam.start.start import with_minimum_parallax
from pliant.algorithms.tracks import FrameExtrema


@pytest.fixture(scope="module")
def flight():
    poses = sideways(60)
    scene = Scene.box(death=0.02)
    return scene, poses, *run(scene.frames(poses))


def test_points_are_published_again_only_if_they_have_moved():
    """What readers know of the others is near enough, and exact in the end."""
    mapper, known, again = Mapper(CAMERA, PARAMETERS, 0), {}, 0

    def told(delta):
        rows = zip(delta.points_world, delta.point_sigmas, delta.point_hosts, strict=True)
        return dict(zip(delta.point_ids.tolist(), rows, strict=True))

    for frame, tracks in enumerate(Scene.box(death=0.02, noise_px=0.3).frames(sideways(60))):
        delta = mapper.process(Frame(frame, frame * INTERVAL_NS, tracks))
        is_keyframe = mapper.publish_keyframes().new >= 0
        if (active := mapper.atlas.active) is None:
            continue
        centre = active.keyframes[-1].T_world_camera[:3, 3]
        for i, (xyz, sigma, host) in told(delta).items():
            if i not in known or host != known[i][2]:
                continue
            moved = np.linalg.norm(xyz - known[i][0]) / np.linalg.norm(xyz - centre)
            assert is_keyframe
            assert moved > 2e-3 or not 0.81 < sigma / known[i][1] < 1.23
            again += 1
        known |= told(delta)
        if is_keyframe:
            points, rows = active.points, active.window.rows[active.window.mapped_columns()]
            xyz = np.array([known[i][0] for i in points.ids[rows].tolist()])
            moved = np.linalg.norm(points.xyz[rows] - xyz, axis=1)
            distance = np.linalg.norm(points.xyz[rows] - centre, axis=1)
            near = np.maximum(2e-3, 0.25 * points.sigmas[rows]) * distance
            assert (moved <= 1.01 * near).all()
    assert again > 100
    known |= told(mapper.finish())
    points = mapper.atlas.points
    rows = points.mapped(0)
    xyz = np.array([known[i][0] for i in points.ids[rows].tolist()])
    np.testing.assert_allclose(xyz, points.xyz[rows], rtol=1e-6, atol=1e-6)


def test_points_are_published_as_files_have_them():
    """What is below is noise, which no compression makes smaller."""
    _, deltas = run(Scene.box().frames(sideways(12)))
    told = np.concatenate([delta.points_world for delta in deltas])
    assert len(told) > 100
    assert (told == told.astype(np.float32)).all()
    for name in ("point_sigmas", "point_parallax_rad"):
        told = np.concatenate([getattr(delta, name) for delta in deltas])
        assert np.unique(told).size > 100
        assert not (told.view(np.uint32) & 0xFFF).any()


def test_every_frame_gets_a_pose_also_before_the_start(flight):
    _, poses, published, _ = flight
    assert published.states[0] == WAITING
    assert published.states[20] == TRACKING
    assert sorted(published.poses) == list(range(len(poses)))
    error, _ = trajectory_error(published, poses)
    assert error < 1e-3


def test_the_map_is_where_the_scene_is(flight):
    scene, poses, published, _ = flight
    _, (scale, R, t) = trajectory_error(published, poses)
    xyz = np.array([p[0] for p in published.points.values()])
    keyframes = np.array([p[1] for p in published.points.values()])
    world = scale * xyz[keyframes >= 3] @ R.T + t
    nearest = np.array([np.linalg.norm(scene.points - x, axis=1).min() for x in world])
    depth = np.linalg.norm(world - poses[0][:3, 3], axis=1)
    assert len(world) > 500
    assert np.median(nearest / depth) < 0.01
    assert np.mean(nearest / depth < 0.05) > 0.95


def test_lost_tracks_come_back_to_their_points(flight):
    scene, _, published, _ = flight
    # 2 % of the tracks die in every frame; without re-acquisition each becomes another point.
    assert len(published.points) < 1.3 * len(scene.points)


def test_keyframes_publish_their_own_pose_first(flight):
    _, _, published, deltas = flight
    known = set()
    for delta in deltas:
        known.update(delta.keyframe_ids.tolist())
        assert set(delta.pose_keyframes.tolist()) <= known
    assert not np.isnan([p[0] for p in published.points.values()]).any()


def test_the_same_input_gives_the_same_bytes(flight):
    scene, poses, _, deltas = flight
    _, again = run(scene.frames(poses))
    for first, second in zip(deltas, again, strict=True):
        for name, value in vars(first).items():
            other = getattr(second, name)
            same = value.tobytes() == other.tobytes() if isinstance(value, np.ndarray) else None
            assert same is not False, name
            assert same or value == other, name


def test_a_late_reader_catches_up_by_the_snapshots():
    parameters = MappingParameters(snapshot_frames=20)
    mapper, late = Mapper(CAMERA, parameters, 0), Published()
    poses = sideways(42)
    for frame, tracks in enumerate(Scene.box().frames(poses)):
        delta = mapper.process(Frame(frame, frame * INTERVAL_NS, tracks))
        if frame >= 39:
            for name in ("pose_frames", "removed_point_ids"):
                assert getattr(delta, name).ndim == 1
            late.apply(delta)
    assert len(late.points) > 300
    assert late.pose(41).shape == (4, 4)


def test_a_still_camera_starts_no_map_with_a_reason():
    published, _ = run(Scene.box().frames([np.eye(4)] * 12))
    assert set(published.states) == {WAITING}
    assert "too little parallax" in published.reasons[-2]
    assert not published.poses


def test_a_rotating_camera_starts_no_map_with_a_reason():
    turning = [looking((0.0, 0.0, 0.0), (0.0, 0.02 * k, 0.0)) for k in range(15)]
    published, _ = run(Scene.box().frames(turning))
    assert set(published.states) == {WAITING}
    assert "pure rotation" in published.reasons[-2]


def test_too_few_tracks_start_no_map_with_a_reason():
    published, _ = run(Scene.box(60).frames(sideways(8)))
    assert set(published.states) == {WAITING}
    assert published.reasons[0] == "too few frames: 1 of 3"
    assert published.reasons[-2].startswith("too few tracks:")
    assert published.reasons[-2].endswith("of 100 last for 3 frames")


def test_a_map_starts_after_a_long_rest():
    poses = [np.eye(4)] * 30 + sideways(30)
    published, _ = run(Scene.box().frames(poses))
    assert sorted(published.poses) == list(range(60))
    error, _ = trajectory_error(published, poses)
    assert error < 2e-3


def noise_frames(count):
    generator = np.random.default_rng(0)
    for k in range(count):
        n = 2000
        yield FrameExtrema(
            ids=np.arange(1000 * k, 1000 * k + n),
            points_px=generator.uniform((0, 0), (640, 480), (n, 2)).astype(np.float32),
            ages=np.zeros(n, np.int32),
            kappas=np.ones(n, np.float32),
            states=np.zeros(n, np.uint8),
            maxima=np.zeros((0, 3), np.float32),
            dominant_flow=np.eye(2, 3),
        )


def test_noise_and_empty_frames_start_no_map():
    published, _ = run(noise_frames(15))
    assert set(published.states) == {WAITING}
    assert all(published.reasons)
    published, _ = run([FrameExtrema.empty()] * 5)
    assert set(published.states) == {WAITING}
    assert "too few tracks: 0 of 100 last for 3 frames" in published.reasons


def cut(poses, at):
    """Every track is cut at a frame, and nothing is seen for longer than the mapper waits."""
    frames = list(Scene.box().frames(poses))
    dark = [FrameExtrema.empty()] * 40
    offset = 1_000_000
    after = [
        FrameExtrema(
            ids=f.ids + offset, points_px=f.points_px, ages=f.ages, kappas=f.kappas,
            states=f.states, maxima=np.zeros((0, 3), np.float32), dominant_flow=f.dominant_flow,
        )
        for f in frames[at:]
    ]  # fmt: skip
    return frames[:at] + dark + after


def test_after_a_loss_a_new_segment_starts():
    published, _ = run(cut(sideways(40), 20))
    assert LOST in published.states
    assert {segment for _, _, segment in published.poses.values()} == {0, 1}
    assert all(k not in published.poses for k in range(20, 60))
    assert published.states[-2] == TRACKING
    lost = published.reasons[published.states.index(LOST)]
    assert lost.startswith("lost:")


@pytest.mark.parametrize("again", [True, False])
def test_a_segment_is_adjusted_as_if_it_were_alone(again):
    """Also where no other follows."""
    poses, window = sideways(70), WindowParameters(keyframes=5)
    frames = cut(poses, 45)
    only = WholeMapParameters(growth=0.0)
    parameters = MappingParameters(window=window, whole_map=only)
    alone, _ = run(frames[:45], parameters)
    published, deltas = run(frames if again else frames[:85], parameters)
    first = [k for k, (_, _, segment) in published.poses.items() if segment == 0]
    assert sorted(first) == list(range(45))
    for k in first:
        np.testing.assert_allclose(published.pose(k), alone.pose(k), atol=1e-12)
    assert len(deltas[-1].keyframe_ids) == len(published.keyframes) > window.keyframes


@pytest.mark.parametrize(("room", "adjusted"), [(6000, {0, 1}), (1000, {1})])
def test_segments_share_what_room_there_is(room, adjusted):
    """What has no more room stays as it was published: the oldest, where nothing else does."""
    poses = sideways(40)
    frames = cut(poses, 20)
    window = WindowParameters(kept_observations=room, kept_per_keyframe=100)
    published, deltas = run(frames, with_minimum_parallax(MappingParameters(window=window)))
    told = deltas[-1].keyframe_segments.tolist()
    assert set(told) == adjusted
    assert told.count(0) < sum(delta.keyframe_segments.tolist().count(0) > 0 for delta in deltas)
    assert {segment for _, _, segment in published.poses.values()} == {0, 1}


def test_a_short_gap_is_bridged():
    poses = sideways(40)
    frames = list(Scene.box().frames(poses))
    frames[25] = FrameExtrema.empty()
    published, _ = run(frames)
    assert published.states[25] == LOST
    assert 25 not in published.poses
    assert len({segment for _, _, segment in published.poses.values()}) <= 2


def test_skipped_frames_get_no_pose_and_the_next_one_continues():
    """Also where the map starts, and with tracks that begin and end between."""
    poses = sideways(60)
    mapper, published = Mapper(CAMERA, PARAMETERS, 0), Published()
    for frame, tracks in enumerate(Scene.box().frames(poses)):
        if frame % 3 == 0:
            published.apply(mapper.process(Frame(frame, frame * INTERVAL_NS, tracks)))
            continue
        delta = mapper.skip(frame, "no time")
        assert (delta.reason, delta.inliers, len(delta.pose_frames)) == ("no time", 0, 0)
        published.apply(delta)
    published.apply(mapper.finish())
    assert sorted(published.poses) == list(range(0, 60, 3))
    error, _ = trajectory_error(published, poses)
    assert error < 2e-3
    assert LOST not in published.states


@pytest.mark.parametrize("mapper_of", [Mapper, BootstrapMapper])
def test_frames_that_are_not_mapped_get_poses_by_their_tracks(mapper_of):
    """Also those that wait for the map, and those that the end finds waiting.  None is a keyframe
    once the map has begun, and none makes a point."""
    poses = sideways(62)
    mapper, published = mapper_of(CAMERA, PARAMETERS, 0), Published()
    for frame, tracks in enumerate(Scene.box().frames(poses)):
        if frame % 4 == 0:
            published.apply(mapper.process(Frame(frame, frame * INTERVAL_NS, tracks)))
            continue
        began = mapper.point_count > 0
        delta = mapper.only_localise(Frame.of_tracks(frame, frame * INTERVAL_NS, tracks), "no time")
        assert (frame in delta.pose_frames.tolist()) == (delta.reason != "no time") == began
        assert len(delta.point_ids) == 0 or delta.snapshot
        assert not began or frame not in delta.keyframe_frames.tolist()
        published.apply(delta)
    published.apply(mapper.finish())
    assert sorted(published.poses) == list(range(62))
    error, _ = trajectory_error(published, poses)
    assert error < 2e-3
    assert LOST not in published.states


def test_a_frame_that_no_tracks_place_waits_for_the_next_mapped_one():
    """What few tracks say is not believed without a look at the image."""
    poses = sideways(40)
    mapper, published = Mapper(CAMERA, PARAMETERS, 0), Published()
    for frame, tracks in enumerate(Scene.box().frames(poses)):
        if frame not in (30, 31):
            published.apply(mapper.process(Frame(frame, frame * INTERVAL_NS, tracks)))
            continue
        few = FrameExtrema.of(first(tracks, 40), tracks.maxima)
        delta = mapper.only_localise(Frame.of_tracks(frame, frame * INTERVAL_NS, few), "no time")
        assert (delta.state, delta.reason, len(delta.pose_frames)) == (TRACKING, "no time", 0)
        published.apply(delta)
    published.apply(mapper.finish())
    assert sorted(published.poses) == list(range(40))
    error, _ = trajectory_error(published, poses)
    assert error < 2e-3


def first(tracks, count):
    """The first of the tracks of a frame."""
    arrays = ("ids", "points_px", "ages", "kappas", "states")
    return replace(tracks, **{name: getattr(tracks, name)[:count] for name in arrays})


def test_a_lost_camera_is_not_found_by_frames_that_are_not_mapped():
    frames = list(Scene.box().frames(sideways(44)))
    mapper, published = Mapper(CAMERA, PARAMETERS, 0), Published()
    for frame, tracks in enumerate(frames[:30]):
        published.apply(mapper.process(Frame(frame, frame * INTERVAL_NS, tracks)))
    assert mapper.process(Frame(30, 30 * INTERVAL_NS, FrameExtrema.empty())).state == LOST
    delta = mapper.only_localise(Frame.of_tracks(31, 31 * INTERVAL_NS, frames[31]), "no time")
    assert (delta.state, delta.reason, len(delta.pose_frames)) == (LOST, "no time", 0)


def test_a_frame_without_pixels_leaves_the_state_as_it_was():
    mapper = Mapper(CAMERA, PARAMETERS, 0)
    assert mapper.skip(0).state == WAITING
    for k, tracks in enumerate(Scene.box().frames(sideways(20))):
        state = mapper.process(Frame(k, k * INTERVAL_NS, tracks)).state
    assert state == TRACKING
    assert mapper.skip(20).state == TRACKING
    assert mapper.process(Frame(21, 21 * INTERVAL_NS, FrameExtrema.empty())).state == LOST
    assert mapper.skip(22).state == LOST

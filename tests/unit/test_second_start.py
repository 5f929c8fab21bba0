"""A camera that turns in one place: the sample of its tracks, and the choice between two maps."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from mapped_scene import PARAMETERS, run, trajectory_error
from mapping_scene import CAMERA, INTERVAL_NS, Scene, looking, sideways

from pliant.algorithms.geometry import align_umeyama, inverse
from pliant.algorithms.slam.adjust import final_adjustment, second_start, track_sample
from pliant.algorithms.slam.adjust.sampled_frames import sampled_frames
from pliant.algorithms.slam.adjust.second_start import (
    SampledFrames,
    Sightings,
    preference,
    second_map,
)
from pliant.algorithms.slam.adjust.segment import Moved
from pliant.algorithms.slam.adjust.track_sample import SampledTracks, TrackSample, turns_in_place
from pliant.algorithms.slam.calibration.self_calibration import SelfCalibration
from pliant.algorithms.slam.estimate.problem import BundleParameters, CalibrationUncertainty
from pliant.algorithms.slam.frame import Frame
from pliant.algorithms.slam.mapper import Mapper
from pliant.algorithms.tracks import FrameExtrema
from pliant.state import load_state, save_state

DEPTH = 6.0
BUNDLE = BundleParameters(kernel_sigma_px=1.0)


def turning(frames, arm):
    """A camera at the end of an arm that turns by 23 degrees to each side."""
    poses = []
    for k in range(frames):
        turn = 0.2 * np.sin(0.21 * k), 0.4 * np.sin(0.13 * k), 0.1 * np.sin(0.17 * k)
        T = looking((0.0, 0.0, 0.0), turn)
        T[:3, 3] = arm * T[:3, 2]
        poses.append(T)
    return np.array(poses)


def around(count, **kwargs):
    """Points on all that such a camera sees."""
    points = np.random.default_rng(0).uniform((-9.0, -7.0, 3.0), (9.0, 7.0, 9.0), (count, 3))
    kappas = np.random.default_rng(1).uniform(5.0, 500.0, count).astype(np.float32)
    return Scene(points, kappas, **kwargs)


def tracks_of(ids):
    ids = np.array(ids, np.int64)
    px = np.column_stack([ids, ids]).astype(np.float32)
    return replace(FrameExtrema.empty(), ids=ids, points_px=px)


def test_the_sample_has_the_same_tracks_in_all_frames():
    sample = TrackSample()
    for frame in range(3):
        sample.add(frame, tracks_of(range(100)))
    assert [each.frame for each in sample.frames] == [0, 1, 2]
    for each in sample.frames:
        np.testing.assert_array_equal(each.ids, np.arange(0, 100, 8))
        np.testing.assert_array_equal(each.points_px[:, 0], each.ids)
    sample.begin_at(2)
    assert [each.frame for each in sample.frames] == [2]


def test_an_endless_turn_thins_the_sample_and_drops_it_in_the_end(monkeypatch):
    monkeypatch.setattr(track_sample, "_ROOM", 200)
    sample, shares, sizes = TrackSample(), [], []
    for frame in range(2000):
        sample.add(frame, tracks_of(range(800)))
        shares.append(sample.every)
        sizes.append(sum(len(each.ids) for each in sample.frames))
        assert all((each.ids % sample.every == 0).all() for each in sample.frames if sample.every)
    assert sorted(set(shares)) == [0, 8, 16, 32, 64]
    assert max(sizes) <= 200
    assert not sample.frames


def test_positions_at_the_end_of_a_short_arm_turn_in_place():
    assert turns_in_place(turning(80, 0.1 * DEPTH), DEPTH)
    assert turns_in_place(turning(80, -0.1 * DEPTH), DEPTH)
    assert not turns_in_place(turning(80, -DEPTH), DEPTH)  # an orbit of the scene
    assert not turns_in_place(np.array(sideways(80)), DEPTH)


def fed(mapper, tracks, first=0):
    """The deltas of tracks from a frame on."""
    deltas = []
    for frame, each in enumerate(tracks[first:], start=first):
        deltas.append(mapper.process(Frame(frame, frame * INTERVAL_NS, each)))
    return deltas


def kept_frames(mapper):
    return len(mapper._sample.frames)


@pytest.fixture(scope="module")
def turn():
    poses = turning(90, 0.15 * DEPTH)
    return poses, list(around(3000, death=0.05).frames(poses))


def test_a_mapper_keeps_the_sample_only_while_the_camera_turns_in_place(turn):
    mapper = Mapper(CAMERA, PARAMETERS, 0)
    fed(mapper, turn[1])
    assert mapper.atlas.active is not None
    assert kept_frames(mapper) == 90
    window = PARAMETERS.window.model_copy(update={"keyframes": 6})  # a slide is judged beyond it
    slides = Mapper(CAMERA, PARAMETERS.model_copy(update={"window": window}), 0)
    frames = list(Scene.box(death=0.02).frames(sideways(60, step=0.1)))
    fed(slides, frames[:10])
    assert kept_frames(slides) == 10
    fed(slides, frames, 10)
    assert kept_frames(slides) == 0


def test_a_long_turn_with_many_keyframes_drops_the_sample(turn, monkeypatch):
    mapper = Mapper(CAMERA, PARAMETERS, 0)
    fed(mapper, turn[1][:60])
    number = len(mapper.atlas.active.keyframes)
    monkeypatch.setattr(track_sample, "_MOST_KEYFRAMES", number)
    assert kept_frames(mapper) == 60
    fed(mapper, turn[1], 60)
    assert len(mapper.atlas.active.keyframes) > number
    assert kept_frames(mapper) == 0


def of_bytes(delta):
    return save_state(delta)


def test_a_restored_mapper_chooses_the_same_map(turn, monkeypatch):
    monkeypatch.setattr(second_start, "_is_better", lambda *_: True)
    mapper = Mapper(CAMERA, PARAMETERS, 0)
    fed(mapper, turn[1][:60])
    restored = load_state(save_state(mapper))
    assert kept_frames(restored) == 60
    one, other = fed(mapper, turn[1], 60), fed(restored, turn[1], 60)
    for a, b in zip([*one, mapper.finish()], [*other, restored.finish()], strict=True):
        assert of_bytes(a) == of_bytes(b)


def test_the_second_map_is_published_as_a_whole(turn, monkeypatch):
    """Here both starts lead to the same map.  That of the run has more observations of frames."""
    first, _ = run(turn[1])
    monkeypatch.setattr(second_start, "_is_better", lambda *_: True)
    second, _ = run(turn[1])
    assert sorted(second.poses) == sorted(first.poses) == list(range(90))
    assert trajectory_error(second, turn[0])[0] < 3.0 * trajectory_error(first, turn[0])[0]
    moved = [np.abs(second.pose(k) - first.pose(k)).max() for k in first.poses]
    assert max(moved) > 0.0
    assert len(second.points) > 0.9 * len(first.points)


def test_a_changing_focal_length_is_undone_by_a_second_map(turn, monkeypatch):
    sure = SimpleNamespace(calls_for_more=True, confirmed_by=lambda *_, **__: True)
    monkeypatch.setattr(final_adjustment, "evidence_of_change", lambda *_: sure)
    first, second = Mapper(CAMERA, PARAMETERS, 0), Mapper(CAMERA, PARAMETERS, 0)
    for mapper in (first, second):
        fed(mapper, turn[1])
    first.finish()
    assert first.calibration.changes
    monkeypatch.setattr(second_start, "_is_better", lambda *_: True)
    second.finish()
    assert not second.calibration.changes
    assert all(keyframe.log_focal == 0.0 for keyframe in second.atlas.active.keyframes)


def test_a_camera_that_slides_has_only_one_start(monkeypatch):
    tried = []
    monkeypatch.setattr(second_start._Start, "adjusted", lambda *_: tried.append(1))
    published, _ = run(Scene.box(death=0.02).frames(sideways(60)))
    assert len(published.poses) == 60
    assert not tried


class Turn:
    """Landmarks in every 8th frame of a turn, and tracks in all, which last for 10 frames."""

    def __init__(self, seed=0, zoom=0.0):
        """zoom: change of the log focal length, there and back."""
        self.poses = turning(60, 0.15 * DEPTH)
        tracks = list(around(3000, noise_px=0.5, death=0.1, seed=seed).frames(self.poses))
        log_focal, centre = zoom * np.sin(np.arange(60) / 10.0), np.array([CAMERA.cx, CAMERA.cy])
        tracks = [
            replace(t, points_px=(centre + f * (t.points_px - centre)).astype(np.float32))
            for t, f in zip(tracks, np.exp(log_focal), strict=True)
        ]
        self.log_focal = log_focal[::8]
        own = np.arange(0, len(tracks), 8)
        camera = np.repeat(own, [len(tracks[m].ids) for m in own]).astype(np.int32)
        ids = np.concatenate([tracks[m].ids for m in own])
        px = np.concatenate([tracks[m].points_px for m in own])
        _, number, counts = np.unique(ids, return_inverse=True, return_counts=True)
        twice = counts[number] >= 2
        number = np.unique(number[twice], return_inverse=True)[1].astype(np.int32)
        self.landmarks = Sightings(
            camera=camera[twice], point=number, px=px[twice],
            weights=np.ones(len(number), np.float32), points=int(number.max()) + 1,
        )  # fmt: skip
        self.known = SelfCalibration.of(CAMERA, CalibrationUncertainty())
        sampled = [
            SampledTracks(frame, each.ids[each.ids % 2 == 0], each.points_px[each.ids % 2 == 0])
            for frame, each in enumerate(tracks)
        ]
        hosts = np.arange(len(tracks)) // 8
        self.frames = SampledFrames(
            np.arange(len(tracks)), hosts, np.zeros((len(tracks), 4, 4)), own, sampled
        )

    def map_from(self, arm):
        """The map by an adjustment from an arm of this length, and its cost."""
        start = second_start._Start(
            self.frames, self.known, self.known.prior(self.known.correction), BUNDLE, DEPTH
        )
        seen = second_start._with_tracks(self.frames, self.landmarks, self.known)
        T = self.poses.copy()
        T[:, :3, 3] = arm * T[:, :3, 2]
        return start.adjusted(T, seen)

    def second(self, found, log_focal=0.0):
        own, hosts = self.frames.keyframes, self.frames.hosts
        T = found.T_world_camera
        frames = self.frames._replace(T_host_camera=inverse(T[own])[hosts] @ T)
        known = self.known.corrected(found.correction, found.covariance, len(own))
        xyz = found.points_world[: self.landmarks.points]
        log_focal = np.broadcast_to(log_focal, len(own))
        return second_map(frames, T[own], xyz, self.landmarks, known, BUNDLE, DEPTH, log_focal)

    def error(self, T_world_camera):
        true = self.poses[self.frames.keyframes, :3, 3]
        at = T_world_camera[:, :3, 3]
        scale, R, t = align_umeyama(at, true, with_scale=True)
        return np.sqrt(((scale * at @ R.T + t - true) ** 2).sum(axis=1).mean())


def test_a_wrong_map_is_a_local_minimum_and_the_second_start_leaves_it():
    turn = Turn()
    own = turn.frames.keyframes
    wrong, right = turn.map_from(-0.15 * DEPTH), turn.map_from(0.15 * DEPTH)
    assert turn.error(wrong.T_world_camera[own]) > 5.0 * turn.error(right.T_world_camera[own])
    assert wrong.correction[0] > 0.05  # an arm looks like another focal length
    assert wrong.final_cost > 1.05 * right.final_cost
    second = turn.second(wrong)
    assert second is not None
    assert turn.error(second.T_world_camera) < 1.5 * turn.error(right.T_world_camera[own])
    assert abs(second.correction[0]) < 0.02
    numbers = [each.frame for each in second.frames]
    assert numbers == sorted(set(range(60)) - set(own.tolist()))
    camera = turn.known.corrected(second.correction, second.covariance, len(own)).view.camera
    for each in second.frames:
        T = each.T_world_camera
        px = camera.project((each.xyz - T[:3, 3]) @ T[:3, :3])
        assert np.median(np.abs(px - each.points_px)) < 0.5


def test_a_right_map_stays():
    turn = Turn()
    assert turn.second(turn.map_from(0.15 * DEPTH)) is None


def test_a_focal_length_that_really_changes_keeps_its_map():
    turn = Turn(zoom=0.05)
    still = Turn()
    assert turn.second(still.map_from(0.15 * DEPTH), turn.log_focal) is None


def test_a_wrong_map_is_left_even_if_a_changing_focal_length_explains_it_better():
    turn = Turn()
    wrong = turn.map_from(-0.15 * DEPTH)
    changes = 0.005 * np.random.default_rng(0).normal(size=len(turn.frames.keyframes))
    second = turn.second(wrong, changes)
    assert second is not None
    assert abs(second.correction[0]) < 0.02


def test_a_preference_counts_what_is_independent():
    generator = np.random.default_rng(0)
    gain = generator.normal(0.1, 1.0, 10_000)
    alone = np.arange(10_000, dtype=np.int32)
    assert preference(gain, alone, alone) == pytest.approx(10.0, rel=0.2)
    # The same observations four times over are no more evidence.
    same = np.tile(alone, 4)
    assert preference(np.tile(gain, 4), same, same) == pytest.approx(10.0, rel=0.2)
    of_camera = np.repeat(np.arange(100, dtype=np.int32), 100)
    by_camera = np.repeat(generator.normal(0.1, 1.0, 100), 100)
    assert preference(by_camera, alone, of_camera) == pytest.approx(1.0, abs=1.5)


def test_a_camera_that_stands_for_long_adds_few_frames():
    poses = turning(240, 0.15 * DEPTH)
    poses[60:] = poses[60]
    mapper = Mapper(CAMERA, PARAMETERS, 0)
    fed(mapper, list(around(3000, death=0.02).frames(poses)))
    segment = mapper.atlas.active.segment
    sampled = sampled_frames(mapper._sample, segment.path, segment.keyframes)
    assert len(mapper._sample.frames) == 240
    assert len(sampled.numbers) <= 60 + 2 * 32
    adjacent = np.diff(sampled.numbers) == 1
    assert (np.append(adjacent, False) | np.insert(adjacent, 0, False)).all()  # for their motions


def test_a_segment_that_joins_another_at_the_end_has_only_one_start(turn, monkeypatch):
    tried = []
    monkeypatch.setattr(second_start._Start, "adjusted", lambda *_: tried.append(1))
    mapper = Mapper(CAMERA, PARAMETERS, 0)
    fed(mapper, turn[1])
    monkeypatch.setattr(mapper.atlas, "_join_met", lambda _: [Moved(np.eye(4))])
    mapper.finish()
    assert not tried

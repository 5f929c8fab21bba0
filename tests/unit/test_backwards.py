"""A source read backwards where its map was lost."""

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
from benchmarks.in_process import true_poses
from benchmarks.second_pass import Frames, Pass, run
from inertial_motion import PHONE, Motion, samples_of

from pliant.algorithms.geometry import so3_exp
from pliant.algorithms.inertial.samples import ImuSamples
from pliant.algorithms.slam.adjust.inertial_adjustment import CouplingOutcome
from pliant.algorithms.slam.adjust.loops import Loop
from pliant.algorithms.slam.atlas.known_places import KnownPlaces
from pliant.backwards import (
    Reached,
    Stretch,
    _backwards,
    _reversed,
    final_update,
    lost_stretches,
    reach_back,
)
from pliant.config import load_config
from pliant.datasets import open_source
from pliant.errors import DatasetError
from pliant.evaluation.run_evaluation import evaluate_trajectory
from pliant.map_history import MapHistory
from pliant.trajectory import Trajectory

STAMPS_NS = {frame: 100_000_000 * frame for frame in range(60)}
CONFIG = load_config(None, ["bundle_adjustment.localisation.max_lost_s=0.05"])


class Blind(KnownPlaces):
    """Nothing is ever recognised, but all is remembered."""

    def recognise(self, *_: object, **__: object) -> None:
        return None

    def compare(self, *_: object, **__: object) -> list[Loop]:
        return []


def test_of_frames_that_all_have_a_pose_in_one_segment_nothing_is_lost() -> None:
    assert lost_stretches(dict.fromkeys(range(60), 0), STAMPS_NS) == []


def test_frames_before_the_map_are_read_from_a_second_after_it_began() -> None:
    assert lost_stretches(dict.fromkeys(range(20, 60), 0), STAMPS_NS) == [Stretch(0, 30)]


def test_after_frames_that_were_lost_at_the_end_nothing_comes() -> None:
    assert lost_stretches(dict.fromkeys(range(50), 0), STAMPS_NS) == []


def test_stretches_are_read_latest_first_and_those_that_overlap_as_one() -> None:
    segments = {f: 0 if f < 45 else 1 for f in range(60) if f not in (12, 13)}
    assert lost_stretches(segments, STAMPS_NS) == [Stretch(34, 55), Stretch(1, 24)]
    segments = {f: 0 if f < 25 else 1 for f in range(60) if f not in (12, 13)}
    assert lost_stretches(segments, STAMPS_NS) == [Stretch(1, 35)]


def test_a_time_lapse_is_read_from_some_frames_on_both_sides() -> None:
    slow = {frame: 60 * 10**9 * frame for frame in range(60)}
    segments = {f: 0 for f in range(60) if f != 30}
    assert lost_stretches(segments, slow) == [Stretch(24, 36)]


@pytest.fixture(scope="module")
def tiny() -> tuple[Frames, Trajectory]:
    opened = open_source("built-in:tiny")
    return Frames(opened.calibration, list(opened)), true_poses(opened)


def without(source: Frames, hidden: Sequence[int]) -> Frames:
    """A source of which some frames show nothing."""
    camera = source.calibration
    flat = {
        "encoding": "mono8", "data": bytes([128]) * (camera.width * camera.height),
        "width": camera.width, "height": camera.height,
    }  # fmt: skip
    frames = [replace(f, **flat) if f.index in hidden else f for f in source.frames]
    return Frames(camera, frames)


def again(
    source: Frames, first: Pass, samples: ImuSamples | None = None
) -> tuple[MapHistory, Reached]:
    history = deepcopy(first.history)
    segments = {frame: segment for frame, (segment, _) in first.poses.items()}
    stretches = lost_stretches(segments, history.stamps_ns)
    return history, reach_back(source, CONFIG, first.kept, stretches, history, samples)


def ate_m(history: MapHistory, truth: Trajectory) -> float:
    found = evaluate_trajectory(history.trajectory(history.final()), truth).ate_m
    assert found is not None
    return found.rmse


@pytest.fixture(scope="module")
def late(tiny: tuple[Frames, Trajectory]) -> Pass:
    """Of a map that began when 15 frames were over."""
    first = run(without(tiny[0], range(15)), CONFIG)
    assert min(first.poses) == 15
    return first


@pytest.fixture(scope="module")
def early(tiny: tuple[Frames, Trajectory], late: Pass) -> tuple[MapHistory, Reached]:
    return again(tiny[0], late)


def test_a_map_reaches_back_to_what_came_before_it(
    tiny: tuple[Frames, Trajectory], late: Pass, early: tuple[MapHistory, Reached]
) -> None:
    source, truth = tiny
    history, reached = early
    final = history.final()
    assert sorted(final) == list(range(len(source.frames)))
    assert {segment for segment, _ in final.values()} == {0}
    assert ate_m(history, truth) < 1e-3
    assert ate_m(history, truth) < 2.0 * ate_m(late.history, truth)
    made = {number: history.keyframes[number].frame for number in reached.keyframes}
    made = {number: frame for number, frame in made.items() if frame >= 0}
    assert min(made.values()) < 10
    frames = [keyframe.frame for keyframe in history.keyframes.values() if keyframe.frame >= 0]
    assert len(set(frames)) == len(frames)
    assert all(each.jpeg and len(each.point_ids) for each in reached.keyframes.values())
    assert {each.session for each in reached.kept} == {0}
    assert {each.id: each.source_frame for each in reached.kept}.items() >= made.items()


def test_segments_that_see_the_same_become_one(tiny: tuple[Frames, Trajectory]) -> None:
    source, truth = tiny
    first = run(without(source, range(18, 23)), CONFIG, places=Blind())
    assert {segment for segment, _ in first.poses.values()} == {0, 1}
    history, reached = again(source, first)
    assert {segment for segment, _ in history.final().values()} == {0}
    assert len(history.final()) == len(source.frames)
    assert {each.segment for each in reached.kept} == {0}
    assert ate_m(history, truth) < 1e-3


def test_samples_move_the_keyframes_of_both_passes() -> None:
    opened = open_source("built-in:tabletop?width=320")
    half = [replace(f, index=n) for n, f in enumerate(list(opened)[::2])]
    source, truth = Frames(opened.calibration, half), true_poses(opened)
    samples = samples_of(
        Motion(truth.stamps_ns, truth.T_world_camera), PHONE, np.random.default_rng(1),
        R_camera_imu=so3_exp(np.array([0.4, 1.0, 2.0])),
        p_camera_imu=np.array([0.02, -0.01, 0.03]), offset_s=0.08,
    )  # fmt: skip
    first = run(without(source, range(20)), CONFIG)
    assert min(first.poses) == 20
    by_images, _ = again(source, first)
    history, reached = again(source, first, samples)
    assert reached.counters["coupling_outcome"] == CouplingOutcome.MOVED
    assert reached.counters["coupling_keyframes"] > len(first.kept)
    assert reached.counters["coupling_moved_m"] > 0.0
    assert len(history.final()) == len(half)
    assert ate_m(history, truth) < 1.1 * ate_m(by_images, truth)
    moved = [n for n in history.keyframes if n in first.history.keyframes and n]
    assert moved
    for n in moved:
        before = by_images.keyframes[n].pose_world_camera
        assert not np.array_equal(history.keyframes[n].pose_world_camera, before)
    others = replace(samples, gyro_rad_s=samples.gyro_rad_s[::-1].copy())
    refused, why = again(source, first, others)
    assert why.counters["coupling_outcome"] == CouplingOutcome.NOT_ALIGNED
    for n, keyframe in by_images.keyframes.items():
        same = refused.keyframes[n].pose_world_camera
        np.testing.assert_array_equal(same, keyframe.pose_world_camera)


def test_the_same_input_gives_the_same_map(
    tiny: tuple[Frames, Trajectory], late: Pass, early: tuple[MapHistory, Reached]
) -> None:
    one, other = early, again(tiny[0], late)
    for a, b in zip(one[0].final().values(), other[0].final().values(), strict=True):
        np.testing.assert_array_equal(a[1], b[1])
    for a, b in zip(one[1].kept, other[1].kept, strict=True):
        np.testing.assert_array_equal(a.points_world, b.points_world)


def test_one_update_makes_the_history_of_both_passes(
    late: Pass, early: tuple[MapHistory, Reached]
) -> None:
    history, reached = early
    assert reached.last is not None
    update, folded = final_update(late.history, history, reached.last), deepcopy(late.history)
    folded.apply(update, frame=39, stamp_ns=0, final=True)
    assert folded.keyframe_poses().keys() == history.keyframe_poses().keys()
    np.testing.assert_array_equal(folded.points().ids, history.points().ids)
    np.testing.assert_array_equal(folded.points().positions, history.points().positions)
    for frame, (segment, pose) in history.final().items():
        assert folded.final()[frame][0] == segment
        np.testing.assert_array_equal(folded.final()[frame][1], pose)
    assert folded.states == late.history.states


def test_a_source_that_has_changed_is_said_so(tiny: tuple[Frames, Trajectory], late: Pass) -> None:
    frames = tiny[0].frames
    moved = [replace(f, stamp_ns=f.stamp_ns + 1) for f in frames]
    with pytest.raises(DatasetError, match="has changed"):
        again(replace(tiny[0], frames=moved), late)
    with pytest.raises(DatasetError, match="has fewer frames"):
        again(replace(tiny[0], frames=frames[:20]), late)


def test_frames_are_held_in_lots(tiny: tuple[Frames, Trajectory]) -> None:
    numbers = [20, 19, 18, 17, 5, 4]
    found = _backwards(tiny[0], numbers, 4)
    assert [frame.index for frame in found] == numbers


def test_time_that_runs_backwards_twice_runs_forwards(late: Pass) -> None:
    kept = replace(late.kept[0], motion=np.arange(6.0), correction=np.arange(7.0))
    back = _reversed(kept)
    np.testing.assert_array_equal(back.motion, -kept.motion)
    np.testing.assert_array_equal(back.correction, [0.0, 1.0, 2.0, -3.0, 4.0, 5.0, 6.0])
    np.testing.assert_array_equal(_reversed(back).correction, kept.correction)

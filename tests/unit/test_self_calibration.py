"""A camera whose calibration is a guess: what is found, how sure it is, what is told meanwhile."""

from dataclasses import replace

import numpy as np
import pytest
from mapped_scene import Published, trajectory_error
from mapping_scene import CAMERA, INTERVAL_NS, Scene, looking, sideways

from pliant.algorithms.map_delta import TRACKING, WAITING
from pliant.algorithms.slam import calibration_bootstrap
from pliant.algorithms.slam.calibration.self_calibration import widened
from pliant.algorithms.slam.calibration_bootstrap import BootstrapMapper, mapper_for
from pliant.algorithms.slam.estimate.problem import CalibrationUncertainty
from pliant.algorithms.slam.frame import Frame
from pliant.algorithms.slam.mapper import Mapper
from pliant.algorithms.slam.parameters import MappingParameters
from pliant.algorithms.slam.start import start

PARAMETERS = MappingParameters()
GUESS_SIGMA = 0.3


def guessed(factor):
    return replace(CAMERA, fx=CAMERA.fx * factor, fy=CAMERA.fy * factor)


def run(frames, factor, parameters=PARAMETERS):
    mapper, published = mapper_for(guessed(factor), parameters, 0, GUESS_SIGMA), Published()
    for frame, tracks in enumerate(frames):
        published.apply(mapper.process(Frame(frame, frame * INTERVAL_NS, tracks)))
    final = mapper.finish()
    return published.apply(final), final


def found_focal(factor, final):
    return guessed(factor).fx * np.exp(final.calibration_correction[0]) / CAMERA.fx


@pytest.fixture(scope="module")
def turning():
    poses = sideways(60)
    return poses, list(Scene.box(death=0.02).frames(poses))


@pytest.mark.parametrize("factor", [0.65, 1.5])
def test_a_wrong_focal_length_is_found_and_the_path_is_that_of_a_calibrated_camera(turning, factor):
    poses, frames = turning
    published, final = run(frames, factor)
    sigma = final.calibration_sigmas[0]
    assert sigma < 0.05
    assert abs(found_focal(factor, final) - 1.0) < min(0.02, 3.0 * sigma)
    assert sorted(published.poses) == list(range(len(poses)))
    assert trajectory_error(published, poses)[0] < 1e-3


def test_frames_of_a_bootstrap_wait_and_then_all_get_their_poses(turning, monkeypatch):
    monkeypatch.setattr(calibration_bootstrap, "_KNOWN", 0.1)
    poses, frames = turning
    published, _ = run(frames, 0.65)
    begun = published.states.index(TRACKING)
    assert 5 < begun < len(poses) - 1
    assert set(published.states[:begun]) == {WAITING}
    assert "focal length is known to" in published.reasons[begun - 1]
    assert sorted(published.poses) == list(range(len(poses)))


def test_a_bootstrap_begins_though_wrong_focal_lengths_make_two_motions_alike(turning, monkeypatch):
    monkeypatch.setattr(start, "_agree", lambda one, other: one is other)
    frames = turning[1][:20]
    published, calibrated = run(frames, 0.65)[0], Published()
    mapper = Mapper(CAMERA, PARAMETERS, 0)
    for frame, tracks in enumerate(frames):
        calibrated.apply(mapper.process(Frame(frame, frame * INTERVAL_NS, tracks)))
    assert "two motions" in calibrated.reasons[-1]
    assert "focal length is known to" in published.reasons[-2]  # before the end


def test_keyframes_publish_pixels_of_the_image_not_of_the_estimated_camera(turning):
    _, frames = turning
    mapper = mapper_for(guessed(0.65), PARAMETERS, 0, GUESS_SIGMA)
    for frame, tracks in enumerate(frames):
        mapper.process(Frame(frame, frame * INTERVAL_NS, tracks))
    final = mapper.finish()
    told = mapper.publish_keyframes()
    frame_of = dict(zip(final.keyframe_ids.tolist(), final.keyframe_frames.tolist(), strict=True))
    at = 0
    for keyframe, count in zip(told.keyframe_ids.tolist(), told.counts.tolist(), strict=True):
        seen = frames[frame_of[keyframe]].points_px
        px = told.points_px[at : at + count]
        at += count
        nearest = np.linalg.norm(px[:, None] - seen[None], axis=2).min(axis=1)
        assert np.median(nearest) < 0.01


def test_straight_ahead_leaves_the_focal_length_open_with_a_reason():
    poses = [looking((0.0, 0.0, 0.05 * k)) for k in range(40)]
    _, final = run(Scene.box(death=0.02).frames(poses), 1.2)
    assert final.calibration_sigmas[0] > 0.05


def test_a_turn_alone_starts_no_map_under_any_focal_length():
    poses = [looking((0.0, 0.0, 0.0), (0.0, 0.01 * k, 0.0)) for k in range(30)]
    published, _ = run(Scene.box().frames(poses), 1.5)
    assert set(published.states) == {WAITING}
    assert not published.poses


def test_only_a_guess_is_tried_and_what_is_held_stays_held():
    assert isinstance(mapper_for(CAMERA, PARAMETERS, 0), Mapper)
    assert isinstance(mapper_for(CAMERA, PARAMETERS, 0, 0.03), Mapper)
    assert isinstance(mapper_for(CAMERA, PARAMETERS, 0, 0.3), BootstrapMapper)
    held = MappingParameters(calibration=CalibrationUncertainty(focal=0.0))
    assert widened(held, 0.3) is held
    assert widened(PARAMETERS, 0.3).calibration.k1 > PARAMETERS.calibration.k1

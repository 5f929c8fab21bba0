"""A focal length that changes during a clip is found, its map unbent; one that does not is left."""

from dataclasses import replace

import numpy as np
import pytest
from mapped_scene import Published, trajectory_error
from mapping_scene import CAMERA, INTERVAL_NS, Scene, sideways

from pliant.algorithms.slam.active import frame_focal
from pliant.algorithms.slam.active.frame_focal import shows_at_once
from pliant.algorithms.slam.adjust import final_adjustment
from pliant.algorithms.slam.adjust.ordinary_frames import OrdinaryFrames
from pliant.algorithms.slam.calibration.changing_focal import Evidence, focal_range
from pliant.algorithms.slam.calibration.self_calibration import SelfCalibration
from pliant.algorithms.slam.frame import Frame
from pliant.algorithms.slam.map.keyframe import Keyframe
from pliant.algorithms.slam.mapper import Mapper
from pliant.algorithms.slam.parameters import MappingParameters
from pliant.results.run import Run

FRAMES = 60
CENTRE = np.array([CAMERA.cx, CAMERA.cy])


def magnified(tracks, factor):
    """Tracks as a camera sees them whose focal length is so many times longer."""
    maxima = tracks.maxima.copy()
    maxima[:, :2] = CENTRE + factor * (maxima[:, :2] - CENTRE)
    points_px = CENTRE + factor * (tracks.points_px - CENTRE)
    return replace(tracks, points_px=points_px.astype(np.float32), maxima=maxima)


def run(factors, calibration=None):
    poses, published = sideways(FRAMES), Published()
    mapper = Mapper(CAMERA, MappingParameters(), 0, calibration)
    online = np.zeros(FRAMES)
    for frame, tracks in enumerate(Scene.box(death=0.02).frames(poses)):
        seen = magnified(tracks, factors[frame])
        published.apply(mapper.process(Frame(frame, frame * INTERVAL_NS, seen)))
        online[frame] = mapper.calibration.log_focal + mapper.calibration.correction[0]
    final = mapper.finish()
    published.apply(final)
    return trajectory_error(published, poses)[0], final, online


@pytest.fixture(scope="module")
def control():
    return run(np.ones(FRAMES))


def test_one_focal_length_is_left_alone(control):
    _, final, online = control
    assert not len(final.log_focals)
    assert np.abs(online).max() < 0.01


BREATHING = 1.0 + 0.015 * np.sin(2.0 * np.pi * np.arange(FRAMES) / 50.0)
SLOW = 1.3 ** (np.arange(FRAMES) / (FRAMES - 1))
FAST = 1.3 ** np.clip(np.arange(FRAMES) / 15.0 - 1.5, 0.0, 1.0)


@pytest.mark.parametrize("factors", [BREATHING, SLOW, FAST], ids=["breathing", "slow", "fast"])
def test_a_focal_length_that_changes_is_found_and_the_path_is_right(factors, monkeypatch):
    error, final, online = run(factors)
    frames = dict(zip(final.keyframe_ids.tolist(), final.keyframe_frames.tolist(), strict=True))
    true = np.log([factors[frames[k]] for k in final.focal_keyframes.tolist()])
    found = final.log_focals + final.calibration_correction[0]
    assert np.polyfit(true, found, 1)[0] == pytest.approx(1.0, abs=0.05)
    assert np.corrcoef(true, found)[0, 1] > 0.99
    assert (online - np.log(factors))[-15:].std() < 0.01  # while the clip runs as well
    none = Evidence(0.0, np.zeros(2), np.zeros(1))
    monkeypatch.setattr(final_adjustment, "evidence_of_change", lambda *_: none)
    monkeypatch.setattr(frame_focal, "shows_at_once", lambda *_: False)
    assert error < 0.4 * run(factors)[0]


def test_who_believed_in_a_change_that_is_none_gives_it_up(control):
    started = replace(SelfCalibration.of(CAMERA, MappingParameters().calibration), changes=True)
    error, final, _ = run(np.ones(FRAMES), started)
    assert not len(final.log_focals)
    assert error < 2.0 * control[0]


def test_the_magnification_of_one_frame_shows_only_what_is_large_and_certain():
    assert shows_at_once(-0.03, 0.0003)
    assert not shows_at_once(0.03, 0.001)
    assert not shows_at_once(0.015, 0.0001)


@pytest.mark.parametrize(("second", "changes"), [(0.03, True), (-0.03, False), (0.001, False)])
def test_a_change_shows_in_two_frames_in_a_row(second, changes, monkeypatch):
    found = [0.015, second]
    magnification = lambda *_: (found.pop(0) if found else 0.0, 0.0003)  # noqa: E731
    monkeypatch.setattr(frame_focal, "refine_focal", magnification)
    mapper = Mapper(CAMERA, MappingParameters(), 0, None)
    frames = Scene.box(death=0.02).frames(sideways(FRAMES))
    for frame, tracks in enumerate(frames):
        mapper.process(Frame(frame, frame * INTERVAL_NS, tracks))
        if not found:
            break
    assert mapper.calibration.changes == changes


def test_a_change_that_is_none_is_withdrawn_from_the_report(control):
    run_of_clip, empty = Run(), control[1]
    ids = np.arange(3)
    changed = replace(empty, focal_keyframes=ids, log_focals=np.array([0.0, 0.02, 0.04]))
    run_of_clip.take_calibration(changed)
    run_of_clip.take_calibration(empty)
    assert run_of_clip.focal_range is not None
    run_of_clip.take_calibration(replace(changed, log_focals=np.zeros(3)))
    assert run_of_clip.focal_range is None


def test_frames_between_keyframes_change_as_between_them():
    view = SelfCalibration.of(CAMERA, MappingParameters().calibration).view
    passed, points_px = OrdinaryFrames(), np.array([[100.0, 50.0]], np.float32)
    nothing = {"segment": 0, "T_world_camera": np.eye(4), "rows": np.zeros(0, np.int32)}
    nothing |= dict.fromkeys(("points_px", "rolled_px"), np.zeros((0, 2), np.float32))
    keyframes = [Keyframe(id=k, frame=2 * k, **nothing) for k in (0, 1)]
    passed.add(1, keyframes[0], np.eye(4), np.zeros(1, np.int32), points_px, 0.1)
    passed.focus(view, keyframes, np.array([0.0, 0.04]))
    (frame,) = passed.take_all()
    assert frame.log_focal == pytest.approx(0.12)
    expected = CENTRE + np.exp(-0.02) * (points_px - CENTRE)
    np.testing.assert_allclose(frame.points_px, expected, atol=1e-3)


def test_what_jumps_from_keyframe_to_keyframe_is_no_change_and_what_lasts_is():
    gaps = np.full(99, 0.1)
    jumping = 0.006 * (-1.0) ** np.arange(100)
    lasting = 0.015 * np.sign(np.sin(np.arange(100) / 16.0))
    assert not Evidence(30.0, jumping, gaps).calls_for_more
    assert not Evidence(5.0, lasting, gaps).calls_for_more
    assert Evidence(30.0, lasting, gaps).confirmed_by(lasting)
    assert Evidence(200.0, jumping, gaps).confirmed_by(jumping)
    # Focal lengths that are there may have run off: they stay only while they explain something.
    assert not Evidence(13.0, 10.0 * lasting, gaps).confirmed_by(10.0 * lasting, known=True)
    assert Evidence(30.0, jumping, gaps).confirmed_by(jumping, known=True)
    np.testing.assert_allclose(focal_range(lasting, gaps), (-0.015, 0.015), atol=1e-3)

"""A map that goes on under another lens: what was seen stays where it was seen."""

from dataclasses import replace

import numpy as np
import pytest
from mapping_scene import CAMERA, INTERVAL_NS, Scene, sideways

from pliant.algorithms.geometry import inverse, transform
from pliant.algorithms.slam.adjust.segment import see_by
from pliant.algorithms.slam.calibration.corrected_view import moved_px
from pliant.algorithms.slam.calibration.rolling_shutter import FramePoses
from pliant.algorithms.slam.calibration.self_calibration import SelfCalibration
from pliant.algorithms.slam.estimate.problem import CalibrationUncertainty
from pliant.algorithms.slam.frame import Frame
from pliant.algorithms.slam.map.landmarks import MAPPED
from pliant.algorithms.slam.mapper import Mapper
from pliant.algorithms.slam.parameters import MappingParameters
from pliant.algorithms.slam.start.first_map import BufferedFrame
from pliant.algorithms.slam.start.initialisation_buffer import InitialisationBuffer
from pliant.algorithms.slam.store.earlier_segments import EarlierSegments

GIVEN = CalibrationUncertainty()
KNOWN = SelfCalibration.of(CAMERA, GIVEN)
FOUND = np.array([0.04, -0.05, 0.01, 0.0, 0.0, 0.0, 0.0])
COVARIANCE = np.diag([0.005, 0.004, 0.0, 0.02, 0.0, 0.0, 0.0]) ** 2
OTHER = KNOWN.with_lens(FOUND, COVARIANCE)


@pytest.fixture
def active():
    mapper = Mapper(CAMERA, MappingParameters(), 0)
    for k, tracks in enumerate(Scene.box().frames(sideways(30))):
        mapper.process(Frame(k, k * INTERVAL_NS, tracks))
    return mapper.atlas.active


def test_points_project_to_the_observations_of_their_keyframes(active, monkeypatch):
    monkeypatch.setattr(active, "_adjust_window", lambda: None)
    rows, host = active.segment.mapped_rows(), active.keyframes[0]
    mine = rows[active.points.first_keyframe[rows] == host.id]
    assert len(mine) > 100
    T, count = inverse(host.T_world_camera), len(rows)
    before = transform(T, active.points.xyz[mine])
    seen = [KNOWN.view.seen(k.points_px + k.rolled_px) for k in active.keyframes]
    see_by(active.segment, KNOWN.view, OTHER)
    active.use_calibration(OTHER)
    after = transform(T, active.points.xyz[mine])
    camera = OTHER.view.camera
    assert active.camera == camera
    assert camera.fx == pytest.approx(CAMERA.fx * np.exp(0.04))
    np.testing.assert_allclose(after[:, 2], before[:, 2])
    px = OTHER.view.seen(camera.project(after).astype(np.float32))
    np.testing.assert_allclose(px, CAMERA.project(before), atol=1e-3)
    for keyframe, was in zip(active.keyframes, seen, strict=True):
        now = OTHER.view.seen(keyframe.points_px + keyframe.rolled_px)
        np.testing.assert_allclose(now, was, atol=1e-3)
    window = active.window
    for slot, keyframe in enumerate(window.keyframes):
        columns = window.columns[keyframe.rows]
        np.testing.assert_array_equal(window.u[slot, columns], keyframe.points_px[:, 0])
    assert np.count_nonzero(active.points.state == MAPPED) == count


def test_what_a_rolling_shutter_moved_goes_along(active):
    known = replace(KNOWN, correction=np.array([0.0, 0, 0, 0.5, 0, 0, 0]))
    keyframe = active.keyframes[3]
    keyframe.rolled_px = keyframe.rolled_px + np.float32(2.0)
    seen, at_once = keyframe.points_px + keyframe.rolled_px, keyframe.points_px
    active.segment.path = FramePoses()
    see_by(active.segment, known.view, known.with_lens(FOUND, COVARIANCE))
    # Of a path without frames no motion is known: what was known of it stays.
    whole = OTHER.view.seen(keyframe.points_px + keyframe.rolled_px)
    np.testing.assert_allclose(whole, seen, atol=1e-3)
    np.testing.assert_allclose(OTHER.view.seen(keyframe.points_px), at_once, atol=1e-3)


def test_earlier_segments_and_waiting_frames_follow(active):
    earlier = EarlierSegments()
    earlier.keep(active.segment, KNOWN)
    assert earlier.like(OTHER) == []
    earlier.see_by(OTHER, OTHER)  # it has other pixels: nothing happens
    assert earlier.like(KNOWN) == [active.segment]
    earlier.see_by(KNOWN, OTHER)
    assert earlier.like(OTHER) == [active.segment]
    px = np.array([[10.0, 20.0], [320.0, 240.0]], np.float32)
    frame = BufferedFrame(
        frame=3, stamp_ns=4, ids=np.arange(2), points_px=px, kappas=np.ones(2, np.float32)
    )
    (waited,) = InitialisationBuffer([frame], []).seen_by(KNOWN.view, OTHER.view).frames
    np.testing.assert_array_equal(waited.points_px, moved_px(px, KNOWN.view, OTHER.view))
    np.testing.assert_allclose(OTHER.view.seen(waited.points_px), px, atol=1e-3)


@pytest.mark.parametrize(
    ("focal", "k1", "sigma", "refuted"),
    [
        (0.04, 0.0, 0.005, True),
        (0.04, 0.0, 0.011, False),  # nobody knows
        (0.009, 0.0, 0.001, False),  # as it was said to be
        (0.0, 0.03, 0.005, True),
        (0.0, 0.0, 0.0001, False),
    ],
)
def test_a_lens_is_refuted_when_it_is_certain_and_unlikely(focal, k1, sigma, refuted):
    found = np.array([focal, k1, 0.0, 0.7, 0.0, 0.0, 0.0])
    covariance = np.diag([sigma, sigma, 0.0, 0.01, 0.0, 0.0, 0.0]) ** 2
    assert KNOWN.is_refuted(found, covariance) == refuted
    held = CalibrationUncertainty(focal=0.0, k1=0.0)
    assert not replace(KNOWN, uncertainty=held).is_refuted(found, np.zeros((7, 7)))
    assert not KNOWN.is_refuted(found, np.full((7, 7), np.inf))
    lens = KNOWN.with_lens(found, covariance)
    assert lens.readout == 0.0
    assert lens.sigmas[3] == KNOWN.sigmas[3]
    assert not lens.is_refuted(found, covariance)
    assert (lens.prior(lens.in_use).focal > GIVEN.focal) == refuted
    assert lens.prior(lens.in_use).k2 == 0.0  # what is held stays held

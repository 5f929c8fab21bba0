"""A focal length that changes during a clip is found, its map unbent; one that does not is left."""

from dataclasses import replace

import numpy as np
import pytest
from mapping_scene import CAMERA, INTERVAL_NS, Scene, sideways
from test_mapper import Published, trajectory_error

from pliant.algorithms.mapping import final_adjustment
from pliant.algorithms.mapping.changing_focal import Evidence, focal_range
from pliant.algorithms.mapping.mapper import Mapper
from pliant.algorithms.mapping.parameters import MappingParameters

FRAMES = 60
CENTRE = np.array([CAMERA.cx, CAMERA.cy])


def magnified(tracks, factor):
    """Tracks as a camera sees them whose focal length is so many times longer."""
    maxima = tracks.maxima.copy()
    maxima[:, :2] = CENTRE + factor * (maxima[:, :2] - CENTRE)
    points_px = CENTRE + factor * (tracks.points_px - CENTRE)
    return replace(tracks, points_px=points_px.astype(np.float32), maxima=maxima)


def run(factors):
    poses, mapper, published = sideways(FRAMES), Mapper(CAMERA, MappingParameters(), 0), Published()
    for frame, tracks in enumerate(Scene.box(death=0.02).frames(poses)):
        seen = magnified(tracks, factors[frame])
        published.apply(mapper.process(frame, frame * INTERVAL_NS, seen, None, None))
    final = mapper.finish()
    published.apply(final)
    return trajectory_error(published, poses)[0], final


@pytest.fixture(scope="module")
def control():
    return run(np.ones(FRAMES))


def test_one_focal_length_is_left_alone(control):
    _, final = control
    assert not len(final.log_focals)


@pytest.mark.parametrize(
    "factors",
    [
        1.0 + 0.015 * np.sin(2.0 * np.pi * np.arange(FRAMES) / 50.0),
        1.3 ** (np.arange(FRAMES) / (FRAMES - 1)),
    ],
    ids=["breathing", "zoom"],
)
def test_a_focal_length_that_changes_is_found_and_the_path_is_right(factors, monkeypatch):
    error, final = run(factors)
    none = Evidence(0.0, np.zeros(2), np.zeros(1))
    monkeypatch.setattr(final_adjustment, "evidence_of_change", lambda *_: none)
    assert error < 0.5 * run(factors)[0]
    frames = dict(zip(final.keyframe_ids.tolist(), final.keyframe_frames.tolist(), strict=True))
    true = np.array([factors[frames[k]] for k in final.focal_keyframes.tolist()])
    found = np.exp(final.log_focals + final.calibration_correction[0])
    assert np.corrcoef(np.log(found), np.log(true))[0, 1] > 0.95
    assert np.ptp(np.log(found)) > 0.5 * np.ptp(np.log(true))


def test_what_jumps_from_keyframe_to_keyframe_is_no_change_and_what_lasts_is():
    gaps = np.full(99, 0.1)
    jumping = 0.01 * (-1.0) ** np.arange(100)
    lasting = 0.015 * np.sign(np.sin(np.arange(100) / 16.0))
    assert not Evidence(30.0, jumping, gaps).calls_for_more
    assert not Evidence(5.0, lasting, gaps).calls_for_more
    assert Evidence(30.0, lasting, gaps).confirmed_by(lasting)
    assert Evidence(200.0, jumping, gaps).confirmed_by(jumping)
    np.testing.assert_allclose(focal_range(lasting, gaps), (-0.015, 0.015), atol=1e-3)

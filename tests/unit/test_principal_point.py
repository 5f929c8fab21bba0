"""A given principal point that is wrong is found, and the path is right; a right one is held."""

from dataclasses import replace

import numpy as np
import pytest
from mapping_scene import CAMERA, INTERVAL_NS, Scene, sideways
from test_mapper import Published, trajectory_error

from pliant.algorithms.mapping.frame import Frame
from pliant.algorithms.mapping.mapper import Mapper
from pliant.algorithms.mapping.parameters import MappingParameters

FRAMES = 60


def run(off):
    """What comes of a calibration whose principal point is off by a share of the focal length."""
    camera = replace(CAMERA, cx=CAMERA.cx + off[0] * CAMERA.fx, cy=CAMERA.cy + off[1] * CAMERA.fy)
    poses, published = sideways(FRAMES), Published()
    mapper = Mapper(camera, MappingParameters(), 0)
    for frame, tracks in enumerate(Scene.box(death=0.02).frames(poses)):
        published.apply(mapper.process(Frame(frame, frame * INTERVAL_NS, tracks)))
    final = mapper.finish()
    published.apply(final)
    return trajectory_error(published, poses)[0], np.array(final.calibration_correction)


@pytest.fixture(scope="module")
def right():
    return run((0.0, 0.0))


def test_a_right_principal_point_is_held(right):
    assert not right[1][4:].any()


@pytest.mark.parametrize("off", [(0.04, 0.0), (-0.1, 0.05)])
def test_a_wrong_principal_point_is_found_and_the_path_is_right(right, off):
    error, correction = run(off)
    np.testing.assert_allclose(correction[4:], -np.array(off), atol=0.005)
    assert error < 3.0 * right[0]

"""A given principal point or aspect ratio that is wrong is found; right ones are held."""

from dataclasses import replace

import numpy as np
import pytest
from mapped_scene import Published, trajectory_error
from mapping_scene import CAMERA, INTERVAL_NS, Scene, looking, sideways

from pliant.algorithms.slam.frame import Frame
from pliant.algorithms.slam.mapper import Mapper
from pliant.algorithms.slam.parameters import MappingParameters

FRAMES = 60


def turning(frames):
    """Slides sideways and rolls about the axis, which shows the aspect ratio."""
    return [looking((0.05 * k, 0.0, 0.02 * k), (0.0, 0.01 * k, 0.02 * k)) for k in range(frames)]


def run(off=(0.0, 0.0), aspect=1.0, path=sideways):
    """What comes of a calibration whose principal point is off by a share of the focal length, and
    whose fx is wrong by a factor."""
    camera = replace(
        CAMERA,
        fx=aspect * CAMERA.fx,
        cx=CAMERA.cx + off[0] * CAMERA.fx,
        cy=CAMERA.cy + off[1] * CAMERA.fy,
    )
    poses, published = path(FRAMES), Published()
    mapper = Mapper(camera, MappingParameters(), 0)
    for frame, tracks in enumerate(Scene.box(death=0.02).frames(poses)):
        published.apply(mapper.process(Frame(frame, frame * INTERVAL_NS, tracks)))
    final = mapper.finish()
    published.apply(final)
    return trajectory_error(published, poses)[0], np.array(final.calibration_correction)


@pytest.fixture(scope="module")
def right():
    return run()


def test_right_unknowns_are_held(right):
    assert not right[1][4:].any()


@pytest.mark.parametrize("off", [(0.04, 0.0), (-0.1, 0.05)])
def test_a_wrong_principal_point_is_found_and_the_path_is_right(right, off):
    error, correction = run(off)
    assert correction[6] == 0.0
    np.testing.assert_allclose(correction[4:6], -np.array(off), atol=0.005)
    assert error < 3.0 * right[0]


@pytest.mark.parametrize("aspect", [1.02, 0.98])
def test_a_wrong_aspect_ratio_is_found_and_the_path_is_right(aspect):
    error, correction = run(aspect=aspect, path=turning)
    assert correction[6] == pytest.approx(np.log(aspect), abs=0.002)
    assert not correction[4:6].any()
    assert error < 3.0 * run(path=turning)[0]

"""What is said in pixels at 640x480 holds at any size, however the camera is held."""

import numpy as np
import pytest

from pliant.algorithms.camera import size_unit
from pliant.algorithms.tracking.parameters import TrackingParameters
from pliant.algorithms.tracking.tracker import ExtremaTracker


def test_the_unit_is_that_of_the_diagonal():
    assert size_unit(640, 480) == size_unit(480, 640) == 1.0
    assert size_unit(1280, 960) == 2.0
    assert size_unit(540, 960) == size_unit(960, 540)


@pytest.mark.parametrize("times", [1, 2])
def test_a_jump_of_as_much_of_the_view_is_followed(times: int):
    """150 px at 640x480, 300 at 1280x960: both are within 180 px at 640x480."""
    coarse = np.random.default_rng(5).integers(0, 256, (90, 120)).astype(np.uint8)
    world = np.kron(coarse, np.ones((8 * times, 8 * times), np.uint8))
    width, height, jump = 640 * times, 480 * times, 150 * times
    tracker = ExtremaTracker(width, height, TrackingParameters())
    for left in (jump, 0):
        found = tracker.track(np.ascontiguousarray(world[:height, left : left + width]))
    middle = np.array([0.5 * width, 0.5 * height])
    moved = middle @ found.dominant_flow[:, :2].T + found.dominant_flow[:, 2] - middle
    np.testing.assert_allclose(moved, (jump, 0.0), atol=3.0)

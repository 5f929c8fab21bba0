"""What is said in pixels at 640x480 holds at any size, however the camera is held."""

from pliant.algorithms.camera import size_unit


def test_the_unit_is_that_of_the_diagonal():
    assert size_unit(640, 480) == size_unit(480, 640) == 1.0
    assert size_unit(1280, 960) == 2.0
    assert size_unit(540, 960) == size_unit(960, 540)

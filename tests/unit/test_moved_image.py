import numpy as np
import pytest
from mapping_scene import CAMERA

from pliant.algorithms.corrected_view import CorrectedView
from pliant.algorithms.image.moved_image import MovedImage, moved_image
from pliant.algorithms.mapping.frame_pose import coloured
from pliant.algorithms.mapping.rolling_shutter import RolledFrame
from pliant.algorithms.mapping.self_calibration import SelfCalibration

WIDTH, HEIGHT = 640, 480


def test_colours_are_those_of_the_nearest_pixel():
    image = np.arange(60, dtype=np.uint8).reshape(4, 5, 3)
    px = np.array([[0.4, 0.4], [3.6, 2.2], [99.0, -7.0]], np.float32)
    expected = [image[0, 0], image[2, 4], image[0, 4]]
    np.testing.assert_array_equal(MovedImage(image).colours(px), expected)
    grey = np.ascontiguousarray(image[..., 1])
    np.testing.assert_array_equal(MovedImage(grey).colours(px), [[e[1]] * 3 for e in expected])


@pytest.mark.parametrize("count", [0, 1, 1023, 3000])
@pytest.mark.parametrize("steps", [1, 2, 3])
@pytest.mark.parametrize("channels", [(), (3,)])
def test_some_pixels_are_those_of_the_whole_image(channels, steps, count):
    rng = np.random.default_rng(count)
    image = rng.integers(0, 256, (HEIGHT, WIDTH, *channels), np.uint8)
    v, u = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    # Far enough for some to lie outside.
    moves = tuple(
        (u + rng.normal(0.0, 9.0, u.shape).astype(np.float32),
         v + rng.normal(0.0, 9.0, v.shape).astype(np.float32))
        for _ in range(steps)
    )  # fmt: skip
    whole = image
    for move in moves:
        whole = moved_image(whole, move)
    px = rng.uniform((0, 0), (WIDTH - 1, HEIGHT - 1), (count, 2)).astype(np.float32)
    np.testing.assert_array_equal(
        MovedImage(image, moves).colours(px), MovedImage(whole).colours(px)
    )


def test_a_frame_has_its_colours_where_lens_and_shutter_have_moved_them():
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, (CAMERA.height, CAMERA.width, 3), np.uint8)
    correction = np.array([0.0, 0.04, -0.01, 0.3, 0.0, 0.0])
    known = SelfCalibration(CAMERA, correction, np.zeros((6, 6)))
    motion = np.array([0.01, -0.02, 0.0, 0.03, 0.0, 0.01])
    rolled = RolledFrame(known.view.camera, 0.3, motion, 0.2)
    px = rng.uniform((0, 0), (CAMERA.width, CAMERA.height), (500, 2)).astype(np.float32)
    whole = rolled.image(known.view.image(image))
    found = coloured(known, rolled, image)
    assert found is not None
    assert (whole != image).any()
    np.testing.assert_array_equal(found.colours(px), MovedImage(whole).colours(px))
    assert coloured(known, None, None) is None
    assert CorrectedView(CAMERA, ()).moves == ()

import cv2
import numpy as np
import pytest
from mapping_scene import CAMERA

from pliant.algorithms.image.moved_image import MovedImage, moved_image
from pliant.algorithms.slam.calibration.corrected_view import CorrectedView
from pliant.algorithms.slam.calibration.rolling_shutter import RolledFrame
from pliant.algorithms.slam.calibration.self_calibration import SelfCalibration
from pliant.algorithms.slam.frame import Frame, IdealFrame
from pliant.algorithms.tracks import FrameExtrema

WIDTH, HEIGHT = 640, 480


def test_colours_are_those_of_the_nearest_pixel():
    image = np.arange(60, dtype=np.uint8).reshape(4, 5, 3)
    px = np.array([[0.4, 0.4], [3.6, 2.2], [99.0, -7.0]], np.float32)
    expected = [image[0, 0], image[2, 4], image[0, 4]]
    np.testing.assert_array_equal(MovedImage(image).colours(px), expected)
    grey = np.ascontiguousarray(image[..., 1])
    np.testing.assert_array_equal(MovedImage(grey).colours(px), [[e[1]] * 3 for e in expected])


@pytest.mark.parametrize("count", [0, 1, 1023, 3000])
@pytest.mark.parametrize("channels", [(), (3,)])
def test_some_pixels_are_those_of_the_whole_image(channels, count):
    rng = np.random.default_rng(count)
    image = rng.integers(0, 256, (HEIGHT, WIDTH, *channels), np.uint8)
    v, u = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    # Far enough for some to lie outside.
    move = (u + rng.normal(0.0, 9.0, u.shape).astype(np.float32),
            v + rng.normal(0.0, 9.0, v.shape).astype(np.float32))  # fmt: skip
    moved = MovedImage(image, move)
    np.testing.assert_array_equal(moved.whole, moved_image(image, move))
    px = rng.uniform((0, 0), (WIDTH - 1, HEIGHT - 1), (count, 2)).astype(np.float32)
    np.testing.assert_array_equal(moved.colours(px), MovedImage(moved.whole).colours(px))


def test_an_image_is_where_lens_and_shutter_have_moved_the_tracks():
    rng = np.random.default_rng(0)
    smooth = cv2.resize(
        rng.integers(0, 256, (12, 16), np.uint8), (CAMERA.width, CAMERA.height),
        interpolation=cv2.INTER_CUBIC,
    )  # fmt: skip
    correction = np.array([0.01, 0.04, -0.01, 0.3, 0.002, -0.003, 0.004])
    known = SelfCalibration(CAMERA, correction, np.zeros((7, 7)))
    motion = np.array([0.01, -0.02, 0.0, 0.03, 0.0, 0.01])
    rolled = RolledFrame(known.view, 0.3, motion, 0.2)
    lens = IdealFrame.of(Frame(0, 0, FrameExtrema.empty(), smooth), known)
    found = lens.to_global_shutter(rolled, np.zeros(0))
    assert found.colours is not None
    np.testing.assert_array_equal(found.colours.whole, found.image)
    np.testing.assert_array_equal(lens.image, known.view.image(smooth))
    at_once = RolledFrame(CorrectedView(known.view.camera, ()), 0.3, motion, 0.2)
    one_by_one = at_once.image(lens.image)
    inner = (slice(20, -20), slice(20, -20))
    assert np.abs(found.image[inner].astype(int) - one_by_one[inner]).max() <= 2
    assert np.abs(found.image[inner].astype(int) - smooth[inner]).max() > 20
    seen = rng.uniform((99, 99), (CAMERA.width - 99, CAMERA.height - 99), (500, 2))
    px = seen.astype(np.float32)
    ideal = known.view.pixels(px)
    at = ideal - rolled.shifts(ideal)
    back = [cv2.remap(p, at[:, :1], at[:, 1:], cv2.INTER_LINEAR) for p in rolled.places]
    np.testing.assert_allclose(np.hstack(back), px, atol=0.02)
    assert not IdealFrame.of(Frame.of_tracks(0, 0, FrameExtrema.empty()), known).has_image
    assert CorrectedView(CAMERA, ()).move is None

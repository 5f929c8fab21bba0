"""From bytes to rectified pixels: exact without distortion, and broken frames are told apart."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from raw_frames import DISTORTED, HEIGHT, PLAIN, WIDTH, picture, raw

from pliant.datasets.base import BrokenFrame, SourceFrame, encoding_of
from pliant.datasets.calibration import calibration_from_yaml, calibration_yaml
from pliant.datasets.rectifier import Rectifier, decode


def source(data: bytes, index: int = 7) -> SourceFrame:
    return SourceFrame(index=index, stamp_ns=1, encoding=encoding_of(data), data=data)


def encode(image: np.ndarray, suffix: str = ".png") -> bytes:
    done, data = cv2.imencode(suffix, image)
    assert done
    return data.tobytes()


def test_pixels_are_untouched_without_distortion() -> None:
    bgr, grey = picture(), picture(colour=False)
    for frame in (source(encode(bgr)), raw(bgr, "bgr8"), raw(bgr[..., ::-1].copy(), "rgb8")):
        got_grey, rgb = Rectifier(PLAIN).rectify(frame)
        assert rgb is not None
        np.testing.assert_array_equal(rgb, bgr[..., ::-1])
        np.testing.assert_array_equal(got_grey, cv2.cvtColor(bgr, cv2.COLOR_BGR2GRAY))
    for frame in (source(encode(grey)), raw(grey, "mono8")):
        got_grey, rgb = Rectifier(PLAIN).rectify(frame)
        assert rgb is None
        np.testing.assert_array_equal(got_grey, grey)


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".bmp", ".tiff", ".webp", ".ppm"])
def test_formats(suffix: str) -> None:
    frame = source(encode(picture(), suffix))
    assert frame.encoding != "unknown"
    decoded = decode(frame).astype(np.float64)
    assert np.abs(decoded - picture()[..., ::-1]).mean() < 4.0


def test_sixteen_bits_become_eight_and_transparency_goes() -> None:
    deep = picture(colour=False).astype(np.uint16) * 256
    np.testing.assert_array_equal(decode(source(encode(deep))), picture(colour=False))
    transparent = np.dstack([picture(), np.zeros((HEIGHT, WIDTH), np.uint8)])
    np.testing.assert_array_equal(decode(source(encode(transparent))), picture()[..., ::-1])


def test_rectification_follows_from_the_frame_and_the_yaml_alone() -> None:
    frame = source(encode(picture(), ".jpg"))
    here = Rectifier(DISTORTED)
    there = Rectifier(calibration_from_yaml(calibration_yaml(DISTORTED)))
    assert here.camera == there.camera
    for first, second in zip(here.rectify(frame), there.rectify(frame), strict=True):
        assert first is not None
        assert second is not None
        np.testing.assert_array_equal(first, second)
        assert first.dtype == np.uint8
        assert first.shape[:2] == (HEIGHT, WIDTH)


def test_grey_belongs_to_colour() -> None:
    grey, rgb = Rectifier(DISTORTED).rectify(source(encode(picture())))
    assert rgb is not None
    np.testing.assert_array_equal(grey, cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY))


def broken_frames() -> list[tuple[SourceFrame, str]]:
    png, jpeg = encode(picture()), encode(picture(), ".jpg")
    bgr = raw(picture(), "bgr8")
    return [
        (SourceFrame(index=7, stamp_ns=1, encoding="png", data=b""), "empty: its file is gone"),
        (source(b"no image at all"), "the image does not decode"),
        (source(png[: len(png) // 2]), "the png image is cut off"),
        (source(jpeg[: len(jpeg) // 2]), "the jpeg image is cut off"),
        (source(jpeg[:-2]), "the jpeg image is cut off"),
        (source(png[:20] + b"\xff" * 8 + png[28:]), "the png image does not decode"),
        (source(encode(picture()[:-1])), "64x47 px, but the camera has 64x48"),
        (SourceFrame(index=7, stamp_ns=1, encoding="bgr8", data=bgr.data), "are no bgr8 image of"),
        (raw(picture(), "mono8"), "are no mono8 image of 64x48"),
        (bgr.without_data(), "was dropped"),
    ]


@pytest.mark.parametrize(
    ("frame", "says"), broken_frames(), ids=[says for _, says in broken_frames()]
)
def test_broken_frames_are_named(frame: SourceFrame, says: str) -> None:
    with pytest.raises(BrokenFrame, match=says) as caught:
        Rectifier(PLAIN).rectify(frame)
    assert str(caught.value).startswith("frame 7: ")
    assert "\n" not in str(caught.value)


def test_the_end_of_a_thumbnail_is_not_the_end_of_the_image() -> None:
    jpeg = encode(picture(), ".jpg")
    thumbnail = b"\xff\xe1" + (len(jpeg) + 2).to_bytes(2, "big") + jpeg
    with_thumbnail = jpeg[:2] + thumbnail + jpeg[2:]
    np.testing.assert_array_equal(decode(source(with_thumbnail)), decode(source(jpeg)))
    with pytest.raises(BrokenFrame, match="cut off"):
        decode(source(with_thumbnail[:-200]))


def test_dropped_frames_keep_their_number_and_time() -> None:
    frame = source(encode(picture()))
    dropped = frame.without_data()
    assert (dropped.index, dropped.stamp_ns, dropped.data) == (frame.index, frame.stamp_ns, b"")
    assert dropped.dropped
    assert not frame.dropped


@settings(max_examples=100)
@given(st.binary(max_size=200), st.sampled_from([b"", b"\x89PNG\r\n\x1a\n", b"BM", b"P5", b"RIFF"]))
def test_any_bytes_are_an_image_or_a_broken_frame(data: bytes, magic: bytes) -> None:
    try:
        image = decode(source(magic + data))
    except BrokenFrame:
        return
    assert image.dtype == np.uint8
    assert image.ndim in (2, 3)

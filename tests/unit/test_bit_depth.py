"""Values of 12 or 14 bits in images of 16, and raw pixels as ROS drivers send them."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import recorded_messages as bags
from recorded_messages import HEIGHT, WIDTH, Ros

from pliant.datasets import notes_on, open_source
from pliant.datasets.rectifier import decode
from pliant.datasets.source_spec import SourceSpec

COUNT = 30


def grey(row: int, bits: int) -> np.ndarray:
    """All values of these bits in the last image, fewer in the others."""
    values = np.linspace(0, (2**bits - 1) * (row + 1) / COUNT, HEIGHT * WIDTH)
    return values.reshape(HEIGHT, WIDTH).astype(np.uint16)


@pytest.mark.parametrize("bits", [8, 10, 12, 14])
@pytest.mark.parametrize("suffix", [".png", ".tiff", ".pgm"])
def test_the_bits_that_are_used_become_eight_in_all_images_alike(
    bits: int, suffix: str, tmp_path: Path
) -> None:
    for row in range(COUNT):
        assert cv2.imwrite(str(tmp_path / f"{row}{suffix}"), grey(row, bits))
    source = open_source(SourceSpec(location=str(tmp_path), fov_deg=60.0))
    for row, frame in enumerate(source):
        assert np.array_equal(decode(frame), grey(row, bits) >> (bits - 8))
    assert f"16-bit images use {bits} bits: these are scaled to 8 bits, in all images alike" in (
        notes_on(source)
    )


def test_colour_too(tmp_path: Path) -> None:
    bgr = np.dstack([grey(0, 12), grey(9, 12), grey(COUNT - 1, 12)])
    for row in range(3):
        cv2.imwrite(str(tmp_path / f"{row}.png"), bgr)
    for frame in open_source(SourceSpec(location=str(tmp_path), fov_deg=60.0)):
        assert np.array_equal(decode(frame), bgr[:, :, ::-1] >> 4)


def test_what_uses_all_bits_or_has_eight_stays_as_it_is(tmp_path: Path) -> None:
    for name, pixels in (("deep", grey(COUNT - 1, 16)), ("plain", grey(COUNT - 1, 8).astype("u1"))):
        (tmp_path / name).mkdir()
        for row in range(2):
            cv2.imwrite(str(tmp_path / name / f"{row}.png"), pixels)
        source = open_source(SourceSpec(location=str(tmp_path / name), fov_deg=60.0))
        assert [frame.encoding for frame in source] == ["png", "png"]
        assert len(notes_on(source)) == 1
        expected = pixels >> 8 if name == "deep" else pixels
        assert np.array_equal(decode(next(iter(source))), expected)


@pytest.mark.parametrize("big", [0, 1])
def test_messages_of_twelve_bits(big: int, tmp_path: Path) -> None:
    ros = Ros(2)
    images = [
        ros.image(
            row, encoding="mono16", is_bigendian=big,
            pixels=grey(COUNT - 1, 12).astype(">u2" if big else "<u2"),
        )
        for row in range(3)
    ]  # fmt: skip
    bags.write_ros2_bag(tmp_path / "bag", ros, {"/image": images})
    for frame in open_source(SourceSpec(location=str(tmp_path / "bag"), fov_deg=70.0)):
        assert np.array_equal(decode(frame), grey(COUNT - 1, 12) >> 4)


def as_yuv(rgb: np.ndarray, encoding: str) -> np.ndarray:
    """Rows of bytes of an image, its colours at half the resolution."""
    i420 = cv2.cvtColor(rgb, cv2.COLOR_RGB2YUV_I420).reshape(-1)
    size = HEIGHT * WIDTH
    y = i420[:size].reshape(HEIGHT, WIDTH)
    u, v = i420[size:].reshape(2, HEIGHT // 2, WIDTH // 2)
    if encoding in ("nv12", "nv21"):
        pair = (u, v) if encoding == "nv12" else (v, u)
        return np.concatenate([y, np.dstack(pair).reshape(HEIGHT // 2, WIDTH)])
    colour = np.dstack([u, v]).repeat(2, axis=0).reshape(HEIGHT, WIDTH)
    order = (colour, y) if encoding in ("yuv422", "uyvy") else (y, colour)
    return np.dstack(order).reshape(HEIGHT, 2 * WIDTH)


@pytest.mark.parametrize(
    "encoding", ["yuv422", "uyvy", "yuv422_yuy2", "yuyv", "yuy2", "nv12", "nv21"]
)
@pytest.mark.parametrize("padding", [0, 8])
def test_every_yuv_gives_its_colours(encoding: str, padding: int, tmp_path: Path) -> None:
    rgb = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    rgb[:, : WIDTH // 2], rgb[:, WIDTH // 2 :] = (200, 90, 10), (20, 160, 220)
    rows = np.pad(as_yuv(rgb, encoding), ((0, 0), (0, padding)))
    ros = Ros(2)
    image = ros.image(0, encoding=encoding)
    image.data, image.step = rows.reshape(-1), rows.shape[1]
    bags.write_ros2_bag(tmp_path / "bag", ros, {"/image": [image]})
    (frame,) = open_source(SourceSpec(location=str(tmp_path / "bag"), fov_deg=70.0))
    assert np.abs(decode(frame).astype(int) - rgb).max() <= 6


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_bayer_of_sixteen_bits(pattern: str, tmp_path: Path) -> None:
    mosaic = np.zeros((HEIGHT, WIDTH), "<u2")
    for i, colour in enumerate(pattern):
        mosaic[i // 2 :: 2, i % 2 :: 2] = {"r": 3000, "g": 1500, "b": 200}[colour]
    ros = Ros(2)
    image = ros.image(0, encoding=f"bayer_{pattern}16", pixels=mosaic)
    bags.write_ros2_bag(tmp_path / "bag", ros, {"/image": [image]})
    (frame,) = open_source(SourceSpec(location=str(tmp_path / "bag"), fov_deg=70.0))
    assert (decode(frame)[2:-2, 2:-2] == np.array([3000, 1500, 200]) >> 4).all()


def test_an_encoding_with_an_odd_size_is_a_broken_image(tmp_path: Path) -> None:
    from pliant.datasets.base import BrokenFrame, SourceFrame

    for encoding, width, height in (("nv12", 5, 4), ("uyvy", 5, 4), ("nv12", 4, 5)):
        size = width * (height + (height + 1) // 2 if encoding == "nv12" else 2 * height)
        frame = SourceFrame(
            index=3, stamp_ns=0, encoding=encoding, data=bytes(size), width=width, height=height
        )
        with pytest.raises(BrokenFrame, match="frame 3: is no"):
            decode(frame)

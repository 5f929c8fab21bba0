"""Packed pixels come out as they went in, and nothing else is taken for some."""

import struct

import msgpack
import numpy as np
import pytest
import zstandard
from hypothesis import given
from hypothesis import strategies as st

from pliant.errors import MessageError
from pliant.messages import codec, packing
from pliant.messages.types import Image, SourceImage


def picture(height: int, width: int) -> np.ndarray:
    rows, columns = np.mgrid[:height, :width]
    return ((3 * rows + 200 * np.sin(columns / 7.0)).astype(np.int64) % 256).astype(np.uint8)


def image(grey: np.ndarray, colour: np.ndarray | None = None) -> Image:
    none = np.zeros((0, 0, 3), np.uint8)
    return Image(
        frame=1, stamp_ns=2, frame_id="camera", grey=grey, colour=none if colour is None else colour
    )


@given(height=st.integers(1, 70), width=st.integers(1, 70), noise=st.integers(1, 255))
def test_pixels_are_the_same(height: int, width: int, noise: int) -> None:
    random = np.random.default_rng(height + width)
    grey = picture(height, width) + random.integers(0, noise, (height, width), np.uint8)
    colour = np.dstack([grey, grey.T.reshape(grey.shape), grey])
    for sent in (image(grey), image(grey, colour)):
        found = codec.decode(Image, codec.encode(sent, packed=True))
        assert codec.encode(found) == codec.encode(sent)
        assert found.grey.flags.writeable  # as kernels were compiled for


def test_smooth_images_are_a_fraction_and_noise_is_left_as_it_is() -> None:
    smooth = image(picture(480, 640))
    assert len(codec.encode(smooth, packed=True)) < 0.1 * len(codec.encode(smooth))
    noise = image(np.random.default_rng(0).integers(0, 256, (480, 640), np.uint8))
    assert codec.encode(noise, packed=True) == codec.encode(noise)


@pytest.mark.parametrize("width", [640, 0])
def test_a_source_image_of_raw_rows_is_smaller_and_a_file_still_itself(width: int) -> None:
    height = 480 if width else 0
    sent = SourceImage(
        frame=0, stamp_ns=0, frame_id="camera",
        encoding="mono8" if width else "unknown", width=width, height=height,
        data=picture(480, 640).tobytes(),
    )  # fmt: skip
    wire = codec.encode(sent, packed=True)
    assert len(wire) < 0.5 * len(sent.data)
    assert codec.decode(SourceImage, wire) == sent


def test_status_and_names_are_never_packed() -> None:
    sent = SourceImage(
        frame=0, stamp_ns=0, frame_id="c" * 5000, encoding="x", width=0, height=0, data=b""
    )
    assert codec.encode(sent, packed=True) == codec.encode(sent)


def _packed(size: int, row: int, data: bytes) -> msgpack.ExtType:
    return msgpack.ExtType(packing.CODE, struct.pack("<QQ", size, row) + data)


_FRAME = zstandard.ZstdCompressor().compress(bytes(12))
_UNSIZED = zstandard.ZstdCompressor(write_content_size=False).compress(bytes(12))


@pytest.mark.parametrize(
    ("hostile", "complaint"),
    [
        (_packed(12, 4, _FRAME), ""),
        (_packed(1 << 62, 4, _FRAME), "claims"),
        (_packed(12, 5, _FRAME), "claims"),
        (_packed(12, 1 << 40, _FRAME), "claims"),
        (_packed(8, 4, _FRAME), "not the 8"),
        (_packed(12, 4, _FRAME[:-2]), "broken"),
        (_packed(12, 4, _UNSIZED), "not the 12"),
        (_packed(12, 4, b"nothing"), "broken"),
        (msgpack.ExtType(packing.CODE, b"short"), "not packed"),
        (msgpack.ExtType(7, _packed(12, 4, _FRAME).data), "not packed"),
        (_packed(4, 4, zstandard.ZstdCompressor().compress(bytes(4))), "do not fill"),
    ],
)
def test_what_is_not_packed_pixels_is_refused(hostile: msgpack.ExtType, complaint: str) -> None:
    content = msgpack.unpackb(codec.encode(image(np.zeros((3, 4), np.uint8))))
    content["grey"] = [[3, 4], hostile]
    wire = msgpack.packb(content)
    if not complaint:
        assert not codec.decode(Image, wire).grey.any()
        return
    with pytest.raises(MessageError, match=complaint):
        codec.decode(Image, wire)


def test_all_fields_together_unpack_to_no_more_than_the_topic_allows() -> None:
    grey = picture(100, 100)
    wire = codec.encode(image(grey, np.dstack([grey] * 3)), packed=True)
    codec.decode(Image, wire, max_bytes=40_000)
    with pytest.raises(MessageError, match="claims"):
        codec.decode(Image, wire, max_bytes=39_000)


def test_only_pixels_may_be_packed() -> None:
    content = msgpack.unpackb(codec.encode(image(np.zeros((3, 4), np.uint8))))
    with pytest.raises(MessageError, match="missing"):
        codec.decode(Image, msgpack.packb({**content, "missing": _packed(12, 4, _FRAME)}))

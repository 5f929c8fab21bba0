"""Messages survive the wire, and nothing else is taken for one."""

from typing import get_args, get_origin

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from pliant.algorithms.arrays import array_fields
from pliant.algorithms.surfels.surfel_frame import SurfelFrame
from pliant.algorithms.tracks import FrameTracks
from pliant.errors import MessageError
from pliant.messages import codec
from pliant.messages.topics import TOPICS, status
from pliant.messages.types import Extrema, Header, Image, MapUpdate, Surfels

MESSAGES = sorted({t.message for t in (*TOPICS, status("ingest"))}, key=lambda m: m.__name__)
_SCALARS = {
    "int": st.integers(-(2**62), 2**62),
    "float": st.floats(allow_nan=False),
    "str": st.text(max_size=20),
    "bool": st.booleans(),
    "bytes": st.binary(max_size=50),
}


@st.composite
def messages(draw: st.DrawFn, message: type[Header]) -> Header:
    sizes: dict[str, int] = {}
    values = {}
    for name, kind in codec.scalars(message).items():
        if get_origin(kind) is tuple:
            element = _SCALARS[get_args(kind)[0].__name__]
            values[name] = tuple(draw(st.lists(element, max_size=4)))
        else:
            values[name] = draw(_SCALARS[kind.__name__])
    for spec in array_fields(message):
        shape = tuple(
            s if isinstance(s, int) else sizes.setdefault(s, draw(st.integers(0, 4)))
            for s in spec.shape
        )
        values[spec.name] = draw(hnp.arrays(spec.dtype, shape))
    return message(**values)


@pytest.mark.parametrize("message", MESSAGES, ids=lambda m: m.__name__)
@given(data=st.data())
def test_round_trip_of_every_message(message: type[Header], data: st.DataObject) -> None:
    sent = data.draw(messages(message))
    wire = codec.encode(sent)
    received = codec.decode(message, wire)
    for spec in array_fields(message):
        before, after = getattr(sent, spec.name), getattr(received, spec.name)
        assert after.dtype == before.dtype
        assert after.shape == before.shape
        assert after.tobytes() == before.tobytes()
    for name in codec.scalars(message):
        assert getattr(received, name) == getattr(sent, name)
    assert codec.encode(received) == wire


@given(noise=st.binary(max_size=200))
def test_random_bytes_are_refused(noise: bytes) -> None:
    with pytest.raises(MessageError):
        codec.decode(Extrema, noise)


def _extrema() -> Extrema:
    header = Header(frame=3, stamp_ns=4, frame_id="camera")
    return Extrema.of(header, FrameTracks.empty())


def test_every_truncation_is_refused() -> None:
    wire = codec.encode(_extrema())
    for length in range(len(wire)):
        with pytest.raises(MessageError):
            codec.decode(Extrema, wire[:length])


@pytest.mark.parametrize(
    ("field", "value", "complaint"),
    [
        ("frame", "three", "frame: expected int"),
        ("frame", True, "frame: expected int"),
        ("ids", [[2], b"12345678"], "do not fill"),
        ("ids", [[1 << 60], b""], "do not fill"),
        ("ids", [[-1], b""], "bad shape"),
        ("ids", [[1, 1], b"12345678"], "dimensions"),
        ("ids", [[1], b"12345678"], "size N"),
        ("ids", 5, "expected an array"),
    ],
)
def test_a_wrong_field_is_named(field: str, value: object, complaint: str) -> None:
    content = msgpack.unpackb(codec.encode(_extrema()))
    content[field] = value
    with pytest.raises(MessageError, match=complaint):
        codec.decode(Extrema, msgpack.packb(content))


def test_an_empty_array_with_an_impossible_side_is_refused() -> None:
    grey = np.zeros((0, 0), np.uint8)
    colour = np.zeros((0, 0, 3), np.uint8)
    image = Image(frame=0, stamp_ns=0, frame_id="camera", grey=grey, colour=colour)
    content = msgpack.unpackb(codec.encode(image))
    content["colour"] = [[0, 2**63, 3], b""]
    with pytest.raises(MessageError, match="colour: bad shape"):
        codec.decode(Image, msgpack.packb(content))


def test_a_missing_field_is_named_and_an_unknown_one_passed_over() -> None:
    content = msgpack.unpackb(codec.encode(_extrema()))
    content["from_the_future"] = [1, 2, 3]
    del content["missing"]  # has a default: an old writer did not know it
    assert codec.decode(Extrema, msgpack.packb(content)).missing == ""
    del content["ids"]
    with pytest.raises(MessageError, match="ids"):
        codec.decode(Extrema, msgpack.packb(content))


def test_a_map_of_a_recording_from_before_segments_were_joined() -> None:
    fields = array_fields(MapUpdate)
    sides = {f.name: [side if isinstance(side, int) else 0 for side in f.shape] for f in fields}
    update = MapUpdate(
        frame=1, stamp_ns=2, frame_id="", state=0, reason="", segment=-1, inliers=0,
        **{f.name: np.zeros(sides[f.name], f.dtype) for f in fields},
    )  # fmt: skip
    content = msgpack.unpackb(codec.encode(update))
    del content["joined"]
    assert codec.decode(MapUpdate, msgpack.packb(content)).joined.shape == (0, 2)


def test_surfels_of_a_recording_without_tried_positions() -> None:
    header = Header(frame=0, stamp_ns=0, frame_id="world")
    content = msgpack.unpackb(codec.encode(Surfels.of(header, SurfelFrame.empty())))
    del content["tried"]
    assert codec.decode(Surfels, msgpack.packb(content)).tried.shape == (0, 3)


def test_a_message_beyond_its_limit_is_refused_unread() -> None:
    with pytest.raises(MessageError, match="more than"):
        codec.decode(Extrema, b"\x00" * 100, max_bytes=99)


def test_a_wrong_dtype_does_not_leave_the_sender() -> None:
    image = Image(
        frame=0,
        stamp_ns=0,
        frame_id="camera",
        grey=np.zeros((2, 2), np.float32),  # type: ignore[arg-type]
        colour=np.zeros((0, 0, 3), np.uint8),
    )
    with pytest.raises(ValueError, match="grey"):
        codec.encode(image)

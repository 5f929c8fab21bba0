"""Recordings hold arrays in planes; who reads them gets what was sent."""

from dataclasses import replace
from pathlib import Path

import msgpack
import numpy as np
import pytest

from pliant.algorithms.tracks import FrameTracks
from pliant.errors import MessageError
from pliant.messages import codec, planes, topics
from pliant.messages.types import Extrema, Header
from pliant.recording.reader import Recording
from pliant.recording.writer import RecordingWriter

_HEADER = Header(frame=3, stamp_ns=4, frame_id="camera")


def extrema(count: int) -> Extrema:
    random = np.random.default_rng(0)
    tracks = replace(
        FrameTracks.empty(),
        ids=np.cumsum(random.integers(1, 9, count)),
        points_px=random.uniform(0.0, 640.0, (count, 2)).astype(np.float32),
        ages=random.integers(0, 99, count).astype(np.int32),
        kappas=random.normal(0.0, 50.0, count).astype(np.float32),
        states=np.zeros(count, np.uint8),
    )
    return Extrema.of(_HEADER, tracks)


def recorded(path: Path, message: Extrema) -> bytes:
    with RecordingWriter(path, {}) as writer:
        data = codec.encode(message)
        writer.write(topics.EXTREMA, data, sequence=0, log_time_ns=0, publish_time_ns=0)
    return next(Recording(path).messages()).data


@pytest.mark.parametrize("count", [0, 10, 3000])
def test_what_is_recorded_is_what_was_sent(tmp_path: Path, count: int) -> None:
    sent = codec.encode(extrema(count))
    stored = recorded(tmp_path / "a.mcap", extrema(count))
    assert codec.encode(codec.decode(Extrema, stored)) == sent
    assert codec.encode(codec.decode(Extrema, stored, views=True)) == sent
    assert planes.in_planes(Extrema, stored) == stored  # recovered, replayed


def test_a_reader_of_another_language_puts_planes_together(tmp_path: Path) -> None:
    """As docs/recording.md says it."""
    message = extrema(500)
    content = msgpack.unpackb(recorded(tmp_path / "a.mcap", message))
    shape, data = content["points_px"]
    assert (data.code, shape) == (2, [500, 2])
    numbers = np.frombuffer(data.data, "u1").reshape(4, -1).T.tobytes()
    assert np.array_equal(np.frombuffer(numbers, "<f4").reshape(shape), message.points_px)
    assert isinstance(content["states"][1], bytes)  # bytes have no planes


def test_planes_are_smaller_on_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recorded(tmp_path / "planes.mcap", extrema(3000))
    monkeypatch.setattr("pliant.recording.writer.in_planes", lambda _, data: data)
    recorded(tmp_path / "plain.mcap", extrema(3000))
    sizes = [(tmp_path / f"{name}.mcap").stat().st_size for name in ("planes", "plain")]
    assert sizes[0] < 0.9 * sizes[1]


@pytest.mark.parametrize(
    ("value", "complaint"),
    [
        (msgpack.ExtType(planes.CODE, bytes(23)), "not in planes"),
        (msgpack.ExtType(1, bytes(24)), "not in planes"),
        (msgpack.ExtType(planes.CODE, bytes(16)), "do not fill"),
    ],
)
def test_what_was_not_made_here_is_refused(value: msgpack.ExtType, complaint: str) -> None:
    content = msgpack.unpackb(codec.encode(extrema(3)))
    content["ids"] = [[3], value]
    with pytest.raises(MessageError, match=f"ids.*{complaint}"):
        codec.decode(Extrema, msgpack.packb(content))


@pytest.mark.parametrize(
    "data", [bytes(2000), msgpack.packb(list(range(2000))), msgpack.packb({"ids": 2000 * "x"})]
)
def test_what_is_no_message_is_recorded_as_it_is(data: bytes) -> None:
    assert planes.in_planes(Extrema, data) == data

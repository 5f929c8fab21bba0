"""A recorder that is started again: what it tells its senders is on the disk, and nothing else is
touched."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pliant.errors import RecordingError
from pliant.messages import codec, topics
from pliant.messages.types import SourceImage, StreamEnd
from pliant.recording.parts import RollingWriter, parts_of
from pliant.recording.reader import Recording
from pliant.recording.recover import mend
from pliant.recording.summary import summarise

KEY = topics.SOURCE.key
SIZE = 200_000


def image(frame: int) -> bytes:
    pixels = np.random.default_rng(frame).integers(0, 256, SIZE, np.uint8).tobytes()
    return codec.encode(
        SourceImage(
            frame=frame, stamp_ns=frame, frame_id="camera",
            encoding="mono8", width=SIZE, height=1, data=pixels,
        )
    )  # fmt: skip


def end_of(key: str, count: int) -> StreamEnd:
    return StreamEnd(frame=count, stamp_ns=0, frame_id="", topic=key, messages=count, complete=True)


def record(path: Path, frames: range, *, per_chunk: int = 2, end: bool = False) -> Path:
    """A part behind those that are there, of these frames, and its path."""
    with RollingWriter(path, {"config": {"yaml": "seed: 0"}}, append=True) as writer:
        for n in frames:
            data = image(n)
            writer.write(topics.SOURCE, data, sequence=n, log_time_ns=n, publish_time_ns=n)
            if n % per_chunk == per_chunk - 1:
                writer.sync()
        if end:
            data = codec.encode(end_of(KEY, frames.stop))
            at = frames.stop
            writer.write(topics.STREAM_END, data, sequence=at, log_time_ns=at, publish_time_ns=0)
    return parts_of(path)[-1]


def on_disk(path: Path) -> list[int]:
    return [message.sequence for message in Recording(path).messages(topics.SOURCE)]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "recording.mcap"


def test_a_part_that_was_moved_away_costs_no_other(path: Path, tmp_path: Path) -> None:
    parts = [record(path, range(4 * n, 4 * n + 4)) for n in range(3)]
    parts[1].rename(tmp_path / "elsewhere.mcap")
    newest = parts[2].read_bytes()
    assert mend(path) == ({KEY: 12}, set())
    assert record(path, range(12, 14)).name == "part_00003.mcap"
    assert parts[2].read_bytes() == newest
    assert on_disk(path) == [0, 1, 2, 3, *range(8, 14)]


def test_no_part_is_written_over(path: Path) -> None:
    part = record(path, range(2))
    content = part.read_bytes()
    with pytest.raises(RecordingError, match=r"part_00000\.mcap exists"):
        RollingWriter(path, {}, roll_ns=1)
    assert part.read_bytes() == content


@pytest.mark.parametrize(("hole", "kept"), [(3, 2), (5, 5), (6, 5)])
def test_messages_count_up_to_the_first_gap(path: Path, hole: int, kept: int) -> None:
    """A power cut leaves blocks of zeros: in a chunk that was written whole, or in the last."""
    record(path, range(2))
    part = record(path, range(2, 8), per_chunk=5)  # chunks of 2 to 4 and of 5 to 7
    content = bytearray(part.read_bytes())
    at = content.index(image(hole)) + 40
    content[at : at + SIZE - 80] = bytes(SIZE - 80)
    part.write_bytes(content[: content.index(image(7)) + SIZE])
    assert mend(path) == ({KEY: kept}, set())
    assert on_disk(path) == list(range(kept))
    assert summarise(path).has_index


def test_a_chunk_that_never_reached_the_disk_is_requested_again(path: Path) -> None:
    """Although the next one did, as did the index."""
    part = record(path, range(6))
    content = bytearray(part.read_bytes())
    at = content.index(image(2))
    content[at : at + SIZE] = bytes(SIZE)
    part.write_bytes(content)
    assert mend(path) == ({KEY: 2}, set())
    assert on_disk(path) == [0, 1]
    record(path, range(2, 8), end=True)
    assert mend(path) == ({KEY: 9}, {KEY})
    assert summarise(path).complete


def test_an_end_counts_though_its_chunk_lies_before_that_of_the_last_messages(path: Path) -> None:
    """Chunks hold messages of one compression: what came last of all may lie in an earlier one."""
    with RollingWriter(path, {}, append=True) as writer:
        data = codec.encode(end_of(KEY, 2))
        writer.write(topics.STREAM_END, data, sequence=2, log_time_ns=2, publish_time_ns=0)
        writer.sync()
        for n in range(2):
            writer.write(topics.SOURCE, image(n), sequence=n, log_time_ns=n, publish_time_ns=n)
        writer.sync()
    part = parts_of(path)[0]
    part.write_bytes(part.read_bytes()[:-8])  # a kill before it was closed
    assert mend(path) == ({KEY: 3}, {KEY})
    assert on_disk(path) == [0, 1]


def test_a_zeroed_end_is_none(path: Path) -> None:
    end, noise = codec.encode(end_of(topics.STREAM.key, 0)), image(0)
    with RollingWriter(path, {}, append=True) as writer:
        for n, (topic, data) in enumerate([(topics.STREAM_END, end), (topics.EXTREMA, noise)]):
            writer.write(topic, data, sequence=n, log_time_ns=n, publish_time_ns=n)
    part = parts_of(path)[0]
    content = part.read_bytes()  # one chunk, and noise is packed as it is
    cut = content[: content.index(noise[-1000:])]
    for left in (cut, cut.replace(end, bytes(len(end)))):  # no checksum vouches for it
        part.write_bytes(left)
        assert mend(path) == ({}, set())


@pytest.mark.parametrize("content", [b"", bytes(5000)])
def test_a_part_of_which_nothing_reached_the_disk_is_set_aside(path: Path, content: bytes) -> None:
    record(path, range(2))
    part = record(path, range(2, 4))
    part.write_bytes(content)
    assert mend(path) == ({KEY: 2}, set())
    assert on_disk(path) == [0, 1]
    assert part.with_name(f"{part.name}.unreadable").read_bytes() == content
    assert record(path, range(2, 4)) == part


@pytest.mark.parametrize("content", [b"", bytes(5000)])
def test_an_earlier_part_of_which_nothing_is_left_is_set_aside(path: Path, content: bytes) -> None:
    """The recorder goes on: what its senders still have is behind the last part."""
    part = record(path, range(2))
    part.write_bytes(content)
    record(path, range(2, 4))
    assert mend(path) == ({KEY: 4}, set())
    assert part.with_name(f"{part.name}.unreadable").read_bytes() == content
    assert on_disk(path) == [2, 3]
    assert record(path, range(4, 6)).name == "part_00002.mcap"
    assert mend(path) == ({KEY: 6}, set())


def test_what_earlier_recorders_closed_is_not_read_again(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    old = record(path, range(40), end=True)
    record(path, range(40, 42))
    read = dict.fromkeys(map(str, parts_of(path)), 0)
    opened = Path.open

    class Counting:
        def __init__(self, file: Any, name: str) -> None:
            self._file, self._name = file, name

        def read(self, size: int = -1) -> bytes:
            data: bytes = self._file.read(size)
            read[self._name] += len(data)
            return data

        def __enter__(self) -> "Counting":
            return self

        def __exit__(self, *_: object) -> None:
            self._file.close()

        def __iter__(self) -> Iterator[bytes]:
            raise NotImplementedError

        def __getattr__(self, name: str) -> Any:
            return getattr(self._file, name)

    monkeypatch.setattr(Path, "open", lambda p, *a, **k: Counting(opened(p, *a, **k), str(p)))
    assert mend(path) == ({KEY: 42}, {KEY})
    assert 0 < read[str(old)] < old.stat().st_size / 5

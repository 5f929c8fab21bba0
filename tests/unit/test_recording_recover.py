"""Recovery of what was cut off or damaged: all that is intact, and never more than an error line.

``PLIANT_CORRUPTIONS=10000`` corrupts more files than the few hundred of an ordinary run.
"""

import os
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from pliant.algorithms.tracks import FrameTracks
from pliant.errors import RecordingError
from pliant.files import create
from pliant.messages import codec, topics
from pliant.messages.types import Extrema, Header, SourceImage, StreamEnd
from pliant.recording.reader import Recorded, Recording
from pliant.recording.recover import recover
from pliant.recording.summary import summarise
from pliant.recording.writer import CHUNK_BYTES, RecordingWriter

CORRUPTIONS = int(os.environ.get("PLIANT_CORRUPTIONS", "300"))
FRAMES, IN_CHUNK = 40, 4


def image(frame: int) -> bytes:
    pixels = np.random.default_rng(frame).integers(0, 256, 200, np.uint8).tobytes()
    message = SourceImage(
        frame=frame, stamp_ns=frame, frame_id="camera",
        encoding="mono8", width=20, height=10, data=pixels,
    )  # fmt: skip
    return codec.encode(message)


IMAGES = [image(n) for n in range(FRAMES)]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("recording") / "a.mcap"
    with RecordingWriter(path, {"config": {"yaml": "seed: 0"}}) as recording:
        for n, data in enumerate(IMAGES):
            recording.write(topics.SOURCE, data, sequence=n, log_time_ns=n, publish_time_ns=n)
            if n % IN_CHUNK == IN_CHUNK - 1:
                recording.sync()
        end = StreamEnd(
            frame=FRAMES, stamp_ns=0, frame_id="",
            topic=topics.SOURCE.key, messages=FRAMES, complete=True,
        )  # fmt: skip
        recording.write(
            topics.STREAM_END,
            codec.encode(end),
            sequence=FRAMES,
            log_time_ns=FRAMES,
            publish_time_ns=0,
        )
    return path.read_bytes()


def recovered(content: bytes, folder: Path) -> list[Recorded]:
    """The images in the recovered file; its index is that of a clean one."""
    damaged, output = folder / "damaged.mcap", folder / "whole.mcap"
    damaged.write_bytes(content)
    recover(damaged, output)
    summary = summarise(output)
    assert summary.has_index
    assert not summary.damage
    with output.open("rb") as file:
        statistics = make_reader(file, validate_crcs=True).get_summary()
    assert statistics is not None
    found = list(Recording(output).messages(topics.SOURCE))
    for message in found:
        assert message.data == IMAGES[message.sequence], "bytes that nobody wrote"
    assert [m.sequence for m in found] == sorted({m.sequence for m in found})
    return found


def test_a_whole_recording_stays_what_it_is(whole: bytes, tmp_path: Path) -> None:
    assert len(recovered(whole, tmp_path)) == FRAMES
    output = tmp_path / "whole.mcap"
    assert summarise(output).complete
    assert Recording(output).metadata()["config"] == {"yaml": "seed: 0"}
    assert Recording(output).metadata()["recovered"]["from"] == "damaged.mcap"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["damaged.mcap", "whole.mcap"]


def test_every_cut_keeps_all_that_was_written_before_it(whole: bytes, tmp_path: Path) -> None:
    """Also the messages of the chunk that was open: each is found by its last byte."""
    ends = [whole.index(data) + len(data) for data in IMAGES]
    start = ends[-1 - IN_CHUNK] - 10  # from within the last chunk but one
    lengths = {*range(start, len(whole), 4), *ends, *(end - 1 for end in ends)}
    for length in sorted(length for length in lengths if length >= start):
        assert len(recovered(whole[:length], tmp_path)) == sum(end <= length for end in ends)


def test_zeros_after_a_power_cut_are_no_messages(whole: bytes, tmp_path: Path) -> None:
    start = whole.index(IMAGES[-4])
    assert len(recovered(whole[:start] + bytes(len(whole) - start), tmp_path)) <= FRAMES - 4
    cut = whole.index(IMAGES[-2])
    zeroed = whole[:start] + bytes(cut - start)  # the open chunk's last block never reached it
    assert len(recovered(zeroed, tmp_path)) == FRAMES - 4


@pytest.mark.parametrize("kind", ["bit", "bytes", "hole", "shift", "lengths"])
def test_random_corruption(whole: bytes, tmp_path: Path, kind: str) -> None:
    """What lies in chunks that were not touched is read; what was touched is never invented."""
    random = np.random.default_rng(sum(kind.encode()))
    for _ in range(CORRUPTIONS // 5):
        content = bytearray(whole)
        at = int(random.integers(8, len(content) - 64))
        size = 1
        if kind == "bit":
            content[at] ^= 1 << int(random.integers(8))
        elif kind == "bytes":
            size = int(random.integers(1, 64))
            content[at : at + size] = random.integers(0, 256, size, np.uint8).tobytes()
        elif kind == "hole":
            size = int(random.integers(1, 600))
            content[at : at + size] = bytes(len(content[at : at + size]))
        elif kind == "shift":
            size = int(random.integers(1, 300))
            del content[at : at + size]
        else:
            size = 8
            length = int(random.integers(2**63)) >> int(random.integers(63))
            content[at : at + 8] = length.to_bytes(8, "little")
        found = {m.sequence for m in recovered(bytes(content), tmp_path)}
        lost = set(range(FRAMES)) - found
        if kind != "shift":
            touched = 1 + size // (IN_CHUNK * len(IMAGES[0])) + 1
            first_chunk = at < whole.index(IMAGES[IN_CHUNK])
            index = at + size > whole.rindex(IMAGES[-1])
            # With both its first chunk and its index gone, nothing says what a channel is.
            assert len(lost) <= touched * IN_CHUNK or (first_chunk and index)
        # Readers and the summary live with the damaged file itself, too.
        summarise(tmp_path / "damaged.mcap")
        list(Recording(tmp_path / "damaged.mcap").messages())


@pytest.mark.parametrize("size", [0, 1, 7, 8, 9, 16, 33, 100_000])
def test_noise_is_one_line(tmp_path: Path, size: int) -> None:
    path = tmp_path / "noise.mcap"
    path.write_bytes(np.random.default_rng(size).integers(0, 256, size, np.uint8).tobytes())
    with pytest.raises(RecordingError, match="not an MCAP"):
        recover(path, tmp_path / "whole.mcap")
    assert [p.name for p in tmp_path.iterdir()] == ["noise.mcap"]


def test_memory_holds_a_message_and_never_what_a_length_claims(
    whole: bytes, tmp_path: Path
) -> None:
    path = tmp_path / "damaged.mcap"
    data = bytes(3 * CHUNK_BYTES)
    path.write_bytes(whole[: len(whole) // 2] + data + whole[len(whole) // 2 :])
    tracemalloc.start()
    try:
        recover(path, tmp_path / "whole.mcap")
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 2 * CHUNK_BYTES


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
def test_a_full_disk_is_one_line_and_leaves_nothing(
    whole: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(whole)
    monkeypatch.setattr("pliant.recording.writer.create", lambda _: create(Path("/dev/full")))
    with pytest.raises(RecordingError, match="disk is full"):
        recover(path, tmp_path / "b.mcap")
    assert [p.name for p in tmp_path.iterdir()] == ["a.mcap"]


def test_random_corruption_of_compressed_chunks(tmp_path: Path) -> None:
    """Nothing is invented, and a chunk that was not touched is kept."""
    path, count = tmp_path / "a.mcap", 24
    sent: list[bytes] = []
    with RecordingWriter(path, {}) as recording:
        for n in range(count):
            header = Header(frame=n, stamp_ns=n, frame_id="camera")
            sent.append(codec.encode(Extrema.of(header, FrameTracks.empty())))
            recording.write(topics.EXTREMA, sent[-1], sequence=n, log_time_ns=n, publish_time_ns=n)
            if n % IN_CHUNK == IN_CHUNK - 1:
                recording.sync()
    content = path.read_bytes()
    random = np.random.default_rng(5)
    for trial in range(CORRUPTIONS // 5):
        damaged = bytearray(content)
        at = int(random.integers(8, len(content) - 64))
        size = int(random.integers(1, 40))
        damaged[at : at + size] = random.integers(0, 256, size, np.uint8).tobytes()
        cut = len(content) if trial % 3 else int(random.integers(at, len(content)))
        path.write_bytes(damaged[:cut])
        try:
            recover(path, tmp_path / "whole.mcap")
        except RecordingError:
            continue
        found = list(Recording(tmp_path / "whole.mcap").messages())
        for message in found:
            assert message.data == sent[message.sequence]
        if cut == len(content):
            assert len(found) >= count - 2 * IN_CHUNK

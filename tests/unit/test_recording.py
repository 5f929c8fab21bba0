"""What is written is read back; what was cut off is read up to the cut."""

import os
from pathlib import Path

import pytest

from pliant.algorithms.tracks import FrameTracks
from pliant.errors import RecordingError
from pliant.messages import codec, topics
from pliant.messages.types import Depth, Extrema, Header, SourceImage
from pliant.recording.reader import Recording
from pliant.recording.writer import RecordingWriter


def extrema(frame: int) -> Extrema:
    header = Header(frame=frame, stamp_ns=10 * frame, frame_id="camera")
    return Extrema.of(header, FrameTracks.empty())


def write(path: Path, count: int, *, sync_every: int = 10**9) -> None:
    with RecordingWriter(
        path, {"pliant": {"version": "1"}, "config": {"yaml": "a: 1"}}
    ) as recording:
        for frame in range(count):
            data = codec.encode(extrema(frame))
            recording.write(
                topics.EXTREMA, data, sequence=frame, log_time_ns=7 + frame, publish_time_ns=frame
            )
            if (frame + 1) % sync_every == 0:
                recording.sync()


def test_round_trip(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    write(path, 100)
    recording = Recording(path)
    found = list(recording.messages())
    assert [r.sequence for r in found] == list(range(100))
    assert [r.log_time_ns for r in found] == [7 + n for n in range(100)]
    assert [codec.encode(r.decode()) for r in found] == [
        codec.encode(extrema(n)) for n in range(100)
    ]
    assert recording.metadata()["config"] == {"yaml": "a: 1"}
    assert not list(recording.messages(topics.IMAGE))


def test_metadata_of_a_command_line_that_is_not_utf_8(tmp_path: Path) -> None:
    named = {"pliant": {"command": os.fsdecode(b"pliant run caf\xe9.mp4")}}
    RecordingWriter(tmp_path / "a.mcap", named).close()
    kept = Recording(tmp_path / "a.mcap").metadata()["pliant"]["command"]
    assert kept == "pliant run caf\ufffd.mp4"


def test_every_cut_leaves_the_complete_chunks(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    write(path, 40, sync_every=10)
    whole = path.read_bytes()
    cut_path = tmp_path / "cut.mcap"
    seen = set()
    for length in range(len(whole) - 1, 200, -37):
        cut_path.write_bytes(whole[:length])
        try:
            found = [r.sequence for r in Recording(cut_path).messages()]
        except RecordingError:
            continue  # so short that not even the metadata is whole
        assert found == list(range(len(found)))
        assert len(found) % 10 == 0
        seen.add(len(found))
    assert seen == {0, 10, 20, 30, 40}


def test_a_file_that_is_no_recording_is_one_line(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(b"not a recording at all" * 100)
    with pytest.raises(RecordingError, match="not an MCAP"):
        list(Recording(path).messages())
    with pytest.raises(RecordingError, match="no such recording"):
        Recording(tmp_path / "none.mcap")


def test_a_newer_schema_is_refused_with_a_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.mcap"
    with monkeypatch.context() as patch:
        patch.setattr(codec, "SCHEMA_VERSION", codec.SCHEMA_VERSION + 1)
        write(path, 1)
    with pytest.raises(RecordingError, match="newer pliant"):
        list(Recording(path).messages())


def test_a_folder_that_cannot_be_written_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="cannot write"):
        RecordingWriter(tmp_path / "none" / "a.mcap", {})


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
def test_a_full_disk_is_one_line() -> None:
    with pytest.raises(RecordingError, match="disk is full"):
        write(Path("/dev/full"), 20000, sync_every=1)


@pytest.mark.parametrize("length", [2**62, 2**64 - 1])
def test_a_record_that_claims_an_impossible_length_ends_the_reading(
    tmp_path: Path, length: int
) -> None:
    path = tmp_path / "a.mcap"
    write(path, 10)
    whole = path.read_bytes()
    header_ends = 8 + 9 + int.from_bytes(whole[9:17], "little")  # magic, opcode and length
    claim = b"\x06" + length.to_bytes(8, "little")  # a chunk
    path.write_bytes(whole[:header_ends] + claim + whole[header_ends:])
    assert list(Recording(path).messages()) == []


def test_the_final_map_comes_after_the_updates_that_it_corrects(tmp_path: Path) -> None:
    """A recorder that was started again gets what waited for it topic by topic."""
    path = tmp_path / "a.mcap"
    with RecordingWriter(path, {"pliant": {"version": "1"}}) as recording:
        for count, topic in enumerate(
            (topics.MAP_UPDATE, topics.MAP_FINAL, topics.MAP_UPDATE, topics.EXTREMA)
        ):
            recording.write(topic, b"x", sequence=count, log_time_ns=count, publish_time_ns=count)
    assert [r.sequence for r in Recording(path).messages()] == [0, 2, 3, 1]
    assert [r.sequence for r in Recording(path).messages(topics.MAP_FINAL)] == [1]


def test_unrequested_files_are_not_read(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    image = SourceImage(
        frame=0, stamp_ns=0, frame_id="", encoding="mono8", width=80, height=10, data=b"X" * 800
    )
    with RecordingWriter(path, {}) as recording:
        for topic, message in ((topics.SOURCE, image), (topics.EXTREMA, extrema(0))):
            data = codec.encode(message)
            recording.write(topic, data, sequence=0, log_time_ns=1, publish_time_ns=1)
    path.write_bytes(path.read_bytes().replace(b"XXXX", b"XYYX", 1))
    assert not list(Recording(path).messages())  # up to the first damage
    assert [m.sequence for m in Recording(path).messages(topics.EXTREMA)] == [0]
    assert not list(Recording(path).messages(topics.SOURCE))


def test_a_chunk_of_more_messages_than_the_system_writes_at_once(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with RecordingWriter(path, {}) as recording:
        for frame in range(2000):
            data = codec.encode(Depth(frame=frame, stamp_ns=0, frame_id="", data=b""))
            recording.write(
                topics.DEPTH, data, sequence=frame, log_time_ns=frame, publish_time_ns=0
            )
    found = [message.decode().frame for message in Recording(path).messages()]
    assert found == list(range(2000))

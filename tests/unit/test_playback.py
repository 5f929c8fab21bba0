"""A recording in order of time, from any moment, in parts or not."""

from pathlib import Path

import pytest

from pliant.algorithms.tracks import FrameTracks
from pliant.errors import RecordingError
from pliant.messages import codec, topics
from pliant.messages.topics import Topic
from pliant.messages.types import Extrema, Header, SourceImage, StreamEnd
from pliant.recording.chunk_index import Index
from pliant.recording.parts import RollingWriter
from pliant.recording.playback import Playback

FRAMES = 60
PERIOD_NS = 100_000_000


def write(path: Path, *, roll_bytes: int = 0) -> None:
    """Images of 10 Hz, and what was made of each, half a second later."""
    events: list[tuple[int, Topic, Header]] = []
    for frame in range(FRAMES):
        stamp = 1000 + frame * PERIOD_NS
        header = Header(frame=frame, stamp_ns=stamp, frame_id="camera")
        image = SourceImage(
            frame=frame, stamp_ns=stamp, frame_id="camera",
            encoding="mono8", width=9, height=9, data=bytes(100_000),
        )  # fmt: skip
        events.append((frame * PERIOD_NS, topics.SOURCE, image))
        late = frame * PERIOD_NS + 5 * PERIOD_NS
        events.append((late, topics.EXTREMA, Extrema.of(header, FrameTracks.empty())))
    events.sort(key=lambda event: event[0])
    sequences: dict[Topic, int] = {}
    with RollingWriter(path, {}, roll_bytes=roll_bytes) as writer:
        for at, topic, message in events:
            sequence = sequences[topic] = sequences.get(topic, -1) + 1
            writer.write(
                topic,
                codec.encode(message),
                sequence=sequence,
                log_time_ns=at,
                publish_time_ns=message.stamp_ns,
            )
        for topic, sequence in sequences.items():
            end = StreamEnd(
                frame=sequence + 1, stamp_ns=0, frame_id="",
                topic=topic.key, messages=sequence + 1, complete=True,
            )  # fmt: skip
            writer.write(
                topics.STREAM_END,
                codec.encode(end),
                sequence=sequence + 1,
                log_time_ns=10**12,
                publish_time_ns=0,
            )


@pytest.fixture(params=[0, 1 << 20], ids=["one file", "parts"])
def path(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    path = tmp_path / "recording.mcap"
    write(path, roll_bytes=request.param)
    return path


def test_everything_comes_in_the_order_in_which_it_was_recorded(path: Path) -> None:
    messages = list(Index(path).messages([topics.SOURCE, topics.EXTREMA]))
    assert len(messages) == 2 * FRAMES
    times = [message.log_time_ns for message in messages]
    assert times == sorted(times)
    for topic in (topics.SOURCE, topics.EXTREMA):
        found = [m.sequence for m in messages if m.topic == topic]
        assert found == list(range(FRAMES))


@pytest.mark.parametrize("frame", [0, 1, 17, 42, FRAMES - 1])
def test_every_topic_begins_with_the_same_frame(path: Path, frame: int) -> None:
    playback = Playback(path)
    messages = list(playback.messages(playback.topics, start_s=frame * PERIOD_NS * 1e-9))
    for topic in (topics.SOURCE, topics.EXTREMA):
        frames = [m.decode().frame for m in messages if m.topic == topic]
        assert frames == list(range(frame, FRAMES))
    assert sum(m.topic == topics.STREAM_END for m in messages) == 2


def test_between_two_moments_and_of_one_topic(path: Path) -> None:
    playback = Playback(path)
    messages = list(playback.messages([topics.EXTREMA], start_s=1.95, end_s=3.0))
    assert [m.decode().frame for m in messages] == list(range(20, 31))


def test_beyond_the_end_is_one_line(path: Path) -> None:
    playback = Playback(path)
    with pytest.raises(RecordingError, match="ends before 6"):
        list(playback.messages(playback.topics, start_s=6.0))


def test_without_its_index_a_recording_is_to_be_recovered(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    write(path)
    whole = path.read_bytes()
    path.write_bytes(whole[:-50])
    with pytest.raises(RecordingError, match="pliant recover"):
        Playback(path)
    damaged = bytearray(whole)
    damaged[-200] ^= 1  # in the index itself
    path.write_bytes(damaged)
    with pytest.raises(RecordingError, match="pliant recover"):
        Playback(path)


def test_damage_under_a_whole_index_is_one_line(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    write(path)
    content = bytearray(path.read_bytes())
    for at in range(1000, len(content) - 100_000, 50_000):
        content[at] ^= 1
    path.write_bytes(content)
    with pytest.raises(RecordingError, match="pliant recover"):
        list(Playback(path).messages([topics.SOURCE]))


def test_seeking_reads_a_few_chunks_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from pliant.recording import chunk_index as module

    path = tmp_path / "a.mcap"
    write(path)
    read: list[int] = []
    scan_chunk = module.scan_chunk

    def counted(file: Path, offset: int, *rest: object) -> object:
        read.append(offset)
        return scan_chunk(file, offset, *rest)  # type: ignore[arg-type]

    playback = Playback(path)
    monkeypatch.setattr(module, "scan_chunk", counted)
    first = next(playback.messages([topics.SOURCE], start_s=4.0))
    assert first.decode().frame == 40
    assert len(read) <= 8  # by halves; what lies well before is never looked at
    assert min(read) > path.stat().st_size // 3

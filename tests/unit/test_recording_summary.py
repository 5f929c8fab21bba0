"""What ``pliant info`` says of whole, interrupted, cut-off and damaged recordings."""

from pathlib import Path

from mcap.reader import make_reader

from pliant.algorithms.tracks import FrameTracks
from pliant.messages import codec, topics
from pliant.messages.types import Extrema, Header, StreamEnd
from pliant.recording.summary import describe, state, summarise
from pliant.recording.writer import RecordingWriter


def write(
    path: Path, frames: list[int], *, end: int | None, complete: bool = True, every: int = 10
) -> None:
    metadata = {"pliant": {"version": "1.2", "command": "pliant run x"}, "config": {"yaml": "a: 1"}}
    with RecordingWriter(path, metadata) as recording:
        for n in frames:
            header = Header(frame=n, stamp_ns=10 * n, frame_id="camera")
            data = codec.encode(Extrema.of(header, FrameTracks.empty()))
            recording.write(
                topics.EXTREMA, data, sequence=n, log_time_ns=n * 10**8, publish_time_ns=10 * n
            )
            if n % every == every - 1:
                recording.sync()
        if end is not None:
            closing = StreamEnd(
                frame=end, stamp_ns=0, frame_id="", topic=topics.EXTREMA.key,
                messages=end, complete=complete,
            )  # fmt: skip
            recording.write(
                topics.STREAM_END,
                codec.encode(closing),
                sequence=end,
                log_time_ns=1,
                publish_time_ns=0,
            )


def test_a_whole_recording(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    write(path, list(range(21)), end=21)
    summary = summarise(path)
    topic = summary.topics[topics.EXTREMA.key]
    assert (topic.messages, topic.missing, topic.gaps) == (21, 0, [])
    assert abs(topic.rate_hz - 10.0) < 1e-9
    assert summary.duration_s == 2.0
    assert summary.complete
    assert not summary.damage
    lines = list(describe(summary))
    assert "closed, nothing missing" in lines[0]
    assert any("pliant 1.2" in line for line in lines)


def test_gaps_and_the_count_of_the_end_are_compared(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    write(path, [0, 1, 4, 5, 7, 8], end=11)
    topic = summarise(path).topics[topics.EXTREMA.key]
    assert topic.gaps == [(2, 3), (6, 6)]
    assert topic.missing == 3 + 2
    text = "\n".join(describe(summarise(path)))
    assert "5 (2-3, 6)" in text
    assert "5 messages missing" in text


def test_one_of_a_thing_is_said_in_the_singular(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    write(path, [0], end=2)
    text = "\n".join(describe(summarise(path)))
    assert " 1 message, " in text
    assert "1 message missing" in text
    write(path, [*range(0, 14, 2)], end=13)
    assert "1 more gap)" in "\n".join(describe(summarise(path)))
    write(path, [0], end=None)
    assert "1 topic" in "\n".join(describe(summarise(path)))


def test_an_interrupted_run_is_closed_and_not_complete(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    write(path, list(range(5)), end=5, complete=False)
    summary = summarise(path)
    assert summary.closed
    assert not summary.complete
    assert state(summary) == "closed after an interruption, no gaps"


def test_a_cut_recording_is_reported_as_cut(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    write(path, list(range(40)), end=40)
    path.write_bytes(path.read_bytes()[:-40])
    summary = summarise(path)
    assert not summary.closed
    assert "not closed" in state(summary)
    assert summary.topics[topics.EXTREMA.key].messages == 40
    assert summary.damage


def test_damage_in_the_middle_costs_one_chunk(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    write(path, list(range(40)), end=40)
    content = bytearray(path.read_bytes())
    with path.open("rb") as file:
        index = make_reader(file).get_summary()
    assert index is not None
    chunk = index.chunk_indexes[1]
    content[chunk.chunk_start_offset + chunk.chunk_length // 2] ^= 0x40
    path.write_bytes(content)
    summary = summarise(path)
    assert summary.topics[topics.EXTREMA.key].missing == 10
    assert summary.has_index
    assert len(summary.damage) == 1
    assert "damaged" in state(summary)

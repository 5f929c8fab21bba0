"""The index at the end of a recording: it finds any moment without reading earlier data."""

import heapq
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel

from pliant.errors import RecordingError
from pliant.messages.topics import Topic, by_key
from pliant.recording.layout import CHUNK_INDEX, CHUNK_PLACE, FOOTER, MAGIC, RECORD
from pliant.recording.parts import parts_of
from pliant.recording.reader import Recorded, check_version
from pliant.recording.scan import Damage, StoredMessage, scan_chunk


@dataclass(frozen=True)
class IndexedChunk:
    """One chunk.  topics: of its messages.  start_ns, end_ns: their log times."""

    number: int
    file: Path
    offset: int
    start_ns: int
    end_ns: int
    topics: frozenset[Topic]


class Index:
    """The chunks of a recording in order, and its topics."""

    def __init__(self, path: Path) -> None:
        """Raises RecordingError if there is no recording, or a part of it was not closed."""
        files = parts_of(path)
        if not files:
            raise RecordingError(f"{path}: no such recording")
        self.chunks: list[IndexedChunk] = []
        self._channels: dict[Path, dict[int, Channel]] = {}
        for file in files:
            try:
                with file.open("rb") as stream:
                    self._read(file, stream)
            except OSError as error:
                raise RecordingError(f"{file}: cannot be read: {error.strerror}") from None

    @property
    def topics(self) -> frozenset[Topic]:
        """Topics that have messages."""
        return frozenset[Topic]().union(*(chunk.topics for chunk in self.chunks))

    def with_topic(self, topic: Topic) -> list[IndexedChunk]:
        """The chunks that hold messages of a topic, in order."""
        return [chunk for chunk in self.chunks if topic in chunk.topics]

    def messages(
        self, topics: Sequence[Topic], *, from_ns: int = 0, chunks: Sequence[IndexedChunk] = ()
    ) -> Iterator[Recorded]:
        """Messages logged at ``from_ns`` or later, in order of log time over all topics.

        ``chunks``: only of these.  Memory holds the chunks that overlap in time.  Raises
        RecordingError at damage.
        """
        wanted = frozenset(topics)
        chosen = [
            chunk
            for chunk in (chunks or self.chunks)
            if chunk.end_ns >= from_ns and chunk.topics & wanted
        ]
        # Of equal times the earlier chunk first: the order within a topic is that of the file.
        heap: list[tuple[int, int, Recorded, Iterator[Recorded]]] = []

        def advance(number: int, following: Iterator[Recorded]) -> None:
            message = next(following, None)
            if message is not None:
                heapq.heappush(heap, (message.log_time_ns, number, message, following))

        for chunk in sorted(chosen, key=lambda chunk: (chunk.start_ns, chunk.number)):
            while heap and heap[0][0] < chunk.start_ns:
                _, number, message, following = heapq.heappop(heap)
                yield message
                advance(number, following)
            advance(chunk.number, self._messages_of(chunk, wanted, from_ns))
        while heap:
            _, number, message, following = heapq.heappop(heap)
            yield message
            advance(number, following)

    def _messages_of(
        self, chunk: IndexedChunk, wanted: frozenset[Topic], from_ns: int
    ) -> Iterator[Recorded]:
        known: dict[str, Topic] = {}

        def size_limit(name: str) -> int:
            topic = by_key(name.removeprefix("/"))
            if topic is None or topic not in wanted:
                return 0
            known[name] = topic
            return topic.max_bytes

        for item in scan_chunk(chunk.file, chunk.offset, self._channels[chunk.file], size_limit):
            if isinstance(item, Damage):
                raise RecordingError(
                    f"{chunk.file}: damaged at byte {item.offset} ({item.what}): `pliant recover` "
                    "keeps the intact part"
                )
            if isinstance(item, StoredMessage) and item.log_time_ns >= from_ns:
                check_version(item.channel, chunk.file)
                yield Recorded(
                    known[item.channel.topic],
                    item.sequence,
                    item.log_time_ns,
                    item.data,
                    item.publish_time_ns,
                )

    def _read(self, file: Path, stream: BinaryIO) -> None:
        size = stream.seek(0, 2)
        summary = _summary(stream, size)
        if summary is None:
            raise RecordingError(
                f"{file}: not closed, or its index is damaged: repair it with `pliant recover`"
            )
        channels = self._channels[file] = {}
        at = 0
        entries: list[tuple[int, int]] = []
        while at + RECORD.size <= len(summary):
            opcode, length = RECORD.unpack_from(summary, at)
            at += RECORD.size
            if opcode == Opcode.CHANNEL:
                stored = BytesIO(summary[at : at + length])
                channel = Channel.read(ReadDataStream(stored))
                channels[channel.id] = channel
            elif opcode == Opcode.CHUNK_INDEX:
                entries.append((at, length))
            at += length
        topics = {n: by_key(c.topic.removeprefix("/")) for n, c in channels.items()}
        for at, _ in entries:
            start, end, offset, _, places = CHUNK_INDEX.unpack_from(summary, at)
            body = summary[at + CHUNK_INDEX.size : at + CHUNK_INDEX.size + places]
            found = (topics.get(number) for number, _ in CHUNK_PLACE.iter_unpack(body))
            held = frozenset(topic for topic in found if topic is not None)
            self.chunks.append(IndexedChunk(len(self.chunks), file, offset, start, end, held))


def _summary(stream: BinaryIO, size: int) -> bytes | None:
    """The summary section; None if the file has none."""
    tail_size = FOOTER.size + len(MAGIC)
    if size < tail_size:
        return None
    stream.seek(size - tail_size)
    tail = stream.read(tail_size)
    opcode, length, start, _, stated = FOOTER.unpack_from(tail)
    if tail[FOOTER.size :] != MAGIC or opcode != Opcode.FOOTER or length != 20:
        return None
    if not 0 < start <= size - tail_size:
        return None
    stream.seek(start)
    summary = stream.read(size - tail_size - start)
    found = zlib.crc32(tail[: FOOTER.size - 4], zlib.crc32(summary))
    return summary if stated in (0, found) else None

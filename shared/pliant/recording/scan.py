"""Reads an MCAP file record by record, even if it is truncated or damaged.

Everything in the file is checked before use: sizes against the file's own, chunks by their
checksum.  Memory holds a chunk of the usual size, compressed and not, or one message of a larger
one, whatever a length field states.  After damage the scan continues with the next chunk whose
header and checksum are valid.
"""

import re
import struct
import zlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, TypeVar

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Metadata

from pliant.errors import RecordingError
from pliant.recording.layout import (
    BLOCK_BYTES,
    CHUNK_BYTES,
    CHUNK_INDEX,
    CHUNK_PLACE,
    CHUNK_SIZE,
    CHUNK_START,
    COMPRESSIONS,
    FOOTER,
    MAGIC,
    MESSAGE,
    RECORD,
    RECORD_LIMIT,
    Inflated,
    Source,
    Span,
    checksum,
)

_CHUNK_START = re.compile(rb"\x06(?=.{5}\x00{3})", re.DOTALL)  # a length below a tebibyte
_CHUNK_HEAD = CHUNK_START.size + 4 + CHUNK_SIZE.size  # with the longest name of a compression
_EXPANSION = 4096
"""No compression of ours makes more of a byte; a header that claims more lies."""

_R = TypeVar("_R")


class NothingReadableError(RecordingError):
    """A file in which there is no chunk: it is no recording, or nothing of it is left."""


@dataclass(frozen=True)
class StoredMessage:
    """One message; ``checked`` is False in a chunk that is cut off and so has no checksum."""

    channel: Channel
    sequence: int
    log_time_ns: int
    publish_time_ns: int
    data: bytes
    checked: bool


@dataclass(frozen=True)
class Damage:
    """Bytes of the file that cannot be used."""

    offset: int
    size: int
    what: str


@dataclass(frozen=True)
class Closed:
    """The index at the end of the file is whole.  The last item of a clean file."""


Item = StoredMessage | Metadata | Attachment | Damage | Closed


@dataclass(frozen=True)
class _Chunk:
    """A chunk's header.  data, end: where its records are stored.  size: what they inflate to."""

    at: int
    data: int
    end: int
    size: int
    checksum: int
    compression: str


_CUT = Damage(0, 0, "the chunk ends within a message")
_WRONG = "a chunk whose checksum does not match"


def scan(path: Path, size_limit: Callable[[str], int]) -> Iterator[Item]:
    """Everything in the file that is intact, in order.

    ``size_limit`` says for a topic's name how large a message may be; where it says 0, messages are
    passed over unread, and chunks that hold nothing else by an intact index are not even
    looked at.  Raises RecordingError for a file that is none or cannot be read.
    """
    try:
        with path.open("rb") as file:
            yield from _Walk(file, path, size_limit).items()
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror}") from None


def scan_chunk(
    path: Path, offset: int, channels: Mapping[int, Channel], size_limit: Callable[[str], int]
) -> Iterator[Item]:
    """The messages of the chunk at ``offset``; ``channels`` are those that are known already.

    Damage where there is none.  Raises RecordingError for a file that cannot be read.
    """
    try:
        with path.open("rb") as file:
            yield from _Walk(file, path, size_limit, channels).chunk(offset)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror}") from None


class _Walk:
    def __init__(
        self,
        file: BinaryIO,
        path: Path,
        size_limit: Callable[[str], int],
        channels: Mapping[int, Channel] | None = None,
    ) -> None:
        self._file = file
        self._path = path
        self._size = file.seek(0, 2)
        self._size_limit = size_limit
        self._limits: dict[int, int] = {}
        self._channels: dict[int, Channel] = {}
        self._unwanted: dict[int, int] = {}  # where such a chunk stands, and where it ends
        for channel in (channels or {}).values():
            self._know(channel)
        self._summary_start = self._read_summary() if channels is None else -1

    def chunk(self, at: int) -> Iterator[Item]:
        """One chunk alone."""
        chunk = self._chunk_at(at)
        if chunk is None:
            yield Damage(at, 0, "no chunk where the index has one")
        else:
            yield from self._chunk(chunk)

    def items(self) -> Iterator[Item]:
        at = len(MAGIC)
        intact = 0  # nothing before it needs to be searched for chunks again
        if self._read(0, at) != MAGIC:
            at = self._next_chunk(0)
            if at == self._size:
                raise NothingReadableError(f"{self._path}: not an MCAP recording")
            yield Damage(0, at, "the beginning of the file")
        while at < self._size:
            if at in self._unwanted:
                at = intact = self._unwanted[at]
                continue
            record = self._read(at, RECORD.size)
            opcode, length = RECORD.unpack(record) if len(record) == RECORD.size else (0, 0)
            body, end = at + RECORD.size, at + RECORD.size + length
            if opcode == Opcode.CHUNK and (chunk := self._chunk_at(at)):
                yield from self._chunk(chunk)
                at = intact = min(end, self._size)
            elif opcode == Opcode.METADATA and (found := self._parse(Metadata.read, body, length)):
                yield found
                at = end
            elif opcode == Opcode.ATTACHMENT and (held := self._attachment(body, length)):
                yield held
                at = end
            elif end <= self._size and self._harmless(opcode, body, length):
                at = end
            elif opcode == Opcode.DATA_END and length == 4 and end == self._summary_start:
                yield Closed()
                return
            else:
                following = self._next_chunk(intact or len(MAGIC))
                start = min(at, following)
                yield Damage(start, following - start, self._what(following))
                at = following
        yield Damage(self._size, 0, "the end is missing: the recording is truncated")

    def _what(self, following: int) -> str:
        return "the end of the file" if following == self._size else "unreadable bytes"

    def _harmless(self, opcode: int, body: int, length: int) -> bool:
        """Whether this is a record that can be passed over, and not a chunk in disguise."""
        if opcode == Opcode.HEADER:
            return body == len(MAGIC) + RECORD.size and length <= RECORD_LIMIT
        if opcode == Opcode.MESSAGE_INDEX and length >= 6:
            return int.from_bytes(self._read(body + 2, 4), "little") == length - 6
        return opcode == Opcode.ATTACHMENT and length > RECORD_LIMIT  # not ours, and not looked at

    # -- chunks --------------------------------------------------------------------------------

    def _chunk_at(self, at: int) -> _Chunk | None:
        """The header of a chunk, if one stands here: it states its size twice at least."""
        head = self._read(at, RECORD.size + _CHUNK_HEAD)
        if len(head) < RECORD.size + CHUNK_START.size:
            return None
        opcode, length = RECORD.unpack_from(head)
        _, _, size, crc, name_size = CHUNK_START.unpack_from(head, RECORD.size)
        stored_at = RECORD.size + CHUNK_START.size + name_size
        if opcode != Opcode.CHUNK or name_size > 4 or len(head) < stored_at + CHUNK_SIZE.size:
            return None
        name = head[stored_at - name_size : stored_at].decode("latin-1")
        (stored,) = CHUNK_SIZE.unpack_from(head, stored_at)
        data = at + stored_at + CHUNK_SIZE.size
        end = at + RECORD.size + length
        likely = size == stored if name == "" else size <= _EXPANSION * (stored + 64)
        if name not in COMPRESSIONS or data + stored != end or not likely or stored >= 1 << 40:
            return None
        return _Chunk(at, data, end, size, crc, name)

    def _next_chunk(self, start: int) -> int:
        """Offset of the next chunk header at or after ``start``; the file's size if none is."""
        overlap = RECORD.size
        while start < self._size:
            block = self._read(start, BLOCK_BYTES + overlap)
            for match in _CHUNK_START.finditer(block):
                if match.start() < BLOCK_BYTES and self._chunk_at(start + match.start()):
                    return start + match.start()
            start += BLOCK_BYTES
        return self._size

    def _records(self, chunk: _Chunk) -> Source:
        """The messages of a chunk, from its beginning."""
        stored = Span(self._file, chunk.data, min(chunk.end, self._size))
        return Inflated(stored, chunk.size) if chunk.compression else stored

    def _chunk(self, chunk: _Chunk) -> Iterator[Item]:
        whole = chunk.end <= self._size
        if not whole or chunk.size > CHUNK_BYTES + BLOCK_BYTES:
            if whole and (chunk.checksum, chunk.size) != self._checked(self._records(chunk), chunk):
                yield Damage(chunk.at, chunk.end - chunk.at, _WRONG)
                return
            yield from self._messages(self._records(chunk), chunk, whole)
            return
        records = self._records(chunk).read(chunk.size)  # the usual one: read once, whole
        if chunk.size != len(records) or chunk.checksum not in (0, zlib.crc32(records)):
            yield Damage(chunk.at, chunk.end - chunk.at, _WRONG)
            return
        yield from self._messages(BytesIO(records), chunk, whole)

    def _checked(self, records: Source, chunk: _Chunk) -> tuple[int, int]:
        found, size = checksum(records)
        return (found if chunk.checksum else 0), size  # 0: its writer made none

    def _messages(self, records: Source, chunk: _Chunk, whole: bool) -> Iterator[Item]:
        at = 0
        while at < chunk.size:
            head = records.read(RECORD.size)
            if len(head) < RECORD.size:
                break
            opcode, length = RECORD.unpack(head)
            if at + RECORD.size + length > chunk.size:
                break
            place = chunk.at + at if chunk.compression else chunk.data + at
            if opcode == Opcode.CHANNEL:
                body = records.read(length) if length <= RECORD_LIMIT else b""
                channel = _parsed(Channel.read, body)
                if channel is None:
                    break
                self._know(channel)
            elif opcode == Opcode.MESSAGE and length >= MESSAGE.size:
                found = self._message(records, place, length, whole)
                if found is _CUT:
                    break
                if found is not None:
                    yield found
            elif opcode != Opcode.SCHEMA or not _passed(records, length):
                break
            at += RECORD.size + length
        if whole and at < chunk.size:
            yield Damage(chunk.at, chunk.end - chunk.at, "records in a chunk")
        elif not whole:
            start = chunk.at if chunk.compression else chunk.data + at
            yield Damage(start, max(0, self._size - start), "the open chunk is truncated")

    def _message(
        self, records: Source, place: int, length: int, whole: bool
    ) -> StoredMessage | Damage | None:
        head = records.read(MESSAGE.size)
        if len(head) < MESSAGE.size:
            return _CUT
        number, sequence, log_time, publish_time = MESSAGE.unpack(head)
        channel = self._channels.get(number)
        size = length - MESSAGE.size
        limit = self._limits.get(number, 0)
        if channel is not None and 0 < size <= limit:
            data = records.read(size)
            if len(data) < size:
                return _CUT
            return StoredMessage(channel, sequence, log_time, publish_time, data, whole)
        if not _passed(records, size):
            return _CUT
        if channel is None:
            return Damage(place, length, f"a message of channel {number}, whose name is lost")
        if limit == 0:
            return None
        return Damage(place, length, f"{channel.topic}: a message of {size} bytes")

    def _know(self, channel: Channel) -> None:
        self._channels[channel.id] = channel
        self._limits[channel.id] = self._size_limit(channel.topic)

    # -- everything else -----------------------------------------------------------------------

    def _attachment(self, body: int, length: int) -> Attachment | None:
        """An attachment whose checksum holds."""
        if not 4 < length <= min(RECORD_LIMIT, self._size - body):
            return None
        content = self._read(body, length)
        crc = int.from_bytes(content[-4:], "little")
        if crc not in (0, zlib.crc32(memoryview(content)[:-4])):
            return None
        return _parsed(Attachment.read, content)

    def _read_summary(self) -> int:
        """Check the index and take its channels; where it starts, -1 if it is not whole."""
        tail = self._read(self._size - len(MAGIC) - FOOTER.size, FOOTER.size + len(MAGIC))
        if len(tail) < FOOTER.size + len(MAGIC) or tail[FOOTER.size :] != MAGIC:
            return -1
        opcode, length, start, _, stated = FOOTER.unpack_from(tail)
        end = self._size - len(tail)
        if opcode != Opcode.FOOTER or length != 20 or not 0 < start <= end:
            return -1
        crc, _ = checksum(Span(self._file, start, end))
        if stated not in (0, zlib.crc32(tail[: FOOTER.size - 4], crc)):
            return -1
        at = start
        chunks: list[bytes] = []
        while at < end:
            record = self._read(at, RECORD.size)
            if len(record) < RECORD.size:
                return -1
            opcode, length = RECORD.unpack(record)
            if opcode == Opcode.CHANNEL:
                channel = self._parse(Channel.read, at + RECORD.size, length)
                if channel is not None:
                    self._know(channel)
            elif opcode == Opcode.CHUNK_INDEX and length <= RECORD_LIMIT:
                chunks.append(self._read(at + RECORD.size, length))
            at += RECORD.size + length
        if 0 in self._limits.values():
            self._unwanted = dict(filter(None, map(self._passed_chunk, chunks)))
        return start

    def _passed_chunk(self, index: bytes) -> tuple[int, int] | None:
        """Where a chunk begins and ends of whose messages none is wanted, as the index has it."""
        if len(index) < CHUNK_INDEX.size:
            return None
        _, _, start, length, size = CHUNK_INDEX.unpack_from(index)
        places = index[CHUNK_INDEX.size : CHUNK_INDEX.size + size]
        if not size or len(places) < size or size % CHUNK_PLACE.size:  # of a wrong size
            return None
        if any(self._limits.get(n, 1) for n, _ in CHUNK_PLACE.iter_unpack(places)):
            return None
        end = start + length
        return (start, end) if RECORD.size < length and end <= self._size else None

    def _parse(self, read: Callable[[ReadDataStream], _R], body: int, length: int) -> _R | None:
        if length > min(RECORD_LIMIT, self._size - body):
            return None
        return _parsed(read, self._read(body, length))

    def _read(self, at: int, size: int) -> bytes:
        if at < 0:
            return b""
        self._file.seek(at)
        return self._file.read(min(size, max(0, self._size - at)))


def _parsed(read: Callable[[ReadDataStream], _R], content: bytes) -> _R | None:
    try:
        return read(ReadDataStream(BytesIO(content)))
    except (McapError, ValueError, OverflowError, struct.error):
        return None


def _passed(records: Source, size: int) -> bool:
    """Skip that many bytes; False if there are fewer."""
    while size > 0:
        block = records.read(min(size, BLOCK_BYTES))
        if not block:
            return False
        size -= len(block)
    return True

"""The layout of an MCAP file, as its writer, its scanner and its index share it."""

import struct
import zlib
from collections.abc import Iterable, Iterator
from io import BytesIO
from typing import Any, BinaryIO, Protocol

import zstandard

from pliant.messages import zstd

MAGIC = b"\x89MCAP0\r\n"
CHUNK_BYTES = 1 << 20
"""A chunk is closed before it grows beyond this; a larger message has a chunk to itself."""
BLOCK_BYTES = 1 << 18
"""Bytes that are read at a time of records larger than a chunk."""
RECORD_LIMIT = 16 << 20
"""Largest metadata, attachment, channel or schema record that is read, in bytes."""
COMPRESSIONS = ("", "zstd")

RECORD = struct.Struct("<BQ")  # opcode, length
CHUNK_START = struct.Struct("<QQQII")  # start, end, size, checksum, length of the compression
CHUNK_SIZE = struct.Struct("<Q")  # stored size
MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
FOOTER = struct.Struct("<BQQQI")
CHUNK_INDEX = struct.Struct("<QQQQI")  # start, end, offset, length, size of the channels' places
CHUNK_PLACE = struct.Struct("<HQ")  # channel, offset of its message index

_ZSTD_LEVEL = 1  # `scripts/bench compression`: of arrays in planes a twentieth less than -5


class Source(Protocol):
    """Bytes that are read in order."""

    def read(self, size: int, /) -> bytes:
        """At most ``size`` bytes; fewer only at the end."""
        ...


def compress(data: bytes, compression: str) -> bytes:
    """The stored form of a chunk's records."""
    return zstd.compress(data, _ZSTD_LEVEL) if compression else data


class Span:
    """A part of a file, read block by block, whatever its length."""

    def __init__(self, file: BinaryIO, start: int, end: int) -> None:
        self._file = file
        self._at = start
        self._end = end

    def read(self, size: int, /) -> bytes:
        """At most ``size`` bytes; fewer only at the end."""
        self._file.seek(self._at)
        data = self._file.read(max(0, min(size, self._end - self._at)))
        self._at += len(data)
        return data


class Inflated:
    """The intact content of compressed bytes.  Memory: a block, and the requested bytes."""

    def __init__(self, stored: Source, limit: int) -> None:
        """``limit``: nothing is inflated beyond the size that the chunk states."""
        self._blocks = _zstd_blocks(stored)
        self._left = limit
        self._block = BytesIO()

    def read(self, size: int, /) -> bytes:
        """At most ``size`` bytes; fewer only where nothing more can be inflated."""
        wanted = min(size, self._left)
        parts: list[bytes] = []
        while wanted > 0:
            part = self._block.read(wanted)
            if not part:
                following = next(self._blocks, b"")
                if not following:
                    break
                self._block = BytesIO(following)
                continue
            parts.append(part)
            wanted -= len(part)
        data = parts[0] if len(parts) == 1 else b"".join(parts)
        self._left -= len(data)
        return data


def _zstd_blocks(stored: Source) -> Iterator[bytes]:
    readable: Any = _Readable(stored)
    reader = zstandard.ZstdDecompressor(max_window_size=1 << 23).stream_reader(readable)
    try:
        while block := reader.read(BLOCK_BYTES):
            yield block
    except (zstandard.ZstdError, MemoryError, ValueError):
        return


class _Readable:
    """A Source as the file object that zstandard wants."""

    def __init__(self, source: Source) -> None:
        self._source = source

    def read(self, size: int = -1) -> bytes:
        return self._source.read(BLOCK_BYTES if size < 0 else min(size, BLOCK_BYTES))


def checksum(source: Source) -> tuple[int, int]:
    """CRC-32 and number of all bytes that are left of a source."""
    crc = size = 0
    while block := source.read(BLOCK_BYTES):
        crc = zlib.crc32(block, crc)
        size += len(block)
    return crc, size


def record(opcode: int, parts: Iterable[bytes]) -> bytes:
    """A record of these bytes."""
    body = b"".join(parts)
    return RECORD.pack(opcode, len(body)) + body

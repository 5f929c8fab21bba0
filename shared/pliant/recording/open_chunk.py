"""The chunk that a writer fills, and the record that it becomes."""

import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field

from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import ChunkIndex, McapRecord

from pliant.recording import layout

_ENTRY = struct.Struct("<QQ")  # log time, offset in the chunk
_INDEX = struct.Struct("<HI")  # channel, size of the entries


def as_bytes(record: McapRecord) -> bytes:
    """A record of the mcap package, as it is stored."""
    builder = RecordBuilder()
    record.write(builder)
    return builder.end()


@dataclass
class OpenChunk:
    """Messages that wait for their chunk to be full.

    Every chunk names the channels of its messages, so that one alone can be read.
    """

    compression: str
    size: int = 0
    messages: int = 0
    start_ns: int = 0
    end_ns: int = 0
    _parts: list[bytes] = field(default_factory=list[bytes])
    _entries: dict[int, list[bytes]] = field(default_factory=dict[int, list[bytes]])

    def add(
        self,
        channel: int,
        names: Callable[[], bytes],
        sequence: int,
        log_time_ns: int,
        publish_time_ns: int,
        data: bytes,
    ) -> None:
        """Append a message.  ``names`` gives the records that say what its channel is."""
        if channel not in self._entries:
            self._entries[channel] = []
            self._append(names())
        self._entries[channel].append(_ENTRY.pack(log_time_ns, self.size))
        length = layout.MESSAGE.size + len(data)
        head = layout.RECORD.pack(Opcode.MESSAGE, length)
        self._append(head + layout.MESSAGE.pack(channel, sequence, log_time_ns, publish_time_ns))
        self._append(data)
        self.start_ns = min(self.start_ns, log_time_ns) if self.messages else log_time_ns
        self.end_ns = max(self.end_ns, log_time_ns)
        self.messages += 1

    def finish(self, offset: int) -> tuple[list[bytes], ChunkIndex]:
        """What goes to the file at ``offset``, and its entry in the index of the whole."""
        # What is stored as it is needs no copy of itself.
        records = [b"".join(self._parts)] if self.compression else self._parts
        stored = [layout.compress(records[0], self.compression)] if self.compression else records
        stored_size = sum(map(len, stored))
        crc = 0
        for part in records:
            crc = zlib.crc32(part, crc)
        name = self.compression.encode()
        start = layout.CHUNK_START.pack(self.start_ns, self.end_ns, self.size, crc, len(name))
        head = start + name + layout.CHUNK_SIZE.pack(stored_size)
        length = len(head) + stored_size
        written = [layout.RECORD.pack(Opcode.CHUNK, length) + head, *stored]
        after = offset + layout.RECORD.size + length
        places: dict[int, int] = {}
        indices: list[bytes] = []
        size = 0
        for channel, entries in self._entries.items():
            places[channel] = after + size
            head = _INDEX.pack(channel, _ENTRY.size * len(entries))
            index = layout.record(Opcode.MESSAGE_INDEX, [head, *entries])
            indices.append(index)
            size += len(index)
        index = ChunkIndex(
            message_start_time=self.start_ns,
            message_end_time=self.end_ns,
            chunk_start_offset=offset,
            chunk_length=layout.RECORD.size + length,
            message_index_offsets=places,
            message_index_length=size,
            compression=self.compression,
            compressed_size=stored_size,
            uncompressed_size=self.size,
        )
        return [*written, *indices], index

    def _append(self, part: bytes) -> None:
        self._parts.append(part)
        self.size += len(part)

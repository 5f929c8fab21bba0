"""The end of an MCAP file: what lets a reader find everything without reading everything."""

import zlib
from collections.abc import Sequence

from mcap.opcode import Opcode
from mcap.records import (
    AttachmentIndex,
    Channel,
    ChunkIndex,
    DataEnd,
    McapRecord,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from pliant.recording import layout
from pliant.recording.open_chunk import as_bytes


def closing(
    offset: int,
    *,
    schemas: Sequence[Schema],
    channels: Sequence[Channel],
    chunks: Sequence[ChunkIndex],
    attachments: Sequence[AttachmentIndex],
    metadata: Sequence[MetadataIndex],
    messages: dict[int, int],
) -> bytes:
    """Everything that follows the last chunk, from the end of the data, at ``offset``, on."""
    data_end = as_bytes(DataEnd(0))
    start = offset + len(data_end)
    statistics = Statistics(
        attachment_count=len(attachments),
        channel_count=len(channels),
        channel_message_counts=messages,
        chunk_count=len(chunks),
        message_count=sum(messages.values()),
        message_start_time=min((c.message_start_time for c in chunks), default=0),
        message_end_time=max((c.message_end_time for c in chunks), default=0),
        metadata_count=len(metadata),
        schema_count=len(schemas),
    )
    groups: list[tuple[Opcode, Sequence[McapRecord]]] = [
        (Opcode.SCHEMA, schemas),
        (Opcode.CHANNEL, channels),
        (Opcode.STATISTICS, [statistics]),
        (Opcode.CHUNK_INDEX, chunks),
        (Opcode.ATTACHMENT_INDEX, attachments),
        (Opcode.METADATA_INDEX, metadata),
    ]
    body = b""
    offsets = b""
    for opcode, records in groups:
        group = b"".join(map(as_bytes, records))
        if group:
            place = SummaryOffset(
                group_opcode=opcode, group_start=start + len(body), group_length=len(group)
            )
            offsets += as_bytes(place)
        body += group
    footer = layout.FOOTER.pack(Opcode.FOOTER, 20, start, start + len(body), 0)[:-4]
    crc = zlib.crc32(footer, zlib.crc32(body + offsets))
    return data_end + body + offsets + footer + crc.to_bytes(4, "little") + layout.MAGIC

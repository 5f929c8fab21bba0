"""Writes every message of a run to one MCAP file."""

import errno
import os
import time
from collections import deque
from collections.abc import Mapping
from contextlib import suppress
from itertools import islice
from pathlib import Path

from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Header,
    Metadata,
    MetadataIndex,
    Schema,
)

from pliant.errors import RecordingError
from pliant.files import create, sync
from pliant.messages import codec
from pliant.messages.planes import in_planes
from pliant.messages.topics import Topic
from pliant.recording import layout
from pliant.recording.layout import CHUNK_BYTES
from pliant.recording.sections import ChunkIndexes, OpenChunk, as_bytes, closing
from pliant.version import __version__
from pliant.wording import encodable

_AT_ONCE = 1024
"""Parts that the system takes in one call (IOV_MAX)."""


class RecordingWriter:
    """An MCAP file that grows by messages.  What was flushed stays readable whatever happens.

    Topics of one compression share chunks, so a file's order is one within a topic, never across.
    """

    def __init__(
        self, path: Path, metadata: Mapping[str, Mapping[str, str]], *, replace: bool = True
    ) -> None:
        """Create the file.  ``metadata`` is written first: the resolved config, versions, host.

        replace: an earlier file of this name.  Raises RecordingError if the file cannot be
        created.
        """
        self._path = path
        self._size = 0
        self._channels: dict[str, Channel] = {}
        self._schemas: list[Schema] = []
        self._counts: dict[str, int] = {}
        self._open: dict[str, OpenChunk] = {}
        self._chunks = ChunkIndexes()
        self._attachments: list[AttachmentIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._broken = False
        try:
            self._file = create(path) if replace else path.open("xb", buffering=0)
        except FileExistsError:
            raise RecordingError(f"{path} exists already: move it elsewhere") from None
        except OSError as error:
            raise self._failed(error) from None
        try:
            sync(path.parent)  # a file must be findable after a power cut
            header = Header(profile="pliant", library=f"pliant {__version__}")
            self._put(layout.MAGIC, as_bytes(header))
            for name, content in metadata.items():
                content = {key: encodable(value) for key, value in content.items()}
                record = as_bytes(Metadata(name=name, metadata=content))
                index = MetadataIndex(offset=self._size, length=len(record), name=name)
                self._put(record)
                self._metadata.append(index)
        except OSError as error:
            self._file.close()
            raise self._failed(error) from None

    def write(
        self, topic: Topic, data: bytes, *, sequence: int, log_time_ns: int, publish_time_ns: int
    ) -> None:
        """Append one encoded message, its arrays in planes.

        Raises RecordingError when the disk is full.
        """
        data = in_planes(topic.message, data)
        channel = self._channels.get(topic.key)
        if channel is None:
            channel = self._channels[topic.key] = self._register(topic)
        chunk = self._open.get(topic.compression)
        if chunk is not None and chunk.size + len(data) > CHUNK_BYTES:
            self._close_chunk(chunk)
            chunk = None
        if chunk is None:
            chunk = self._open[topic.compression] = OpenChunk(topic.compression)
        chunk.add(
            channel.id,
            lambda: self._names(channel),
            sequence & 0xFFFFFFFF,
            log_time_ns,
            publish_time_ns,
            data,
        )
        self._counts[topic.key] = self._counts.get(topic.key, 0) + 1

    def attach(self, name: str, media_type: str, data: bytes) -> None:
        """Append a file, e.g. the calibration.  Raises RecordingError when the disk is full."""
        now = time.time_ns()
        attachment = Attachment(
            create_time=now, log_time=now, name=name, media_type=media_type, data=data
        )
        record = as_bytes(attachment)
        index = AttachmentIndex(
            offset=self._size,
            length=len(record),
            create_time=now,
            log_time=now,
            data_size=len(data),
            name=name,
            media_type=media_type,
        )
        try:
            self._put(record)
        except OSError as error:
            raise self._failed(error) from None
        self._attachments.append(index)

    def sync(self) -> None:
        """Put everything written so far on the disk."""
        self._close_chunks()
        try:
            os.fsync(self._file.fileno())
        except OSError as error:
            if error.errno not in (errno.EINVAL, errno.EROFS):  # not a file, e.g. a pipe
                raise self._failed(error) from None

    def close(self) -> None:
        """Write the index and close."""
        try:
            if self._broken:  # the error was raised when it broke
                return
            self._close_chunks()
            counts = {self._channels[key].id: count for key, count in self._counts.items()}
            end = closing(
                self._size,
                schemas=self._schemas,
                channels=list(self._channels.values()),
                chunks=self._chunks,
                attachments=self._attachments,
                metadata=self._metadata,
                messages=counts,
            )
            self._put(end)
            os.fsync(self._file.fileno())
        except OSError as error:
            raise self._failed(error) from None
        finally:
            with suppress(OSError):  # a full disk fails once more here; the error was raised before
                self._file.close()

    @property
    def counts(self) -> dict[str, int]:
        """Messages written, by topic key."""
        return dict(self._counts)

    @property
    def size(self) -> int:
        """Bytes in the file and in the chunks that are open."""
        return self._size + sum(chunk.size for chunk in self._open.values())

    def __enter__(self) -> "RecordingWriter":
        return self

    def __exit__(self, error_type: type[BaseException] | None, *_: object) -> None:
        try:
            self.close()
        except RecordingError:
            if error_type is None:  # otherwise the first error is more helpful
                raise

    def _close_chunks(self) -> None:
        for chunk in sorted(self._open.values(), key=lambda chunk: chunk.start_ns):
            self._close_chunk(chunk)
        self._open.clear()

    def _close_chunk(self, chunk: OpenChunk) -> None:
        parts, index = chunk.finish(self._size)
        try:
            self._put(*parts)
        except OSError as error:
            raise self._failed(error) from None
        self._chunks.add(index)

    def _put(self, *parts: bytes) -> None:
        """Write all of it: a raw file may take a part at a time."""
        waiting = deque(memoryview(part) for part in parts if part)
        while waiting:
            written = os.writev(self._file.fileno(), list(islice(waiting, _AT_ONCE)))
            self._size += written
            while waiting and written >= len(waiting[0]):
                written -= len(waiting.popleft())
            if waiting:
                waiting[0] = waiting[0][written:]

    def _register(self, topic: Topic) -> Channel:
        name = f"pliant.{topic.message.__name__}"
        schema = next((s for s in self._schemas if s.name == name), None)
        if schema is None:
            data = codec.schema(topic.message)
            schema = Schema(id=len(self._schemas) + 1, name=name, encoding="pliant", data=data)
            self._schemas.append(schema)
        return Channel(
            id=len(self._channels) + 1,
            topic=f"/{topic.key}",
            message_encoding="msgpack",
            schema_id=schema.id,
            metadata={"schema_version": str(codec.SCHEMA_VERSION)},
        )

    def _names(self, channel: Channel) -> bytes:
        schema = self._schemas[channel.schema_id - 1]
        return as_bytes(schema) + as_bytes(channel)

    def _failed(self, error: OSError) -> RecordingError:
        self._broken = True
        if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
            return RecordingError(
                f"{self._path}: the disk is full; the recording so far stays readable"
            )
        return RecordingError(f"{self._path}: cannot write the recording: {error.strerror}")

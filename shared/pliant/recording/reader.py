"""Reads recordings, complete or truncated."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from mcap.records import Attachment, Channel, Metadata

from pliant.errors import RecordingError
from pliant.messages import codec
from pliant.messages.topics import MAP_FINAL, Topic, by_key
from pliant.messages.types import Header
from pliant.recording.parts import parts_of
from pliant.recording.scan import Closed, Damage, Item, StoredMessage, scan
from pliant.recording.writer import RecordingWriter


@dataclass(frozen=True)
class Recorded:
    """One message of a recording, still encoded."""

    topic: Topic
    sequence: int
    log_time_ns: int
    data: bytes
    publish_time_ns: int = 0
    checked: bool = True
    """False if it comes from a chunk that was cut off, so that no checksum vouches for it."""

    def decode(self) -> Header:
        """The message.  Raises MessageError if its bytes are not what its topic carries."""
        return codec.decode(self.topic.message, self.data, max_bytes=self.topic.max_bytes)

    def write_to(self, writer: RecordingWriter) -> None:
        """Append the message to another recording, with its number and times."""
        writer.write(
            self.topic, self.data, sequence=self.sequence, log_time_ns=self.log_time_ns,
            publish_time_ns=self.publish_time_ns,
        )  # fmt: skip


class Recording:
    """A recording on disk.  Every complete chunk is read, also where the file was cut off."""

    def __init__(self, path: Path) -> None:
        """``path``: a file, or the name or folder of one in parts.

        Raises RecordingError if there is no such file.
        """
        self.files = parts_of(path)
        """The files that it consists of, in order."""
        if not self.files:
            raise RecordingError(f"{path}: no such recording")
        self._path = path

    @property
    def path(self) -> Path:
        """The path that it was opened with."""
        return self._path

    @property
    def size(self) -> int:
        """Bytes on the disk."""
        return sum(file.stat().st_size for file in self.files)

    def messages(self, *topics: Topic) -> Iterator[Recorded]:
        """Messages in file order up to the first damage; of all known topics if none is named.

        Of a closed recording, damage to other topics' chunks is none: they are not read.

        The final map comes last, as it was published: a restarted recorder gets waiting messages
        topic by topic, and may have it before the updates that it corrects.
        """
        final: list[Recorded] = []
        for item in self.everything(*topics):
            if isinstance(item, Damage) or (isinstance(item, Recorded) and not item.checked):
                break  # what came before is all that is certain
            if isinstance(item, Recorded):
                if item.topic == MAP_FINAL:
                    final.append(item)
                else:
                    yield item
        yield from final

    def decoded(self, topic: Topic) -> Iterator[Header]:
        """The decoded messages of one topic, in order."""
        for recorded in self.messages(topic):
            yield recorded.decode()

    def metadata(self) -> dict[str, dict[str, str]]:
        """Metadata records by name: what stands before the first message of the first part."""
        found: dict[str, dict[str, str]] = {}
        for item in scan(self.files[0], lambda _: 1):
            if isinstance(item, Metadata):
                found[item.name] = dict(item.metadata)
            elif isinstance(item, Damage | StoredMessage):
                break
        return found

    def attachments(self) -> dict[str, bytes]:
        """Attached files by name."""
        items = (item for file in self.files for item in scan(file, lambda _: 0))
        return {item.name: item.data for item in items if isinstance(item, Attachment)}

    def everything(self, *topics: Topic) -> Iterator[Recorded | Item]:
        """Messages (as Recorded), metadata, attachments, damage and the close, past damage.

        ``Closed`` comes once, last, and only if every part is closed.
        """
        closed = 0
        for file in self.files:
            for item in self._of_file(file, topics):
                if isinstance(item, Closed):
                    closed += 1
                else:
                    yield item
        if closed == len(self.files):
            yield Closed()

    def _of_file(self, file: Path, topics: Sequence[Topic]) -> Iterator[Recorded | Item]:
        wanted = {topic.key for topic in topics}
        known: dict[str, Topic] = {}

        def size_limit(name: str) -> int:
            topic = by_key(name.removeprefix("/"))
            if topic is None or (wanted and topic.key not in wanted):
                return 0
            known[name] = topic
            return topic.max_bytes

        versions: set[str] = set()
        for item in scan(file, size_limit):
            if not isinstance(item, StoredMessage):
                yield item
                continue
            if item.channel.topic not in versions:
                check_version(item.channel, file)
                versions.add(item.channel.topic)
            yield Recorded(
                known[item.channel.topic],
                item.sequence,
                item.log_time_ns,
                item.data,
                item.publish_time_ns,
                item.checked,
            )


def check_version(channel: Channel, file: Path) -> None:
    """Raise RecordingError for a channel that a newer pliant has written."""
    version = channel.metadata.get("schema_version", "0")
    if not version.isdigit() or int(version) > codec.SCHEMA_VERSION:
        raise RecordingError(
            f"{file}: {channel.topic} has schema version {version}, this pliant reads up "
            f"to {codec.SCHEMA_VERSION}: install a newer pliant"
        )

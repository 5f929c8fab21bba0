"""Makes a clean, indexed recording of a truncated or damaged one.

``pliant recover`` keeps all readable data; a restarted recorder only data that is certainly
complete.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path

from mcap.records import Attachment, Metadata

from pliant.errors import MessageError, RecordingError
from pliant.files import put_in_place
from pliant.messages import topics
from pliant.messages.types import StreamEnd
from pliant.recording.chunk_index import Index
from pliant.recording.parts import PART_RECORD, folder_of_parts, number_of, parts_in
from pliant.recording.reader import Recorded, Recording
from pliant.recording.scan import Damage, NothingReadableError
from pliant.recording.summary import summarise
from pliant.recording.writer import RecordingWriter

RECOVERED = "recovered"
"""Name of the metadata record that names the source of a recovered recording."""


@dataclass
class Recovery:
    """The recovered messages, ends of topics not counted.  ``unchecked``: those of them without a
    checksum."""

    messages: int = 0
    unchecked: int = 0
    damage: list[Damage] = field(default_factory=list[Damage])


def decodes(message: Recorded) -> bool:
    """Whether a checksum vouches for a message or, in a chunk that was cut off, it decodes."""
    if not message.checked:
        try:
            message.decode()
        except MessageError:
            return False  # zeros after a power cut, or half a message
    return True


def recover(damaged: Path, output: Path, *, keep: Callable[[Recorded], bool] = decodes) -> Recovery:
    """Copy everything that is intact into a new recording, which appears whole or not at all.

    Chunks count by their checksums, and in them the messages that ``keep`` selects.  Raises
    RecordingError if nothing can be read or written.
    """
    partial = output.with_name(output.name + ".partial")
    recovery = Recovery()
    source = Recording(damaged)
    metadata: dict[str, dict[str, str]] = {}
    attachments: dict[str, Attachment] = {}
    waiting: Recorded | None = None
    items = source.everything()
    for item in items:  # metadata comes before messages, in the new file too
        if isinstance(item, Recorded):
            waiting = item
            break
        _note(item, metadata, recovery, attachments)
    metadata.pop(PART_RECORD, None)  # what is recovered is one file again
    metadata[RECOVERED] = {"from": damaged.name, "bytes": str(source.size)}
    try:
        with RecordingWriter(partial, metadata) as writer:
            for held in attachments.values():
                writer.attach(held.name, held.media_type, held.data)
            for item in chain([waiting] if waiting else [], items):
                if isinstance(item, Recorded):
                    if keep(item):
                        _keep(writer, item, recovery)
                elif not isinstance(item, Attachment):
                    _note(item, {}, recovery, {})
                elif item.name not in attachments:
                    attachments[item.name] = item
                    writer.attach(item.name, item.media_type, item.data)
        put_in_place(partial, output)
    except OSError as error:
        raise RecordingError(f"{output}: cannot be written: {error.strerror}") from None
    finally:
        partial.unlink(missing_ok=True)
    return recovery


def _keep(writer: RecordingWriter, message: Recorded, recovery: Recovery) -> None:
    message.write_to(writer)
    if message.topic is not topics.STREAM_END:
        recovery.messages += 1
        recovery.unchecked += not message.checked


def _note(
    item: object,
    metadata: dict[str, dict[str, str]],
    recovery: Recovery,
    attachments: dict[str, Attachment],
) -> None:
    if isinstance(item, Metadata):
        metadata[item.name] = dict(item.metadata)
    elif isinstance(item, Attachment):
        attachments[item.name] = item
    elif isinstance(item, Damage):
        recovery.damage.append(item)


def mend(path: Path) -> tuple[dict[str, int], set[str]]:
    """Close the part that was cut off; return the number of messages of each topic, and its end.

    For a restarted recorder.  Counted messages are on the disk, without a gap, under a checksum.
    Other data that a power cut left of the last part is dropped: its senders still have it, because
    it was not reported as safe.  Earlier parts were synced when they were closed, and are not read
    again.  A part without readable data is set aside.  An end counts as a message of its topic.
    ``path``: of the recording, whose parts lie beside it.

    Raises RecordingError if a part cannot be read or written.
    """
    books = _Books()
    files = parts_in(folder_of_parts(path))
    whole = [file for file in files[:-1] if _read_or_set_aside(books.take_up, file)]
    for last in files[-1:]:
        numbers = [*map(number_of, [*whole, last])]
        books.from_the_beginning = numbers == [*range(len(files))]
        _read_or_set_aside(books.take_up_last, last)
    return books.counts, books.ended


def _read_or_set_aside(read: Callable[[Path], None], file: Path) -> bool:
    """Whether something of a part can be read; it gets another name where nothing can."""
    try:
        read(file)
    except NothingReadableError:
        put_in_place(file, file.with_name(file.name + ".unreadable"))
        return False
    return True


@dataclass
class _Books:
    """Messages there are of each topic, by key.

    from_the_beginning: a topic that is not here has none yet; else they may have been taken away.
    """

    counts: dict[str, int] = field(default_factory=dict[str, int])
    ended: set[str] = field(default_factory=set[str])
    from_the_beginning: bool = True

    def mend(self, file: Path) -> None:
        """Leave of a part what follows without a gap, under a checksum, and count it.

        Ends lie in chunks of their own, perhaps before the last messages of their topics: so
        messages are counted first, without writing anything.
        """
        reached = _Books(dict(self.counts), set(), self.from_the_beginning)
        for item in Recording(file).everything():
            if isinstance(item, Recorded) and item.topic is not topics.STREAM_END:
                reached._take(item)
        ends: dict[str, Recorded] = {}

        def keep(message: Recorded) -> bool:
            if message.topic is not topics.STREAM_END:
                return self._take(message)
            if reached._follows(message):
                ends[self._key(message)] = message
                return True
            return False

        recover(file, file, keep=keep)
        for key, end in ends.items():
            self._count(key, end)

    def _take(self, message: Recorded) -> bool:
        """Count a message, if it is the next of its topic and a checksum vouches for it."""
        follows = self._follows(message)
        if follows:
            self._count(self._key(message), message)
        return follows

    def _follows(self, message: Recorded) -> bool:
        none_yet = 0 if self.from_the_beginning else message.sequence
        following = self.counts.get(self._key(message), none_yet)
        return message.checked and message.sequence == following

    def take_up(self, file: Path) -> None:
        """Count what the last chunks of a closed part say; one that is damaged is mended first."""
        try:
            self._count_last(Index(file))
        except RecordingError:
            recover(file, file)
            self._count_last(Index(file))

    def take_up_last(self, file: Path) -> None:
        """Count the messages of a part that may have been cut off."""
        summary = summarise(file)
        if not summary.has_index or summary.damage:
            self.mend(file)
        else:
            self.take_up(file)

    def _count_last(self, index: Index) -> None:
        for topic in index.topics:
            chunks = index.with_topic(topic)
            of_interest = chunks if topic is topics.STREAM_END else chunks[-1:]
            for message in index.messages([topic], chunks=of_interest):
                self._count(self._key(message), message)

    def _count(self, key: str, message: Recorded) -> None:
        self.counts[key] = max(self.counts.get(key, 0), message.sequence + 1)
        if message.topic is topics.STREAM_END:
            self.ended.add(key)

    def _key(self, message: Recorded) -> str:
        """The topic that a message belongs to; of an end, the one that it closes."""
        if message.topic is not topics.STREAM_END or not message.checked:
            return message.topic.key
        end = message.decode()
        assert isinstance(end, StreamEnd)
        return end.topic

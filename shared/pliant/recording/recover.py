"""Makes a clean, indexed recording of one that was cut off or damaged: ``pliant recover``."""

from dataclasses import dataclass, field
from pathlib import Path

from mcap.records import Attachment, Metadata

from pliant.errors import MessageError, RecordingError
from pliant.messages import topics
from pliant.recording.parts import PART_RECORD
from pliant.recording.reader import Recorded, Recording
from pliant.recording.scan import Damage
from pliant.recording.writer import RecordingWriter

RECOVERED = "recovered"
"""Name of the metadata record that says what a recovered recording was made of."""


@dataclass
class Recovery:
    """What was kept, ends of topics not counted.  ``unchecked``: those of the messages that no
    checksum vouched for."""

    messages: int = 0
    unchecked: int = 0
    damage: list[Damage] = field(default_factory=list[Damage])


def recover(damaged: Path, output: Path) -> Recovery:
    """Copy everything that is intact into a new recording, which appears whole or not at all.

    Chunks count by their checksums.  Of a chunk that was cut off, messages are kept up to the first
    that does not decode.  Raises RecordingError where nothing can be read or written.
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
            if waiting is not None:
                _keep(writer, waiting, recovery)
            for item in items:
                if isinstance(item, Recorded):
                    _keep(writer, item, recovery)
                elif not isinstance(item, Attachment):
                    _note(item, {}, recovery, {})
                elif item.name not in attachments:
                    attachments[item.name] = item
                    writer.attach(item.name, item.media_type, item.data)
        partial.replace(output)
    except OSError as error:
        raise RecordingError(f"{output}: cannot be written: {error.strerror}") from None
    finally:
        partial.unlink(missing_ok=True)
    return recovery


def _keep(writer: RecordingWriter, message: Recorded, recovery: Recovery) -> None:
    if not message.checked:
        try:
            message.decode()
        except MessageError:
            return  # zeros after a power cut, or half a message
    writer.write(
        message.topic,
        message.data,
        sequence=message.sequence,
        log_time_ns=message.log_time_ns,
        publish_time_ns=message.publish_time_ns,
    )
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

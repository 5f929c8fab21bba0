"""What a recorder that is started again finds on the disk, and where it goes on."""

from pathlib import Path

from pliant.messages import topics
from pliant.messages.types import StreamEnd
from pliant.recording.parts import folder_of_parts, parts_of
from pliant.recording.reader import Recorded, Recording
from pliant.recording.recover import recover
from pliant.recording.scan import Closed


def mend(path: Path) -> tuple[dict[str, int], set[str]]:
    """Close the part that was cut off; return the messages there are of each topic, and its end.

    An end counts as a message of its topic.  ``path``: of the recording, whose parts lie beside
    it.  Raises RecordingError where a part cannot be read or written.
    """
    files = parts_of(folder_of_parts(path))
    counts: dict[str, int] = {}
    ended: set[str] = set()
    for file in files:
        closed = False
        for item in Recording(file).everything():
            closed = closed or isinstance(item, Closed)
            if isinstance(item, Recorded):
                key = item.topic.key
                if item.topic is topics.STREAM_END:
                    message = item.decode()
                    assert isinstance(message, StreamEnd)
                    key = message.topic
                    ended.add(key)
                counts[key] = max(counts.get(key, 0), item.sequence + 1)
        if not closed:
            recover(file, file)
    return counts, ended

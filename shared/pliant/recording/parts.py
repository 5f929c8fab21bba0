"""Recordings in one file or in several: a folder of parts counts as one recording."""

import re
from collections.abc import Mapping
from pathlib import Path

from pliant.errors import RecordingError
from pliant.files import make_folder
from pliant.messages.topics import Topic
from pliant.recording.writer import RecordingWriter

PART = "part_{:05d}.mcap"
_PART = re.compile(r"part_\d{5,}\.mcap")  # and not a recovered or exported one
PART_RECORD = "part"
"""Name of the metadata record that numbers a part."""


def folder_of_parts(path: Path) -> Path:
    """Where the parts of ``recording.mcap`` lie: the folder ``recording`` beside it."""
    return path.with_suffix("")


def parts_of(path: Path) -> list[Path]:
    """The files of a recording in order; empty where there is none.

    ``path``: a file, the name of a file that was written in parts, a folder of parts, or a result
    folder.
    """
    if path.is_file():
        return [path]
    if path.is_dir():
        return parts_in(path) or parts_of(path / "recording.mcap")
    folder = folder_of_parts(path)
    return parts_in(folder) if folder != path else []


def parts_in(folder: Path) -> list[Path]:
    """The parts that lie in this very folder, in order; empty where there are none."""
    found = folder.glob("part_*.mcap") if folder.is_dir() else ()
    return sorted((part for part in found if _PART.fullmatch(part.name)), key=number_of)


def following_number(folder: Path) -> int:
    """The number of the next part: behind the highest, also where one was taken away."""
    return max(map(number_of, parts_in(folder)), default=-1) + 1


def number_of(part: Path) -> int:
    """The number in the name of a part."""
    return int(part.stem.removeprefix("part_"))


def exists(path: Path) -> bool:
    """Whether there is a recording, in one file or in parts."""
    return bool(parts_of(path))


class RollingWriter:
    """A RecordingWriter that begins a new file whenever one is large or old enough.

    Every part is a whole recording of its messages, with all metadata and attachments.
    """

    def __init__(
        self,
        path: Path,
        metadata: Mapping[str, Mapping[str, str]],
        *,
        roll_bytes: int = 0,
        roll_ns: int = 0,
        append: bool = False,
    ) -> None:
        """``roll_bytes``, ``roll_ns``: size and span of a part, 0 for no limit; without either,
        one file.  append: begin a part behind those that are there, as a recorder does that may
        be started again.  Raises RecordingError if nothing can be written."""
        self._path = path
        self._metadata = metadata
        self._roll_bytes = roll_bytes
        self._roll_ns = roll_ns
        self._attached: dict[str, tuple[str, bytes]] = {}
        self._in_parts = bool(roll_bytes or roll_ns or append)
        self._number = following_number(folder_of_parts(path)) if append else 0
        self._first_ns: int | None = None
        if self._in_parts:
            try:
                make_folder(folder_of_parts(path))
            except OSError as error:
                raise RecordingError(f"{path}: cannot be written: {error.strerror}") from None
        self._writer = self._part()

    def write(
        self, topic: Topic, data: bytes, *, sequence: int, log_time_ns: int, publish_time_ns: int
    ) -> None:
        """Append one encoded message.  Raises RecordingError when the disk is full."""
        first = log_time_ns if self._first_ns is None else self._first_ns
        large = self._roll_bytes and self._writer.size + len(data) > self._roll_bytes
        old = self._roll_ns and log_time_ns - first > self._roll_ns
        if self._first_ns is not None and (large or old):
            self._writer.close()
            self._number += 1
            first = log_time_ns
            self._writer = self._part()
        self._first_ns = first
        self._writer.write(
            topic,
            data,
            sequence=sequence,
            log_time_ns=log_time_ns,
            publish_time_ns=publish_time_ns,
        )

    def attach(self, name: str, media_type: str, data: bytes) -> None:
        """Append a file to this part and to all that follow."""
        self._attached[name] = (media_type, data)
        self._writer.attach(name, media_type, data)

    def sync(self) -> None:
        """Put everything written so far on the disk."""
        self._writer.sync()

    def __enter__(self) -> "RollingWriter":
        return self

    def __exit__(self, error_type: type[BaseException] | None, *_: object) -> None:
        self._writer.__exit__(error_type)

    def _part(self) -> RecordingWriter:
        if not self._in_parts:
            return RecordingWriter(self._path, self._metadata, replace=False)
        path = folder_of_parts(self._path) / PART.format(self._number)
        writer = RecordingWriter(
            path, {**self._metadata, PART_RECORD: {"number": str(self._number)}}, replace=False
        )
        for name, (media_type, data) in self._attached.items():
            writer.attach(name, media_type, data)
        return writer

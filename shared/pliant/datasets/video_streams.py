"""The video streams of a container: what each is, which one is meant, and how to hide the others.

OpenCV decodes the first video stream of a file, be it a preview or a cover picture.  So the others
are hidden from it: a few bytes of the header are replaced while it reads (``PatchedFile``).
"""

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO


@dataclass(frozen=True)
class Patch:
    """Bytes that replace those of a file from ``offset`` on."""

    offset: int
    data: bytes


@dataclass(frozen=True, kw_only=True)
class VideoStream:
    """One video stream, as its container describes it.

    width, height: of the stored images, pixels.
    is_default: not marked as one to be passed over.
    is_still: a cover picture or thumbnails, no film.
    frames: how many it has; None if unknown to its headers.
    stamps_ns: when frames are shown, sorted, in media time; () if only reading shows.
    origin_ns: when the first is shown in the order of decoding, from which OpenCV counts.
    shown_ns: intervals of media time that are to be shown; () for all.
    may_change: whether the size of its images may change on the way.
    hide: what makes a reader pass over this stream.
    """

    width: int
    height: int
    is_default: bool = True
    is_still: bool = False
    frames: int | None = None
    stamps_ns: Sequence[int] = ()
    origin_ns: int = 0
    shown_ns: tuple[tuple[int, int], ...] = ()
    may_change: bool = True
    hide: tuple[Patch, ...] = ()

    def shows(self, media_ns: int) -> bool:
        """Whether the edit list shows what was taken at this media time."""
        times = self.shown_ns
        return not times or any(start <= media_ns < end for start, end in times)


@dataclass(frozen=True, kw_only=True)
class Container:
    """The video streams in the order of the file, none where it is not understood.

    patches: needed whichever stream is read.     may_change: as of a stream that is not listed.
    """

    streams: tuple[VideoStream, ...] = ()
    patches: tuple[Patch, ...] = ()
    may_change: bool = True


@dataclass(frozen=True, kw_only=True)
class ChosenStream:
    """The decoded stream of a file.  stream: None if the container is not understood."""

    stream: VideoStream | None = None
    patches: tuple[Patch, ...] = ()
    may_change: bool = True
    note: str = ""


def choose(container: Container) -> ChosenStream:
    """The largest film among the streams that are marked as default, or among all."""
    streams = container.streams
    if not streams:
        return ChosenStream(patches=container.patches, may_change=container.may_change)
    wanted = [each for each in streams if not each.is_still] or list(streams)
    wanted = [each for each in wanted if each.is_default] or wanted
    chosen = max(wanted, key=lambda each: each.width * each.height)
    others = [each for each in streams if each is not chosen]
    patches = [*container.patches, *(patch for each in others for patch in each.hide)]
    return ChosenStream(
        stream=chosen,
        patches=tuple(patches),
        may_change=chosen.may_change,
        note=_note(streams, chosen),
    )


def _note(streams: Sequence[VideoStream], chosen: VideoStream) -> str:
    if len(streams) == 1:
        return ""
    listed = ", ".join(
        f"{each.width}x{each.height}{' (picture)' if each.is_still else ''}" for each in streams
    )
    number = next(i for i, each in enumerate(streams, start=1) if each is chosen)
    return f"{len(streams)} video streams ({listed}): reading stream {number}"


class PatchedFile(io.BufferedIOBase):
    """A file of which some bytes read otherwise; how OpenCV reads what has no name for it."""

    def __init__(self, file: Path, patches: Sequence[Patch] = ()) -> None:
        """Raises OSError."""
        self._file: BinaryIO = file.open("rb")
        self._patches = tuple(patches)

    def read(self, size: int | None = -1, /) -> bytes:
        """The next bytes."""
        start = self._file.tell()
        data = self._file.read(-1 if size is None else size)
        for patch in self._patches:
            first = patch.offset - start
            if -len(patch.data) < first < len(data):
                skip, at = max(0, -first), max(0, first)
                there = patch.data[skip : skip + len(data) - at]
                data = data[:at] + there + data[at + len(there) :]
        return data

    def seek(self, offset: int, whence: int = 0, /) -> int:
        """Go to a position; returns it."""
        return self._file.seek(offset, whence)

    def tell(self) -> int:
        """The position."""
        return self._file.tell()

    def readable(self) -> bool:
        """Always."""
        return True

    def seekable(self) -> bool:
        """Always."""
        return True

    def close(self) -> None:
        """Close the file."""
        self._file.close()
        super().close()

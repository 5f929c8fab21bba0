"""The file of a video, as a recording keeps it instead of raw frames."""

import math
import zlib
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from pathlib import Path

from pliant.datasets.base import Dataset
from pliant.datasets.excerpt import Excerpt, Part
from pliant.datasets.masks import Masked
from pliant.datasets.static_mask import StaticallyMasked
from pliant.datasets.video import VideoFile
from pliant.datasets.video_decoder import file_version
from pliant.datasets.working_size import SmallerImages
from pliant.errors import DatasetError
from pliant.messages.types import ClipPiece

_PIECE_BYTES = 1 << 20
_RAW_BYTES = 3  # of a pixel, as videos are decoded


class Clip:
    """A video file that is sent in pieces, and watched for changes from then on."""

    def __init__(self, file: Path) -> None:
        """Raises DatasetError if it cannot be read."""
        self._path = file
        with self._reading():
            self.size = file.stat().st_size
        self._before = file_version(file)

    def pieces(self) -> Iterator[ClipPiece]:
        """The whole file, in order.  Memory: one piece.  Raises DatasetError."""
        offset = 0
        for number, data in enumerate(self._blocks()):
            yield ClipPiece(
                frame=number,
                stamp_ns=0,
                frame_id="",
                name=self._path.name,
                size=self.size,
                offset=offset,
                data=data,
            )
            offset += len(data)

    def checksum(self) -> int:
        """CRC-32 of the file.  Raises DatasetError."""
        crc = 0
        for data in self._blocks():
            crc = zlib.crc32(data, crc)
        return crc

    def is_as_it_was(self) -> bool:
        """Whether its name still leads to it, and it is unchanged since it was opened."""
        return file_version(self._path) == self._before

    def _blocks(self) -> Iterator[bytes]:
        with self._reading(), self._path.open("rb") as file:
            for offset in range(0, self.size, _PIECE_BYTES):
                yield file.read(min(_PIECE_BYTES, self.size - offset))

    @contextmanager
    def _reading(self) -> Generator[None]:
        try:
            yield
        except OSError as error:
            raise DatasetError(f"{self._path}: cannot be read: {error.strerror}") from None


def clip_of(source: Dataset) -> Clip | None:
    """The video behind a source, where its file is no larger than the frames that are taken of it.

    Raises DatasetError if it cannot be read.
    """
    origin, parts = source, list[Part]()
    while isinstance(origin, SmallerImages | Excerpt | Masked | StaticallyMasked):
        parts += [origin.part] if isinstance(origin, Excerpt) else []
        origin = origin.source
    if not isinstance(origin, VideoFile):
        return None
    clip, frames, camera = Clip(origin.file), origin.frame_count, source.calibration
    if frames is None:  # unknown to its container
        return None if parts else clip
    for part in parts:
        until_s = min(frames / origin.rate_hz, part.end_s or math.inf)
        frames = max(0.0, until_s - part.start_s) * origin.rate_hz / part.every
    return clip if clip.size <= _RAW_BYTES * camera.width * camera.height * frames else None

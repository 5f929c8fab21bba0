"""The images of a recording with their pixels, also where it holds the clip instead of these.

A recording of a video holds its file (``camera/clip``), and of each frame its number in it and the
checksum of the pixels that were worked on.  They are made again as the run made them, and nothing
is delivered whose checksum differs.
"""

import re
import tempfile
import weakref
import zlib
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import IO

import cv2

from pliant.datasets.rectifier import decode
from pliant.datasets.video import GIVE_UP, raw_frame
from pliant.datasets.video_decoder import opened
from pliant.datasets.working_size import smaller
from pliant.errors import DatasetError, RecordingError
from pliant.messages import topics
from pliant.messages.types import ClipPiece, SourceImage
from pliant.recording.reader import Recorded, Recording

_NEAR_S = 2.0
"""So far ahead frames are passed over; beyond, and backwards, the decoder seeks."""


class RecordedImages:
    """Gives images their pixels.  Quickest in the order of their frames."""

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self._clip: _RecordedClip | None = None

    def __iter__(self) -> Iterator[SourceImage]:
        """All of them, in order.  Raises RecordingError as ``whole`` does."""
        for image in self._recording.decoded(topics.SOURCE):
            assert isinstance(image, SourceImage)
            yield self.whole(image)

    def whole(self, image: SourceImage) -> SourceImage:
        """The image with its pixels, and without the clip.

        Raises RecordingError if the clip gives other pixels, or is not there.
        """
        if image.data or image.clip_frame < 0:
            return image
        if self._clip is None:
            self._clip = _RecordedClip(self._recording)
        return replace(image, data=self._clip.pixels(image), clip_frame=-1, checksum=0)


class _RecordedClip:
    """The video file in a recording, and the decoder that reads it."""

    def __init__(self, recording: Recording) -> None:
        self._path = recording.path
        self._made_with = recording.metadata().get("packages", {}).get("opencv-python-headless", "")
        self._missing = ""
        self._held = ExitStack()
        weakref.finalize(self, self._held.close)
        try:
            self._file = Path(self._held.enter_context(self._unpacked(recording)).name)
        except OSError as error:
            raise RecordingError(
                f"{self._path}: the clip in it cannot be unpacked to {tempfile.gettempdir()}: "
                f"{error.strerror}; free some space there, or set TMPDIR"
            ) from None
        self._decoder = self._held.enter_context(ExitStack())
        self._begin()

    def pixels(self, image: SourceImage) -> bytes:
        """The bytes of an image.  Raises RecordingError if they cannot be made again."""
        ahead = image.clip_frame - self._next
        near = round(_NEAR_S * self._video.rate_hz)
        found = self._following(image) if 0 <= ahead <= near else self._sought(image, near)
        if found is None:  # counted from the beginning, then
            self._begin()
            found = self._following(image)
        if found is None:
            version = self._made_with or "of its version"
            raise RecordingError(
                f"{self._path}: frame {image.frame}: OpenCV {cv2.__version__} decodes other "
                f"pixels from its clip than the run{self._missing}: read it on the machine of the "
                f"run, or with OpenCV {version}"
            )
        return found

    def _following(self, image: SourceImage) -> bytes | None:
        """An image further on, by counting; None if its number has other pixels."""
        failed = 0
        while self._next < image.clip_frame and failed <= GIVE_UP:
            failed = 0 if self._video.grab() else failed + 1
            self._next += 1
        return self._read(image)

    def _sought(self, image: SourceImage, near: int) -> bytes | None:
        """An image anywhere, near where the container has it; None if there is none like it.

        The container's list of frames may be wrong: only the checksum decides.
        """
        for start, count in ((image.clip_frame, 1), (image.clip_frame - near // 2, near)):
            if start <= 0 or not self._video.seek_frame(start):
                continue
            for _ in range(count):
                found = self._read(image)
                if found is not None:
                    self._next = image.clip_frame + 1
                    return found
        return None

    def _read(self, image: SourceImage) -> bytes | None:
        """The next frame as it was published, if it is this image."""
        pixels = self._video.read()
        self._next += 1
        if pixels is None:
            return None
        frame = raw_frame(pixels, image.frame, image.stamp_ns)
        if (frame.width, frame.height) != (image.width, image.height):
            frame = smaller(frame, decode(frame), max(image.width, image.height))
        return frame.data if zlib.crc32(frame.data) == image.checksum else None

    def _begin(self) -> None:
        """At the first frame, in a decoder that has seen no other."""
        self._decoder.close()
        try:
            self._video = self._decoder.enter_context(opened(self._file))
        except DatasetError:
            raise RecordingError(
                f"{self._path}: OpenCV {cv2.__version__} cannot read its clip{self._missing}"
            ) from None
        self._next = 0

    def _unpacked(self, recording: Recording) -> IO[bytes]:
        """The part of the file that the recording has; removed after its last reader."""
        file: IO[bytes] | None = None
        there = size = 0
        for item in recording.everything(topics.CLIP):
            if not isinstance(item, Recorded) or not item.checked:
                continue
            piece = item.decode()
            assert isinstance(piece, ClipPiece)
            size = piece.size
            if not 0 <= piece.offset <= size - len(piece.data):
                raise RecordingError(f"{self._path}: a piece of the clip in it lies beyond its end")
            if file is None:
                ending = re.search(r"\.[A-Za-z0-9]{1,8}$", piece.name)
                file = tempfile.NamedTemporaryFile(  # noqa: SIM115 (as long as it is read)
                    prefix="pliant-clip-", suffix=ending[0] if ending else ""
                )
            file.seek(piece.offset)
            there += file.write(piece.data)
        if file is None:
            raise RecordingError(
                f"{self._path}: the clip of its images is missing (if this is one part of "
                "several, pass the folder of all parts)"
            )
        file.flush()
        if there < size:
            self._missing = f" ({size - there} of its {size} bytes are missing)"
        return file

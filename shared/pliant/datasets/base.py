"""The frame as it came, and the protocol of every source of frames."""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol

from pliant.datasets.calibration import Calibration
from pliant.errors import DatasetError


class BrokenFrame(DatasetError):  # noqa: N818 (an error of one frame, not of the source)
    """One frame does not decode or has another size; the run continues without it."""


@dataclass(frozen=True, kw_only=True)
class SourceFrame:
    """One frame as the source provides it.

    index: from 0, without gaps.     stamp_ns: capture time, increasing.
    encoding: how ``data`` is read: a file format ("jpeg", "png", "bmp", "tiff", "webp", "pnm", or
    "unknown", left to the decoder) or raw rows without padding ("mono8", "bgr8", "rgb8" and
    the others of ``raw_pixels.RAW_BYTES``).
    data: bytes as they are in the file, or the raw pixels.
    width, height: of raw pixels; 0 for file formats, which contain their size.
    made_from: description of the original if the frame was converted; "" otherwise; of a frame
    without data, the reason.
    clip_frame: number of the frame in its video file; -1: not from a video file.
    depth: content of the file with its depth map; b"" without one.
    mask: content of an image file that marks the used part; b"": all of it.
    number: in the source, if only a part of the source is used; -1: ``index``.
    name: of its file; "" without one; not compared.
    captured_s: in live mode, when it came or was due by the clock of this machine; not compared.
    """

    index: int
    stamp_ns: int
    encoding: str
    data: bytes
    width: int = 0
    height: int = 0
    depth: bytes = b""
    made_from: str = ""
    clip_frame: int = -1
    mask: bytes = b""
    number: int = -1
    name: str = field(default="", compare=False)
    captured_s: float = field(default=0.0, compare=False)

    @property
    def dropped(self) -> bool:
        """Whether it was skipped on purpose; a frame of an empty file is broken, not dropped."""
        return self.encoding == ""

    def broken(self, why: str) -> "SourceFrame":
        """Return the frame as a broken one, without data.  why: the reason, for people."""
        nothing = {"encoding": "unknown", "width": 0, "height": 0, "clip_frame": -1}
        return replace(self, **nothing, data=b"", depth=b"", mask=b"", made_from=why)

    @property
    def called(self) -> str:
        """Its name in messages."""
        return f"frame {self.index}" if self.number < 0 else f"frame {self.number} of the source"

    def without_data(self) -> "SourceFrame":
        """Return the frame as a skipped one, with its number and time."""
        nothing = {"encoding": "", "width": 0, "height": 0, "clip_frame": -1}
        return replace(self, **nothing, data=b"", depth=b"", mask=b"")


class Dataset(Protocol):
    """A source of frames.  Each iteration starts with the first frame."""

    @property
    def name(self) -> str:
        """Short name for people."""
        ...

    @property
    def calibration(self) -> Calibration:
        """The camera, with distortion."""
        ...

    @property
    def is_live(self) -> bool:
        """Whether frames arrive at their own pace, even if no reader is ready."""
        ...

    @property
    def frame_count(self) -> int | None:
        """Number of frames; None if unknown.  Of a video file, according to its container."""
        ...

    @property
    def ground_truth_path(self) -> Path | None:
        """The file with its ground-truth poses; None without one."""
        ...

    def __iter__(self) -> Iterator[SourceFrame]:
        """Yield the frames.  Raises DatasetError if the source fails, not for a broken frame."""
        ...


VIDEO_SUFFIXES = (
    *(".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi", ".mpg", ".mpeg", ".mts", ".m2ts", ".ts"),
    *(".wmv", ".flv", ".ogv", ".3gp", ".mjpeg"),
)
"""Endings of clips in a folder.  For a file that a user names, OpenCV decides."""

_MAGIC = (
    (b"\xff\xd8\xff", "jpeg"),
    (b"\x89PNG\r\n\x1a\n", "png"),
    (b"BM", "bmp"),
    (b"II*\x00", "tiff"),
    (b"MM\x00*", "tiff"),
    (b"P5", "pnm"),
    (b"P6", "pnm"),
)


def encoding_of(data: bytes) -> str:
    """Return the format of an image file by its first bytes: its name may be wrong."""
    for magic, encoding in _MAGIC:
        if data.startswith(magic):
            return encoding
    return "webp" if data[:4] == b"RIFF" and data[8:12] == b"WEBP" else "unknown"


BUILTIN_PREFIX = "built-in:"


def is_builtin(source: str) -> bool:
    """Whether a source names a built-in sequence."""
    return source.startswith(BUILTIN_PREFIX)

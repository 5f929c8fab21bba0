"""Video files: any that OpenCV reads, with a calibration file or a field of view.

A file of the same name with the ending .yaml beside it is taken as its calibration.  Times are
those of the container; where it has none, or they repeat, frames follow each other at its rate.
A frame that does not decode is one without data, and those behind it come all the same.
Frames are published as they leave the decoder, as raw BGR pixels.  One thread decodes: with several
FFmpeg makes of a damaged stream what timing says, and other pixels with every run.
"""

import contextlib
from collections.abc import Generator, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import cv2

from pliant.algorithms.arrays import U8
from pliant.datasets.base import SourceFrame
from pliant.datasets.calibration import Calibration
from pliant.datasets.images import SourceOptions, choose_calibration
from pliant.errors import DatasetError

_DEFAULT_FPS = 30.0
GIVE_UP = 600
"""Frames that do not decode, one behind the other, before nothing more is expected."""


class VideoFile:
    """The frames of a video file.  ``frame_count`` is the container's word, not a promise."""

    is_live = False
    ground_truth_path: Path | None = None

    def __init__(self, file: Path, options: SourceOptions) -> None:
        """Raises DatasetError where it holds no video, CalibrationError for its calibration."""
        self.name = file.stem
        self.file = file
        self._version = file_version(file)
        with opened(file) as capture:
            read, first = capture.read()
            if not read:
                raise DatasetError(f"{file}: a video without frames")
            count = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
            self.rate_hz = rate_hz(capture)
        self.frame_count = count if count > 0 else None
        height, width = cast(U8, first).shape[:2]
        self.calibration: Calibration = choose_calibration(
            options, (width, height), found=file.with_suffix(".yaml"), where=str(file)
        )

    def reaches(self, time_s: float) -> bool:
        """Whether a frame is found there by seeking; where none is, only reading tells."""
        with opened(self.file) as capture:
            capture.set(cv2.CAP_PROP_POS_MSEC, 1e3 * time_s)
            read, _ = capture.read()
            return read and 1e-3 * capture.get(cv2.CAP_PROP_POS_MSEC) >= time_s - 1.0 / self.rate_hz

    def __iter__(self) -> Iterator[SourceFrame]:
        """Raises DatasetError where it is another file by now, or was written to meanwhile.

        A file that has lost its name while it is read is there until its end.
        """
        yield from self._frames()
        self.check_unwritten()

    def check_unwritten(self) -> None:
        """Raise DatasetError where it was written to since it was opened."""
        now = file_version(self.file)
        if now != self._version and now[:2] == self._version[:2]:
            raise DatasetError(
                f"{self.file}: was written to while it was read, and its frames may be of two "
                "videos: run it again"
            )

    def _frames(self) -> Iterator[SourceFrame]:
        with opened(self.file) as capture:
            if file_version(self.file) != self._version:
                raise DatasetError(f"{self.file}: was replaced after it was opened: run it again")
            step_ns = round(1e9 / rate_hz(capture))
            index, previous_ns, broken = 0, -step_ns, 0
            while True:
                read, pixels = capture.read()
                if not read:  # at its end, or a frame that is damaged: then the next may be whole
                    broken += 1
                    if broken > GIVE_UP or index + broken >= (self.frame_count or 0):
                        return
                    continue
                stamp_ns = round(capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6)
                if stamp_ns <= previous_ns:
                    stamp_ns = previous_ns + (broken + 1) * step_ns
                between_ns = (stamp_ns - previous_ns) // (broken + 1)
                for number in range(broken):
                    yield _damaged(index + number, previous_ns + (number + 1) * between_ns)
                index, broken = index + broken, 0
                yield replace(raw_frame(cast(U8, pixels), index, stamp_ns), clip_frame=index)
                index, previous_ns = index + 1, stamp_ns


def file_version(file: Path) -> tuple[int, ...]:
    """What tells a file from another of its name, or from what it was before it was written to;
    () where there is none."""
    try:
        status = file.stat()
    except OSError:
        return ()
    return status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns


def raw_frame(pixels: U8, index: int, stamp_ns: int) -> SourceFrame:
    """A decoded frame, (H, W) grey or (H, W, 3) BGR, as raw bytes."""
    height, width = pixels.shape[:2]
    return SourceFrame(
        index=index,
        stamp_ns=stamp_ns,
        encoding="mono8" if pixels.ndim == 2 else "bgr8",
        data=pixels.tobytes(),
        width=width,
        height=height,
    )


def _damaged(index: int, stamp_ns: int) -> SourceFrame:
    return SourceFrame(
        index=index, stamp_ns=stamp_ns, encoding="unknown", data=b"", width=0, height=0
    )


def _why_not(file: Path) -> str:
    if file_version(file) and not file.stat().st_size:
        return "is empty (0 bytes): copy it again"
    return (
        "not a video that OpenCV can read: without pictures, cut off before its end, or in a "
        "format that it does not know (then convert it, e.g. to MP4)"
    )


@contextlib.contextmanager
def quiet_opencv() -> Generator[None, None, None]:
    """Keep OpenCV and FFmpeg from writing to the terminal: our own line says what is wrong."""
    logging: Any = cv2.utils.logging
    before = logging.getLogLevel()
    logging.setLogLevel(logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        logging.setLogLevel(before)


def rate_hz(capture: cv2.VideoCapture) -> float:
    """Frames a second, as the container says; a usual rate where it says nothing likely."""
    stated = capture.get(cv2.CAP_PROP_FPS)
    return stated if 0.1 < stated < 1e4 else _DEFAULT_FPS


@contextlib.contextmanager
def opened(file: Path) -> Generator[cv2.VideoCapture, None, None]:
    """The decoder, at its first frame.  Raises DatasetError for a file that holds no video."""
    with quiet_opencv():
        capture = cv2.VideoCapture(str(file), cv2.CAP_FFMPEG, [cv2.CAP_PROP_N_THREADS, 1])
        if not capture.isOpened():
            capture = cv2.VideoCapture(str(file))
    try:
        if not capture.isOpened():
            raise DatasetError(f"{file}: {_why_not(file)}")
        yield capture
    finally:
        capture.release()

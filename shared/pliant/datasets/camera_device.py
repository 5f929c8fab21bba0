"""Cameras that are attached: ``camera:0``, or just ``0``, with a calibration or a field of view.

The device is opened once to find out whether it exists and how large its images are, and closed.
It is opened again to stream.  So a check before a run does not block the process that reads it.
"""

import re
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Protocol, cast

import cv2

from pliant.algorithms.arrays import U8
from pliant.datasets.base import SourceFrame
from pliant.datasets.calibration import Calibration
from pliant.datasets.calibration_files import read_calibration
from pliant.datasets.images import choose_calibration
from pliant.datasets.source_spec import SourceSpec
from pliant.datasets.video import raw_frame
from pliant.datasets.video_decoder import quiet_opencv
from pliant.errors import DatasetError

_INDEX = re.compile(r"(?:camera:)?([0-9]{1,3})")


class Capture(Protocol):
    """The part of ``cv2.VideoCapture`` that is used."""

    def isOpened(self) -> bool: ...
    def read(self) -> tuple[bool, U8 | None]: ...
    def set(self, property_id: int, value: float, /) -> bool: ...
    def release(self) -> None: ...


def _open_device(index: int) -> Capture:
    with quiet_opencv():
        return cast(Capture, cv2.VideoCapture(index))


class CameraDevice:
    """A live camera; it ends when it is no longer read, or with an error when it stops.

    Frames are stamped when they arrive; no two stamps are the same.
    """

    is_live = True
    frame_count: int | None = None
    ground_truth_path: Path | None = None

    def __init__(
        self,
        index: int,
        spec: SourceSpec,
        *,
        open_device: Callable[[int], Capture] = _open_device,
        clock_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        """Raises DatasetError if there is no such camera, and CalibrationError.

        open_device, clock_ns: for tests.
        """
        self.name = f"camera:{index}"
        self._index = index
        self._open_device = open_device
        self._clock_ns = clock_ns
        # Request the size of the calibration.
        self._size: tuple[int, int] | None = None
        if spec.calibration is not None:
            wanted = read_calibration(spec.calibration)
            self._size = (wanted.width, wanted.height)
        capture = self._start()
        try:
            height, width = self._read(capture).shape[:2]
        finally:
            capture.release()
        self.calibration: Calibration = choose_calibration(
            spec, (width, height), found=None, where=self.name
        )

    def __iter__(self) -> Iterator[SourceFrame]:
        capture = self._start()
        try:
            index, previous_ns = 0, -1
            while True:
                pixels = self._read(capture)
                stamp_ns = max(self._clock_ns(), previous_ns + 1)
                yield raw_frame(pixels, index, stamp_ns)
                index, previous_ns = index + 1, stamp_ns
        finally:
            capture.release()

    def _start(self) -> Capture:
        capture = self._open_device(self._index)
        if not capture.isOpened():
            capture.release()
            raise DatasetError(
                f"{self.name}: no such camera, or another program uses it; the first camera "
                "is camera:0"
            )
        if self._size is not None:
            capture.set(cv2.CAP_PROP_FRAME_WIDTH, self._size[0])
            capture.set(cv2.CAP_PROP_FRAME_HEIGHT, self._size[1])
        return capture

    def _read(self, capture: Capture) -> U8:
        read, pixels = capture.read()
        if not read or pixels is None:
            raise DatasetError(f"{self.name}: delivers no more images; is it still plugged in?")
        return pixels


def camera_index(source: str) -> int | None:
    """The index that a source names; None if it names no camera."""
    match = _INDEX.fullmatch(source)
    return int(match.group(1)) if match else None

"""A part of a source: between two times, each n-th frame or the sharpest of each n."""

from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Protocol, cast

import cv2

from pliant.algorithms.arrays import U8
from pliant.algorithms.image.sharpness import LONGEST_SIDE_PX, resized, sharpness
from pliant.datasets.base import BrokenFrame, Dataset, SourceFrame
from pliant.datasets.images import ImageFiles
from pliant.datasets.masks import Masked
from pliant.datasets.rectifier import decode
from pliant.datasets.video import VideoFile
from pliant.errors import DatasetError


class Part(Protocol):
    """The frames of a source that are taken, by ``ingest`` of the configuration.

    start_s, end_s: seconds after its first frame, the end not included; end 0: to its end.
    every: one of this many frames: the first, or the ``sharpest``.
    """

    @property
    def start_s(self) -> float: ...
    @property
    def end_s(self) -> float: ...
    @property
    def every(self) -> int: ...
    @property
    def sharpest(self) -> bool: ...


class Frames(Part, Protocol):
    """Which frames of a source are used and how: ``ingest`` of the configuration.

    longest_side_px: the limit of a larger image; 0: as many pixels as its details need.
    mask_static: whether borders and overlays are found and masked, without a mask: see
    ``static_mask``.
    """

    @property
    def longest_side_px(self) -> int: ...
    @property
    def mask_static(self) -> bool: ...


class Excerpt:
    """Those frames of a source, counted from 0.  Times stay those of the source."""

    def __init__(self, source: Dataset, part: Part, *, first_depth_only: bool = False) -> None:
        """first_depth_only: of depth maps that come along, only the first is delivered.

        Raises DatasetError if the end is not after the start.
        """
        if 0.0 < part.end_s <= part.start_s:
            raise DatasetError(f"--end {part.end_s:g}: must be after --start {part.start_s:g}")
        self.source = source
        self.part = part
        self._first_depth_only = first_depth_only
        self.calibration = source.calibration
        self.name = source.name
        self.is_live = source.is_live
        count, cut = source.frame_count, part.start_s > 0.0 or part.end_s > 0.0
        self.frame_count = None if count is None or cut else -(-count // part.every)
        self.ground_truth_path: Path | None = source.ground_truth_path

    def __iter__(self) -> Iterator[SourceFrame]:
        for index, group in enumerate(_groups(self._within(), self.part.every)):
            chosen = max(group, key=_sharpness) if self.part.sharpest else group[0]
            # Of equals max takes the first, so that frames without pixels are as without it.
            depth = b"" if index and self._first_depth_only else chosen.depth
            number = chosen.index if chosen.number < 0 else chosen.number
            yield replace(chosen, index=index, number=number, depth=depth)

    def _within(self) -> Iterator[SourceFrame]:
        """Raises DatasetError if there is none."""
        part, first_ns, time_s, count = self.part, 0, 0.0, 0
        for frame in self.source:
            first_ns = first_ns if frame.index else frame.stamp_ns
            time_s = 1e-9 * (frame.stamp_ns - first_ns)
            if part.end_s and time_s >= part.end_s:
                if isinstance(self._origin, VideoFile):  # which has not come to its own end
                    self._origin.check_unwritten()
                break
            if time_s >= part.start_s:
                count += 1
                yield frame
        if count == 0:
            if time_s < part.start_s:
                raise self._too_short(time_s)
            raise DatasetError(
                f"{self.name}: no frame lies between --start {part.start_s:g} s and "
                f"--end {part.end_s:g} s"
            )

    def check_start(self) -> None:
        """Raise DatasetError if the source ends before the start, in no time if it can tell."""
        origin = self._origin
        if isinstance(origin, ImageFiles):
            if origin.length_s < self.part.start_s:
                raise self._too_short(origin.length_s)
        elif not (isinstance(origin, VideoFile) and origin.reaches(self.part.start_s)):
            next(iter(self))

    @property
    def _origin(self) -> Dataset:
        return self.source.source if isinstance(self.source, Masked) else self.source

    def _too_short(self, length_s: float) -> DatasetError:
        return DatasetError(
            f"{self.name}: is {length_s:.2f} s long: no frame comes at --start "
            f"{self.part.start_s:g} s or later"
        )


def is_all(part: Part | None) -> bool:
    """Whether it is the whole source."""
    return part is None or (part.start_s == part.end_s == 0.0 and part.every == 1)


def _groups(frames: Iterable[SourceFrame], size: int) -> Iterator[list[SourceFrame]]:
    """Groups of that many consecutive frames; the last may have fewer."""
    group: list[SourceFrame] = []
    for frame in frames:
        group.append(frame)
        if len(group) == size:
            yield group
            group = []
    if group:
        yield group


def _sharpness(frame: SourceFrame) -> float:
    if frame.dropped:
        return -1.0
    try:
        pixels = decode(frame)
    except BrokenFrame:
        return -1.0
    if pixels.ndim == 3:
        pixels = cast(U8, cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY))
    return sharpness(resized(pixels, LONGEST_SIDE_PX))

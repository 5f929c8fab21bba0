"""A source at the size that it is worked on: what is larger than its details is made smaller.

The first frames determine it, so the same source has the same size.  Everything behind the source,
the recording too, has the smaller images and their camera, and knows nothing of larger ones.
"""

from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import cast

import cv2

from pliant.algorithms.arrays import U8
from pliant.algorithms.image.sharpness import (
    LEAST_SIDE_PX,
    LONGEST_SIDE_PX,
    resized,
    size_at,
    working_side,
)
from pliant.datasets.base import BrokenFrame, Dataset, SourceFrame
from pliant.datasets.calibration import Calibration
from pliant.datasets.rectifier import decode
from pliant.errors import DatasetError

_LEAST_SHORTER_SIDE_PX = 16
_LOOKED_AT, _STEP = 7, 5
"""Frames that determine how sharp a source is, and their distance: cameras begin out of focus."""


class SmallerImages:
    """A source of frames, made smaller one by one; what does not decode stays as it is."""

    def __init__(self, source: Dataset, side: int) -> None:
        """side: pixels along the longer side, fewer than the source's.

        source_size: (width, height) that they come in.
        """
        whole = source.calibration
        self.source = source
        self._side = side
        self.source_size = (whole.width, whole.height)
        self.calibration = _smaller(whole, side)
        self.name = source.name
        self.is_live = source.is_live
        self.frame_count = source.frame_count
        self.ground_truth_path: Path | None = source.ground_truth_path
        to = f"{self.calibration.width}x{self.calibration.height}"
        self.note = f"images of {whole.width}x{whole.height} px are processed at {to} px"

    def __iter__(self) -> Iterator[SourceFrame]:
        for frame in self.source:
            yield frame if frame.dropped else self._made_smaller(frame)

    def _made_smaller(self, frame: SourceFrame) -> SourceFrame:
        try:
            pixels = decode(frame)
        except BrokenFrame:
            return frame  # reported when it is rectified
        if pixels.shape[1::-1] != self.source_size:
            return frame
        return smaller(frame, pixels, self._side)


def smaller(frame: SourceFrame, pixels: U8, side: int) -> SourceFrame:
    """A frame, and its pixels (H, W) or (H, W, 3) RGB, with that many along the longer side."""
    made_from = f"{frame.encoding} of {pixels.shape[1]}x{pixels.shape[0]} px"
    pixels = resized(pixels, side)
    height, width = pixels.shape[:2]
    return replace(
        frame,
        encoding="mono8" if pixels.ndim == 2 else "rgb8",
        data=pixels.tobytes(),
        width=width,
        height=height,
        made_from=made_from,
    )


def at_working_size(source: Dataset, longest_side_px: int = 0) -> Dataset:
    """The source itself, or its images made smaller.  longest_side_px: 0: chosen by them.

    A camera's first images say little, and it would give others after a restart: of those it is
    the limit alone that counts.     Raises DatasetError for images that are too narrow.
    """
    width, height = source.calibration.width, source.calibration.height
    longer = max(width, height)
    shorter = min(width, height, round(min(width, height) * LONGEST_SIDE_PX / longer))
    if shorter < _LEAST_SHORTER_SIDE_PX:
        raise DatasetError(
            f"{source.name}: images of {width}x{height} px are too narrow for tracking: the "
            f"shorter side needs {_LEAST_SHORTER_SIDE_PX} px where the longer one has "
            f"{LONGEST_SIDE_PX}"
        )
    side = longest_side_px or _side_of(source, longer)
    return SmallerImages(source, side) if side < longer else source


def _side_of(source: Dataset, longer: int) -> int:
    if longer <= LEAST_SIDE_PX or source.is_live:
        return min(longer, LONGEST_SIDE_PX)
    images: list[U8] = []
    for frame in islice(source, 0, _LOOKED_AT * _STEP, _STEP):
        try:
            pixels = decode(frame)
        except BrokenFrame:
            continue
        if pixels.ndim == 3:
            pixels = cast(U8, cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY))
        images.append(resized(pixels, LONGEST_SIDE_PX))
    return working_side(images) if images else min(longer, LONGEST_SIDE_PX)


def _smaller(camera: Calibration, side: int) -> Calibration:
    return at_size(camera, *size_at(camera.width, camera.height, side))


def at_size(camera: Calibration, width: int, height: int) -> Calibration:
    """The camera of resized images; that of depth images, which stay, is as it was."""
    across, down = width / camera.width, height / camera.height
    return replace(
        camera,
        width=width,
        height=height,
        fx=camera.fx * across,
        fy=camera.fy * down,
        cx=(camera.cx + 0.5) * across - 0.5,
        cy=(camera.cy + 0.5) * down - 0.5,
    )

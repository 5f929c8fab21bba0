"""A source whose static regions (borders, overlays) are found and masked: see
``algorithms.image.static_regions``.

A file is looked at ahead, so that its mask holds from the first frame; a camera's mask holds from
the frame that decides it.  Either way a mask travels with its frame and is recorded, so a replay
has the same.
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import cast

import cv2

from pliant.algorithms.arrays import U8
from pliant.algorithms.image.masks import packed
from pliant.algorithms.image.static_regions import StaticMask, StaticRegions
from pliant.datasets.base import BrokenFrame, Dataset, SourceFrame
from pliant.datasets.rectifier import decode

_AHEAD_S = 15.0
"""Seconds of a file that are read before its first frame, or until an overlay can be recognised."""

_PREFIX = "static_"


class StaticMasks:
    """Finds the mask of a stream of frames as they come.   shares: of the image, by kind; 0 of
    those that were found and are not any more."""

    def __init__(self) -> None:
        self.shares: dict[str, float] = {}
        self._regions = StaticRegions()
        self._mask = b""
        self._next = 0

    def masked(self, frame: SourceFrame) -> SourceFrame:
        """The frame, with the mask that holds by now unless it has one of its own."""
        if frame.dropped or frame.mask:
            return frame
        if frame.index >= self._next:
            self.look(frame)
        return replace(frame, mask=self._mask) if self._mask else frame

    def look(self, frame: SourceFrame) -> int:
        """Take a frame as evidence, in order; returns how often the mask has been decided."""
        self._next = frame.index + 1
        if frame.dropped or frame.mask or not self._regions.is_wanted(frame.stamp_ns):
            return self._regions.decisions
        try:
            pixels = decode(frame)
        except BrokenFrame:  # reported when it is rectified
            return self._regions.decisions
        grey = pixels if pixels.ndim == 2 else cast(U8, cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY))
        if self._regions.add(grey, frame.stamp_ns):
            self._take(self._regions.decide((grey.shape[1], grey.shape[0])))
        return self._regions.decisions

    def _take(self, found: StaticMask | None) -> None:
        self._mask = packed(found.used) if found is not None else b""
        self.shares = dict.fromkeys(self.shares, 0.0) | (found.shares if found is not None else {})


class StaticallyMasked:
    """A source with the masks of its static regions."""

    def __init__(self, source: Dataset) -> None:
        self.source = source
        self.calibration = source.calibration
        self.name = source.name
        self.is_live = source.is_live
        self.frame_count = source.frame_count
        self.ground_truth_path = source.ground_truth_path
        self.shares: dict[str, float] = {}

    def __iter__(self) -> Iterator[SourceFrame]:
        masks = StaticMasks()
        if not self.is_live:
            first_ns = None
            for frame in self.source:
                first_ns = frame.stamp_ns if first_ns is None else first_ns
                if masks.look(frame) > 1 or frame.stamp_ns - first_ns > 1e9 * _AHEAD_S:
                    break
        for frame in self.source:
            masked = masks.masked(frame)
            self.shares = masks.shares
            yield masked


def static_counters(dataset: Dataset) -> dict[str, float]:
    """The last static mask of a source, as counters of a service."""
    while not isinstance(dataset, StaticallyMasked):
        inner = getattr(dataset, "source", None)
        if inner is None:
            return {}
        dataset = inner
    return {_PREFIX + kind: share for kind, share in sorted(dataset.shares.items())}


def static_line(counters: Mapping[str, float]) -> str:
    """The line for users on these counters; "" without any."""
    shares = {
        key.removeprefix(_PREFIX): share
        for key, share in counters.items()
        if key.startswith(_PREFIX) and share > 0.0
    }
    if not shares:
        return ""
    kinds = ", ".join(sorted(shares))
    share = 100.0 * sum(shares.values())
    of = f"{share:.0f} %" if share >= 1.0 else f"{share:.1f} %"
    return f"{of} of the image never changes and is masked: {kinds}"

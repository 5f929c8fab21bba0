"""The same frames at several sizes: what each is worked on at, and what its map is worth.

Built-in sequences are rendered at each size, and so sharp at all of them.  Others are enlarged,
which adds no detail, or made smaller; of a size of another shape the middle is cut out.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import cv2

from benchmarks.in_process import run
from benchmarks.table import markdown
from pliant.config import IngestParameters
from pliant.datasets import open_source
from pliant.datasets.base import Dataset, SourceFrame, is_builtin
from pliant.datasets.rectifier import decode
from pliant.datasets.working_size import at_size, at_working_size

_HEADER = (
    *("source", "size", "worked on at", "tracks", "mapped inliers", "ATE, final / online"),
    "times the best",
)


class _Sized:
    """A source whose images have another size."""

    def __init__(self, source: Dataset, width: int, height: int) -> None:
        camera = source.calibration
        scale = max(width / camera.width, height / camera.height)
        self._whole = math.ceil(scale * camera.width), math.ceil(scale * camera.height)
        left, top = (self._whole[0] - width) // 2, (self._whole[1] - height) // 2
        self._part = slice(top, top + height), slice(left, left + width)
        camera = at_size(camera, *self._whole)
        self.calibration = replace(
            camera, width=width, height=height, cx=camera.cx - left, cy=camera.cy - top
        )
        self._source, self.name, self.is_live = source, source.name, False
        self.frame_count, self.ground_truth_path = source.frame_count, source.ground_truth_path

    def __iter__(self) -> Iterator[SourceFrame]:
        for frame in self._source:
            pixels = decode(frame)
            smaller = self._whole[0] < pixels.shape[1]
            how = cv2.INTER_AREA if smaller else cv2.INTER_CUBIC
            pixels = cv2.resize(pixels, self._whole, interpolation=how)[self._part]
            encoding = "mono8" if pixels.ndim == 2 else "rgb8"
            height, width = pixels.shape[:2]
            yield replace(
                frame, encoding=encoding, data=pixels.tobytes(), width=width, height=height
            )


def measure(
    sources: Sequence[str], sizes: Sequence[str], frames: int, overrides: Sequence[str]
) -> Iterator[str]:
    """A table for each source.  sizes: as ``640x480``.  frames: the first of each."""
    for name in sources:
        found = []
        for size in sizes:
            width, height = (int(side) for side in size.split("x"))
            if is_builtin(name):
                source = open_source(
                    f"{name}?frames={frames}&width={width}", IngestParameters(longest_side_px=width)
                )
            else:
                source = open_source(name, IngestParameters(longest_side_px=4096))
            source = at_working_size(_Sized(source, width, height))
            found.append((size, source.calibration, run(source, overrides, frames=frames)))
        best = min(mapped.ate_m for _, _, mapped in found)
        rows = [
            [
                Path(name).name,
                size,
                f"{camera.width}x{camera.height}",
                f"{mapped.tracks:.0f}",
                f"{mapped.inliers:.0f}",
                mapped.both,
                f"{mapped.ate_m / best:.2f}",
            ]
            for size, camera, mapped in found
        ]
        yield markdown(_HEADER, rows)

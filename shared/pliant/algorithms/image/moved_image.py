"""Images whose pixels have been moved: a whole one, or what it shows in a few places.

To move a colour image of 640x480 takes 2.6 ms, and a keyframe needs it where new points are only.
Each pixel is found by itself, so that both have the same bytes.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import cv2
import numpy as np

from pliant.algorithms.arrays import F32, I64, U8

Move: TypeAlias = tuple[F32, F32]
"""(H, W) columns and rows in which the pixels of a new image are seen in the one before."""

_WIDEST = 1024
"""Places in a row: OpenCV has no images of more than 32,767 columns."""


def moved_image(pixels: U8, move: Move) -> U8:
    """The new image of one (H, W) or (H, W, 3), interpolated; its border continues outside."""
    moved = cv2.remap(pixels, *move, cv2.INTER_LINEAR, None, cv2.BORDER_REPLICATE)
    return np.asarray(moved, np.uint8)


@dataclass(frozen=True)
class MovedImage:
    """pixels: (H, W) or (H, W, 3) RGB of the image before.   move: from it; None: it stays."""

    pixels: U8
    move: Move | None = None

    @cached_property
    def whole(self) -> U8:
        """All of the new image."""
        return self.pixels if self.move is None else moved_image(self.pixels, self.move)

    def colours(self, points_px: F32) -> U8:
        """(N, 3) RGB of the pixels of the new image that are nearest to points (N, 2)."""
        height, width = self.pixels.shape[:2]
        nearest = (points_px.astype(np.float64) + 0.5).astype(np.int64)
        columns, rows = np.clip(nearest, 0, (width - 1, height - 1)).T
        found = _pixels_at(self.pixels, self.move, columns, rows)
        return found if found.ndim == 2 else np.repeat(found[:, None], 3, axis=1)


def _pixels_at(pixels: U8, move: Move | None, columns: I64, rows: I64) -> U8:
    """(N,) or (N, 3) pixels of the new image."""
    if move is None or not len(columns):
        return pixels[rows, columns]
    u, v = (each[rows, columns] for each in move)
    shape = (-(-len(u) // _WIDEST), _WIDEST)
    moved = moved_image(pixels, (np.resize(u, shape), np.resize(v, shape)))
    return moved.reshape(-1, *moved.shape[2:])[: len(u)]

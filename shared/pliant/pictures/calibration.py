"""A picture of a calibration: where the board was seen, and the remaining errors."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from pliant.algorithms.arrays import F64, U8

_WIDTH_PX = 900
_BAR_PX = 34
_SHOWN = 0.03
"""Share of the width that an arrow has whose length 95 % of them stay below."""
_INK, _GRID, _DOT, _ARROW = (40, 40, 40), (200, 200, 200), (70, 110, 180), (190, 60, 40)
_SHIFT = 4  # fractional bits of OpenCV's drawing coordinates


@dataclass(frozen=True)
class SeenCorners:
    """One view: (N, 2) px where its corners are seen, and (N, 2) px by how much off they are."""

    points_px: F64
    residuals_px: F64


def coverage(views: Sequence[SeenCorners], width: int, height: int) -> float:
    """The share of the image that lies between the corners of any view."""
    return float((_times_covered(views, width, height) > 0).mean())


def draw_calibration(
    views: Sequence[SeenCorners], width: int, height: int, words: Sequence[str]
) -> U8:
    """(H, W, 3) RGB: left the image with the areas of the views, corners and residuals as arrows;
    right all residuals about their zero; below, the words line by line.
    """
    scale = _WIDTH_PX / width
    times = cv2.resize(
        _times_covered(views, width, height),
        (_WIDTH_PX, round(height * scale)),
        interpolation=cv2.INTER_NEAREST,
    )
    most = max(int(times.max()), 1)
    shade = 255.0 - 70.0 * np.sqrt(times / most)
    left = np.stack([np.where(times > 0, shade - 20.0, 255.0), shade, np.full_like(shade, 255.0)])
    image = np.ascontiguousarray(np.moveaxis(left, 0, 2).astype(np.uint8))
    lengths = np.concatenate([np.hypot(*view.residuals_px.T) for view in views])
    longest = max(float(np.quantile(lengths, 0.95)), 1e-6)
    enlarged = _SHOWN * width / longest
    for view in views:
        for point, off in zip(view.points_px, view.residuals_px, strict=True):
            start = (point + 0.5) * scale
            cv2.line(image, _at(start), _at(start + off * enlarged * scale), _ARROW, 1, 16, _SHIFT)
            cv2.circle(image, _at(start), 2 << _SHIFT, _DOT, -1, 16, _SHIFT)
    right = _scatter(views, image.shape[0], longest)
    both = np.concatenate([image, np.full((image.shape[0], 4, 3), 120, np.uint8), right], axis=1)
    lines = [*words, f"arrows: residuals, enlarged {enlarged:.0f} times"]
    return np.concatenate([both, _bar(lines, both.shape[1])])


def _times_covered(views: Sequence[SeenCorners], width: int, height: int) -> U8:
    """In how many views each block of 4x4 px lies between corners."""
    times = np.zeros((-(-height // 4), -(-width // 4)), np.uint8)
    for view in views:
        mask = np.zeros_like(times)
        hull = cv2.convexHull(((view.points_px + 0.5) / 4.0).astype(np.float32))
        cv2.fillConvexPoly(mask, np.rint(hull).astype(np.int32), (1,))
        times += mask
    return times


def _scatter(views: Sequence[SeenCorners], side: int, longest: float) -> U8:
    """Residuals as dots in a square, with circles at round distances."""
    image = np.full((side, side, 3), 255, np.uint8)
    step = 10.0 ** np.floor(np.log10(longest))
    step *= 1.0 if longest < 2.0 * step else 2.0 if longest < 5.0 * step else 5.0
    reach = 2.0 * longest
    middle = np.array([0.5 * side, 0.5 * side])
    for axis in ((1.0, 0.0), (0.0, 1.0)):
        end = middle * axis
        cv2.line(image, _at(middle - end), _at(middle + end), _GRID, 1, 16, _SHIFT)
    for number in range(1, int(reach / step) + 1):
        radius = number * step / reach * 0.5 * side
        cv2.circle(image, _at(middle), round(radius * (1 << _SHIFT)), _GRID, 1, 16, _SHIFT)
        place = (round(middle[0] + 4), round(middle[1] - radius - 4))
        cv2.putText(image, f"{number * step:g} px", place, 0, 0.45, _INK, 1, 16)
    for off in np.concatenate([view.residuals_px for view in views]):
        if np.abs(off).max() < reach:
            cv2.circle(
                image, _at(middle + off / reach * 0.5 * side), 2 << _SHIFT, _ARROW, -1, 16, _SHIFT
            )
    return image


def _bar(lines: Sequence[str], width: int) -> U8:
    bar = np.full((_BAR_PX * len(lines) + 10, width, 3), 245, np.uint8)
    for number, line in enumerate(lines):
        cv2.putText(bar, line, (12, _BAR_PX * (number + 1) - 8), 0, 0.6, _INK, 1, 16)
    return bar


def _at(point: F64) -> tuple[int, int]:
    x, y = np.rint((point - 0.5) * (1 << _SHIFT)).astype(int).tolist()
    return x, y

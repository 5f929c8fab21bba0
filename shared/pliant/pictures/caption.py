"""A bar of words under a picture, as high as a share of it: readable at every size."""

from functools import lru_cache
from typing import Any

import cv2
import numpy as np

from pliant.algorithms.arrays import U8
from pliant.pictures.movie import GROUND

_HEIGHT, _OF_WIDTH = 0.075, 0.028
_LEAST_PX = 20
_INK = (235, 235, 235)
_TEXT = 0.6
"""Height of the letters with what reaches above and below the line, as a share of the bar's."""
_HERSHEY_PX = 30.0
"""Height of OpenCV's plain letters at scale 1."""
_ENDLESS = (1 << 20, 1)  # a picture in which no line breaks


def with_caption(picture: U8, words: str) -> U8:
    """(H', W', 3) RGB: the picture (H, W, 3), words under it, of even sizes, as codecs want them.

    Words that are too long for the picture are written smaller.
    """
    height, width = picture.shape[:2]
    high = max(_LEAST_PX, round(_HEIGHT * height), round(_OF_WIDTH * width))
    bar = np.full((high + (height + high) % 2, width, 3), GROUND, np.uint8)
    left = round(0.3 * high)
    # Twice as large and shrunk: small letters of a few pixels have soft edges, too.
    large = np.full((2 * len(bar), 2 * width, 3), GROUND, np.uint8)
    size = 2.0 * _TEXT * high
    size *= min(1.0, 2.0 * (width - 2 * left) / max(_width(words, size), 1.0))
    _write(large, words, (2 * left, round(1.0 * high + 0.35 * size)), size)
    bar[:] = cv2.resize(large, bar.shape[1::-1], interpolation=cv2.INTER_AREA)
    whole = np.concatenate([picture, bar])
    return np.ascontiguousarray(whole[:, : width - width % 2])


def _write(canvas: U8, words: str, at: tuple[int, int], size: float) -> None:
    font = _font()
    module: Any = cv2
    if font is not None:
        module.putText(canvas, words, at, _INK, font, round(size), 400)
        return
    thickness = max(1, round(0.06 * size))
    cv2.putText(canvas, words, at, 0, size / _HERSHEY_PX, _INK, thickness, cv2.LINE_AA)


def _width(words: str, size: float) -> float:
    font = _font()
    module: Any = cv2
    if font is not None:
        return float(module.getTextSize(_ENDLESS, words, (0, 0), font, round(size), 400)[2])
    return float(cv2.getTextSize(words, 0, size / _HERSHEY_PX, 1)[0][0])


@lru_cache
def _font() -> Any:
    """OpenCV's own font; None before OpenCV 5, which has plain letters only."""
    module: Any = cv2
    return module.FontFace("sans") if hasattr(module, "FontFace") else None

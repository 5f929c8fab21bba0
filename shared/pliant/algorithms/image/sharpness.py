"""How fine the details of an image are, and the size at which it loses none of them by shrinking.

Detail is what a small Gaussian takes away.  Of a sharp image the pixels show most of what twice as
large ones do; one that was enlarged, defocused or compressed has hardly anything there but noise.
"""

from collections.abc import Sequence
from typing import Any, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from pliant.algorithms.arrays import F32, U8

LONGEST_SIDE_PX = 1280
"""No image is worked on at more than this: tracks grow no better, and everything slower."""
LEAST_SIDE_PX = 640
"""No image is made smaller than this along its longer side."""
MIN_SHARPNESS = 0.43
"""Cameras of 640x480 have 0.45 to 0.65 (a rendered image 0.75); twice enlarged, 0.38."""
_STEP = 2.0**0.5
_BLUR_PX = 0.85
_BLOCK_PX = 16


def working_side(images: Sequence[U8]) -> int:
    """The longer side that images of one camera are worked on at, pixels; never more than theirs.

    images: (H, W) grey, a few of a stream.  The largest size of a ladder of half octaves, from
    LONGEST_SIDE_PX down to LEAST_SIDE_PX, at which the sharpest of them is sharp.
    """
    side = min(max(images[0].shape), LONGEST_SIDE_PX)
    while side / _STEP >= LEAST_SIDE_PX - 1:
        sharpest = max(sharpness(resized(image, side)) for image in images)
        if not 0.0 < sharpest < MIN_SHARPNESS:  # 0: they show nothing that could tell
            break
        side = round(side / _STEP)
    return side


def sharpness(grey: U8) -> float:
    """Detail of an image (H, W) over that of its half size, where it has most, without the noise.

    Noise is what the least detailed of fifty blocks has; half the size has half of it.
    0 where there is nothing but noise.
    """
    image = grey.astype(np.float32)
    halved = cast(F32, cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))
    fine = _block_energies(image, _BLOCK_PX)
    coarse = _block_energies(halved, _BLOCK_PX // 2)
    if not len(fine) or not len(coarse):
        return 0.0
    noise = float(np.quantile(fine, 0.02))
    most_fine = float(np.sort(fine)[len(fine) * 4 // 5 :].mean()) - noise
    most_coarse = float(np.sort(coarse)[len(coarse) * 4 // 5 :].mean()) - 0.25 * noise
    if most_coarse <= noise or most_fine <= 0.0:
        return 0.0
    return (most_fine / most_coarse) ** 0.5


def resized(image: U8, side: int) -> U8:
    """An (H, W) or (H, W, 3) image, resized by areas to a longer side of that many pixels."""
    height, width = image.shape[:2]
    if side >= max(height, width):
        return image
    return cast(U8, cv2.resize(image, size_at(width, height, side), interpolation=cv2.INTER_AREA))


def size_at(width: int, height: int, side: int) -> tuple[int, int]:
    """(width, height) of an image whose longer side has that many pixels."""
    longer = max(width, height)
    return round(width * side / longer), round(height * side / longer)


def _block_energies(image: F32, block: int) -> NDArray[Any]:
    """Mean square of the detail of each block."""
    detail = image - cv2.GaussianBlur(image, (3, 3), _BLUR_PX)
    rows, columns = image.shape[0] // block, image.shape[1] // block
    squares = np.square(detail[: rows * block, : columns * block])
    return squares.reshape(rows, block, columns, block).mean(axis=(1, 3)).ravel()

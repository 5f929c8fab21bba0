"""Parts of images that show nothing of the scene: what moves with the camera, or by itself.

A mask marks the pixels that are used.  It travels as a PNG of one bit a pixel, and is worked
with as the *clearance*: (H, W) float32, how many pixels the nearest that is not used lies away, the
larger of the distances along the two axes; 0 where it is not used itself.
"""

from collections.abc import Callable
from functools import lru_cache

import cv2
import numpy as np

from pliant.algorithms.arrays import F32, U8, BoolArray
from pliant.algorithms.image.decoding import decoded

EDGE_PX = 2
"""So near to what is not used, lens, demosaicing and compression have mixed it in."""

_PNG = [
    *(cv2.IMWRITE_PNG_BILEVEL, 1),
    *(cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_DEFAULT),
    *(cv2.IMWRITE_PNG_COMPRESSION, 6),
]
"""A third of what OpenCV makes by itself, for photographs."""


def packed(used: BoolArray) -> bytes:
    """The mask (H, W) as it travels."""
    pixels = 255 * used.astype(np.uint8)
    return cv2.imencode(".png", pixels, _PNG)[1].tobytes()


def unpacked(data: bytes) -> BoolArray:
    """The mask (H, W) in an image file of one channel.  Raises ValueError if it is none."""
    pixels = decoded(data, cv2.IMREAD_UNCHANGED)
    if pixels is None or pixels.ndim != 2:
        raise ValueError("no image that can be read")
    return np.asarray(pixels) > 0


def scaled(used: BoolArray, size: tuple[int, int]) -> BoolArray:
    """The mask of an image of another size (width, height): used is what is so as a whole.

    Raises ValueError if the aspect is another one, by more than rounding makes.
    """
    height, width = used.shape
    if abs(width * size[1] - height * size[0]) > max(*size, width, height):
        of_image = f"{size[0]}x{size[1]} px"
        raise ValueError(f"{width}x{height} px, another aspect than the image's {of_image}")
    if (width, height) == size:
        return used
    smaller = width > size[0]
    how = cv2.INTER_AREA if smaller else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(255 * used.astype(np.uint8), size, interpolation=how)) == 255


@lru_cache(maxsize=2)
def clearance_in(data: bytes) -> F32 | None:
    """The clearance of a mask that has travelled; None of b"": all is used.

    One array for the same bytes: a mask that stays is unpacked once.  Raises ValueError.
    """
    return clearance_of(unpacked(data)) if data else None


def clearance_of(used: BoolArray) -> F32:
    """The clearance of a mask (H, W)."""
    found = cv2.distanceTransform(used.astype(np.uint8), cv2.DIST_C, 3)
    return np.asarray(found, np.float32)


def filled(image: U8, clearance: F32 | None) -> U8:
    """An image (H, W) whose unused parts are made up smoothly of what is around them.

    There is nothing left to be found there, neither foreign texture nor an edge, at any scale: a
    pyramid of means goes down over what is used, and comes up again, interpolated, where nothing
    is (pull and push: Gortler et al., "The lumigraph", 1996).
    """
    if clearance is None:
        return image
    used = clearance > EDGE_PX
    levels: list[tuple[F32, F32]] = []
    weights = used.astype(np.float32)
    sums = weights * image
    while not weights.all() and max(weights.shape) > 1:
        levels.append((sums, weights))
        size = ((weights.shape[1] + 1) // 2, (weights.shape[0] + 1) // 2)
        sums, weights = (
            np.asarray(cv2.resize(each, size, interpolation=cv2.INTER_AREA), np.float32)
            for each in (sums, weights)
        )
    means = np.divide(sums, weights, out=np.zeros_like(sums), where=weights > 0.0)
    for sums, weights in reversed(levels):
        size = (weights.shape[1], weights.shape[0])
        coarse = cv2.resize(means, size, interpolation=cv2.INTER_LINEAR)
        means = np.divide(sums, weights, out=np.asarray(coarse, np.float32), where=weights > 0.0)
    return np.where(used, image, np.rint(means).astype(np.uint8))


def glaring(image: U8, clearance: F32 | None) -> U8:
    """An image (H, W) whose unused parts are white, as highlights are, which surfels leave out."""
    if clearance is None:
        return image
    return np.where(clearance > EDGE_PX, image, np.uint8(255))


def mask_image(used: BoolArray, view: Callable[[U8], U8]) -> U8:
    """A mask (H, W) as an image, white where all is used that a view of images makes a pixel of."""
    return np.where(view(255 * used.astype(np.uint8)) == 255, np.uint8(255), np.uint8(0))

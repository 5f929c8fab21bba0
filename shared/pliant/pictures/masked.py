"""Images as they are shown where a part of them is not used."""

import numpy as np

from pliant.algorithms.arrays import U8, BoolArray
from pliant.algorithms.image.masks import unpacked

_BRIGHTNESS = 0.3
"""Brightness of masked parts, which stay visible."""


def dimmed(image: U8, used: BoolArray | None) -> U8:
    """An image (H, W) or (H, W, 3), dark where its mask (H, W) has it ignored; None: nowhere."""
    if used is None:
        return image
    used = used if image.ndim == 2 else used[:, :, None]
    return np.where(used, image, np.round(image * np.float32(_BRIGHTNESS)).astype(np.uint8))


def dimmed_by(image: U8, mask: bytes) -> U8:
    """The same, by a mask that has travelled; one of another size is passed over."""
    used = unpacked(mask) if mask else None
    return image if used is not None and used.shape != image.shape[:2] else dimmed(image, used)

"""Colours that leave the grey image as it is: cameras that are grey and in colour see the same.

A colour is the excess of its red and blue over its grey value, as shares of that.
"""

import numpy as np

from pliant.algorithms.arrays import F32, F64, U8
from pliant.rendering.solids import Vector

LEAST, MOST = -1.0, 0.8
"""Shares of red and blue beyond which a colour would not fit into eight bits."""

# OpenCV's luma, in steps of 2**-15.
_RED, _GREEN, _BLUE = 9798, 19235, 3735
_HALF, _SHIFT = 1 << 14, 15
_ROOM = 1.25
"""How much of what is left to white a colour may take: near it there are none."""


def shares(tint: Vector) -> tuple[float, float]:
    """How much more red and blue than grey a tint (red, green, blue) has."""
    red, green, blue = tint
    luma = 0.299 * red + 0.587 * green + 0.114 * blue
    more = np.clip((red / luma - 1.0, blue / luma - 1.0), LEAST, MOST)
    return float(more[0]), float(more[1])


def colour_image(grey: U8, red: F32 | F64, blue: F32 | F64) -> U8:
    """(H, W, 3) RGB of which ``cv2.cvtColor`` makes ``grey`` (H, W), exactly.

    red, blue: (H, W) shares, LEAST to MOST.  Less so towards white, so that nothing clips.
    """
    g = np.arange(256.0)
    # The lesser of both, with a round corner.
    with np.errstate(divide="ignore"):
        strength = (g**-3.0 + (_ROOM * (255.0 - g)) ** -3.0) ** (-1.0 / 3.0)
    weight = strength.astype(np.float32)[grey]
    r, b = (
        np.rint(grey + share * weight).astype(np.int32)
        for share in (np.clip(red, LEAST, MOST), np.clip(blue, LEAST, MOST))
    )
    # The least green that rounds to the grey value: one step of it is less than one of grey.
    rest = (grey.astype(np.int32) << _SHIFT) - _HALF - _RED * r - _BLUE * b
    return np.stack([r, -(-rest // _GREEN), b], axis=2).clip(0, 255).astype(np.uint8)

"""Images that show nothing, by their grey values."""

import numpy as np

from pliant.algorithms.arrays import U8

BLACK, WHITE, FLAT = "the frame is black", "the frame is overexposed", "the frame is flat"
FLAWS = (BLACK, WHITE, FLAT)
_SAMPLED = 64
"""Rows and columns that tell, at most."""
_OUTLIERS = 0.02
"""Share of the pixels that may be darker, and that may be brighter."""
_LEAST_RANGE, _DARK, _BRIGHT = 8, 32, 224
"""Grey values: less range than noise and compression have; below the first nothing is lit."""


def flaw_of(grey: U8) -> str:
    """Why an image (H, W) shows nothing: black, overexposed or flat; "" where it shows something.

    Its noise and a few bright or dark pixels, of a time stamp or of defects, change nothing.
    """
    rows, columns = (-(-side // _SAMPLED) for side in grey.shape)
    low, high = np.quantile(grey[::rows, ::columns], (_OUTLIERS, 1.0 - _OUTLIERS))
    if high - low >= _LEAST_RANGE:
        return ""
    if high < _DARK:
        return BLACK
    return WHITE if low > _BRIGHT else FLAT

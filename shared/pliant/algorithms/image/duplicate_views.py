"""Which views of a scene are to be kept, where of two that show nearly the same one is blurred."""

import numpy as np

from pliant.algorithms.arrays import F64, BoolArray

SHARPER = 1.1
"""An image as many times as sharp as another is clearly sharper."""
_SHIFT = 0.05
"""Share of the width by which points move between near-duplicate views, in the median."""
_SHARED = 0.5
"""Share of the points of either view that near-duplicates both see."""


def sharp_views(pixels: F64, sharpness: F64, width: int) -> BoolArray:
    """(N,) views without those of which a clearly sharper near-duplicate is kept.

    pixels: (N, P, 2) where each view sees each point, NaN where it does not.    sharpness: (N,)
    comparable between near-duplicates, for they show the same.    width: of the images, pixels.
    The sharpest are decided first, so no view is dropped for one that is dropped itself.
    """
    kept = np.zeros(len(pixels), np.bool_)
    for view in np.argsort(-sharpness, kind="stable").tolist():
        rivals = np.flatnonzero(kept & (sharpness > SHARPER * sharpness[view]))
        kept[view] = not _near_duplicates(pixels[rivals], pixels[view], width).any()
    return kept


def _near_duplicates(others: F64, one: F64, width: int) -> BoolArray:
    """(M,) which of the views (M, P, 2) show nearly the same as one of them (P, 2)."""
    shifts = np.linalg.norm(others - one, axis=2)
    there, here = np.isfinite(others[..., 0]).sum(axis=1), np.isfinite(one[:, 0]).sum()
    shared = np.isfinite(shifts).sum(axis=1)
    near = (shifts < _SHIFT * width).sum(axis=1) > 0.5 * shared
    return near & (shared >= _SHARED * np.maximum(there, here))

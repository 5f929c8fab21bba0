"""Colours of strain: blue is compressed, grey unchanged, red stretched."""

import numpy as np

from pliant.algorithms.arrays import F64, U8

_COMPRESSED, _UNCHANGED, _STRETCHED = (
    np.array(rgb, np.float64) for rgb in ((45, 105, 235), (205, 205, 200), (225, 50, 35))
)
_NEARLY_ALL = 0.95
_LEAST = 0.01


def strain_scale(values: F64) -> float:
    """Strain with the full colour: 95 % of the finite values have less, but 1 % at least."""
    known = np.abs(values[np.isfinite(values)])
    return max(float(np.quantile(known, _NEARLY_ALL)) if len(known) else 0.0, _LEAST)


def strain_colours(values: F64, full: float) -> U8:
    """(N, 3) RGB of (N,) strains.  full: strain with the full colour, either way."""
    share = np.clip(np.nan_to_num(values) / full, -1.0, 1.0)[:, None]
    towards = np.where(share > 0.0, _STRETCHED, _COMPRESSED)
    return np.round(_UNCHANGED + np.abs(share) * (towards - _UNCHANGED)).astype(np.uint8)

"""Colours of tracks by age, in a few steps: viewers draw groups faster than single points."""

from collections.abc import Iterator

import numpy as np

from pliant.algorithms.arrays import I32, I64, U8
from pliant.pictures.overlay import OLDEST, palette

_STEPS = 8
_PALETTE = palette(_STEPS)


def age_buckets(ages: I32) -> Iterator[tuple[I64, tuple[int, int, int]]]:
    """Rows of tracks of about one age with their RGB colour, blue (new) to orange (old)."""
    share = np.log1p(ages) / np.log1p(OLDEST)
    bucket = np.minimum(share * _STEPS, _STEPS - 1).astype(np.int64)
    for i in range(_STEPS):
        rows = np.flatnonzero(bucket == i)
        if rows.size:
            yield rows, _PALETTE[i]


def track_colours(ages: I32) -> U8:
    """(N, 3) RGB of each track."""
    colours = np.zeros((len(ages), 3), np.uint8)
    for rows, colour in age_buckets(ages):
        colours[rows] = colour
    return colours

"""Of tracks that have run together the oldest stays."""

import numpy as np
from numpy.typing import NDArray

from pliant.algorithms.arrays import F32, I32
from pliant.algorithms.kernel import fast_kernel, leaf_kernel
from pliant.algorithms.tracking.pixel_bits import any_around, get_bit, no_bits, set_bit
from pliant.algorithms.tracking.track_table import ALIVE, U, V


@fast_kernel
def remove_doubles(count: int, floats: F32, ints: I32, owners: I32) -> None:
    """Clear ALIVE of tracks within 1 px of an older one.

    owners: (H, W) scratch.  All living tracks lie a pixel or more inside.  Hardly any has another
    beside it.  A bit for every pixel, which stays in cache as ``owners`` does not, finds those
    that do; only they are looked at closely.
    """
    height, width = owners.shape
    taken, crowded = no_bits(height, width), no_bits(height, width)
    found = False
    for i in range(count):
        if ints[i, ALIVE] == 0:
            continue
        at = _pixel(floats[i], width)
        if any_around(taken, at, width):
            found = True
            for row in range(-1, 2):
                for column in range(-1, 2):
                    set_bit(crowded, at + row * width + column)
        set_bit(taken, at)
    if found:
        taken[:] = np.uint64(0)
        _keep_oldest(count, floats, ints, crowded, taken, owners.reshape(-1), width)


@leaf_kernel
def _keep_oldest(
    count: int,
    floats: F32,
    ints: I32,
    crowded: NDArray[np.uint64],
    taken: NDArray[np.uint64],
    owners: I32,
    width: int,
) -> None:
    """Compare the tracks of crowded pixels with those around.  taken: bits, none of them set."""
    for i in range(count):
        at = _pixel(floats[i], width)
        if ints[i, ALIVE] == 0 or not get_bit(crowded, at):
            continue
        for row in range(-1, 2):
            for column in range(-1, 2):
                beside = at + row * width + column
                if not get_bit(taken, beside):
                    continue
                other = owners[beside]
                du = floats[other, U] - floats[i, U]
                dv = floats[other, V] - floats[i, V]
                if du * du + dv * dv < np.float32(1.0):
                    ints[i, ALIVE] = 0
        if ints[i, ALIVE] == 1:
            owners[at] = i
            set_bit(taken, at)


@leaf_kernel
def _pixel(track: F32, width: int) -> int:
    half = np.float32(0.5)
    return int(track[V] + half) * width + int(track[U] + half)

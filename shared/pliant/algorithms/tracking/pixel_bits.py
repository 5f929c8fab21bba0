"""A bit for every pixel of an image: small enough to stay in cache where a byte is not."""

import numpy as np
from numpy.typing import NDArray

from pliant.algorithms.kernel import fast_kernel, leaf_kernel

MAX_REACH = 31
"""Pixels: a row of a square of bits fits into one word."""


@fast_kernel
def no_bits(height: int, width: int) -> NDArray[np.uint64]:
    """Bits of an image, by flat pixel in words of 64, and one word more; none is set."""
    return np.zeros(height * width // 64 + 2, np.uint64)


@leaf_kernel
def get_bit(bits: NDArray[np.uint64], at: int) -> bool:
    """Whether the bit of a flat pixel is set."""
    return bool((bits[at >> 6] >> np.uint64(at & 63)) & np.uint64(1))


@leaf_kernel
def set_bit(bits: NDArray[np.uint64], at: int) -> None:
    """Set the bit of a flat pixel."""
    bits[at >> 6] |= np.uint64(1) << np.uint64(at & 63)


@leaf_kernel
def any_around(bits: NDArray[np.uint64], at: int, width: int) -> bool:
    """Whether a bit of a pixel or of its eight neighbours is set."""
    seen = np.uint64(0)
    for row in range(-1, 2):
        first = at + row * width - 1
        shift = np.uint64(first & 63)
        # The next word's bits come in from above; shifted twice, as by 64 is undefined.
        high = (bits[(first >> 6) + 1] << np.uint64(1)) << (np.uint64(63) - shift)
        seen |= (bits[first >> 6] >> shift) | high
    return bool(seen & np.uint64(7))


@leaf_kernel
def set_square(
    bits: NDArray[np.uint64], x: int, y: int, reach: int, height: int, width: int
) -> None:
    """Set the pixels of the image within ``reach`` (<= MAX_REACH) of (x, y) in both directions."""
    first, last = max(x - reach, 0), min(x + reach, width - 1)
    row_bits = (np.uint64(2) << np.uint64(last - first)) - np.uint64(1)
    for row in range(max(y - reach, 0), min(y + reach, height - 1) + 1):
        at = row * width + first
        shift = np.uint64(at & 63)
        bits[at >> 6] |= row_bits << shift
        bits[(at >> 6) + 1] |= (row_bits >> np.uint64(1)) >> (np.uint64(63) - shift)

"""Images as kernels read them, and smaller ones by averaging blocks, in floats.

Half scale: ``u' = (u + 0.5) / 2 - 0.5``; a sixth likewise with 6.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pliant.algorithms.arrays import F32
from pliant.compiler.kernel import fast_kernel


class Pixels(NamedTuple):
    """An image as kernels read it: float32 values, flat (height * width)."""

    values: F32
    width: int
    height: int


def pixels_of(image: F32) -> Pixels:
    """A contiguous image (H, W) as kernels read it."""
    return Pixels(image.reshape(-1), image.shape[1], image.shape[0])


@fast_kernel
def halve(image: NDArray[Any]) -> F32:
    """Average 2x2 blocks: (H, W) grey levels to (H // 2, W // 2) float32."""
    height, width = image.shape[0] // 2, image.shape[1] // 2
    half = np.empty((height, width), np.float32)
    quarter = np.float32(0.25)
    for y in range(height):
        above, below, out = image[2 * y], image[2 * y + 1], half[y]
        for x in range(width):
            out[x] = quarter * (
                np.float32(above[2 * x])
                + np.float32(above[2 * x + 1])
                + np.float32(below[2 * x])
                + np.float32(below[2 * x + 1])
            )
    return half


@fast_kernel
def shrink(image: NDArray[Any], factor: int) -> F32:
    """Average blocks of factor x factor pixels: (H, W) to (H // factor, W // factor) float32."""
    height, width = image.shape[0] // factor, image.shape[1] // factor
    small = np.empty((height, width), np.float32)
    column_sums = np.empty(width * factor, np.float32)
    scale = np.float32(1.0) / np.float32(factor * factor)
    for y in range(height):
        column_sums[:] = 0.0
        for row in range(factor):
            source = image[y * factor + row]
            for x in range(width * factor):
                column_sums[x] += np.float32(source[x])
        for x in range(width):
            total = np.float32(0.0)
            for column in range(factor):
                total += column_sums[x * factor + column]
            small[y, x] = total * scale
    return small

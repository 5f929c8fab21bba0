"""Points drawn as discs, the nearest before the others."""

import math

import numpy as np

from pliant.algorithms.arrays import F32, F64, U8
from pliant.compiler.kernel import kernel


def draw_discs(centres_px: F64, depths: F64, radii_px: F64, colours: U8, image: F32) -> F32:
    """Draw on an image (H, W, 3); returns the depth (H, W) of what was drawn, inf elsewhere.

    centres_px: (N, 2).    depths: (N,).    radii_px: (N,): a pixel is covered whose centre is no
    farther from the pixel in which the disc has its own.    colours: (N, 3).
    """
    nearest = np.full(image.shape[:2], np.inf)
    _draw(centres_px, depths, radii_px, colours.astype(np.float32), image, nearest)
    return nearest.astype(np.float32)


@kernel
def _draw(centres: F64, depths: F64, radii: F64, colours: F32, image: F32, nearest: F64) -> None:
    height, width = nearest.shape
    for row in range(len(depths)):
        u, v = math.floor(centres[row, 0] + 0.5), math.floor(centres[row, 1] + 0.5)
        radius = radii[row]
        span = int(radius)
        if u + span < 0 or v + span < 0 or u - span >= width or v - span >= height:
            continue
        for y in range(max(0, int(v) - span), min(height - 1, int(v) + span) + 1):
            for x in range(max(0, int(u) - span), min(width - 1, int(u) + span) + 1):
                square = (x - u) * (x - u) + (y - v) * (y - v)
                if square <= radius * radius and depths[row] <= nearest[y, x]:
                    nearest[y, x] = depths[row]
                    for k in range(3):
                        image[y, x, k] = colours[row, k]

"""The pyramid of a frame, level 0 being the image itself, as kernels read it."""

import numpy as np

from pliant.algorithms.arrays import F32, U8
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.image.pixels import halve
from pliant.algorithms.kernel import fast_kernel
from pliant.algorithms.surfels.sampling import Level, make_level


@fast_kernel
def smooth(image: U8) -> F32:
    """Binomial 3x3 blur of (H, W) grey levels.

    Interpolation between pixels blurs as well, by as much as it is off the pixel centres.  Where
    the noise is already smooth that changes little; on a raw image the cost would have its dips
    where samples fall between pixels, and not where the texture fits.
    """
    height, width = image.shape
    out = np.empty((height, width), np.float32)
    rows = np.empty(width, np.float32)
    quarter, half = np.float32(0.25), np.float32(0.5)
    for y in range(height):
        above, here = image[max(y - 1, 0)], image[y]
        below = image[min(y + 1, height - 1)]
        for x in range(width):
            rows[x] = (
                quarter * np.float32(above[x])
                + half * np.float32(here[x])
                + quarter * np.float32(below[x])
            )
        target = out[y]
        for x in range(1, width - 1):
            target[x] = quarter * rows[x - 1] + half * rows[x] + quarter * rows[x + 1]
        target[0] = np.float32(0.75) * rows[0] + quarter * rows[min(1, width - 1)]
        target[width - 1] = np.float32(0.75) * rows[width - 1] + quarter * rows[max(width - 2, 0)]
    return out


def samples_of(side: int, stride: int) -> int:
    """Samples along an edge of a patch of at least ``side`` pixels, ``stride`` pixels apart."""
    return 2 * ((side // 2 + stride - 1) // stride) + 1


_SPARSE_STRIDE_PX = 2


def make_pyramid(image: U8, camera: PinholeCamera, levels: int, side: int) -> list[Level]:
    """``levels`` levels, each half the size of the one before.

    image: (H, W) uint8.  Half scale: ``u' = (u + 0.5) / 2 - 0.5``.  A patch has ``side`` pixels of
    every level along an edge, so that one of the coarsest level covers most of the scene.  Its
    samples are two pixels apart at every second level: two levels share each distance of samples
    in the image, 1, 4, 4, 16 pixels, which is time saved where it is missed least.
    """
    out: list[Level] = []
    pixels = smooth(image)
    for level in range(levels):
        scale = float(2**level)
        cx, cy = (camera.cx + 0.5) / scale - 0.5, (camera.cy + 0.5) / scale - 0.5
        apart = _SPARSE_STRIDE_PX if level % 2 else 1
        focal = camera.fx / scale, camera.fy / scale
        out.append(make_level(pixels, *focal, cx, cy, samples_of(side, apart), apart))
        pixels = halve(pixels)
    return out


def usable_levels(width: int, height: int, side: int, wanted: int) -> int:
    """How many levels an image is large enough for: two patches must fit into the coarsest."""
    levels = 1
    while levels < wanted and min(width, height) >> levels >= 2 * side:
        levels += 1
    return levels

"""The pyramid of a frame, and the grey levels of a surfel's patch in it (DSDT, Eq. 5).

A sample needs four pixels.  They lie side by side in one 64-bit word (``pack``), so that a sample
is one load.  Coordinates, loads and interpolation are loops of their own over all samples: all but
the loads are vector arithmetic.  One loop that does everything is several times slower.

A surfel in the camera frame is a row of POSE_FLOATS numbers: position X, tangents A and B (the
columns of R J0, metres per unit of normalised coordinate), F as (f11, f12, f22), gain and bias.
Gain and bias act on grey levels from which the template's mean has been taken.
"""

from typing import NamedTuple

import numpy as np

from pliant.algorithms.arrays import F32, F64, U8, U32, U64
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.image.pixels import halve
from pliant.compiler.kernel import fast_kernel, kernel

X, A, B, F, GAIN, BIAS, POSE_FLOATS = 0, 3, 6, 9, 12, 13, 14
"""Where the parts of a surfel's row begin, and its length."""

INVALID = 1.0e9
"""Grey level of a sample outside of the image or on a highlight: it is saturated for sure."""

_ONE = 256.0
"""Grey level 1 in a packed pixel."""

MARGIN = np.float32(0.005)
"""A sample this far outside of the image, in pixels, is still inside."""

_LARGEST = 1e9
"""No entry of a homography is larger in any scene: metres times pixels."""

MIN_DEPTH_SHARE = 0.05
"""No corner of a patch may come nearer than this share of its centre's depth."""

_SPARSE_STRIDE_PX = 2


class Level(NamedTuple):
    """One level of an image pyramid, as kernels read it."""

    pixels: F32  # (H, W) grey levels
    quads: U64  # (H * W,) each pixel with those to its right, below and below right, see ``pack``
    width: int
    height: int
    fx: float  # intrinsics of this level, pixels
    fy: float
    cx: float
    cy: float
    step_u: float  # distance of neighbouring grid points, normalised coordinates
    step_v: float
    side: int  # samples along an edge of a patch


def make_level(
    pixels: F32, fx: float, fy: float, cx: float, cy: float, side: int, stride: int = 1
) -> Level:
    """A level of (H, W) grey levels from 0 to 255, with intrinsics in its own pixels.

    side, stride: a patch has side x side samples, ``stride`` pixels apart.
    """
    height, width = pixels.shape
    steps = stride / fx, stride / fy
    return Level(pixels, pack(pixels), width, height, fx, fy, cx, cy, *steps, side)


@kernel
def pack(image: F32) -> U64:
    """(H * W,) words of four pixels, 16 bits each, the least: itself, right, below, below right.

    image: (H, W) grey levels from 0 to 255, kept to 1/256: what the first levels of a pyramid of
    8 bit images are multiples of.  The last row and column have no such four, and are 0.
    """
    height, width = image.shape
    out = np.zeros(height * width, np.uint64)
    above, below = np.empty(width, np.uint64), np.empty(width, np.uint64)
    _fixed_point(image[0], above)
    for row in range(height - 1):
        _fixed_point(image[row + 1], below)
        target = out[row * width : (row + 1) * width]
        for k in range(width - 1):
            high = below[k] << np.uint64(32) | below[k + 1] << np.uint64(48)
            target[k] = above[k] | above[k + 1] << np.uint64(16) | high
        above, below = below, above
    return out


@fast_kernel
def _fixed_point(row: F32, out: U64) -> None:
    for k in range(len(out)):
        out[k] = np.uint64(np.int32(row[k] * np.float32(_ONE) + np.float32(0.5)))


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


class Grid(NamedTuple):
    """The symmetric grid of a patch, and room for its samples."""

    side: int  # samples along an edge
    i: F32  # (side * side,) column, 0 in the middle
    j: F32  # (side * side,) row, 0 in the middle
    x: F32  # where they fall in the image, pixels
    y: F32
    above: U32  # the pixel above and left
    quads: U64  # the four pixels around
    values: F32  # grey levels


def make_grid(side: int) -> Grid:
    """A grid of side x side samples one pixel apart; side is odd."""
    half, n = side // 2, side * side
    j, i = np.mgrid[-half : half + 1, -half : half + 1].astype(np.float32)
    x, y, values = (np.zeros(n, np.float32) for _ in range(3))
    above, quads = np.zeros(n, np.uint32), np.zeros(n, np.uint64)
    return Grid(side, i.ravel().copy(), j.ravel().copy(), x, y, above, quads, values)


@fast_kernel(inline=True)
def homography(pose: F64, level: Level, out: F64) -> bool:
    """The 9 numbers, row by row, that map the grid (i, j, 1) to homogeneous pixels.

    Returns whether the whole patch of any size up to 64 px lies in front of the camera, and shows
    its front: from behind it would be its mirror image.
    """
    for k in range(3):
        a, b = pose[A + k], pose[B + k]
        out[3 * k] = level.step_u * (pose[F] * a + pose[F + 1] * b)
        out[3 * k + 1] = level.step_v * (pose[F + 1] * a + pose[F + 2] * b)
        out[3 * k + 2] = pose[X + k]
    for k in range(3):
        z = out[6 + k]
        out[k] = level.fx * out[k] + level.cx * z
        out[3 + k] = level.fy * out[3 + k] + level.cy * z
    largest = 0.0
    for k in range(9):
        largest = max(largest, abs(out[k]))
    front = (
        out[0] * (out[4] * out[8] - out[5] * out[7])
        - out[1] * (out[3] * out[8] - out[5] * out[6])
        + out[2] * (out[3] * out[7] - out[4] * out[6])
    )
    return out[8] > 0.0 and front > 0.0 and largest < _LARGEST


@fast_kernel(inline=True)
def sample_patch(h: F64, level: Level, grid: Grid, highlight: float) -> bool:
    """Fill ``grid.values`` with bilinear grey levels; INVALID outside and above ``highlight``.

    h: from ``homography``.  Returns False, and fills nothing, when the patch is not wholly in
    front of the camera.
    """
    half = grid.side // 2
    nearest = h[8] - half * (abs(h[6]) + abs(h[7]))
    if not nearest > MIN_DEPTH_SHARE * h[8]:
        return False
    # Just short of the last pixel, so that the pixel to the right is there as well.
    right, bottom = np.float32(level.width - 1.001), np.float32(level.height - 1.001)
    # The upper two pixels of a sample, then the lower two.
    halves = grid.quads.view(np.uint32)
    _coordinates(h, grid.i, grid.j, grid.x, grid.y)
    if _wholly_inside(grid.x, grid.y, grid.side, right, bottom):
        _pixels_inside(grid.x, grid.y, np.uint32(level.width), grid.above)
        _load(level.quads, grid.above, grid.quads)
        _interpolate_inside(grid.x, grid.y, halves, np.float32(highlight), grid.values)
        return True
    _pixels(grid.x, grid.y, right, bottom, np.uint32(level.width), grid.above)
    _load(level.quads, grid.above, grid.quads)
    _interpolate(grid.x, grid.y, right, bottom, halves, np.float32(highlight), grid.values)
    return True


@fast_kernel(inline=True)
def _wholly_inside(x: F32, y: F32, side: int, right: np.float32, bottom: np.float32) -> bool:
    """Whether the corners lie in the image: in front of the camera a square stays convex."""
    zero, last = np.float32(0.0), side * side - 1
    for k in (0, side - 1, last - side + 1, last):
        if not ((x[k] >= zero) & (y[k] >= zero) & (x[k] < right) & (y[k] < bottom)):
            return False
    return True


@fast_kernel
def _coordinates(h: F64, i: F32, j: F32, x: F32, y: F32) -> None:
    h0, h1, h2 = np.float32(h[0]), np.float32(h[1]), np.float32(h[2])
    h3, h4, h5 = np.float32(h[3]), np.float32(h[4]), np.float32(h[5])
    h6, h7, h8 = np.float32(h[6]), np.float32(h[7]), np.float32(h[8])
    one = np.float32(1.0)
    for k in range(len(i)):
        w = one / (h6 * i[k] + h7 * j[k] + h8)
        x[k] = (h0 * i[k] + h1 * j[k] + h2) * w
        y[k] = (h3 * i[k] + h4 * j[k] + h5) * w


@fast_kernel
def _pixels(
    x: F32, y: F32, right: np.float32, bottom: np.float32, width: np.uint32, out: U32
) -> None:
    zero = np.float32(0.0)
    for k in range(len(out)):
        # Written so that what is not a number ends at a valid pixel.
        u = x[k] if x[k] > zero else zero
        v = y[k] if y[k] > zero else zero
        u = u if u < right else right
        v = v if v < bottom else bottom
        out[k] = np.uint32(np.int32(v)) * width + np.uint32(np.int32(u))


@fast_kernel
def _load(quads: U64, index: U32, out: U64) -> None:
    for k in range(len(out)):
        out[k] = quads[index[k]]


@fast_kernel
def _pixels_inside(x: F32, y: F32, width: np.uint32, out: U32) -> None:
    for k in range(len(out)):
        out[k] = np.uint32(np.int32(y[k])) * width + np.uint32(np.int32(x[k]))


@fast_kernel
def _interpolate(
    x: F32, y: F32, right: np.float32, bottom: np.float32, halves: U32, highlight: np.float32,
    out: F32,
) -> None:  # fmt: skip
    zero, outside = np.float32(0.0), np.float32(INVALID)
    for k in range(len(out)):
        u, v = x[k], y[k]
        inside = (u > -MARGIN) & (v > -MARGIN) & (u < right + MARGIN) & (v < bottom + MARGIN)
        u = u if u > zero else zero
        v = v if v > zero else zero
        u = u if u < right else right
        v = v if v < bottom else bottom
        value = _mixed(halves[2 * k], halves[2 * k + 1], u, v)
        out[k] = value if inside & (value <= highlight) else outside


@fast_kernel
def _interpolate_inside(x: F32, y: F32, halves: U32, highlight: np.float32, out: F32) -> None:
    outside = np.float32(INVALID)
    for k in range(len(out)):
        value = _mixed(halves[2 * k], halves[2 * k + 1], x[k], y[k])
        out[k] = value if value <= highlight else outside


@fast_kernel(inline=True)
def _mixed(upper: np.uint32, lower: np.uint32, u: np.float32, v: np.float32) -> np.float32:
    """Bilinear grey level of two rows of two packed pixels."""
    mask, shift = np.uint32(0xFFFF), np.uint32(16)
    across, down = u - np.float32(np.int32(u)), v - np.float32(np.int32(v))
    p, q = np.float32(np.int32(upper & mask)), np.float32(np.int32(upper >> shift))
    r, s = np.float32(np.int32(lower & mask)), np.float32(np.int32(lower >> shift))
    top = p + across * (q - p)
    return np.float32(1.0 / _ONE) * (top + down * (r + across * (s - r) - top))

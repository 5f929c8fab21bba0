"""Where the grid of a surfel falls in an image, and the grey levels there (DSDT, Eq. 5).

Coordinates and gather are two loops over all samples: the first is vector arithmetic, the second
is loads alone.  One loop that does both is several times slower.

A surfel in the camera frame is a row of POSE_FLOATS numbers: position X, tangents A and B (the
columns of R J0, metres per unit of normalised coordinate), F as (f11, f12, f22), gain and bias.
Gain and bias act on grey levels from which the template's mean has been taken.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pliant.algorithms.arrays import F32, F64
from pliant.algorithms.kernel import fast_kernel, kernel

X, A, B, F, GAIN, BIAS, POSE_FLOATS = 0, 3, 6, 9, 12, 13, 14
"""Where the parts of a surfel's row begin, and its length."""

INVALID = 1.0e9
"""Grey level of a sample outside of the image or on a highlight: it is saturated for sure."""

_LARGEST = 1e9
"""No entry of a homography is larger in any scene: metres times pixels."""

MIN_DEPTH_SHARE = 0.05
"""No corner of a patch may come nearer than this share of its centre's depth."""


class Level(NamedTuple):
    """One level of an image pyramid, as kernels read it."""

    pixels: F32  # (H * W,) grey levels
    width: int
    height: int
    fx: float  # intrinsics of this level, pixels
    fy: float
    cx: float
    cy: float
    step_u: float  # distance of neighbouring grid points, normalised coordinates
    step_v: float


class Grid(NamedTuple):
    """The symmetric grid of a patch, and room for its samples."""

    side: int  # samples along an edge
    i: F32  # (side * side,) column, 0 in the middle
    j: F32  # (side * side,) row, 0 in the middle
    above: NDArray[np.uint32]  # the pixel above and left
    across: F32  # how far to the right of it, 0 to 1
    down: F32  # how far below
    valid: F32  # 1 inside of the image, else 0
    values: F32  # grey levels


def make_grid(side: int) -> Grid:
    """A grid of side x side samples one pixel apart; side is odd."""
    half = side // 2
    j, i = np.mgrid[-half : half + 1, -half : half + 1].astype(np.float32)
    zeros = np.zeros((5, side * side), np.float32)
    return Grid(
        side, i.ravel().copy(), j.ravel().copy(), zeros[0].astype(np.uint32),
        zeros[1].copy(), zeros[2].copy(), zeros[3].copy(), zeros[4].copy(),
    )  # fmt: skip


@fast_kernel
def homography(pose: F64, level: Level, out: F64) -> bool:
    """The 9 numbers, row by row, that map the grid (i, j, 1) to homogeneous pixels.

    Returns whether the whole patch of any size up to 64 px lies in front of the camera.
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
    return out[8] > 0.0 and largest < _LARGEST


@fast_kernel
def sample_patch(h: F64, level: Level, grid: Grid, highlight: float) -> bool:
    """Fill ``grid.values`` with bilinear grey levels; INVALID outside and above ``highlight``.

    h: from ``homography``.  Returns False, and fills nothing, when the patch is not wholly in
    front of the camera.
    """
    half = grid.side // 2
    nearest = h[8] - half * (abs(h[6]) + abs(h[7]))
    if not nearest > MIN_DEPTH_SHARE * h[8]:
        return False
    _coordinates(h, level, grid)
    _gather(level, grid, np.float32(highlight))
    return True


@fast_kernel
def _coordinates(h: F64, level: Level, grid: Grid) -> None:
    h0, h1, h2 = np.float32(h[0]), np.float32(h[1]), np.float32(h[2])
    h3, h4, h5 = np.float32(h[3]), np.float32(h[4]), np.float32(h[5])
    h6, h7, h8 = np.float32(h[6]), np.float32(h[7]), np.float32(h[8])
    one, zero = np.float32(1.0), np.float32(0.0)
    # Just short of the last pixel, so that the pixel to the right is there as well.
    right, bottom = np.float32(level.width - 1.001), np.float32(level.height - 1.001)
    width = np.uint32(level.width)
    for k in range(len(grid.i)):
        i, j = grid.i[k], grid.j[k]
        w = one / (h6 * i + h7 * j + h8)
        x = (h0 * i + h1 * j + h2) * w
        y = (h3 * i + h4 * j + h5) * w
        # Written so that what is not a number ends at a valid pixel.
        u = x if x > zero else zero
        v = y if y > zero else zero
        u = u if u < right else right
        v = v if v < bottom else bottom
        column, row = np.int32(u), np.int32(v)
        grid.above[k] = np.uint32(row) * width + np.uint32(column)
        grid.across[k] = u - np.float32(column)
        grid.down[k] = v - np.float32(row)
        grid.valid[k] = one if abs(x - u) + abs(y - v) < np.float32(0.01) else zero


@kernel
def _gather(level: Level, grid: Grid, highlight: np.float32) -> float:
    """Interpolate.  The sum, in order, keeps LLVM from gather instructions, which are slower."""
    pixels, width = level.pixels, np.uint64(level.width)
    one = np.uint64(1)
    values, across, down, valid = grid.values, grid.across, grid.down, grid.valid
    index = grid.above
    outside = np.float32(INVALID)
    total = np.float32(0.0)
    for k in range(len(values)):
        above = np.uint64(index[k])
        below = above + width
        p, q = pixels[above], pixels[below]
        p += across[k] * (pixels[above + one] - p)
        q += across[k] * (pixels[below + one] - q)
        v = p + down[k] * (q - p)
        total += v
        values[k] = v if (valid[k] > np.float32(0.5)) & (v <= highlight) else outside
    return float(total)

"""Small patches of grey levels that tell a point of the map from its neighbours."""

import math

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, U8
from pliant.algorithms.kernel import fast_kernel, inline_kernel, kernel

PATCH = 8
"""Side of a patch, px.  Its samples lie at -3.5, ..., 3.5 px from the point."""

_ITERATIONS = 4
_HOPELESS = 0.2
"""ZNCC at the start under which alignment is not tried."""

_FLAT = 1.0
"""Standard deviation, in grey levels, under which a patch says nothing."""


@inline_kernel
def sample_patch(grey: U8, u: float, v: float, out: F32) -> bool:
    """Interpolate the patch around (u, v) into (8, 8); False where it leaves the image."""
    left, top = u - 0.5 * (PATCH - 1), v - 0.5 * (PATCH - 1)
    x, y = math.floor(left), math.floor(top)
    if not (left >= 0.0 and top >= 0.0 and x + PATCH < grey.shape[1] and y + PATCH < grey.shape[0]):
        return False
    column, line = int(x), int(y)
    a, b = np.float32(left - x), np.float32(top - y)
    one = np.float32(1.0)
    w00, w01, w10, w11 = (one - a) * (one - b), a * (one - b), (one - a) * b, a * b
    for r in range(PATCH):
        upper, lower = grey[line + r], grey[line + r + 1]
        for c in range(PATCH):
            out[r, c] = (
                w00 * upper[column + c]
                + w01 * upper[column + c + 1]
                + w10 * lower[column + c]
                + w11 * lower[column + c + 1]
            )
    return True


@inline_kernel
def normalise_patch(patch: F32) -> bool:
    """Bring the patch to mean 0 and sum of squares 1; False where it is flat."""
    total, squares = np.float32(0.0), np.float32(0.0)
    for r in range(PATCH):
        for c in range(PATCH):
            total += patch[r, c]
            squares += patch[r, c] * patch[r, c]
    n = np.float32(PATCH * PATCH)
    mean = total / n
    variance = squares / n - mean * mean
    if variance < _FLAT * _FLAT:
        return False
    scale = np.float32(1.0) / np.float32(math.sqrt(variance * n))
    for r in range(PATCH):
        for c in range(PATCH):
            patch[r, c] = (patch[r, c] - mean) * scale
    return True


@inline_kernel
def correlation(a: F32, b: F32) -> float:
    """ZNCC of two normalised patches."""
    total = 0.0
    for r in range(PATCH):
        for c in range(PATCH):
            total += a[r, c] * b[r, c]
    return total


@inline_kernel
def align_patch(
    grey: U8, template: F32, u: float, v: float, work: F32, reach_px: float, out: F64
) -> float:
    """Move (u, v) to where the image fits the normalised template best.

    Inverse compositional Gauss-Newton (Baker and Matthews 2004) on a translation; gain and mean
    are removed at every step.  Writes the position to ``out`` and returns the ZNCC there, -1 where
    the patch is flat, leaves the image or moves further than ``reach_px``.
    """
    half = np.float32(0.5)
    hxx, hxy, hyy = np.float32(1e-9), np.float32(0.0), np.float32(1e-9)
    for r in range(1, PATCH - 1):
        for c in range(1, PATCH - 1):
            gx = half * (template[r, c + 1] - template[r, c - 1])
            gy = half * (template[r + 1, c] - template[r - 1, c])
            hxx += gx * gx
            hxy += gx * gy
            hyy += gy * gy
    det = hxx * hyy - hxy * hxy
    out[0], out[1] = u, v
    if det <= 1e-8:
        return -1.0
    for k in range(_ITERATIONS):
        if not sample_patch(grey, out[0], out[1], work) or not normalise_patch(work):
            return -1.0
        if k == 0 and correlation(work, template) < _HOPELESS:
            return -1.0
        bx, by = np.float32(0.0), np.float32(0.0)
        for r in range(1, PATCH - 1):
            for c in range(1, PATCH - 1):
                difference = work[r, c] - template[r, c]
                bx += half * (template[r, c + 1] - template[r, c - 1]) * difference
                by += half * (template[r + 1, c] - template[r - 1, c]) * difference
        du, dv = (hyy * bx - hxy * by) / det, (hxx * by - hxy * bx) / det
        out[0] -= du
        out[1] -= dv
        if (out[0] - u) ** 2 + (out[1] - v) ** 2 > reach_px * reach_px:
            return -1.0
        if du * du + dv * dv < 1e-4:
            break
    if not sample_patch(grey, out[0], out[1], work) or not normalise_patch(work):
        return -1.0
    return correlation(work, template)


@fast_kernel
def cut_patches(grey: U8, points_px: F32, rows: I32, patches: U8) -> None:
    """Store the patch around each point (N, 2) in ``patches[rows[n]]``, zeros at the border."""
    work = np.empty((PATCH, PATCH), np.float32)
    for i in range(rows.size):
        inside = sample_patch(grey, points_px[i, 0], points_px[i, 1], work)
        for r in range(PATCH):
            for c in range(PATCH):
                patches[rows[i], r, c] = np.uint8(work[r, c] + 0.5) if inside else np.uint8(0)


@kernel
def sample_colours(image: U8, points_px: F32) -> U8:
    """(N, 3) RGB of the pixel nearest to each point; image (H, W, 3) or (H, W)."""
    colours = np.empty((points_px.shape[0], 3), np.uint8)
    flat = image.reshape(image.shape[0], image.shape[1], -1)
    channels = flat.shape[2]
    for i in range(points_px.shape[0]):
        column = min(max(int(points_px[i, 0] + 0.5), 0), flat.shape[1] - 1)
        line = min(max(int(points_px[i, 1] + 0.5), 0), flat.shape[0] - 1)
        for k in range(3):
            colours[i, k] = flat[line, column, min(k, channels - 1)]
    return colours

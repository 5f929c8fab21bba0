"""Small patches that follow a point: inverse compositional alignment, blind to gain and offset.

Lucas-Kanade as in Baker and Matthews (2004), translation only.  The patch seen now is modelled as
gain * template + offset, and both are projected out of the steepest-descent images, so that a
change of exposure moves nothing.  Pixels count by a window.
"""

from typing import NamedTuple

import numpy as np

from pliant.algorithms.arrays import F32
from pliant.algorithms.image.patch_sums import (
    PATCH_PIXELS,
    PATCH_SIZE,
    patch_sums,
    tensor_sums,
    write_template,
)
from pliant.algorithms.image.pixels import Pixels
from pliant.compiler.kernel import fast_kernel

TEMPLATE_MARGIN = 1
"""Pixels around a patch that its gradients need when the template is made."""
MIN_ENERGY = np.float32(1e-3)
MIN_STRENGTH = np.float32(1e-4)
"""DN^2: a patch with less than either has nothing to be placed by."""


class PatchTensor(NamedTuple):
    """The texture of a patch.

    level + mean: the mean grey level.  mean_x, mean_y: the mean gradient.  energy: the sum of
    squares without the mean.  tx, ty: how much of the patch is in each gradient image, per unit of
    it.  xx, xy, yy: the structure tensor without what offset and gain explain.
    """

    level: np.float32
    mean: np.float32
    mean_x: np.float32
    mean_y: np.float32
    energy: np.float32
    tx: np.float32
    ty: np.float32
    xx: np.float32
    xy: np.float32
    yy: np.float32


class Template(NamedTuple):
    """One of many templates: values from ``offset`` on, the energy of its patch, its window."""

    values: F32
    offset: int
    energy: np.float32
    window: F32


class Alignment(NamedTuple):
    """Where a patch is found.

    u, v: of its first pixel.  zncc, residual: the correlation, and the RMS residual in grey levels
    of the image, both *before* the last step.  step: length of that step, px.  zncc is -1 where
    alignment fails: it left the image or its reach, or lost contrast.
    """

    u: np.float32
    v: np.float32
    zncc: np.float32
    residual: np.float32
    step: np.float32


@fast_kernel
def patch_tensor(image: Pixels, left: int, top: int, window: F32) -> PatchTensor:
    """The tensor of the patch whose first pixel is (left, top).

    The patch and TEMPLATE_MARGIN must lie inside of the image.  window: GAUSSIAN or UNIFORM.
    """
    n = np.float32(PATCH_PIXELS)
    first = top * image.width + left
    level = image.values[first + PATCH_SIZE // 2 * image.width + PATCH_SIZE // 2]
    st, sx, sy, stt, stx, sty, sxx, sxy, syy = tensor_sums(
        image.values, np.uint64(first), np.uint64(image.width), level, window
    )
    mean, mean_x, mean_y = st / n, sx / n, sy / n
    energy = stt - st * mean
    # Orthogonal to the template, so that the gain moves nothing.
    share = np.float32(1.0) / max(energy, MIN_ENERGY)
    tx, ty = (stx - st * mean_x) * share, (sty - st * mean_y) * share
    xx = sxx - sx * mean_x - tx * tx * energy
    xy = sxy - sx * mean_y - tx * ty * energy
    yy = syy - sy * mean_y - ty * ty * energy
    return PatchTensor(level, mean, mean_x, mean_y, energy, tx, ty, xx, xy, yy)


@fast_kernel
def patch_strength(tensor: PatchTensor) -> tuple[np.float32, np.float32]:
    """Smaller eigenvalue of a ``patch_tensor`` per pixel, DN^2, and that over the larger one.

    Strength 0: no use.
    """
    xx, xy, yy = tensor.xx, tensor.xy, tensor.yy
    half = np.float32(0.5)
    difference = np.sqrt((xx - yy) * (xx - yy) + np.float32(4.0) * xy * xy)
    smaller, larger = half * (xx + yy - difference), half * (xx + yy + difference)
    strength = smaller / np.float32(PATCH_PIXELS)
    determinant = xx * yy - xy * xy
    if tensor.energy < MIN_ENERGY or strength < MIN_STRENGTH or determinant <= np.float32(0.0):
        return np.float32(0.0), np.float32(0.0)
    return strength, smaller / larger


@fast_kernel
def make_template(
    image: Pixels,
    left: int,
    top: int,
    tensor: PatchTensor,
    window: F32,
    templates: F32,
    offset: int,
) -> None:
    """Make a template from the patch whose first pixel is (left, top).

    tensor: the patch's own under this window, with a strength above 0.  templates: flat; written
    from ``offset`` on: t0 with sum t0 v = gain, and t1, t2 with sum t v = gain * (displacement of
    the patch).
    """
    mean, mean_x, mean_y = tensor.mean + tensor.level, tensor.mean_x, tensor.mean_y
    tx, ty, xx, xy, yy = tensor.tx, tensor.ty, tensor.xx, tensor.xy, tensor.yy
    determinant = xx * yy - xy * xy
    # v = gain * (t - gradient . e) for a patch displaced by -e: minus the inverse of the tensor.
    ixx, ixy, iyy = -yy / determinant, xy / determinant, -xx / determinant
    share = np.float32(1.0) / tensor.energy
    of_u, of_v = ixx * tx + ixy * ty, ixy * tx + iyy * ty
    write_template(
        image.values,
        np.uint64(top * image.width + left),
        np.uint64(image.width),
        (
            -mean * share,
            share,
            np.float32(0.0),
            np.float32(0.0),
            of_u * mean - ixx * mean_x - ixy * mean_y,
            -of_u,
            ixx,
            ixy,
            of_v * mean - ixy * mean_x - iyy * mean_y,
            -of_v,
            ixy,
            iyy,
        ),
        templates,
        offset,
        window,
    )


@fast_kernel
def align_patch(
    image: Pixels,
    u: np.float32,
    v: np.float32,
    template: Template,
    iterations: int,
    reach: np.float32,
) -> Alignment:
    """Align a template with the image, from (u, v), where its first pixel is thought to be.

    iterations: at most; it stops earlier once a step is below 0.01 px.  reach: largest distance
    from the start, px.
    """
    n = np.float32(PATCH_PIXELS)
    failed = np.float32(-1.0)
    zero = np.float32(0.0)
    start_u, start_v = u, v
    gain, variance, step = zero, np.float32(1.0), zero
    for _ in range(iterations):
        inside = (
            u >= np.float32(0.0)
            and v >= np.float32(0.0)
            and u < np.float32(image.width - PATCH_SIZE - 1)
            and v < np.float32(image.height - PATCH_SIZE - 1)
        )
        if not inside:
            return Alignment(u, v, failed, zero, step)
        column, row = int(u), int(v)
        total, squares, gain, du, dv = patch_sums(
            image.values,
            np.uint64(row * image.width + column),
            np.uint64(image.width),
            u - np.float32(column),
            v - np.float32(row),
            template.values,
            np.uint64(template.offset),
            template.window,
        )
        variance = squares - total * total / n
        if gain <= np.float32(0.05) or gain >= np.float32(20.0) or variance <= np.float32(1e-3):
            return Alignment(u, v, failed, zero, step)
        du /= gain
        dv /= gain
        # A patch that is far off can throw a step out of its region of convergence.
        step = np.sqrt(du * du + dv * dv)
        if step > np.float32(2.0):
            du *= np.float32(2.0) / step
            dv *= np.float32(2.0) / step
        u += du
        v += dv
        away_u, away_v = u - start_u, v - start_v
        if not (away_u * away_u + away_v * away_v <= reach * reach):
            return Alignment(u, v, failed, zero, step)
        if step < np.float32(0.01):
            break
    zncc = gain * np.sqrt(template.energy / variance)
    residual = np.sqrt(max(variance - gain * gain * template.energy, zero) / n)
    return Alignment(u, v, zncc, residual, step)

"""Sums over a patch from which every normal equation follows (DSDT, Eq. 5).

A surfel is flat, so its grid always moves by a homography: each row of the Jacobian combines eight
functions of the grid, and two for gain and bias,

    Vu, Vv, i Vu, j Vu, i Vv, j Vv, i D, j D, V, 1      with  D = i Vu + j Vv,

Vu and Vv being derivatives of the patch along its own grid.  One 10 x 10 matrix over the samples
therefore serves every deformation model and both cameras; ``deformation_models`` has the mixing.

The derivatives are those of the frame's patch (forward, as the paper), of the texture, or their
mean.  The matrix affects the steps, and not the result, which depends on the sums of features times
residual.  So these are computed at every step, and the matrix, which costs twice as much, only
after a surfel has moved.

A patch is sampled one pixel wider on every side, for its derivatives.  Its textures keep the rows
of that grid, with two unused samples between rows, so that a sample and its neighbours have
fixed distances and one loop serves all: sample k is at ``first_inner``
+ k of it.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from pliant.algorithms.arrays import F32, F64
from pliant.algorithms.surfels.patch_sampling import Grid
from pliant.compiler.kernel import fast_kernel

FEATURES = 10
TEMPLATE_IMAGES = 3
"""Grey level (mean removed) and the derivatives along i and j."""

_FAR = 1.0e6
_I, _J, _D = FEATURES, FEATURES + 1, FEATURES + 2
"""Rows of the scratch of ``feature_matrix``: the grid, and D; before them the features."""


class Comparison(NamedTuple):
    """How a patch of a frame is compared with a texture: ``gain (patch - mean) + bias - texture``.

    mean, bias: grey levels.    saturation: DN, of a residual.    blend: share of the frame in the
    derivatives; the rest are the texture's.
    """

    mean: Any
    gain: Any
    bias: Any
    saturation: Any
    blend: Any


def padded(side: int) -> int:
    """Samples of a texture of side x side, with the two between its rows that it lacks."""
    return side * (side + 2) - 2


def make_features(side: int) -> F32:
    """Scratch of ``feature_matrix`` for textures of side x side."""
    n, half = padded(side), side // 2
    features = np.zeros((FEATURES + 3, n), np.float32)
    features[_I] = np.arange(n) % (side + 2) - half
    features[_J] = np.arange(n) // (side + 2) - half
    return features


@fast_kernel(inline=True)
def first_inner(grid: Grid) -> int:
    """Where in the grid of a patch, one sample wider on each side, its first sample stands."""
    return grid.side + 1


@fast_kernel(inline=True)
def photometric_sums(
    images: F32, grid: Grid, comparison: Comparison, out: F64
) -> tuple[float, int]:
    """Saturated cost, and the sums of features times residual.

    images: (TEMPLATE_IMAGES, n) of the texture.  out: (FEATURES,).  Returns (cost DN^2, samples not
    saturated).
    """
    # With a blend of 1 the texture's derivatives are not read from memory.
    u, v = (images[1], images[2]) if comparison.blend < 1.0 else (images[0], images[0])
    texture = (images[0], u, v)
    return _sums(grid.i, grid.j, grid.values, grid.side, texture, _single(comparison), out)


@fast_kernel(inline=True)
def _single(comparison: Comparison) -> Comparison:
    c = comparison
    return Comparison(
        np.float32(c.mean), np.float32(c.gain), np.float32(c.bias), np.float32(c.saturation),
        np.float32(c.blend),
    )  # fmt: skip


@fast_kernel
def _sums(
    gi: F32, gj: F32, values: F32, wide: int, texture: tuple[F32, F32, F32], single: Comparison,
    out: F64,
) -> tuple[float, int]:  # fmt: skip
    t, tu, tv = texture
    m, g, b, limit, blend = single
    n, at = len(t), wide + 1
    i, j, here = gi[at : at + n], gj[at : at + n], values[at : at + n]
    left, right = values[at - 1 : at - 1 + n], values[at + 1 : at + 1 + n]
    above, below = values[at - wide : at - wide + n], values[at + wide : at + wide + n]
    zero, one, far = np.float32(0.0), np.float32(1.0), np.float32(_FAR)
    rest, slope = one - blend, np.float32(0.5) * g * blend
    s0 = s1 = s2 = s3 = s4 = s5 = s6 = s7 = s8 = s9 = cost = seen = zero
    for k in range(n):
        r = g * (here[k] - m) + b - t[k]
        u, v = right[k] - left[k], below[k] - above[k]
        inside = (abs(r) < limit) & (abs(u) < far) & (abs(v) < far)
        r = r if inside else zero
        seen += one if inside else zero
        p, q = (slope * u + rest * tu[k]) * r, (slope * v + rest * tv[k]) * r
        d = i[k] * p + j[k] * q
        s0 += p
        s1 += q
        s2 += i[k] * p
        s3 += j[k] * p
        s4 += i[k] * q
        s5 += j[k] * q
        s6 += i[k] * d
        s7 += j[k] * d
        s8 += t[k] * r
        s9 += r
        cost += r * r
    out[0], out[1], out[2], out[3], out[4] = s0, s1, s2, s3, s4
    # The frame's own patch, gain and bias applied, is the texture plus the residual.
    out[5], out[6], out[7], out[8], out[9] = s5, s6, s7, s8 + blend * cost, s9
    return float(cost + limit * limit * (np.float32(n) - seen)), int(seen)


@fast_kernel
def feature_matrix(
    images: F32, grid: Grid, comparison: Comparison, features: F32, out: F64
) -> None:
    """Sums of products of the features, for the samples that ``photometric_sums`` counts.

    The arguments are those of ``photometric_sums``.  features: from ``make_features``, filled.
    out: (FEATURES, FEATURES).
    """
    texture = (images[0], images[1], images[2])
    _features(grid.values, grid.side, texture, _single(comparison), features)
    _products(features, out)


@fast_kernel
def _features(
    values: F32, wide: int, texture: tuple[F32, F32, F32], single: Comparison, features: F32
) -> None:
    t, tu, tv = texture
    m, g, b, limit, blend = single
    n, at = len(t), wide + 1
    here = values[at : at + n]
    left, right = values[at - 1 : at - 1 + n], values[at + 1 : at + 1 + n]
    above, below = values[at - wide : at - wide + n], values[at + wide : at + wide + n]
    zero, one, far = np.float32(0.0), np.float32(1.0), np.float32(_FAR)
    rest, slope = one - blend, np.float32(0.5) * g * blend
    fu, fv, level, seen = features[0], features[1], features[8], features[9]
    # One array to write in one loop: with several of them LLVM does not vectorise.
    for k in range(n):
        r = g * (here[k] - m) + b - t[k]
        u, v = right[k] - left[k], below[k] - above[k]
        inside = (abs(r) < limit) & (abs(u) < far) & (abs(v) < far)
        seen[k] = one if inside else zero
    for k in range(n):
        fu[k] = (slope * (right[k] - left[k]) + rest * tu[k]) * seen[k]
    for k in range(n):
        fv[k] = (slope * (below[k] - above[k]) + rest * tv[k]) * seen[k]
    for k in range(n):
        level[k] = (t[k] + blend * (g * (here[k] - m) + b - t[k])) * seen[k]
    i, j, d = features[_I], features[_J], features[_D]
    _times(i, fu, features[2])
    _times(j, fu, features[3])
    _times(i, fv, features[4])
    _times(j, fv, features[5])
    f2, f5 = features[2], features[5]
    for k in range(n):
        d[k] = f2[k] + f5[k]
    _times(i, d, features[6])
    _times(j, d, features[7])


@fast_kernel
def _times(a: F32, b: F32, out: F32) -> None:
    for k in range(len(out)):
        out[k] = a[k] * b[k]


@fast_kernel
def _products(features: F32, out: F64) -> None:
    """Scalar products of all rows with each other, four at a time."""
    for row in range(FEATURES):
        a = features[row]
        for column in range(0, row + 1, 4):
            b, c = features[column], features[min(column + 1, row)]
            d, e = features[min(column + 2, row)], features[min(column + 3, row)]
            s0 = s1 = s2 = s3 = np.float32(0.0)
            for k in range(len(a)):
                s0 += a[k] * b[k]
                s1 += a[k] * c[k]
                s2 += a[k] * d[k]
                s3 += a[k] * e[k]
            sums = (s0, s1, s2, s3)
            for m in range(4):
                if column + m <= row:
                    out[row, column + m] = out[column + m, row] = sums[m]


@fast_kernel
def correlation(template: F32, values: F32) -> tuple[float, int]:
    """ZNCC of two patches over the samples that both have, and how many these are."""
    n = sa = sb = saa = sbb = sab = np.float32(0.0)
    zero, far = np.float32(0.0), np.float32(_FAR)
    origin = np.float32(0.0)
    for k in range(len(values)):
        if abs(values[k]) < far:
            origin = values[k]
            break
    for k in range(len(values)):
        good = (abs(template[k]) < far) & (abs(values[k]) < far)
        a = template[k] if good else zero
        b = values[k] - origin if good else zero
        n += np.float32(1.0) if good else zero
        sa += a
        sb += b
        saa += a * a
        sbb += b * b
        sab += a * b
    count = np.float64(n)
    if count < 1.0:
        return 0.0, 0
    va = np.float64(saa) - np.float64(sa) ** 2 / count
    vb = np.float64(sbb) - np.float64(sb) ** 2 / count
    # Less than a fifth of a grey level of contrast is none at all.
    floor = 0.04 * count
    if va <= floor or vb <= floor:
        return 0.0, int(n)
    cab = np.float64(sab) - np.float64(sa) * np.float64(sb) / count
    return cab / math.sqrt(va * vb), int(n)

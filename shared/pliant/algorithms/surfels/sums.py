"""Sums over a patch from which every normal equation follows (DSDT, Eq. 5).

A surfel is flat, so whatever it does, its grid moves by a homography: each row of the Jacobian
is a mixture of eight functions of the grid, and of two for gain and bias,

    Vu, Vv, i Vu, j Vu, i Vv, j Vv, i D, j D, V, 1      with  D = i Vu + j Vv,

Vu and Vv being derivatives of the patch along its own grid.  One 10 x 10 matrix over the samples
therefore serves every deformation model and both cameras; ``motion`` has the mixing.
"""

import math

import numpy as np

from pliant.algorithms.arrays import F32, F64
from pliant.algorithms.kernel import fast_kernel, leaf_kernel
from pliant.algorithms.surfels.sampling import Grid

FEATURES = 10
TEMPLATE_IMAGES = 3
"""Grey level (mean removed) and the derivatives along i and j."""

_FAR = 1.0e6
_I, _J, _D = FEATURES + 1, FEATURES + 2, FEATURES + 3
"""Rows of the scratch of ``frame_sums``: the grid, and D; before them features and residual."""


def make_features(side: int) -> F32:
    """Scratch of ``frame_sums`` for patches of side x side samples."""
    half = side // 2
    features = np.zeros((FEATURES + 4, side * side), np.float32)
    j, i = np.mgrid[-half : half + 1, -half : half + 1]
    features[_I], features[_J] = i.ravel(), j.ravel()
    return features


@fast_kernel
def template_sums(
    template: F32, grid: Grid, mean: float, gain: float, bias: float, tau: float, out: F64
) -> tuple[float, int]:
    """Saturated cost, and the sums of features times residual with the template's derivatives.

    template: (3, n) images.  out: (FEATURES,).  Returns (cost DN^2, samples not saturated).
    """
    i, j, values = grid.i, grid.j, grid.values
    t, tu, tv = template[0], template[1], template[2]
    zero, one = np.float32(0.0), np.float32(1.0)
    m, g, b = np.float32(mean), np.float32(gain), np.float32(bias)
    limit, top = np.float32(tau), np.float32(tau * tau)
    s0 = s1 = s2 = s3 = s4 = s5 = s6 = s7 = s8 = s9 = cost = seen = zero
    for k in range(len(values)):
        r = g * (values[k] - m) + b - t[k]
        inside = abs(r) < limit
        r = r if inside else zero
        cost += r * r if inside else top
        seen += one if inside else zero
        p, q = tu[k] * r, tv[k] * r
        d = i[k] * p + j[k] * q
        s0 += p
        s1 += q
        s2 += i[k] * p
        s3 += j[k] * p
        s4 += i[k] * q
        s5 += j[k] * q
        s6 += i[k] * d
        s7 += j[k] * d
        s8 += t[k] * r if inside else zero
        s9 += r
    out[0], out[1], out[2], out[3], out[4] = s0, s1, s2, s3, s4
    out[5], out[6], out[7], out[8], out[9] = s5, s6, s7, s8, s9
    return float(cost), int(seen)


@leaf_kernel
def frame_sums(
    template: F32,
    grid: Grid,
    mean: float,
    gain: float,
    bias: float,
    tau: float,
    features: F32,
    matrix: F64,
    out: F64,
) -> tuple[float, int]:
    """As ``template_sums``, with the derivatives of the frame's own patch (forward, as the paper).

    grid: one sample wider on each side than the template.  features: from ``make_features``.
    matrix: (FEATURES, FEATURES), filled with the sums of products of the features.
    """
    wide = grid.side
    side = wide - 2
    n = side * side
    m, g, b = np.float32(mean), np.float32(gain), np.float32(bias)
    limit, top = np.float32(tau), np.float32(tau * tau)
    zero, one, half = np.float32(0.0), np.float32(1.0), np.float32(0.5)
    far = np.float32(_FAR)
    slope = half * g
    f0, f1, f8, f9, f10 = features[0], features[1], features[8], features[9], features[10]
    for row in range(side):
        start, at = (row + 1) * wide + 1, row * side
        here, before = grid.values[start : start + side], grid.values[start - 1 : start - 1 + side]
        after = grid.values[start + 1 : start + 1 + side]
        above = grid.values[start - wide : start - wide + side]
        below = grid.values[start + wide : start + wide + side]
        row0, row1, row8 = f0[at : at + side], f1[at : at + side], f8[at : at + side]
        for k in range(side):
            row0[k] = slope * (after[k] - before[k])
        for k in range(side):
            row1[k] = slope * (below[k] - above[k])
        for k in range(side):
            row8[k] = here[k] - m
    t = template[0]
    for k in range(n):
        f10[k] = g * f8[k] + b - t[k]
    for k in range(n):
        inside = (abs(f10[k]) < limit) & (abs(f0[k]) < far) & (abs(f1[k]) < far)
        f9[k] = one if inside else zero
    _times(f0, f9, f0)
    _times(f1, f9, f1)
    _times(f8, f9, f8)
    _times(f10, f9, f10)
    cost = seen = zero
    for k in range(n):
        cost += f10[k] * f10[k]
        seen += f9[k]
    cost += top * (np.float32(n) - seen)
    i, j, d = features[_I], features[_J], features[_D]
    _times(i, f0, features[2])
    _times(j, f0, features[3])
    _times(i, f1, features[4])
    _times(j, f1, features[5])
    f2, f5 = features[2], features[5]
    for k in range(n):
        d[k] = f2[k] + f5[k]
    _times(i, d, features[6])
    _times(j, d, features[7])
    _products(features, n, matrix, out)
    return float(cost), int(seen)


@leaf_kernel
def _times(a: F32, b: F32, out: F32) -> None:
    """One product in one loop: with several arrays to write LLVM does not vectorise."""
    for k in range(len(out)):
        out[k] = a[k] * b[k]


@leaf_kernel
def _products(features: F32, n: int, matrix: F64, out: F64) -> None:
    """Scalar products of all rows with each other and with the last, four at a time."""
    for row in range(FEATURES):
        a = features[row]
        for column in range(0, row + 1, 4):
            b, c = features[column], features[min(column + 1, FEATURES)]
            d, e = features[min(column + 2, FEATURES)], features[min(column + 3, FEATURES)]
            s0 = s1 = s2 = s3 = np.float32(0.0)
            for k in range(n):
                s0 += a[k] * b[k]
                s1 += a[k] * c[k]
                s2 += a[k] * d[k]
                s3 += a[k] * e[k]
            sums = (s0, s1, s2, s3)
            for m in range(4):
                if column + m <= row:
                    matrix[row, column + m] = matrix[column + m, row] = sums[m]
        r = features[FEATURES]
        total = np.float32(0.0)
        for k in range(n):
            total += a[k] * r[k]
        out[row] = total


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

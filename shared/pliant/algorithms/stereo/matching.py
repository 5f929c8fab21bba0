"""How badly images match at several inverse depths of every pixel (plane and surface sweeps).

Collins 1996: a window of the reference is compared with what the other images show where its
pixels would be at a depth.  Here each pixel of a window has its own inverse depth, base + offset:
with a base of 0 the windows are parallel to the image (a plane sweep); with a surface as the base
they lie along it, and slanted ones match as well as those face on.

The cost is 1 - ZNCC, the correlation of what is left of two windows without their means:

    ZNCC = (E[rs] - E[r] E[s]) / sqrt((Var r + v) (Var s + v)),                               (2)

with v the variance of noise, so that windows without texture match neither well nor badly.
"""

from typing import TypeAlias

import cv2
import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, U8, U32, BoolArray
from pliant.algorithms.stereo.views import NOT_SHOWN, Motion
from pliant.compiler.kernel import kernel

WORST = 255
"""Cost of windows that do not correlate, as many as the same grey everywhere."""
_UNITS = 16
"""Of one grey level, so that sums over windows are whole numbers and exact."""
NOISE_VARIANCE = 4.0
"""Of a pixel of the small images: noise, JPEG, interpolation; grey levels squared."""
_OUTSIDE = 3.0
"""Cost of what an image does not show, before it is left out: above all others."""

Places: TypeAlias = tuple[I32, F32, F32]
"""Of a row: the quad at each pixel, and the shares of its right and lower pixels."""


def textured(grey: U8, radius: int) -> BoolArray:
    """(H, W): where the grey of the window (2 radius + 1)^2 varies by more than its noise.

    Elsewhere a match is that of other pixels: a surface seems to continue into a bare sky.
    """
    side = 2 * radius + 1
    values, n = grey.astype(np.float64), side * side
    sums, squares = (  # whole numbers, hence exact
        cv2.boxFilter(each, cv2.CV_64F, (side, side), normalize=False)
        for each in (values, values * values)
    )
    return np.asarray(n * squares - sums * sums > NOISE_VARIANCE * n * n, np.bool_)


def matching_costs(
    reference: U8, sources: U8, moved: Motion, base: F32, offsets: F32, radius: int
) -> U8:
    """(H, W, D) costs, 0 to WORST, at the inverse depths base + offsets.

    reference: (H, W).    sources: (S, H, W) grey images of the same camera.    base: (H, W).
    offsets: (D,).    radius: of the square window, pixels.
    Of the images that show the pixel, the best two thirds count: the others may be occluded.
    """
    costs = np.full((len(offsets), *reference.shape), WORST, np.uint8)
    if len(sources):
        _sweep(
            reference, _quads(sources), moved.homographies.astype(np.float32),
            moved.translations.astype(np.float32), base, offsets, radius, costs,
        )  # fmt: skip
    return np.ascontiguousarray(costs.transpose(1, 2, 0))


@kernel
def _sweep(
    reference: U8, quads: U32, homographies: F32, translations: F32, base: F32, offsets: F32,
    radius: int, costs: U8,
) -> None:  # fmt: skip
    """One depth after the other; of the warped images only the rows of a window are held."""
    height, width = reference.shape
    count, ring = len(quads), 2 * radius + 2
    middle, units = np.int32(128 * _UNITS), np.int32(_UNITS)
    centred = np.empty((height, width), np.int32)
    for v in range(height):
        for u in range(width):
            centred[v, u] = np.int32(np.int32(reference[v, u]) * units - middle)
    means, spreads = _window_sums(centred, radius)
    warped = np.zeros((count, ring, width), np.int32)
    shown = np.zeros((count, ring, width), np.uint8)
    sums = np.zeros((count, 3, width + 2 * radius), np.int32)
    each = np.empty((count, width), np.float32)
    rows, used = np.empty((3, width), np.int32), np.empty(width, np.int32)
    totals = np.empty(width, np.float32)
    places = (np.empty(width, np.int32), np.empty(width, np.float32), np.empty(width, np.float32))
    for d in range(len(offsets)):
        sums[:] = 0
        for s in range(count):
            for row in range(min(radius + 1, height)):
                _warp(
                    quads[s], width, homographies[s], translations[s], row, base[row], offsets[d],
                    places, warped[s, row], shown[s, row],
                )  # fmt: skip
            for k in range(-radius, radius + 1):
                row = min(max(k, 0), height - 1)
                _add(warped[s, row], centred[row], sums[s], radius)
        for v in range(height):
            for s in range(count):
                if v > 0:
                    new, old = v + radius, max(v - 1 - radius, 0)
                    at, gone = min(new, height - 1), old % ring
                    if new < height:
                        _warp(
                            quads[s], width, homographies[s], translations[s], new, base[new],
                            offsets[d], places, warped[s, new % ring], shown[s, new % ring],
                        )  # fmt: skip
                    _exchange(
                        warped[s, at % ring], centred[at], warped[s, gone], centred[old],
                        sums[s], radius,
                    )  # fmt: skip
                _correlate(sums[s], means[v], spreads[v], shown[s, v % ring], radius, rows, each[s])
            _sort(each)
            _mean_of_best(each, used, totals, costs[d, v])


@kernel
def _warp(
    quads: U32, width: int, A: F32, b: F32, row: int, base: F32, offset: np.float32,
    places: Places, out: I32, shown: U8,
) -> None:  # fmt: skip
    """A row of the reference as another image has it, bilinearly; and which of it that shows.

    quads: (H - 1) (W - 1) of the other image, of that width.  Three loops, so that the first and
    the last are SIMD code.
    """
    at, right_shares, low_shares = places
    across = np.int32(width - 1)
    height = len(quads) // across + 1
    zero, half = np.float32(0.0), np.float32(0.5)
    right, low = np.float32(width - 1), np.float32(height - 1)
    last_u, last_v = np.int32(width - 2), np.int32(height - 2)
    v = np.float32(row)
    a0, a1, a2 = A[0, 1] * v + A[0, 2], A[1, 1] * v + A[1, 2], A[2, 1] * v + A[2, 2]
    b0, b1, b2, c0, c1, c2 = b[0], b[1], b[2], A[0, 0], A[1, 0], A[2, 0]
    for u in range(len(out)):
        column, w = np.float32(u), base[u] + offset
        z = c2 * column + a2 + b2 * w
        x, y = (c0 * column + a0 + b0 * w) / z, (c1 * column + a1 + b1 * w) / z
        inside = (z > zero) & (x >= -half) & (x <= right + half) & (y >= -half) & (y <= low + half)
        shown[u] = inside
        # Compared so, what is no number becomes 0, too.
        x, y = x if x > zero else zero, y if y > zero else zero
        x, y = x if x < right else right, y if y < low else low
        i, j = min(np.int32(x), last_u), min(np.int32(y), last_v)
        right_shares[u], low_shares[u] = x - np.float32(i), y - np.float32(j)
        at[u] = np.int32(np.int32(j * across) + i)
    for u in range(len(out)):
        out[u] = np.int32(quads[np.uint32(at[u])])
    units, middle = np.float32(_UNITS), np.int32(128 * _UNITS)
    byte = np.uint32(255)
    for u in range(len(out)):
        quad, p, q = np.uint32(out[u]), right_shares[u], low_shares[u]
        g00 = np.float32(np.int32(quad & byte))
        g01 = np.float32(np.int32((quad >> np.uint32(8)) & byte))
        g10 = np.float32(np.int32((quad >> np.uint32(16)) & byte))
        g11 = np.float32(np.int32(quad >> np.uint32(24)))
        top, bottom = g00 + p * (g01 - g00), g10 + p * (g11 - g10)
        grey = top + q * (bottom - top)
        out[u] = np.int32(np.int32(units * grey + half) - middle)
        shown[u] = shown[u] & np.uint8(quad != np.uint32(0))


def _quads(images: U8) -> U32:
    """(S, (H - 1) (W - 1)) the four pixels around each place between pixels of (S, H, W) images,
    a byte each, so that one load fetches them; 0 where one of them shows nothing."""
    count = len(images)
    wide = images.astype(np.uint32)
    a, b, c, d = wide[:, :-1, :-1], wide[:, :-1, 1:], wide[:, 1:, :-1], wide[:, 1:, 1:]
    packed = a | b << np.uint32(8) | c << np.uint32(16) | d << np.uint32(24)
    whole = np.minimum(np.minimum(a, b), np.minimum(c, d)) != NOT_SHOWN
    return np.ascontiguousarray(np.where(whole, packed, np.uint32(0)).reshape(count, -1))


@kernel
def _add(row: I32, centred: I32, sums: I32, radius: int) -> None:
    """To the sums over columns of the window: s, s s, r s."""
    first, second, third = sums[0], sums[1], sums[2]
    for u in range(len(row)):
        s, r = row[u], centred[u]
        first[radius + u] += s
        second[radius + u] += np.int32(s * s)
        third[radius + u] += np.int32(r * s)


@kernel
def _exchange(row: I32, centred: I32, gone: I32, centred_gone: I32, sums: I32, radius: int) -> None:
    """Add the row that enters the window and take away the one that leaves it."""
    first, second, third = sums[0], sums[1], sums[2]
    for u in range(len(row)):
        s, r, t, q = row[u], centred[u], gone[u], centred_gone[u]
        first[radius + u] += np.int32(s - t)
        second[radius + u] += np.int32(np.int32(s * s) - np.int32(t * t))
        third[radius + u] += np.int32(np.int32(r * s) - np.int32(q * t))


@kernel
def _correlate(
    sums: I32, means: F32, spreads: F32, shown: U8, radius: int, rows: I32, out: F32
) -> None:
    """1 - ZNCC of each window of a row, equation (2) times n squared; _OUTSIDE: not shown."""
    width = len(out)
    for k in range(3):
        line, total = sums[k], rows[k]
        for u in range(radius):  # what lies outside repeats the border
            line[u], line[radius + width + u] = line[radius], line[radius + width - 1]
        for u in range(width):
            total[u] = line[u]
        for offset in range(1, 2 * radius + 1):
            moved = line[offset:]
            for u in range(width):
                total[u] += moved[u]
    n = np.float32((2 * radius + 1) ** 2)
    noise = np.float32(NOISE_VARIANCE * _UNITS**2) * n * n
    zero, one, outside = np.float32(0.0), np.float32(1.0), np.float32(_OUTSIDE)
    of_s, of_ss, of_rs = rows[0], rows[1], rows[2]
    for u in range(width):
        mean = np.float32(of_s[u])
        spread = n * np.float32(of_ss[u]) - mean * mean + noise
        joint = n * np.float32(of_rs[u]) - means[u] * mean
        cost = one - joint / np.sqrt(spread * (spreads[u] + noise))
        cost = cost if cost > zero else zero
        cost = cost if cost < one else one
        out[u] = cost if shown[u] else outside


@kernel
def _window_sums(centred: I32, radius: int) -> tuple[F32, F32]:
    """(H, W) sums of the reference's windows, and their variances times n squared."""
    height, width = centred.shape
    n = np.float32((2 * radius + 1) ** 2)
    means, spreads = np.empty((height, width), np.float32), np.empty((height, width), np.float32)
    column, squares = np.empty(width, np.int64), np.empty(width, np.int64)
    for v in range(height):
        column[:] = 0
        squares[:] = 0
        for k in range(v - radius, v + radius + 1):
            row = centred[min(max(k, 0), height - 1)]
            for u in range(width):
                column[u] += row[u]
                squares[u] += row[u] * row[u]
        for u in range(width):
            total, square = 0, 0
            for k in range(u - radius, u + radius + 1):
                at = min(max(k, 0), width - 1)
                total += column[at]
                square += squares[at]
            mean = np.float32(total)
            means[v, u] = mean
            spreads[v, u] = n * np.float32(square) - mean * mean
    return means, spreads


@kernel
def _sort(each: F32) -> None:
    """The costs of each pixel, ascending: (S, W)."""
    count, width = each.shape
    for end in range(count - 1, 0, -1):
        for k in range(end):
            low, high = each[k], each[k + 1]
            for u in range(width):
                a, b = low[u], high[u]
                low[u], high[u] = a if a < b else b, b if a < b else a


@kernel
def _mean_of_best(each: F32, used: I32, totals: F32, out: U8) -> None:
    """The mean of the best two thirds of the sources that show a pixel, of (S, W) sorted costs.

    used, totals: (W,) scratch.  All loops but the last are SIMD code: it writes far apart.
    """
    count, width = each.shape
    one, zero = np.float32(1.0), np.float32(0.0)
    used[:] = 0
    totals[:] = zero
    for s in range(count):
        row = each[s]
        for u in range(width):
            used[u] += np.int32(row[u] <= one)
    for u in range(width):
        used[u] = np.int32(np.int32(2 * used[u] + 2) // np.int32(3))
    for s in range(count):
        row = each[s]
        for u in range(width):
            totals[u] += row[u] if np.int32(s) < used[u] else zero
    for u in range(width):
        mean = totals[u] / np.float32(max(used[u], np.int32(1)))
        totals[u] = np.float32(WORST) * (mean if used[u] > 0 else one) + np.float32(0.5)
    for u in range(width):
        out[u] = np.uint8(totals[u])


def inverse_depths_between(least: float, most: float, step: float, count: int) -> F64:
    """(D,) evenly spaced inverse depths, at most ``count``, no nearer than a step apart."""
    number = int(min(max(np.ceil((most - least) / step), 2), count - 1)) + 1
    return np.linspace(least, most, number)

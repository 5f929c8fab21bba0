"""The dominant flow between two frames (VITAMIN-E, section 2.2).

BRIEF pairs (Calonder et al. 2010, without steering) on the image at a sixth of its size, or larger
if that leaves too few rows.  An affine model y = A x + b is fitted to them with the Geman-McClure
kernel (Eq. 2-3).
"""

from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from pliant.algorithms.arrays import F32, F64, Shape
from pliant.algorithms.image.pixels import shrink
from pliant.algorithms.image.vector_code import count_bits
from pliant.algorithms.tracking.maxima import curvature_and_maxima
from pliant.compiler.kernel import fast_kernel

SHRINK = 6
"""The paper's subsampling."""
BRIEF_RADIUS = 7
"""Half-width in pixels of the window that BRIEF compares points in."""
BRIEF_WORDS = 4
"""64-bit words of a descriptor: 256 comparisons."""
_LEAST_SIDE = 2 * (2 * BRIEF_RADIUS + 1)
"""Minimum side of the small image, so that half of its rows and columns can be described."""
_CLEAR = 2
"""Small pixels from a masked area within which its edge affects the curvature."""


@dataclass(frozen=True, kw_only=True)
class BriefFeatures:
    """Described points of one frame.  points_px are of the full-size image."""

    points_px: Annotated[F32, Shape("N", 2)]
    descriptors: Annotated[NDArray[np.uint64], Shape("N", BRIEF_WORDS)]


class BriefExtractor:
    """Describes curvature extrema of the small image."""

    def __init__(self, rng: np.random.Generator, max_points: int) -> None:
        """Draw the comparisons from an isotropic Gaussian: the best of the paper's variants."""
        tests = rng.normal(0.0, BRIEF_RADIUS / 2.5, (64 * BRIEF_WORDS, 4))
        limit = float(BRIEF_RADIUS)
        self._tests = np.clip(np.rint(tests), -limit, limit).astype(np.int32)
        self._max_points = max_points

    def extract(self, grey: NDArray[Any], clearance: F32 | None = None) -> BriefFeatures:
        """Describe the strongest curvature maxima of a (H, W) image.

        clearance: (H, W) of its mask, whose unused parts are filled in; None: without one.
        """
        factor = min(SHRINK, max(1, min(grey.shape) // _LEAST_SIDE))
        small = shrink(grey, factor)
        if min(small.shape) <= 2 * BRIEF_RADIUS + 1:
            return _no_features()
        smooth, _, _, maxima = curvature_and_maxima(small, 1.0, 0.1)
        u, v, strength = maxima[:, 0], maxima[:, 1], np.abs(maxima[:, 2])
        height, width = small.shape
        limit_u, limit_v = width - 1 - BRIEF_RADIUS, height - 1 - BRIEF_RADIUS
        inside = (u >= BRIEF_RADIUS) & (u <= limit_u) & (v >= BRIEF_RADIUS) & (v <= limit_v)
        if clearance is not None:
            seen = np.ascontiguousarray(clearance[factor // 2 :: factor, factor // 2 :: factor])
            clear = seen[np.rint(v).astype(np.int32), np.rint(u).astype(np.int32)]
            inside &= clear > _CLEAR * factor
        kept = np.flatnonzero(inside)
        strongest = np.argsort(-strength[kept], kind="stable")[: self._max_points]
        points = maxima[kept[np.sort(strongest)], :2]
        descriptors = np.zeros((len(points), BRIEF_WORDS), np.uint64)
        _describe(smooth, points, self._tests, descriptors)
        full = (points + np.float32(0.5)) * np.float32(factor) - np.float32(0.5)
        return BriefFeatures(points_px=full, descriptors=descriptors)


def _no_features() -> BriefFeatures:
    return BriefFeatures(
        points_px=np.zeros((0, 2), np.float32),
        descriptors=np.zeros((0, BRIEF_WORDS), np.uint64),
    )


def match_features(
    previous: BriefFeatures, current: BriefFeatures, *, max_distance_bits: int, max_shift_px: float
) -> tuple[F32, F32]:
    """Pair features that are each other's nearest.  Returns two (N, 2) arrays of pixels."""
    if len(previous.points_px) == 0 or len(current.points_px) == 0:
        return np.zeros((0, 2), np.float32), np.zeros((0, 2), np.float32)
    partners = _match(
        previous.points_px,
        previous.descriptors,
        current.points_px,
        current.descriptors,
        max_distance_bits,
        np.float32(max_shift_px * max_shift_px),
    )
    found = np.flatnonzero(partners >= 0)
    return previous.points_px[found], current.points_px[partners[found]]


def fit_affine(sources_px: F32, targets_px: F32, *, sigma_px: float) -> F64:
    """Fit y = A x + b by Gauss-Newton under the Geman-McClure kernel (Eq. 2-3).

    sources_px, targets_px: (N, 2) pairs.  sigma_px: scale of the kernel; the first steps use
    4 and 2 times as much.  Starts from the most voted translation.  Returns (2, 3) [A | b]; the
    identity where fewer than six pairs are given or agree.
    """
    if len(sources_px) < 6:
        return np.eye(2, 3)
    centre = sources_px.mean(axis=0, dtype=np.float64)
    # Centred and scaled, the normal equations are well conditioned.
    scale = max(float(np.abs(sources_px - centre).max()), 1.0)
    x = (sources_px - centre) / scale
    y = targets_px.astype(np.float64) - centre
    shift = most_voted_shift(sources_px, targets_px, 4.0 * sigma_px)
    model: F64 = np.array([[scale, 0.0, shift[0]], [0.0, scale, shift[1]]])
    squares = np.empty(len(x))
    _gauss_newton(x, y, model, sigma_px, squares)
    weights = geman_mcclure_weights(squares, sigma_px)
    supporting = int((weights > 0.25).sum())
    A = model[:, :2] / scale
    sane = bool(np.all(np.isfinite(model))) and bool(np.abs(A - np.eye(2)).max() < 0.5)
    if supporting < 6 or not sane:
        return np.eye(2, 3)
    b = model[:, 2] + centre - A @ centre
    return np.column_stack([A, b]).astype(np.float64)


def geman_mcclure_weights(squares: F64, sigma: float) -> F64:
    """Weights of the kernel (Eq. 3) in Gauss-Newton, 1 at zero: (sigma^2 / (x^2 + sigma^2))^2."""
    return (sigma * sigma / (squares + sigma * sigma)) ** 2


def most_voted_shift(sources_px: F32, targets_px: F32, bin_px: float) -> F64:
    """The mean displacement in the fullest neighbourhood of a histogram of displacements."""
    return _most_voted(targets_px - sources_px, np.float32(bin_px * bin_px))


@fast_kernel
def _most_voted(shifts: F32, square: np.float32) -> F64:
    best_votes = 0
    best = np.zeros(2)
    for i in range(len(shifts)):
        votes = 0
        u, v = np.float32(0.0), np.float32(0.0)
        for j in range(len(shifts)):
            du, dv = shifts[j, 0] - shifts[i, 0], shifts[j, 1] - shifts[i, 1]
            near = np.float32(1.0) if du * du + dv * dv < square else np.float32(0.0)
            votes += int(near)
            u += near * du
            v += near * dv
        if votes > best_votes:
            best_votes = votes
            best[0] = shifts[i, 0] + u / np.float32(votes)
            best[1] = shifts[i, 1] + v / np.float32(votes)
    return best


@fast_kernel
def _gauss_newton(x: F64, y: F64, model: F64, sigma_px: float, squares: F64) -> None:
    """Improve the (2, 3) model in place; squares: (N,) of the residuals before the last step."""
    for step in range(15):
        sigma = sigma_px * (4.0 if step < 4 else 2.0 if step < 8 else 1.0)
        square = sigma * sigma
        xx = xy = yy = sx = sy = n = 0.0
        ux = uy = u = vx = vy = v = 0.0
        for i in range(len(x)):
            px, py = x[i, 0], x[i, 1]
            ru = y[i, 0] - (model[0, 0] * px + model[0, 1] * py + model[0, 2])
            rv = y[i, 1] - (model[1, 0] * px + model[1, 1] * py + model[1, 2])
            squares[i] = ru * ru + rv * rv
            ratio = square / (squares[i] + square)
            weight = ratio * ratio
            wx, wy, wu, wv = weight * px, weight * py, weight * ru, weight * rv
            xx, xy, yy = xx + wx * px, xy + wx * py, yy + wy * py
            sx, sy, n = sx + wx, sy + wy, n + weight
            ux, uy, u = ux + wu * px, uy + wu * py, u + wu
            vx, vy, v = vx + wv * px, vy + wv * py, v + wv
        # Damped just enough for collinear points.
        xx, yy, n = xx + 1e-9, yy + 1e-9, n + 1e-9
        # Cofactors of the normal matrix [[xx, xy, sx], [xy, yy, sy], [sx, sy, n]].
        a, b, c = yy * n - sy * sy, sx * sy - xy * n, xy * sy - sx * yy
        d, e, f = xx * n - sx * sx, xy * sx - xx * sy, xx * yy - xy * xy
        determinant = xx * a + xy * b + sx * c
        model[0, 0] += (a * ux + b * uy + c * u) / determinant
        model[0, 1] += (b * ux + d * uy + e * u) / determinant
        model[0, 2] += (c * ux + e * uy + f * u) / determinant
        model[1, 0] += (a * vx + b * vy + c * v) / determinant
        model[1, 1] += (b * vx + d * vy + e * v) / determinant
        model[1, 2] += (c * vx + e * vy + f * v) / determinant


@fast_kernel
def _describe(
    smooth: F32, points: F32, tests: NDArray[np.int32], descriptors: NDArray[np.uint64]
) -> None:
    width = smooth.shape[1]
    image = smooth.reshape(-1)
    first = np.empty(len(tests), np.int64)
    second = np.empty(len(tests), np.int64)
    for bit in range(len(tests)):
        first[bit] = tests[bit, 1] * width + tests[bit, 0]
        second[bit] = tests[bit, 3] * width + tests[bit, 2]
    for i in range(len(points)):
        centre = int(points[i, 1] + 0.5) * width + int(points[i, 0] + 0.5)
        for word in range(BRIEF_WORDS):
            bits = np.uint64(0)
            for bit in range(64):
                a = image[centre + first[64 * word + bit]]
                b = image[centre + second[64 * word + bit]]
                bits |= np.uint64(a < b) << np.uint64(bit)
            descriptors[i, word] = bits


@fast_kernel
def _match(
    points_a: F32,
    descriptors_a: NDArray[np.uint64],
    points_b: F32,
    descriptors_b: NDArray[np.uint64],
    max_distance: int,
    max_shift_squared: np.float32,
) -> NDArray[np.int64]:
    """Index of each a's partner in b, -1 where the choice is not mutual or not near enough."""
    count_a, count_b = len(points_a), len(points_b)
    best_of_a = np.full(count_a, -1, np.int64)
    best_of_b = np.full(count_b, -1, np.int64)
    distance_of_b = np.full(count_b, max_distance + 1, np.int64)
    for i in range(count_a):
        best = max_distance + 1
        for j in range(count_b):
            du = points_a[i, 0] - points_b[j, 0]
            dv = points_a[i, 1] - points_b[j, 1]
            bits = np.uint64(0)
            for word in range(BRIEF_WORDS):
                bits += count_bits(descriptors_a[i, word] ^ descriptors_b[j, word])
            # Hardly any pair is nearer than the best so far: this branch is predictable.
            far = du * du + dv * dv > max_shift_squared
            distance = np.int64(bits) + (np.int64(64 * BRIEF_WORDS + 1) if far else np.int64(0))
            if distance < best:
                best = distance
                best_of_a[i] = j
            if distance < distance_of_b[j]:
                distance_of_b[j] = distance
                best_of_b[j] = i
    for i in range(count_a):
        if best_of_a[i] >= 0 and best_of_b[best_of_a[i]] != i:
            best_of_a[i] = -1
    return best_of_a

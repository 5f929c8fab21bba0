"""What the depths of a keyframe and of its neighbours agree on (visibility-based fusion).

Merrell et al. 2007, section 3.1 and 3.2: the depths of the neighbours are rendered into the view;
each is a candidate.  What supports a candidate counts for it; a depth in front of it (the candidate
would be hidden) and a neighbour that sees through it (free space) count against it.  They take the
nearest stable depth, or the most confident one; here support and conflicts are one sum,

    S(w_i) = sum_j c_j (1 - (w_j - w_i)^2 / (tol w_i)^2)+ - 0.3 sum_front c_j - 0.5 sum_through c_j.
"""

from collections.abc import Sequence

import cv2
import numpy as np

from pliant.algorithms.arrays import F32
from pliant.algorithms.stereo.matching import textured
from pliant.algorithms.stereo.sweep import FINE_RADIUS, poses_of
from pliant.algorithms.stereo.views import DenseDepth, StereoView, motion
from pliant.compiler.kernel import kernel

_TOLERANCE = 0.03
"""Share of the inverse depth by which depths of one surface differ at most."""
_OWN = 1.5
"""How much more the view's own depth counts: it was not resampled."""
_FRONT, _THROUGH = 0.3, 0.5
"""What a confidence that contradicts a candidate counts."""


def consensus(
    view: StereoView, own: DenseDepth, others: Sequence[StereoView], depths: Sequence[DenseDepth]
) -> DenseDepth:
    """The inverse depth with the largest sum at each pixel, and its support, which may exceed 1.

    Without texture there is none.   others, depths: (N) neighbours of the same camera.
    """
    shape = view.grey.shape
    w, c = (np.zeros((len(others) + 1, *shape), np.float32) for _ in range(2))
    w[0], c[0] = own.inverse_depths, np.float32(_OWN) * own.confidences
    maps = np.zeros((len(others), *shape, 2), np.float32)
    there = motion(view.camera, view.T_world_camera, poses_of(others))
    for j, (other, depth) in enumerate(zip(others, depths, strict=True)):
        maps[j, ..., 0], maps[j, ..., 1] = depth.inverse_depths, depth.confidences
        back = motion(view.camera, other.T_world_camera, view.T_world_camera[None])
        _splat(
            maps[j], back.homographies[0].astype(np.float32),
            back.translations[0].astype(np.float32), w[j + 1], c[j + 1],
        )  # fmt: skip
    found, support = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    _agree(
        w, c, maps, there.homographies.astype(np.float32), there.translations.astype(np.float32),
        found, support,
    )  # fmt: skip
    smooth = np.asarray(cv2.medianBlur(found, 3), np.float32)
    found = np.where((found > 0.0) & (smooth > 0.0), smooth, found)
    known = textured(view.grey, FINE_RADIUS)
    return DenseDepth(*(np.where(known, each, np.float32(0.0)) for each in (found, support)))


@kernel
def _splat(depth: F32, A: F32, b: F32, w: F32, c: F32) -> None:
    """Move (H, W, 2) inverse depths and confidences to the nearest pixel of another view (H, W),
    where the nearest surface stays."""
    height, width = w.shape
    half = np.float32(0.5)
    right, low = np.float32(width) - half, np.float32(height) - half
    for v in range(height):
        for u in range(width):
            inverse_depth, confidence = depth[v, u, 0], depth[v, u, 1]
            if not (confidence > np.float32(0.0) and inverse_depth > np.float32(0.0)):
                continue
            x, y, z = _moved(A, b, u, v, inverse_depth)
            if not (z > np.float32(0.0) and -half <= x < right and -half <= y < low):
                continue
            i, j, there = int(x + half), int(y + half), inverse_depth / z
            if there > w[j, i]:
                w[j, i], c[j, i] = there, confidence


@kernel
def _moved(
    A: F32, b: F32, u: int, v: int, w: np.float32
) -> tuple[np.float32, np.float32, np.float32]:
    """A pixel in another view, and the ratio of the depth there to that here."""
    x, y = np.float32(u), np.float32(v)
    z = A[2, 0] * x + A[2, 1] * y + A[2, 2] + b[2] * w
    return (
        (A[0, 0] * x + A[0, 1] * y + A[0, 2] + b[0] * w) / z,
        (A[1, 0] * x + A[1, 1] * y + A[1, 2] + b[1] * w) / z,
        z,
    )


@kernel
def _agree(
    w: F32, c: F32, maps: F32, homographies: F32, translations: F32, found: F32, support: F32
) -> None:
    """w, c: (N + 1, H, W) candidates and confidences in this view, 0 where there are none.

    maps: (N, H, W, 2) the same in the neighbours' own views.
    """
    count, height, width = w.shape
    zero, one = np.float32(0.0), np.float32(1.0)
    tolerance, through = np.float32(_TOLERANCE), np.float32(_THROUGH)
    scores = np.empty((count, width), np.float32)
    for v in range(height):
        for i in range(count):
            scores[i, :] = zero
            for j in range(count):
                _vote(w[i, v], w[j, v], c[j, v], scores[i])
        for u in range(width):
            # Those that see through only lower a score: the most promising first, until none of
            # the rest can be better.
            best, chosen = zero, -1
            for _ in range(count):
                i = -1
                for j in range(count):
                    if c[j, v, u] > zero and scores[j, u] > (scores[i, u] if i >= 0 else best):
                        i = j
                if i < 0:
                    break
                score = scores[i, u] - through * _seen_through(
                    w[i, v, u], u, v, maps, homographies, translations
                )
                scores[i, u] = zero
                if score > best:
                    best, chosen = score, i
            if chosen < 0:
                continue
            agreed = w[chosen, v, u]
            total, weight, reach = zero, zero, tolerance * agreed
            for j in range(count):
                off = w[j, v, u] - agreed
                if abs(off) < reach:
                    share = c[j, v, u] * (one - (off / reach) * (off / reach))
                    total += share * w[j, v, u]
                    weight += share
            found[v, u], support[v, u] = total / weight, weight


@kernel
def _vote(candidate: F32, w: F32, c: F32, scores: F32) -> None:
    """What a row of depths w with confidences c, 0 where there are none, counts for one of
    candidates; SIMD code, as pixels side by side do not wait for each other."""
    zero, one = np.float32(0.0), np.float32(1.0)
    tolerance, front = np.float32(_TOLERANCE), np.float32(_FRONT)
    for u in range(len(scores)):
        off, reach = w[u] - candidate[u], tolerance * candidate[u]
        share = off / reach
        against = -front * c[u] if off > zero else zero
        scores[u] += c[u] * (one - share * share) if abs(off) < reach else against


@kernel
def _seen_through(
    w: np.float32, u: int, v: int, maps: F32, homographies: F32, translations: F32
) -> np.float32:
    """Sum of the confidences of neighbours that see something behind a candidate."""
    height, width = maps.shape[1:3]
    half, total = np.float32(0.5), np.float32(0.0)
    right, low = np.float32(width) - half, np.float32(height) - half
    for j in range(len(maps)):
        x, y, z = _moved(homographies[j], translations[j], u, v, w)
        if not (z > np.float32(0.0) and -half <= x < right and -half <= y < low):
            continue
        at_u, at_v = int(x + half), int(y + half)
        seen = maps[j, at_v, at_u, 0]
        if seen < (np.float32(1.0) - np.float32(_TOLERANCE)) * (w / z):
            total += maps[j, at_v, at_u, 1]
    return total

"""What a place is recognised by: corners of an image at several scales, and their descriptors.

ORB (Rublee et al., "ORB: an efficient alternative to SIFT or SURF", ICCV 2011) as OpenCV has it:
FAST corners of a pyramid, turned by their intensity centroid, 256 comparisons of pixels each.  The
map's own points do not serve: of 15,000 curvature extrema of a frame the 600 strongest, one in each
part of the image, are 5 % the same from another view, where corners are a third and more.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from pliant.algorithms.arrays import F32, I32, I64, U8, U64, BoolArray
from pliant.compiler.kernel import fast_kernel, kernel

_FEATURES = 700
"""In an image.  With the index these are 45 kB."""

_SCALE_FACTOR = 1.2
_LEVELS = 8
"""Of the pyramid: 3.6 times."""

_FAST_THRESHOLD = 10
"""Grey levels by which a corner differs; in half the light as well."""

_MAX_BITS = 64
"""Of 256 by which descriptors of one corner may differ."""

_RATIO = 0.85
"""Of the bits to the next best descriptor (Lowe, IJCV 2004, section 7.1)."""

_WORDS = 4
"""Of 64 bits in a descriptor."""


@dataclass(frozen=True, kw_only=True)
class Features:
    """Corners of an image, the strongest first of each scale.

    points_px: (n, 2).    descriptors: (n, 32) bytes.
    """

    points_px: F32
    descriptors: U8


def describe(grey: U8) -> Features:
    """Corners of an image (H, W), none where it shows nothing."""
    orb = cv2.ORB_create(  # pyright: ignore[reportAttributeAccessIssue]
        nfeatures=_FEATURES, scaleFactor=_SCALE_FACTOR, nlevels=_LEVELS,
        fastThreshold=_FAST_THRESHOLD,
    )  # fmt: skip
    corners, descriptors = orb.detectAndCompute(grey, None)
    if descriptors is None:
        return Features(points_px=np.zeros((0, 2), np.float32), descriptors=np.zeros((0, 32), "u1"))
    # OpenCV scales pixels by their corner, we by their centre.
    places = [(*corner.pt, 0.5 * (_SCALE_FACTOR**corner.octave - 1.0)) for corner in corners]
    u, v, shift = np.array(places).T
    points_px = np.column_stack([u + shift, v + shift]).astype(np.float32)
    return Features(points_px=points_px, descriptors=descriptors)


def match(a: Features, b: Features) -> I64:
    """(m, 2) corners of a and of b that are each other's best, clearly better than the next."""
    A, B = (np.ascontiguousarray(each.descriptors).view(np.uint64) for each in (a, b))
    there, back = np.full(len(A), -1, np.int32), np.full(len(B), -1, np.int32)
    _best(A, B, there, _RATIO)
    _best(B, A, back, 1.0)
    found = np.flatnonzero(there >= 0)
    found = found[back[there[found]] == found]
    return np.column_stack([found, there[found]]).astype(np.int64)


def look_alike(seen: Features, corners: I64) -> I64:
    """(m, 2) of an image: which of some corners (n,), and which of all looks as they do."""
    every = np.ascontiguousarray(seen.descriptors).view(np.uint64)
    found = np.zeros((len(corners), len(every)), np.bool_)
    _alike(every[corners], every, found)
    return np.argwhere(found)


@kernel
def _alike(A: U64, B: U64, found: BoolArray) -> None:
    for i in range(A.shape[0]):
        for j in range(B.shape[0]):
            distance = 0
            for k in range(_WORDS):
                distance += _bits(A[i, k] ^ B[j, k])
            found[i, j] = distance <= _MAX_BITS


@fast_kernel
def _bits(word: np.uint64) -> np.int64:
    """How many bits are set."""
    word = word - ((word >> np.uint64(1)) & np.uint64(0x5555555555555555))
    twos = np.uint64(0x3333333333333333)
    word = (word & twos) + ((word >> np.uint64(2)) & twos)
    word = (word + (word >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return np.int64((word * np.uint64(0x0101010101010101)) >> np.uint64(56))


@kernel
def _best(A: U64, B: U64, found: I32, ratio: float) -> None:
    """Index of the nearest of B to each of A, left where none is near or the next is as well."""
    for i in range(A.shape[0]):
        nearest, least, following = -1, 256, 256
        for j in range(B.shape[0]):
            distance = 0
            for k in range(_WORDS):
                distance += _bits(A[i, k] ^ B[j, k])
            if distance < least:
                nearest, least, following = j, distance, least
            elif distance < following:
                following = distance
        if least <= _MAX_BITS and least <= ratio * following:
            found[i] = nearest

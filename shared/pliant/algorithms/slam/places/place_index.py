"""Places: their description by corners, and the index that finds the places most similar to an
image.

Description.  Corners of an image at several scales: ORB (Rublee et al., "ORB: an efficient
alternative to SIFT or SURF", ICCV 2011) of OpenCV: FAST corners of a pyramid, rotated by their
intensity centroid, 256 comparisons of pixels each.  The map's own points are unsuitable: of 15,000
curvature extrema of a frame, the 600 strongest, one in each part of the image, are 5 % the same
from another view, while corners are a third and more.

Index.  It does not compare each descriptor of each place.  The first bytes of a binary descriptor
are hashes of it: its bits are comparisons chosen to be as independent as possible.  So descriptors
of one corner often share 16 consecutive bits, and others hardly ever do (multi-index hashing,
Norouzi et al., CVPR 2012).  Each such chunk is a word.  Places are scored by the words that they
share with the image, weighted by how rare those are (Sivic and Zisserman, "Video Google", ICCV
2003).  Words of many places carry little information and are skipped, so a query takes time with
the square root of the number of places.  There is no vocabulary to train or to load; the index
grows with the map.

Repetition.  An image may repeat itself a step aside: tiles, chequers, windows, bars.  If the
content at X is repeated at X + d, a camera that is a step d aside sees the same image.  Then it
verifies no pose, because the pattern may continue outside the map.  The image itself shows this,
free of noise, light or viewpoint.  Each two of its similar corners propose a step (RANSAC by one
pair).  The step holds for a corner if the image has a similar one a step forth or back; which of
the two is in view is chance.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field

import cv2
import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, I64, U8, U64, BoolArray
from pliant.algorithms.camera import PinholeCamera
from pliant.compiler.kernel import fast_kernel, kernel

_FEATURES = 700
"""In an image.  With the index these are 45 kB."""

_MOST_PIXELS = 640 * 480
"""Of the image that corners are looked for in: larger ones are reduced to as many, which costs half
as much and leaves as many corners as are wanted."""

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

_CHUNKS = 3
_BITS = 16

_COMMON, _COMMON_GROWTH = 8.0, 2.0
"""A word of this many places, or of this times the root of their number, is skipped."""

_LEAST_DEAD = 64
"""Forgotten places before the index is rebuilt."""

_APART_SHARE = 0.025
"""Of the image's width: what looks alike within is one corner, found at two scales."""

_STEPS = 500
"""Tried at most: one that holds for a tenth is among these."""


@dataclass(frozen=True, kw_only=True)
class Features:
    """Corners of an image, the strongest first of each scale.

    points_px: (n, 2).    descriptors: (n, 32) bytes.
    """

    points_px: F32
    descriptors: U8


def describe(grey: U8) -> Features:
    """Corners of an image (H, W), none where it shows nothing."""
    small, scale = _reduced(grey)
    orb = cv2.ORB_create(  # pyright: ignore[reportAttributeAccessIssue]
        nfeatures=_FEATURES, scaleFactor=_SCALE_FACTOR, nlevels=_LEVELS,
        fastThreshold=_FAST_THRESHOLD,
    )  # fmt: skip
    corners, descriptors = orb.detectAndCompute(small, None)
    if descriptors is None:
        return Features(points_px=np.zeros((0, 2), np.float32), descriptors=np.zeros((0, 32), "u1"))
    # OpenCV scales pixels by their corner, we by their centre.
    places = [(*corner.pt, 0.5 * (_SCALE_FACTOR**corner.octave - 1.0)) for corner in corners]
    u, v, shift = np.array(places).T
    points_px = np.column_stack([u + shift, v + shift])
    if small is not grey:
        points_px = (points_px + 0.5) / scale - 0.5
    return Features(points_px=points_px.astype(np.float32), descriptors=descriptors)


def _reduced(grey: U8) -> tuple[U8, F64]:
    """The image at no more than that many pixels, and its (width, height) as shares of before."""
    height, width = grey.shape
    share = np.sqrt(_MOST_PIXELS / grey.size)
    if share >= 1.0:
        return grey, np.ones(2)
    size = max(round(share * width), 1), max(round(share * height), 1)
    small = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.uint8), np.array(size) / (width, height)


def match(a: Features, b: Features) -> I64:
    """(m, 2) corners of a and of b that are each other's best, clearly better than the next."""
    A, B = (np.ascontiguousarray(each.descriptors).view(np.uint64) for each in (a, b))
    there, back = np.full(len(A), -1, np.int64), np.full(len(B), -1, np.int64)
    _best(A, B, there, back)
    found = np.flatnonzero(there >= 0)
    found = found[back[there[found]] == found]
    return np.column_stack([found, there[found]])


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
            bits = np.uint64(0)
            for k in range(_WORDS):
                bits += _bits_of_bytes(A[i, k] ^ B[j, k])
            found[i, j] = _sum_of_bytes(bits) <= _MAX_BITS


@fast_kernel
def _bits_of_bytes(word: np.uint64) -> np.uint64:
    """How many bits are set in each byte, in that byte."""
    word = word - ((word >> np.uint64(1)) & np.uint64(0x5555555555555555))
    twos = np.uint64(0x3333333333333333)
    word = (word & twos) + ((word >> np.uint64(2)) & twos)
    return (word + (word >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)


@fast_kernel
def _sum_of_bytes(word: np.uint64) -> np.int64:
    """By shifts, not by a product, which has no SIMD code."""
    pairs = np.uint64(0x00FF00FF00FF00FF)
    word = (word & pairs) + ((word >> np.uint64(8)) & pairs)
    word = word + (word >> np.uint64(16))
    return np.int64((word + (word >> np.uint64(32))) & np.uint64(0xFFFF))


@kernel
def _best(A: U64, B: U64, there: I64, back: I64) -> None:
    """Index of the nearest of B to each of A, left where none is near or the next is as well; and
    of the nearest of A to each of B."""
    count = B.shape[0]
    columns = np.ascontiguousarray(B.T)
    b0, b1, b2, b3 = columns[0], columns[1], columns[2], columns[3]
    distances = np.empty(count, np.int64)
    closest = np.full(count, 257, np.int64)
    for i in range(A.shape[0]):
        a0, a1, a2, a3 = A[i, 0], A[i, 1], A[i, 2], A[i, 3]
        least = np.int64(256)
        for j in range(count):  # SIMD code, as the next loop
            bits = _bits_of_bytes(a0 ^ b0[j]) + _bits_of_bytes(a1 ^ b1[j])
            bits += _bits_of_bytes(a2 ^ b2[j]) + _bits_of_bytes(a3 ^ b3[j])
            distance = _sum_of_bytes(bits)
            distances[j] = distance
            least = min(least, distance)
        for j in range(count):
            nearer = distances[j] < closest[j]
            closest[j] = distances[j] if nearer else closest[j]
            back[j] = i if nearer else back[j]
        if least <= _MAX_BITS:
            there[i] = _clearly_nearest(distances, least)


@kernel
def _clearly_nearest(distances: I64, least: np.int64) -> int:
    """The first at the least distance; -1 where the next is about as near."""
    nearest, following = -1, 256
    for j in range(distances.size):
        if nearest < 0 and distances[j] == least:
            nearest = j
        else:
            following = min(following, distances[j])
    return nearest if least <= _RATIO * following else -1


def words_of(descriptors: U8) -> I32:
    """Ascending words of descriptors (n, 32), each once."""
    chunks = np.ascontiguousarray(descriptors[:, : 2 * _CHUNKS]).view("<u2").astype(np.int32)
    return np.unique(chunks + (np.arange(_CHUNKS, dtype=np.int32) << _BITS))


@dataclass(kw_only=True)
class PlaceIndex:
    """Features of places by their ids, and an inverted file of their words.

    ids: of each slot; slots are in the order in which places came.   sizes: words of each.
    alive: whether it is still a place.   starts: of each word, where in ``entries`` its slots are,
    one after the other, so that a query waits for memory once a word.   counts: how many slots it
    has; there is room for the power of two from there, and then it moves to where there is twice as
    much.   entries: (capacity,).   used: how many of these are taken.
    """

    features: dict[int, Features] = field(default_factory=dict[int, Features])
    ids: list[int] = field(default_factory=list[int])
    sizes: list[int] = field(default_factory=list[int])
    alive: list[bool] = field(default_factory=list[bool])
    starts: I32 = field(default_factory=lambda: np.zeros(_CHUNKS << _BITS, np.int32))
    counts: I32 = field(default_factory=lambda: np.zeros(_CHUNKS << _BITS, np.int32))
    entries: I32 = field(default_factory=lambda: np.zeros(1 << 12, np.int32))
    used: int = 0

    def add(self, place: int, features: Features) -> None:
        """Remember a new place."""
        words = words_of(features.descriptors)
        while self.used + _room_for(words, self.counts) > len(self.entries):
            self.entries = np.concatenate([self.entries, np.zeros_like(self.entries)])
        self.used = _enter(words, len(self.ids), self.starts, self.counts, self.entries, self.used)
        self.features[place] = features
        self.ids.append(place)
        self.sizes.append(len(words))
        self.alive.append(True)

    def forget(self, places: Iterable[int]) -> None:
        """These are places no more."""
        gone = set(places) & self.features.keys()
        if not gone:
            return
        for place in gone:
            del self.features[place]
        self.alive = [
            known and place not in gone for known, place in zip(self.alive, self.ids, strict=True)
        ]
        dead = len(self.ids) - len(self.features)
        if dead > max(_LEAST_DEAD, len(self.features)):
            rebuilt = PlaceIndex()
            for place, features in self.features.items():
                rebuilt.add(place, features)
            vars(self).update(vars(rebuilt))

    def query(self, features: Features) -> list[int]:
        """Ids of the places that share words with an image, the most alike first."""
        scores = np.zeros(len(self.ids))
        alive = np.array(self.alive, np.bool_)
        words = words_of(features.descriptors)
        words = words[self.counts[words] < _COMMON + _COMMON_GROWTH * np.sqrt(len(scores))]
        _score(words, self.starts, self.counts, self.entries, alive, scores)
        # A place with many words shares some with every image.
        scores /= np.sqrt(np.maximum(np.array(self.sizes), 1))
        order: I64 = np.argsort(-scores, kind="stable")
        return [self.ids[slot] for slot in order.tolist() if scores[slot] > 0.0]


@kernel
def _room_for(words: I32, counts: I32) -> int:
    """How many entries are taken when each of the words gets one more."""
    room = 0
    for word in words:
        count = int(counts[word])
        if count & (count - 1) == 0:
            room += max(2 * count, 1)
    return room


@kernel
def _enter(words: I32, slot: int, starts: I32, counts: I32, entries: I32, used: int) -> int:
    """Add a slot to words, each once.  Returns how many entries are taken."""
    for word in words:
        count = int(counts[word])
        if count & (count - 1) == 0:  # full
            for k in range(count):
                entries[used + k] = entries[starts[word] + k]
            starts[word] = used
            used += max(2 * count, 1)
        entries[starts[word] + count] = slot
        counts[word] = count + 1
    return used


@kernel
def _score(
    words: I32, starts: I32, counts: I32, entries: I32, alive: BoolArray, scores: F64
) -> None:
    """Add the squared log of how rare each word is to the places that have it."""
    for word in words:
        if counts[word] == 0:
            continue
        rarity = np.log((1.0 + scores.size) / counts[word])
        for k in range(starts[word], starts[word] + counts[word]):
            if alive[entries[k]]:
                scores[entries[k]] += rarity * rarity


def repeated_share(
    seen: Features,
    corners: I64,
    xyz: F64,
    camera: PinholeCamera,
    *,
    gate_px: float,
    least_step: float,
) -> float:
    """Share of the corners that are seen again after one step, of all steps the largest.

    corners: (n,) of those of an image, rows of ``seen``.   xyz: (n, 3) where they are before the
    camera.   gate_px: largest error.   least_step: shorter ones lead to the same place.
    """
    pairs = look_alike(seen, corners)
    apart = np.linalg.norm(
        seen.points_px[corners[pairs[:, 0]]] - seen.points_px[pairs[:, 1]], axis=1
    )
    pairs = pairs[apart > _APART_SHARE * camera.width]
    row = np.full(len(seen.points_px), -1, np.int64)
    row[corners] = np.arange(len(corners))
    ends = np.column_stack([pairs[:, 0], row[pairs[:, 1]]])
    ends = ends[ends[:, 1] >= 0]
    steps = xyz[ends[:, 1]] - xyz[ends[:, 0]]
    steps = steps[np.linalg.norm(steps, axis=1) > least_step]
    if not len(steps):
        return 0.0
    steps = steps[:: -(-len(steps) // _STEPS)]
    seen_at = camera.normalise(seen.points_px.astype(np.float64))
    return _most_repeated(steps, pairs, xyz, seen_at, gate_px / camera.fx) / len(corners)


@kernel
def _most_repeated(steps: F64, pairs: I64, xyz: F64, seen_at: F64, gate: float) -> int:
    """How many of the corners the best step explains."""
    most, holds = 0, np.empty(len(xyz), np.bool_)
    for s in range(len(steps)):
        holds[:] = False
        for p in range(len(pairs)):
            i, j = pairs[p, 0], pairs[p, 1]
            holds[i] |= _is_at(xyz[i], steps[s], 1.0, seen_at[j], gate)
            holds[i] |= _is_at(xyz[i], steps[s], -1.0, seen_at[j], gate)
        most = max(most, holds.sum())
    return most


@fast_kernel
def _is_at(X: F64, step: F64, sign: float, seen_at: F64, gate: float) -> bool:
    z = X[2] + sign * step[2]
    if z <= 0.0:
        return False
    u, v = (X[0] + sign * step[0]) / z, (X[1] + sign * step[1]) / z
    return (u - seen_at[0]) ** 2 + (v - seen_at[1]) ** 2 < gate * gate

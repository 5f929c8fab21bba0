"""Which of many places look like an image, found without looking at each of their descriptors.

The first bytes of a binary descriptor are hashes of it: its bits are comparisons that were chosen
to depend on each other as little as possible, so descriptors of one corner often share 16 bits in a
row, and others hardly ever (multi-index hashing, Norouzi et al., CVPR 2012).  Each such chunk is a
word of its own; places are scored as texts are, by the words that they share with the image,
weighted by how rare those are (Sivic and Zisserman, "Video Google", ICCV 2003).  Words that many
places have say little and are passed over, so that a query takes as long as the square root of
the number of places.  There is no vocabulary to train or to load; the index grows with the map.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from pliant.algorithms.arrays import F64, I32, I64, U8, BoolArray
from pliant.algorithms.places.features import Features
from pliant.compiler.kernel import kernel

_CHUNKS = 3
_BITS = 16

_COMMON, _COMMON_GROWTH = 8.0, 2.0
"""A word is passed over that as many places have, and so many times the root of their number."""

_LEAST_DEAD = 64
"""Forgotten places before the index is made anew."""


def words_of(descriptors: U8) -> I32:
    """Ascending words of descriptors (n, 32), each once."""
    chunks = np.ascontiguousarray(descriptors[:, : 2 * _CHUNKS]).view("<u2").astype(np.int32)
    return np.unique(chunks + (np.arange(_CHUNKS, dtype=np.int32) << _BITS))


@dataclass(kw_only=True)
class PlaceIndex:
    """Features of places by their ids, and an inverted file of their words.

    ids: of each slot; slots are in the order in which places came.   sizes: words of each.
    alive: whether it is still a place.   heads: newest entry of each word, -1 without one.
    counts: how many entries each has.   entries: (capacity, 2) slot, and the entry before of the
    same word.   used: how many there are.
    """

    features: dict[int, Features] = field(default_factory=dict[int, Features])
    ids: list[int] = field(default_factory=list[int])
    sizes: list[int] = field(default_factory=list[int])
    alive: list[bool] = field(default_factory=list[bool])
    heads: I32 = field(default_factory=lambda: np.full(_CHUNKS << _BITS, -1, np.int32))
    counts: I32 = field(default_factory=lambda: np.zeros(_CHUNKS << _BITS, np.int32))
    entries: I32 = field(default_factory=lambda: np.zeros((1 << 12, 2), np.int32))
    used: int = 0

    def add(self, place: int, features: Features) -> None:
        """Remember a new place."""
        words = words_of(features.descriptors)
        while self.used + len(words) > len(self.entries):
            self.entries = np.concatenate([self.entries, np.zeros_like(self.entries)])
        _enter(words, len(self.ids), self.heads, self.entries, self.used)
        self.counts[words] += 1
        self.used += len(words)
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
            anew = PlaceIndex()
            for place, features in self.features.items():
                anew.add(place, features)
            vars(self).update(vars(anew))

    def query(self, features: Features) -> list[int]:
        """Ids of the places that share words with an image, the most alike first."""
        scores = np.zeros(len(self.ids))
        alive = np.array(self.alive, np.bool_)
        words = words_of(features.descriptors)
        words = words[self.counts[words] < _COMMON + _COMMON_GROWTH * np.sqrt(len(scores))]
        _score(words, self.heads, self.counts, self.entries, alive, scores)
        # A place with many words shares some with every image.
        scores /= np.sqrt(np.maximum(np.array(self.sizes), 1))
        order: I64 = np.argsort(-scores, kind="stable")
        return [self.ids[slot] for slot in order.tolist() if scores[slot] > 0.0]


@kernel
def _enter(words: I32, slot: int, heads: I32, entries: I32, used: int) -> None:
    for word in words:
        entries[used, 0], entries[used, 1] = slot, heads[word]
        heads[word] = used
        used += 1


@kernel
def _score(
    words: I32, heads: I32, counts: I32, entries: I32, alive: BoolArray, scores: F64
) -> None:
    """Add the squared log of how rare each word is to the places that have it."""
    for word in words:
        entry = heads[word]
        if entry < 0:
            continue
        rarity = np.log((1.0 + scores.size) / counts[word])
        while entry >= 0:
            if alive[entries[entry, 0]]:
                scores[entries[entry, 0]] += rarity * rarity
            entry = entries[entry, 1]

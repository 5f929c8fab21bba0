"""Sparsification: what a segment drops when it has more observations than there is memory for.

Maps of any length are adjusted as a whole, and each adjustment takes time and memory per
observation. Dropped content has been published and stays in the results: it no longer takes part in
adjustments, and moves with a keyframe.

Landmarks are dropped first.  A keyframe sees thousands, and a fraction of them determines its pose
as well; those with the most observations stay.  Each keyframe keeps an equal share.  If that
becomes less than a place needs, or keyframes have too many neighbours, keyframes are dropped, the
one with the smallest loss of information first.  Of a landmark observed by n keyframes, one of them
carries a share of 1 / (n - 1), and all of it if n = 1; the loss of a keyframe is the mean over its
landmarks.  In a place that was visited many times, that is one of many visits; on a path, every
other keyframe where the camera was slow.  Landmarks with one remaining keyframe are dropped with
them: the adjustment would take them for outliers.
"""

import heapq

import numpy as np

from pliant.algorithms.arrays import I32, I64, BoolArray
from pliant.algorithms.slam.adjust.final_adjustment import MOST_SEEN
from pliant.algorithms.slam.adjust.segment import DroppedKeyframes, Segment
from pliant.algorithms.slam.map.landmarks import MAPPED
from pliant.algorithms.slam.parameters import WindowParameters
from pliant.compiler.kernel import kernel

_SPARE = 0.1
"""Share of the memory that is freed beyond what is necessary: selecting takes time."""

_LESS = 0.8
"""Factor from one attempt to the next on what keyframes keep: many see landmarks that
others need.
"""

_PAIRS = 25
"""Maximum pairs of keyframes per observation: adjustments have a table of 6 bytes for each pair,
and some 150 for each observation.
"""

_NEAR = 0.5
"""Share of a keyframe's view that others must share for its neighbours in time to be near."""

_SPREAD = 2654435761
"""Knuth's multiplicative hash: spreads equally observed landmarks that are dropped first."""


def observations_of(segments: list[Segment]) -> int:
    """Number of observations of segments, of landmarks and candidates."""
    return sum(len(keyframe.rows) for segment in segments for keyframe in segment.keyframes)


def sparsify(
    segment: Segment,
    room: int,
    limits: WindowParameters,
    linked: I32,
    *,
    whole: int,
    settled: bool = True,
) -> None:
    """Reduce a segment to the allowed number of observations, as far as possible.

    linked: row of each living track, negative where it has none.   whole: newest keyframes that are
    unchanged with their landmarks, because they may not be published yet.
    settled: the others have just been adjusted together, so keyframes with more neighbours than
    ``limits`` allow may be dropped as well.
    """
    most = int(np.sqrt(_PAIRS * room))
    if settled and len(segment.keyframes) > limits.kept_neighbours:
        most = min(most, _most_keyframes(segment, limits.kept_neighbours))
    if observations_of([segment]) > room:
        room = int((1.0 - _SPARE) * room)
        _give_up_points(segment, room, limits.kept_per_keyframe, linked, whole)
    if len(segment.keyframes) > most:
        most = int((1.0 - _SPARE) * most)
    surplus, count = observations_of([segment]) - room, len(segment.keyframes) - most
    if surplus > 0 or count > 0:
        _give_up_keyframes(segment, surplus, count, linked, whole)


def _give_up_points(segment: Segment, room: int, floor: int, linked: I32, whole: int) -> None:
    keyframes, points = segment.keyframes, segment.points
    start, slots = _seen_by(segment)
    counts = np.diff(start)
    rows = np.flatnonzero((counts > 0) & _may_go(segment, linked, whole))
    chance = points.ids[rows] * _SPREAD % (1 << 32)
    order = rows[np.lexsort((chance, counts[rows]))]
    left = np.array([len(keyframe.rows) for keyframe in keyframes], np.int64)
    gone = np.zeros(len(points.state), np.bool_)
    least, surplus = float(room) / max(len(keyframes), 1), int(left.sum()) - room
    while surplus > 0 and least >= floor:
        surplus = _choose(order, start, slots, int(least), surplus, left, gone)
        least *= _LESS
    if gone.any():
        _let_go(segment, gone)


def _may_go(segment: Segment, linked: I32, whole: int) -> BoolArray:
    """Which rows have landmarks that no track and none of the newest keyframes need."""
    may = segment.points.state == MAPPED
    may[linked[linked >= 0]] = False
    for keyframe in segment.keyframes[max(len(segment.keyframes) - whole, 0) :]:
        may[keyframe.rows] = False
    return may


def _let_go(segment: Segment, gone: BoolArray) -> None:
    """Drop published landmarks from adjustments."""
    for keyframe in segment.keyframes:
        keyframe.keep(~gone[keyframe.rows])
    segment.points.cull(np.flatnonzero(gone).astype(np.int32))
    segment.sparsified = True


def _give_up_keyframes(segment: Segment, surplus: int, count: int, linked: I32, whole: int) -> None:
    """Drop this many observations and keyframes; the first and the newest stay."""
    start, slots = _seen_by(segment)
    counts = np.diff(start)
    known = list(segment.keyframes)
    may = range(1, len(known) - whole)
    queue = [(_loss(counts[known[slot].rows]), slot) for slot in may]
    heapq.heapify(queue)
    alive, hosts = np.ones(len(known), np.bool_), np.arange(len(known))
    while queue and (surplus > 0 or count > 0):
        _, slot = heapq.heappop(queue)
        rows = known[slot].rows
        loss = _loss(counts[rows])  # it only grows as others are dropped
        if queue and (loss, slot) > queue[0]:
            heapq.heappush(queue, (loss, slot))
            continue
        alive[slot], count = False, count - 1
        counts[rows] -= 1
        surplus -= len(rows)
        shared = _shared(rows, start, slots, len(known))
        shared[~alive] = 0
        before, after = np.flatnonzero(alive[:slot])[-1], slot + 1 + np.argmax(alive[slot + 1 :])
        near = max(shared[before], shared[after])
        hosts[slot] = slot if _NEAR * shared.max() <= near else np.argmax(shared)
    gone = np.flatnonzero(~alive)
    dropped = DroppedKeyframes(
        ids=np.array([known[slot].id for slot in gone], np.int64),
        hosts=np.array([known[slot].id for slot in hosts[gone]], np.int64),
        centres=np.array([known[slot].T_world_camera[:3, 3] for slot in gone]).reshape(-1, 3),
    )
    segment.dropped.take_in(dropped)
    segment.ordinary.leave(set(dropped.ids.tolist()))
    segment.since -= int(np.count_nonzero(gone < segment.since))
    segment.keyframes = [known[slot] for slot in np.flatnonzero(alive)]
    if len(gone):
        seen = np.zeros(len(counts), np.bool_)
        seen[np.concatenate([known[slot].rows for slot in gone])] = True
        _let_go(segment, seen & (counts < 2) & _may_go(segment, linked, whole))


def _most_keyframes(segment: Segment, neighbours: int) -> int:
    """Maximum keyframes of a segment so that the root mean square number of covisible keyframes is
    as
    given: the time to factor the equations of an adjustment grows with that mean.
    """
    count = len(segment.keyframes)
    start, slots = _seen_by(segment)
    met = np.zeros((count, count), np.bool_)
    _meet(start, slots, met)
    found = float(np.sqrt(np.square(met.sum(axis=1)).mean()))
    return count if found <= neighbours else int(count * neighbours / found)


@kernel
def _meet(start: I64, slots: I32, met: BoolArray) -> None:
    """Mark keyframes (K, K) that share a landmark; of landmarks with many keyframes, only some."""
    for row in range(start.size - 1):
        seen = slots[start[row] : start[row + 1]]
        step = max(1, seen.size // MOST_SEEN)
        for a in range(0, seen.size, step):
            for c in range(0, a, step):
                met[seen[a], seen[c]] = met[seen[c], seen[a]] = True


def _loss(counts: I64) -> float:
    """Share of its landmarks' information that a keyframe carries.  counts: (n,) keyframes
    of each.
    """
    return float((1.0 / np.maximum(counts - 1, 1)).mean()) if len(counts) else 0.0


def _seen_by(segment: Segment) -> tuple[I64, I32]:
    """Which keyframes see each row: those of row r are ``slots[start[r] : start[r + 1]]``."""
    sizes = [len(keyframe.rows) for keyframe in segment.keyframes]
    slot = np.repeat(np.arange(len(sizes), dtype=np.int32), sizes)
    rows = np.concatenate([keyframe.rows for keyframe in segment.keyframes])
    start = np.zeros(len(segment.points.state) + 1, np.int64)
    np.cumsum(np.bincount(rows, minlength=len(start) - 1), out=start[1:])
    slots = np.empty(len(rows), np.int32)
    _sort(rows, slot, start[:-1].copy(), slots)
    return start, slots


@kernel
def _sort(rows: I32, slot: I32, at: I64, slots: I32) -> None:
    for i in range(rows.size):
        slots[at[rows[i]]] = slot[i]
        at[rows[i]] += 1


@kernel
def _choose(
    order: I64, start: I64, slots: I32, least: int, surplus: int, left: I64, gone: BoolArray
) -> int:
    """Mark landmarks as dropped, in order, until the surplus is gone; returns the remaining
    surplus.

    left: (K,) observations of each keyframe, counted down, but not below ``least``.
    """
    for row in order:
        if surplus <= 0:
            break
        first, last = start[row], start[row + 1]
        may = not gone[row]
        for i in range(first, last):
            may = may and left[slots[i]] > least
        if may:
            gone[row] = True
            surplus -= int(last - first)
            for i in range(first, last):
                left[slots[i]] -= 1
    return surplus


@kernel
def _shared(rows: I32, start: I64, slots: I32, keyframes: int) -> I64:
    """(K,) how many of the rows each keyframe observes."""
    shared = np.zeros(keyframes, np.int64)
    for row in rows:
        for i in range(start[row], start[row + 1]):
            shared[slots[i]] += 1
    return shared

"""What a segment gives up where it has more observations than there is room for.

All of the map is adjusted at any length, and each adjustment takes time and memory by the
observation.  What is given up has been published and stays in the results: it only does not tell
the adjustment any more how the map lies, and hangs on a keyframe that moves it.

First go points.  A keyframe sees thousands, and a fraction of them holds it as well; those seen by
the most keyframes hold the most and stay.  Of each keyframe an equal share is left.  Where that
becomes less than a place needs, or keyframes have too many neighbours, keyframes go: the one of
which the least is lost.  Of what a point seen by n keyframes tells, one of these is a share of
1 / (n - 1), and all of it where n = 1; the mean over the points that it sees is what is lost with a
keyframe.  Where a place was visited many times, that is one visit of many; on a path, every other
keyframe of where the camera was slow.  Points that one keyframe alone is left to see go with them:
the adjustment would take them for wrong.
"""

import heapq

import numpy as np

from pliant.algorithms.arrays import I32, I64, BoolArray
from pliant.algorithms.mapping.final_adjustment import MOST_SEEN
from pliant.algorithms.mapping.landmarks import MAPPED
from pliant.algorithms.mapping.parameters import WindowParameters
from pliant.algorithms.mapping.segment import DroppedKeyframes, Segment
from pliant.compiler.kernel import kernel

_SPARE = 0.1
"""Share of the room that is made free beyond what is needed: to find what can go takes time."""

_LESS = 0.8
"""Of one try to the next, what keyframes are to keep: many see points that others need."""

_PAIRS = 25
"""Pairs of keyframes that there may be for each observation that there is room for: adjustments
have a table of 6 bytes for each pair, and some 150 for each observation."""

_NEAR = 0.5
"""Share of what others see of what a keyframe saw that makes its neighbours in time near."""

_SPREAD = 2654435761
"""Knuth's multiplicative hash: which of the points that are seen as often go first, all over."""


def observations_of(segments: list[Segment]) -> int:
    """What the keyframes of segments see, of points and candidates."""
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
    """Let a segment have no more observations than there is room for, as far as that can be.

    linked: row of each living track, negative where it has none.   whole: newest keyframes that
    stay as they are, with the points that they see: nobody may have been told of them yet.
    settled: the others have just been adjusted together, so that those may go, too, that have more
    neighbours than ``limits`` allow.
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
    """Which rows have points that no track and none of the newest keyframes need."""
    may = segment.points.state == MAPPED
    may[linked[linked >= 0]] = False
    for keyframe in segment.keyframes[max(len(segment.keyframes) - whole, 0) :]:
        may[keyframe.rows] = False
    return may


def _let_go(segment: Segment, gone: BoolArray) -> None:
    """Points have been published, and tell the adjustment no more."""
    for keyframe in segment.keyframes:
        keyframe.keep(~gone[keyframe.rows])
    segment.points.cull(np.flatnonzero(gone).astype(np.int32))
    segment.sparsified = True


def _give_up_keyframes(segment: Segment, surplus: int, count: int, linked: I32, whole: int) -> None:
    """All but the first and the newest may go, until so many observations and so many keyframes
    have."""
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
        loss = _loss(counts[rows])  # it only grows as others go
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
    """How many keyframes a segment may have so that each shares points with so many, as the root of
    the mean square: to factor the equations of an adjustment takes time by that mean."""
    count = len(segment.keyframes)
    start, slots = _seen_by(segment)
    met = np.zeros((count, count), np.bool_)
    _meet(start, slots, met)
    found = float(np.sqrt(np.square(met.sum(axis=1)).mean()))
    return count if found <= neighbours else int(count * neighbours / found)


@kernel
def _meet(start: I64, slots: I32, met: BoolArray) -> None:
    """Mark keyframes (K, K) that share a point, of those that see many as many as tell of one."""
    for row in range(start.size - 1):
        seen = slots[start[row] : start[row + 1]]
        step = max(1, seen.size // MOST_SEEN)
        for a in range(0, seen.size, step):
            for c in range(0, a, step):
                met[seen[a], seen[c]] = met[seen[c], seen[a]] = True


def _loss(counts: I64) -> float:
    """Share of what its points tell that goes with a keyframe.  counts: (n,) who sees each."""
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
    """Mark points as gone, in order, until the surplus is; returns what of it there still is.

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
    """(K,) of how many of the rows each keyframe sees."""
    shared = np.zeros(keyframes, np.int64)
    for row in rows:
        for i in range(start[row], start[row + 1]):
            shared[slots[i]] += 1
    return shared

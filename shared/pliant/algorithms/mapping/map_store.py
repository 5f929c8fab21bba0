"""The map: points as growing arrays, keyframes with their observations, links to the tracks."""

from dataclasses import dataclass

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, I64, U8, BoolArray
from pliant.algorithms.image.patch_alignment import TEMPLATE_MARGIN
from pliant.algorithms.image.patch_sums import PATCH_SIZE
from pliant.compiler.kernel import kernel

PATCH_SIDE = PATCH_SIZE + 2 * TEMPLATE_MARGIN
"""Of the grey levels kept around a point, whose samples lie at -4.5, ..., 4.5 px from it."""

UNLINKED = -1
"""Row of a track that belongs to no point."""

_KEPT_GONE = 20_000
"""Tracks that have gone, whose rows are remembered: bounds memory and time."""

_LOST_AT_ONCE = 0.5
"""Share of the tracks that a frame loses at least where candidates are remembered, too, unless the
one before has: elsewhere hardly a track comes back.  Nor are they where map points alone
carry the pose: in quick motion they made it a little worse."""

MAPPED_SHARE = 0.25
"""Share of what a frame sees under which points of the map alone do not carry its pose."""

FREE, CANDIDATE, MAPPED, MERGED = 0, 1, 2, 3
"""State of a row: nothing, a track that still lacks parallax, a point of the map, the alias of
another row until the keyframes have been published."""


class PointRows:
    """Points and candidates, one row each; arrays grow by doubling, rows of candidates are reused.

    state: FREE, CANDIDATE, MAPPED or MERGED.    ids: of mapped points, never reused; else -1.
    alias: the row that a MERGED one stands for; itself otherwise.
    xyz: world position of mapped points, and of candidates the provisional one.
    spread: (3,) how uncertain that is, see ``directions``; 0 for mapped points, NaN for candidates
    that have no place yet.    published_xyz: as last published, NaN before.
    published_sigmas: ``sigmas`` when last published.    segment: of the map.
    first_keyframe: keyframe id of the first observation.
    keyframes, parallax_rad, sigmas: as MapDelta defines them.
    base_keyframes, base_parallax_rad: what of those is due to keyframes out of the window.
    kappas: curvature when last seen.    strikes: bad frames of its track in a row.
    misses: frames in a row in which it should have been found again, and was not.
    patches: grey levels around the point when a keyframe last saw it.   patch_keyframe: id of that.
    """

    def __init__(self) -> None:
        self.count = 0
        self.state: U8 = np.zeros(1024, np.uint8)
        self.ids: I64 = np.zeros(1024, np.int64)
        self.alias: I32 = np.zeros(1024, np.int32)
        self.segment: I32 = np.zeros(1024, np.int32)
        self.xyz: F64 = np.zeros((1024, 3))
        self.spread: F64 = np.zeros((1024, 3))
        self.published_xyz: F64 = np.zeros((1024, 3))
        self.published_sigmas: F32 = np.zeros(1024, np.float32)
        self.colours: U8 = np.zeros((1024, 3), np.uint8)
        self.first_keyframe: I32 = np.zeros(1024, np.int32)
        self.base_keyframes: I32 = np.zeros(1024, np.int32)
        self.base_parallax_rad: F32 = np.zeros(1024, np.float32)
        self.keyframes: I32 = np.zeros(1024, np.int32)
        self.parallax_rad: F32 = np.zeros(1024, np.float32)
        self.sigmas: F32 = np.zeros(1024, np.float32)
        self.kappas: F32 = np.zeros(1024, np.float32)
        self.strikes: U8 = np.zeros(1024, np.uint8)
        self.misses: U8 = np.zeros(1024, np.uint8)
        self.patches: U8 = np.zeros((1024, PATCH_SIDE, PATCH_SIDE), np.uint8)
        self.patch_keyframe: I32 = np.zeros(1024, np.int32)
        self.culled = 0
        """Points of the map that were published and are not kept any more."""
        self._free: I32 = np.zeros(0, np.int32)
        self._next_id = 0
        self._removed: list[I64] = []

    def allocate(self, count: int) -> I32:
        """Rows of ``count`` new candidates, cleared."""
        reused = self._free[:count]
        self._free = self._free[count:]
        fresh = count - len(reused)
        names = [name for name, value in vars(self).items() if isinstance(value, np.ndarray)]
        names.remove("_free")
        while self.count + fresh > len(self.state):
            for name in names:
                old = getattr(self, name)
                setattr(self, name, np.concatenate([old, np.zeros_like(old)]))
        rows = np.concatenate([reused, np.arange(self.count, self.count + fresh, dtype=np.int32)])
        self.count += fresh
        for name in names:
            getattr(self, name)[rows] = 0
        self.state[rows] = CANDIDATE
        self.ids[rows] = -1
        self.alias[rows] = rows
        self.spread[rows] = np.nan
        self.published_xyz[rows] = np.nan
        self.published_sigmas[rows] = np.nan
        return rows

    def free(self, rows: I32) -> None:
        """Give back rows that nothing refers to any more."""
        self.state[rows] = FREE
        self._free = np.concatenate([self._free, rows])

    def cull(self, rows: I32) -> None:
        """Give back the rows of points that stay as they were last published."""
        self.culled += len(rows)
        self.free(rows)

    def promote(self, rows: I32) -> None:
        """Make candidates points of the map: they get their ids, in the order given."""
        self.state[rows] = MAPPED
        self.spread[rows] = 0.0
        self.ids[rows] = np.arange(self._next_id, self._next_id + len(rows))
        self._next_id += len(rows)

    def merge(self, old: I32, new: I32) -> None:
        """Let rows stand for others, none of which is merged; of one named twice the last holds."""
        self._note_removed(np.unique(old[self.state[old] == MAPPED]))
        self.state[old] = MERGED
        self.alias[old] = new
        older = self.first_keyframe[old] < self.first_keyframe[new]
        self.first_keyframe[new[older]] = self.first_keyframe[old[older]]
        self.published_sigmas[new[older]] = np.nan  # readers are told on what they hang

    def remove(self, rows: I32) -> None:
        """Points go.  As candidates they may come back while their track lives."""
        self._note_removed(rows)
        self.state[rows] = CANDIDATE
        self.ids[rows] = -1
        self.published_xyz[rows] = np.nan
        self.published_sigmas[rows] = np.nan

    def _note_removed(self, rows: I32) -> None:
        """Points go that have been published; nobody knows of the others."""
        self._removed.append(self.ids[rows[np.isfinite(self.published_xyz[rows, 0])]])

    def take_removed(self) -> I64:
        """Ids of the points that were removed since the last call."""
        removed, self._removed = self._removed, []
        return np.concatenate([*removed, np.zeros(0, np.int64)])

    def go_on_after(self, last_id: int) -> None:
        """Points up to this id come from elsewhere."""
        self._next_id = max(self._next_id, last_id + 1)

    def mapped(self, segment: int) -> I32:
        """Rows of all points of a segment."""
        used = slice(0, self.count)
        here = (self.state[used] == MAPPED) & (self.segment[used] == segment)
        return np.flatnonzero(here).astype(np.int32)


@dataclass(kw_only=True)
class Keyframe:
    """A keyframe and what it observed.

    rows: (n,) rows of points or candidates, each at most once.    points_px: (n, 2).
    rolled_px: (n, 2) by how much farther a rolling shutter had moved them, see ``RolledFrame``.
    published_pose: T_world_camera when last published.
    turned: it stands where the last one does: what turns on the spot tells nothing of depths, and
    its pose rests on all that it saw when it was made.
    stamp_ns: when it was taken; -1: nobody knows.   log_focal: of its focal length relative to the
    calibration, with which its pixels are those of an ideal camera: see ``changing_focal``.
    focus: (3,) where it looks: on its axis, at the median depth of its points.  Set when it leaves
    the window; NaN where it sees no point of the map.
    """

    id: int
    frame: int
    segment: int
    T_world_camera: F64
    rows: I32
    points_px: F32
    rolled_px: F32
    turned: bool = False
    stamp_ns: int = -1
    log_focal: float = 0.0
    published_pose: F64 | None = None
    focus: F64 | None = None

    def keep(self, mask: BoolArray) -> None:
        """Forget the observations that are not in the mask."""
        self.rows, self.points_px, self.rolled_px = _kept(
            self.rows, self.points_px, self.rolled_px, mask
        )

    def follow_aliases(self, points: PointRows) -> None:
        """Let observations of merged rows stand for the rows that took them in."""
        self.rows, self.points_px, self.rolled_px = _follow_aliases(
            self.rows, self.points_px, self.rolled_px, points.alias
        )


@kernel
def _kept(rows: I32, points_px: F32, rolled_px: F32, mask: BoolArray) -> tuple[I32, F32, F32]:
    count = mask.sum()
    if count == rows.size:
        return rows, points_px, rolled_px
    out, out_px, out_rolled = _room_for(count)
    at = 0
    for i in range(rows.size):
        if mask[i]:
            out[at] = rows[i]
            for k in range(2):
                out_px[at, k], out_rolled[at, k] = points_px[i, k], rolled_px[i, k]
            at += 1
    return out, out_px, out_rolled


@kernel
def _room_for(count: int) -> tuple[I32, F32, F32]:
    """Rows, points_px and rolled_px of so many observations, to be filled."""
    shape = (count, 2)
    return np.empty(count, np.int32), np.empty(shape, np.float32), np.empty(shape, np.float32)


@kernel
def _follow_aliases(rows: I32, points_px: F32, rolled_px: F32, alias: I32) -> tuple[I32, F32, F32]:
    """Ascending rows stay so, each once: of two observations that of the lower row is kept."""
    merged = np.empty(rows.size, np.int32)
    count = 0
    for i in range(rows.size):
        if alias[rows[i]] != rows[i]:
            # Few have merged since the last keyframe, so that they are sorted as they come.
            at = count
            while at > 0 and alias[rows[merged[at - 1]]] > alias[rows[i]]:
                merged[at] = merged[at - 1]
                at -= 1
            merged[at] = i
            count += 1
    if count == 0:
        return rows, points_px, rolled_px
    out, out_px, out_rolled = _room_for(rows.size)
    size, own, other = 0, 0, 0
    while own < rows.size or other < count:
        if own < rows.size and alias[rows[own]] != rows[own]:
            own += 1
            continue
        i = merged[min(other, count - 1)]
        if other == count or (own < rows.size and (rows[own], own) < (alias[rows[i]], i)):
            i, own = own, own + 1
        else:
            other += 1
        row = alias[rows[i]]
        if size == 0 or out[size - 1] != row:
            out[size] = row
            for k in range(2):
                out_px[size, k], out_rolled[size, k] = points_px[i, k], rolled_px[i, k]
            size += 1
    return out[:size].copy(), out_px[:size].copy(), out_rolled[:size].copy()


@dataclass(frozen=True, kw_only=True)
class Observations:
    """What a frame sees of the map: rows (n,), each once, points_px and rolled_px (n, 2)."""

    rows: I32
    points_px: F32
    rolled_px: F32

    @staticmethod
    def none() -> "Observations":
        """Nothing."""
        no_px = np.zeros((0, 2), np.float32)
        return Observations(rows=np.zeros(0, np.int32), points_px=no_px, rolled_px=no_px)


class TrackLinks:
    """The rows of the tracks of the latest frame.

    ids: (N,) ascending ids of the tracks.    rows: (N,) their rows, UNLINKED where they have none.

    Tracks may be missing for some frames (``tracking.bridging``): rows are kept for those that went
    last.
    """

    def __init__(self) -> None:
        self.ids: I64 = np.zeros(0, np.int64)
        self.rows: I32 = np.zeros(0, np.int32)
        self._gone: I64 = np.zeros((0, 3), np.int64)  # id, row and ``_identity`` of tracks
        self._lost_at_once = False

    def follow(self, ids: I64, points: PointRows) -> None:
        """Go on to the tracks of the next frame: living tracks keep their rows, and those that come
        back have theirs again, where these are still in the map and without a track.

        See ``_LOST_AT_ONCE`` for whose are kept.
        """
        before, rows = self.ids, np.full(len(ids), UNLINKED, np.int32)
        _carry_over(before, self.rows, ids, rows)
        gone = np.flatnonzero(~np.isin(before, ids, assume_unique=True) & (self.rows != UNLINKED))
        at_once = len(gone) >= _LOST_AT_ONCE * max(len(before), 1)
        stay = rows[rows != UNLINKED]
        mapped = np.count_nonzero(points.state[stay] == MAPPED)
        if not at_once or self._lost_at_once or mapped >= MAPPED_SHARE * max(len(stay), 1):
            gone = gone[points.state[self.rows[gone]] == MAPPED]
        self._lost_at_once = at_once
        if len(before):
            old = np.flatnonzero(ids <= before[-1])
            back = old[~np.isin(ids[old], before, assume_unique=True)]
            self._take_back(ids, rows, back, points)
        row = self.rows[gone]
        new = np.column_stack([before[gone], row, _identity(points, row)])
        self._gone = np.concatenate([self._gone, new.astype(np.int64)])[-_KEPT_GONE:]
        self.ids, self.rows = ids, rows

    def _take_back(self, ids: I64, rows: I32, back: I64, points: PointRows) -> None:
        """Link tracks, by their indices, that were missing."""
        if not len(back) or not len(self._gone):
            return
        newest = len(self._gone) - 1
        known, last = np.unique(self._gone[::-1, 0], return_index=True)
        at = np.minimum(np.searchsorted(known, ids[back]), len(known) - 1)
        found = known[at] == ids[back]
        back, (_, row, identity) = back[found], self._gone[newest - last[at[found]]].T
        mapped, seen_first = points.state[row] == MAPPED, -1 - points.first_keyframe[row]
        usable = (points.ids[row] == identity) & mapped
        usable |= (seen_first == identity) & (mapped | (points.state[row] == CANDIDATE))
        usable &= ~np.isin(row, rows)
        back, row = back[usable], row[usable]
        _, first = np.unique(row, return_index=True)
        rows[back[first]] = row[first]

    def awaited(self) -> I32:
        """Rows of the candidates whose tracks may come back."""
        return self._gone[self._gone[:, 2] < 0, 1].astype(np.int32)

    def in_state(self, state: U8, wanted: int) -> I64:
        """Indices of the tracks whose row has the wanted state.  state: of all rows."""
        return _in_state(self.rows, state, wanted)


def _identity(points: PointRows, rows: I32) -> I64:
    """What tells (n,) rows from what has them later: the id of a point; of a candidate, which has
    none, -1 and less by the keyframe that saw it first."""
    return np.where(points.ids[rows] >= 0, points.ids[rows], -1 - points.first_keyframe[rows])


@kernel
def _in_state(rows: I32, state: U8, wanted: int) -> I64:
    found = np.empty(rows.size, np.int64)
    count = 0
    for i in range(rows.size):
        if rows[i] != UNLINKED and state[rows[i]] == wanted:
            found[count] = i
            count += 1
    return found[:count].copy()


@kernel
def _carry_over(ids: I64, rows: I32, new_ids: I64, new_rows: I32) -> None:
    i = 0
    for j in range(new_ids.size):
        while i < ids.size and ids[i] < new_ids[j]:
            i += 1
        if i < ids.size and ids[i] == new_ids[j]:
            new_rows[j] = rows[i]

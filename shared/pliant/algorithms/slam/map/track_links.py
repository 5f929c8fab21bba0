"""Which landmark each track of the latest frame belongs to."""

import numpy as np

from pliant.algorithms.arrays import I32, I64, U8
from pliant.algorithms.slam.map.landmarks import CANDIDATE, MAPPED, MAPPED_SHARE, Landmarks
from pliant.compiler.kernel import kernel

UNLINKED = -1
"""Row of a track without a landmark or candidate."""

_KEPT_GONE = 20_000
"""Maximum lost tracks whose rows are stored: bounds memory and time."""

_LOST_AT_ONCE = 0.5
"""Minimum share of tracks lost in one frame for which candidates are stored, too, unless the frame
before
did: otherwise hardly a track returns.  Nor are they stored where landmarks alone determine the
pose: in quick motion they made it a little worse.
"""


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

    def follow(self, ids: I64, points: Landmarks) -> None:
        """Continue with the tracks of the next frame: living tracks keep their rows; returning
        tracks get theirs back if these are still in the map and without a track.

        See ``_LOST_AT_ONCE`` for which rows are stored.
        """
        before, rows = self.ids, np.full(len(ids), UNLINKED, np.int32)
        gone, back = _carry_over(before, self.rows, ids, rows)
        at_once = len(gone) >= _LOST_AT_ONCE * max(len(before), 1)
        stay = np.count_nonzero(rows != UNLINKED)
        mapped = len(_in_state(rows, points.state, MAPPED))
        if not at_once or self._lost_at_once or mapped >= MAPPED_SHARE * max(stay, 1):
            gone = gone[points.state[self.rows[gone]] == MAPPED]
        self._lost_at_once = at_once
        self._take_back(ids, rows, back, points)
        row = self.rows[gone]
        new = np.column_stack([before[gone], row, _identity(points, row)])
        self._gone = np.concatenate([self._gone, new.astype(np.int64)])[-_KEPT_GONE:]
        self.ids, self.rows = ids, rows

    def _take_back(self, ids: I64, rows: I32, back: I64, points: Landmarks) -> None:
        """Link returning tracks, by their indices."""
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
        """Rows of the candidates whose tracks may return."""
        return self._gone[self._gone[:, 2] < 0, 1].astype(np.int32)

    def in_state(self, state: U8, wanted: int) -> I64:
        """Indices of the tracks whose row has the wanted state.  state: of all rows."""
        return _in_state(self.rows, state, wanted)


def _identity(points: Landmarks, rows: I32) -> I64:
    """Identity of (n,) rows that distinguishes them from later uses: the id of a landmark; for a
    candidate a negative number by its first keyframe.
    """
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
def _carry_over(ids: I64, rows: I32, new_ids: I64, new_rows: I32) -> tuple[I64, I64]:
    """Write the rows of the tracks that go on.  Returns the indices of linked tracks that have
    gone, and the new indices of tracks that are older than the last one before, but were not there.
    """
    gone, back = np.empty(ids.size, np.int64), np.empty(new_ids.size, np.int64)
    went, came, i = 0, 0, 0
    for j in range(new_ids.size + 1):
        while i < ids.size and (j == new_ids.size or ids[i] < new_ids[j]):
            gone[went] = i
            went += rows[i] != UNLINKED
            i += 1
        if i == ids.size:
            break
        if ids[i] == new_ids[j]:
            new_rows[j] = rows[i]
            i += 1
        else:
            back[came] = j
            came += 1
    return gone[:went].copy(), back[:came].copy()

"""Which row of the map each living track belongs to."""

import numpy as np

from pliant.algorithms.arrays import I32, I64
from pliant.algorithms.kernel import kernel

UNLINKED = -1


class TrackLinks:
    """The rows of the tracks of the latest frame.

    ids: (N,) ascending ids of the tracks.    rows: (N,) their rows, UNLINKED where they have none.
    """

    def __init__(self) -> None:
        self.ids: I64 = np.zeros(0, np.int64)
        self.rows: I32 = np.zeros(0, np.int32)

    def follow(self, ids: I64) -> None:
        """Go on to the tracks of the next frame: living tracks keep their rows."""
        rows = np.full(len(ids), UNLINKED, np.int32)
        _carry_over(self.ids, self.rows, ids, rows)
        self.ids, self.rows = ids, rows


@kernel
def _carry_over(ids: I64, rows: I32, new_ids: I64, new_rows: I32) -> None:
    i = 0
    for j in range(new_ids.size):
        while i < ids.size and ids[i] < new_ids[j]:
            i += 1
        if i < ids.size and ids[i] == new_ids[j]:
            new_rows[j] = rows[i]

"""Keyframes and what they observe."""

from dataclasses import dataclass

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, BoolArray
from pliant.algorithms.slam.map.landmarks import Landmarks
from pliant.compiler.kernel import kernel


@dataclass(kw_only=True)
class Keyframe:
    """A keyframe and its observations.

    rows: (n,) rows of landmarks or candidates, each at most once.    points_px: (n, 2).
    rolled_px: (n, 2) rolling-shutter offset that was removed, see ``rolling_shutter``.
    is_pure_rotation: it has the position of the last one: a pure rotation determines no depths, and
    its pose depends on all its observations when it was made.
    stamp_ns: capture time; -1: unknown.   log_focal: its focal length relative to the calibration,
    with which its pixels are those of an ideal camera: see ``changing_focal``.
    focus: (3,) the point on its axis at the median depth of its landmarks.  Set when it leaves the
    window; NaN without landmarks.
    """

    id: int
    frame: int
    segment: int
    T_world_camera: F64
    rows: I32
    points_px: F32
    rolled_px: F32
    is_pure_rotation: bool = False
    stamp_ns: int = -1
    log_focal: float = 0.0
    focus: F64 | None = None

    def keep(self, mask: BoolArray) -> None:
        """Remove the observations outside the mask."""
        self.rows, self.points_px, self.rolled_px = _kept(
            self.rows, self.points_px, self.rolled_px, mask
        )

    def follow_aliases(self, points: Landmarks) -> None:
        """Replace merged rows by the rows that they were merged into."""
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
    """Rows, points_px and rolled_px of that many observations, to be filled."""
    shape = (count, 2)
    return np.empty(count, np.int32), np.empty(shape, np.float32), np.empty(shape, np.float32)


@kernel
def _follow_aliases(rows: I32, points_px: F32, rolled_px: F32, alias: I32) -> tuple[I32, F32, F32]:
    """Keep the rows ascending and unique: of two observations, the one of the lower row is kept."""
    merged = np.empty(rows.size, np.int32)
    count = 0
    for i in range(rows.size):
        if alias[rows[i]] != rows[i]:
            # Few were merged since the last keyframe, so insertion sort is fast.
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
    """Observations of a frame: rows (n,), each once, points_px and rolled_px (n, 2)."""

    rows: I32
    points_px: F32
    rolled_px: F32

    @staticmethod
    def none() -> "Observations":
        """Return no observations."""
        no_px = np.zeros((0, 2), np.float32)
        return Observations(rows=np.zeros(0, np.int32), points_px=no_px, rolled_px=no_px)

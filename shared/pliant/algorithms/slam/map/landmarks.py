"""The landmarks of the map, and the candidates for landmarks: growing arrays with a row each."""

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, I64, U8
from pliant.algorithms.geometry import transform_each
from pliant.algorithms.image.patch_alignment import TEMPLATE_MARGIN
from pliant.algorithms.image.patch_sums import PATCH_SIZE
from pliant.algorithms.map_delta import MapMoves
from pliant.algorithms.slam.map.kept_keyframe import KeptKeyframe
from pliant.compiler.kernel import kernel

PATCH_SIDE = PATCH_SIZE + 2 * TEMPLATE_MARGIN
"""Side of the stored grey patch, whose samples lie at -4.5, ..., 4.5 px from the landmark."""

MAPPED_SHARE = 0.25
"""Share of a frame's tracks below which landmarks alone do not determine its pose."""

FREE, CANDIDATE, MAPPED, MERGED = 0, 1, 2, 3
"""State of a row: free, a candidate without enough parallax, a landmark, or the alias of another
row until the keyframes have been published."""


class Landmarks:
    """Landmarks and candidates, one row each; arrays grow by doubling, rows of candidates are
    reused.

    Only the methods of this class write positions.

    state: FREE, CANDIDATE, MAPPED or MERGED.    ids: of landmarks, never reused; else -1.
    alias: the row that a MERGED one stands for; itself otherwise.
    xyz: world position of landmarks, and the provisional one of candidates.
    spread: (3,) depth sigma along the ray, see ``inverse_depth``; 0 for landmarks, NaN for
    candidates without a position.    segment: of the map.
    first_keyframe: keyframe id of the first observation.
    keyframes, parallax_rad, sigmas: as MapDelta defines them.
    base_keyframes, base_parallax_rad: the part of these from keyframes outside the window.
    kappas: curvature at the last detection.    strikes: consecutive frames in which its track
    missed.
    misses: consecutive frames in which a search for it failed.
    patches: grey levels around it in its last keyframe.   patch_keyframe: id of that.
    """

    def __init__(self) -> None:
        self.count = 0
        self.state: U8 = np.zeros(1024, np.uint8)
        self.ids: I64 = np.zeros(1024, np.int64)
        self.alias: I32 = np.zeros(1024, np.int32)
        self.segment: I32 = np.zeros(1024, np.int32)
        self.xyz: F64 = np.zeros((1024, 3))
        self.spread: F64 = np.zeros((1024, 3))
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
        self._removed: list[tuple[I32, I64]] = []

    def allocate(self, count: int, *, segment: int = 0, keyframe: int = 0) -> I32:
        """Return rows of ``count`` new candidates, cleared.   keyframe: id of the first that sees
        them.
        """
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
            getattr(self, name)[reused] = 0
        self.state[rows] = CANDIDATE
        self.ids[rows] = -1
        self.alias[rows] = rows
        self.spread[rows] = np.nan
        self.segment[rows] = segment
        self.first_keyframe[rows] = keyframe
        return rows

    def free(self, rows: I32) -> None:
        """Free rows without references."""
        self.state[rows] = FREE
        self._free = np.concatenate([self._free, rows])

    def cull(self, rows: I32) -> None:
        """Free the rows of landmarks that stay as they were last published."""
        self.culled += len(rows)
        self.free(rows)

    def place_candidates(self, rows: I32, xyz: F64, spread: F64) -> None:
        """Give candidates provisional positions (n, 3), with their uncertainty (n, 3)."""
        _set_rows(self.xyz, rows, xyz)
        _set_rows(self.spread, rows, spread)

    def place(
        self, rows: I32, xyz: F64, parallax_rad: F32 | float = 0.0, sigmas: F32 | float = 0.0
    ) -> None:
        """Turn candidates triangulated at (n, 3) into landmarks."""
        _set_rows(self.xyz, rows, xyz)
        self.parallax_rad[rows], self.sigmas[rows] = parallax_rad, sigmas
        self.promote(rows)

    def restore(self, rows: I32, kept: KeptKeyframe, patches: U8) -> None:
        """Add the landmarks of a loaded map's keyframe, with their patches."""
        self.state[rows] = MAPPED
        self.ids[rows] = kept.point_ids
        self.segment[rows] = kept.segment
        self.first_keyframe[rows] = kept.id
        self.xyz[rows] = kept.points_world
        self.spread[rows] = 0.0
        self.colours[rows] = kept.point_colours
        self.keyframes[rows] = self.base_keyframes[rows] = kept.point_keyframes
        self.parallax_rad[rows] = self.base_parallax_rad[rows] = kept.point_parallax_rad
        self.sigmas[rows] = kept.point_sigmas
        self.kappas[rows] = kept.point_kappas
        self.patches[rows] = patches

    def move_to(self, rows: I32 | I64, xyz: F64) -> None:
        """Set adjusted positions (n, 3) of landmarks or candidates."""
        _set_rows(self.xyz, rows, xyz)

    def move(self, segment: int, moves: MapMoves) -> None:
        """Move a segment."""
        rows = self.used(segment)
        S = moves.matrices(self.first_keyframe[rows].astype(np.int64))
        self.xyz[rows] = transform_each(S, self.xyz.take(rows, 0))
        self.spread[rows] = (S[:, :3, :3] @ self.spread.take(rows, 0)[:, :, None])[:, :, 0]

    def promote(self, rows: I32) -> None:
        """Turn candidates into landmarks, with ids in the given order."""
        self.state[rows] = MAPPED
        self.spread[rows] = 0.0
        self.ids[rows] = np.arange(self._next_id, self._next_id + len(rows))
        self._next_id += len(rows)

    def merge(self, old: I32, new: I32) -> None:
        """Merge rows into others, none of which is merged; of a row named twice the last counts."""
        if not len(old):
            return
        gone = np.unique(old[self.state[old] == MAPPED])
        self._removed.append((gone, self.ids[gone]))
        self.state[old] = MERGED
        self.alias[old] = new
        older = self.first_keyframe[old] < self.first_keyframe[new]
        self.first_keyframe[new[older]] = self.first_keyframe[old[older]]

    def remove(self, rows: I32) -> None:
        """Remove landmarks.  They may return as candidates while their tracks live."""
        self._removed.append((rows, self.ids[rows]))
        self.state[rows] = CANDIDATE
        self.ids[rows] = -1

    def take_removed(self) -> tuple[I32, I64]:
        """Return rows and ids of the landmarks removed since the last call."""
        removed = [(np.zeros(0, np.int32), np.zeros(0, np.int64)), *self._removed]
        self._removed = []
        rows, ids = zip(*removed)
        return np.concatenate(rows), np.concatenate(ids)

    def continue_after(self, last_id: int) -> None:
        """Reserve the ids up to this one for another map."""
        self._next_id = max(self._next_id, last_id + 1)

    def used(self, segment: int) -> I64:
        """Return the rows of all landmarks and candidates of a segment."""
        used = slice(0, self.count)
        return np.flatnonzero((self.state[used] != FREE) & (self.segment[used] == segment))

    def mapped(self, segment: int) -> I32:
        """Return the rows of all landmarks of a segment."""
        used = slice(0, self.count)
        here = (self.state[used] == MAPPED) & (self.segment[used] == segment)
        return np.flatnonzero(here).astype(np.int32)


def _set_rows(table: F64, rows: I32 | I64, values: F64) -> None:
    """Set rows (n,) of a table (N, 3): indexing by an array takes ten times as long."""
    _write_rows(table, np.ascontiguousarray(rows, np.int32), np.ascontiguousarray(values))


@kernel
def _write_rows(table: F64, rows: I32, values: F64) -> None:
    for i in range(rows.size):
        for k in range(3):
            table[rows[i], k] = values[i, k]

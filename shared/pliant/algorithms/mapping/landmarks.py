"""The landmarks of the map, and the candidates that may become some: growing arrays, a row each."""

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, I64, U8
from pliant.algorithms.geometry import transform_each
from pliant.algorithms.image.patch_alignment import TEMPLATE_MARGIN
from pliant.algorithms.image.patch_sums import PATCH_SIZE
from pliant.algorithms.kept_keyframe import KeptKeyframe
from pliant.algorithms.map_delta import MapMoves

PATCH_SIDE = PATCH_SIZE + 2 * TEMPLATE_MARGIN
"""Of the grey levels kept around a point, whose samples lie at -4.5, ..., 4.5 px from it."""

MAPPED_SHARE = 0.25
"""Share of what a frame sees under which points of the map alone do not carry its pose."""

FREE, CANDIDATE, MAPPED, MERGED = 0, 1, 2, 3
"""State of a row: nothing, a track that still lacks parallax, a point of the map, the alias of
another row until the keyframes have been published."""


class Landmarks:
    """Points and candidates, one row each; arrays grow by doubling, rows of candidates are reused.

    Positions are written by its methods alone.

    state: FREE, CANDIDATE, MAPPED or MERGED.    ids: of mapped points, never reused; else -1.
    alias: the row that a MERGED one stands for; itself otherwise.
    xyz: world position of mapped points, and of candidates the provisional one.
    spread: (3,) how uncertain that is, see ``inverse_depth``; 0 for mapped points, NaN for
    candidates that have no place yet.    published_xyz: as last published, NaN before.
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

    def allocate(self, count: int, *, segment: int = 0, keyframe: int = 0) -> I32:
        """Rows of ``count`` new candidates, cleared.   keyframe: id of the first that sees them."""
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
        self.segment[rows] = segment
        self.first_keyframe[rows] = keyframe
        return rows

    def free(self, rows: I32) -> None:
        """Give back rows that nothing refers to any more."""
        self.state[rows] = FREE
        self._free = np.concatenate([self._free, rows])

    def cull(self, rows: I32) -> None:
        """Give back the rows of points that stay as they were last published."""
        self.culled += len(rows)
        self.free(rows)

    def place_candidates(self, rows: I32, xyz: F64, spread: F64) -> None:
        """Give candidates provisional places (n, 3), with how uncertain these are (n, 3)."""
        self.xyz[rows], self.spread[rows] = xyz, spread

    def place(
        self, rows: I32, xyz: F64, parallax_rad: F32 | float = 0.0, sigmas: F32 | float = 0.0
    ) -> None:
        """Candidates have been triangulated at (n, 3), and become points of the map."""
        self.xyz[rows] = xyz
        self.parallax_rad[rows], self.sigmas[rows] = parallax_rad, sigmas
        self.promote(rows)

    def restore(self, rows: I32, kept: KeptKeyframe, patches: U8) -> None:
        """Points of an earlier session that hang on a keyframe, with their patches."""
        self.state[rows] = MAPPED
        self.ids[rows] = kept.point_ids
        self.segment[rows] = kept.segment
        self.first_keyframe[rows] = kept.id
        self.xyz[rows] = self.published_xyz[rows] = kept.points_world
        self.spread[rows] = 0.0
        self.published_sigmas[rows] = np.nan  # told again where this session sees them
        self.colours[rows] = kept.point_colours
        self.keyframes[rows] = self.base_keyframes[rows] = kept.point_keyframes
        self.parallax_rad[rows] = self.base_parallax_rad[rows] = kept.point_parallax_rad
        self.sigmas[rows] = kept.point_sigmas
        self.kappas[rows] = kept.point_kappas
        self.patches[rows] = patches

    def move_to(self, rows: I32 | I64, xyz: F64) -> None:
        """An adjustment has found points, or candidates their places, at (n, 3)."""
        self.xyz[rows] = xyz

    def move(self, segment: int, moves: MapMoves) -> None:
        """A segment has moved, and with it what has been published of it."""
        rows = self.used(segment)
        S = moves.matrices(self.first_keyframe[rows].astype(np.int64))
        self.xyz[rows] = transform_each(S, self.xyz[rows])
        self.published_xyz[rows] = transform_each(S, self.published_xyz[rows])
        self.spread[rows] = (S[:, :3, :3] @ self.spread[rows][:, :, None])[:, :, 0]

    def move_published(self, rows: I32, moves: MapMoves) -> None:
        """Readers have been told how points move that have been adjusted."""
        hosts = self.first_keyframe[rows].astype(np.int64)
        self.published_xyz[rows] = moves.points(self.published_xyz[rows], hosts)

    def unpublished(self, rows: I32) -> I32:
        """Those of the rows of which nothing has been published."""
        return rows[np.isnan(self.published_sigmas[rows])]

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

    def used(self, segment: int) -> I64:
        """Rows of all points and candidates of a segment; the latter may have a place, too."""
        used = slice(0, self.count)
        return np.flatnonzero((self.state[used] != FREE) & (self.segment[used] == segment))

    def mapped(self, segment: int) -> I32:
        """Rows of all points of a segment."""
        used = slice(0, self.count)
        here = (self.state[used] == MAPPED) & (self.segment[used] == segment)
        return np.flatnonzero(here).astype(np.int32)

"""Keyframes that a segment has given up: how they move when those that it has kept do.

They have been published, with frames and points that hang on them.  One on a path moves as the map
between the keyframes before and after it: in between, by what share of the way lies behind it.
Where others of another time see more of what it saw, it moves as the one that sees most.
"""

from dataclasses import dataclass, field

import numpy as np

from pliant.algorithms.arrays import F64, I64, BoolArray
from pliant.algorithms.geometry import (
    matrix_to_pose,
    so3_exp,
    so3_log,
    transform_each,
)
from pliant.algorithms.map_delta import MapMoves


@dataclass(kw_only=True)
class GivenUp:
    """ids: (G,) of the keyframes, ascending.   hosts: (G,) the keyframe that each moves as, by id,
    itself where it lies between others.   centres: (G, 3) where they stood.
    """

    ids: I64 = field(default_factory=lambda: np.zeros(0, np.int64))
    hosts: I64 = field(default_factory=lambda: np.zeros(0, np.int64))
    centres: F64 = field(default_factory=lambda: np.zeros((0, 3)))

    def __len__(self) -> int:
        return len(self.ids)

    def take_in(self, other: "GivenUp") -> None:
        """Those of another segment, or others of this one, are given up as well."""
        ids = np.concatenate([self.ids, other.ids])
        order = np.argsort(ids)
        self.ids = ids[order]
        self.centres = np.concatenate([self.centres, other.centres])[order]
        hosts, before = np.concatenate([self.hosts, other.hosts])[order], None
        while before is None or (hosts != before).any():  # a host may have been given up since
            before = hosts
            gone = np.isin(hosts, self.ids)
            hosts = hosts.copy()
            hosts[gone] = before[np.searchsorted(self.ids, before[gone])]
        self.hosts = hosts

    def host_of(self, keyframe: int, kept: I64) -> int:
        """A keyframe, or where it has been given up one that has been kept and is near it, by id.

        kept: (M,) all of these, ascending.
        """
        if keyframe in self.ids:
            keyframe = int(self.hosts[np.searchsorted(self.ids, keyframe)])
        if keyframe in self.ids:
            keyframe = int(kept[max(np.searchsorted(kept, keyframe) - 1, 0)])
        return keyframe

    def told_with(self, moves: MapMoves) -> MapMoves:
        """The moves of all keyframes of the segment from those of the ones that had been kept."""
        new = ~np.isin(self.ids, moves.keyframe_ids)
        if not new.any():
            return moves
        ids = np.concatenate([moves.keyframe_ids, self.ids[new]])
        rows = np.concatenate([moves.moves, self._between(moves, new)])
        order = np.argsort(ids)
        ids, rows = ids[order], rows[order]
        hosted = new & (self.hosts != self.ids)
        # A host that is newer than all that are told of moves as the last of them.
        host = np.searchsorted(ids, self.hosts[hosted], side="right") - 1
        rows[np.searchsorted(ids, self.ids[hosted])] = rows[host]
        return MapMoves(keyframe_ids=ids, moves=rows)

    def _between(self, moves: MapMoves, some: BoolArray) -> F64:
        """(S, 8) of some of them, as of ``MapMoves``, in between those of what is told of."""
        ids, told = self.ids[some], moves.keyframe_ids
        b = np.clip(np.searchsorted(told, ids), 1, len(told) - 1) if len(told) > 1 else 0 * ids
        a = np.maximum(b - 1, 0)
        share = np.clip((ids - told[a]) / np.maximum(told[b] - told[a], 1), 0.0, 1.0)[:, None]
        first, last = moves.matrices(told[a]), moves.matrices(told[b])
        scale_a, scale_b = moves.moves[a, 7:], moves.moves[b, 7:]
        R_a, R_b = first[:, :3, :3] / scale_a[:, None], last[:, :3, :3] / scale_b[:, None]
        T = np.tile(np.eye(4), (len(ids), 1, 1))
        T[:, :3, :3] = R_a @ so3_exp(share * so3_log(np.swapaxes(R_a, 1, 2) @ R_b))
        scales = scale_a ** (1.0 - share) * scale_b**share
        # What happens where it stood lies in between; elsewhere R and scale say.
        at = self.centres[some]
        moved = (1.0 - share) * transform_each(first, at) + share * transform_each(last, at)
        T[:, :3, 3] = moved - scales * (T[:, :3, :3] @ at[:, :, None])[:, :, 0]
        return np.column_stack([matrix_to_pose(T), scales])

    def move(self, moves: MapMoves) -> None:
        """The map moves."""
        self.centres = moves.points(self.centres, self.ids)

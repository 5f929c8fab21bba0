"""The points of the map by id, in blocks: only changed blocks are drawn again."""

import numpy as np

from pliant.algorithms.arrays import F32, I64, U8
from pliant.algorithms.map_delta import MapMoves

BLOCK_POINTS = 4096


class PointBlocks:
    """Positions and colours of points, 25 bytes each; a viewer that missed updates stays right.

    Points in the mapper's window are repeated in each snapshot.  After a gap, points since the
    snapshot before the gap are uncertain: they may have been removed meanwhile.  Those that the
    next snapshot does not confirm are removed.
    """

    def __init__(self) -> None:
        self._xyz: F32 = np.zeros((0, 3), np.float32)
        self._rgb: U8 = np.zeros((0, 3), np.uint8)
        self._hosts: I64 = np.zeros(0, np.int64)
        self._alive = np.zeros(0, np.bool_)
        self._recent = np.zeros(0, np.bool_)  # published since the last snapshot, or in it
        self._doubtful = np.zeros(0, np.bool_)
        self._changed: set[int] = set()

    def __len__(self) -> int:
        return int(np.count_nonzero(self._alive))

    def update(
        self, ids: I64, xyz: F32, rgb: U8, hosts: I64, removed: I64, *, snapshot: bool
    ) -> None:
        """Take in new, changed and removed points.  snapshot: ``ids`` are all active ones.

        hosts: the keyframe on which each hangs.
        """
        self._reserve(int(max(ids.max(initial=-1), removed.max(initial=-1))) + 1)
        if snapshot:
            self._recent[:] = False
        self._xyz[ids], self._rgb[ids], self._hosts[ids] = xyz, rgb, hosts
        self._alive[ids], self._recent[ids], self._doubtful[ids] = True, True, False
        self._alive[removed] = self._doubtful[removed] = False
        self._touch(ids)
        self._touch(removed)
        if snapshot and self._doubtful.any():
            self._touch(np.flatnonzero(self._doubtful))
            self._alive[self._doubtful] = False
            self._doubtful[:] = False

    def draw_again(self) -> None:
        """The viewer has none of the points."""
        self._touch(np.flatnonzero(self._alive))

    def move(self, moves: MapMoves) -> None:
        """The whole map moves, points with the keyframes on which they hang."""
        ids = np.flatnonzero(self._alive)
        moved = moves.points(self._xyz[ids].astype(np.float64), self._hosts[ids])
        self._xyz[ids] = moved.astype(np.float32)
        self._touch(ids)

    def take_in(self, other: "PointBlocks") -> None:
        """The points of another world belong to this one."""
        ids = np.flatnonzero(other._alive)
        self._reserve(int(ids.max(initial=-1)) + 1)
        self._xyz[ids], self._rgb[ids], self._hosts[ids] = (
            other._xyz[ids], other._rgb[ids], other._hosts[ids],
        )  # fmt: skip
        self._alive[ids] = True
        self._recent[ids], self._doubtful[ids] = other._recent[ids], other._doubtful[ids]
        self._touch(ids)

    def miss(self) -> None:
        """Updates were missed here."""
        self._doubtful |= self._recent & self._alive

    def take_changed(self) -> list[int]:
        """Blocks that changed since the last call, in order."""
        changed, self._changed = sorted(self._changed), set()
        return changed

    def block(self, number: int) -> tuple[F32, U8]:
        """(N, 3) positions and (N, 3) RGB of the points of a block."""
        rows = slice(number * BLOCK_POINTS, (number + 1) * BLOCK_POINTS)
        alive = self._alive[rows]
        return self._xyz[rows][alive], self._rgb[rows][alive]

    def blocks(self, numbers: list[int]) -> tuple[F32, U8]:
        """The points of several blocks."""
        parts = [self.block(number) for number in numbers]
        none = (np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8))
        return (
            np.concatenate([none[0], *(xyz for xyz, _ in parts)]),
            np.concatenate([none[1], *(rgb for _, rgb in parts)]),
        )

    def everything(self) -> tuple[F32, U8]:
        """All points."""
        return self._xyz[self._alive], self._rgb[self._alive]

    def _touch(self, ids: I64) -> None:
        self._changed.update(np.unique(ids // BLOCK_POINTS).tolist())

    def _reserve(self, size: int) -> None:
        if size <= len(self._alive):
            return
        more = max(size, 2 * len(self._alive), BLOCK_POINTS) - len(self._alive)
        self._xyz = np.concatenate([self._xyz, np.zeros((more, 3), np.float32)])
        self._rgb = np.concatenate([self._rgb, np.zeros((more, 3), np.uint8)])
        self._hosts = np.concatenate([self._hosts, np.zeros(more, np.int64)])
        self._alive = np.concatenate([self._alive, np.zeros(more, np.bool_)])
        self._recent = np.concatenate([self._recent, np.zeros(more, np.bool_)])
        self._doubtful = np.concatenate([self._doubtful, np.zeros(more, np.bool_)])

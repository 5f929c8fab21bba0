"""Blocks of voxels: the pool that holds them, and a table from key to row.

Voxel (i, j, k) stands at the lattice point (i, j, k) * voxel; block (a, b, c) has the voxels from
8 (a, b, c) on.
"""

from typing import Annotated, Any, NamedTuple

import numpy as np

from pliant.algorithms.arrays import I32, I64, Shape
from pliant.algorithms.meshing.mesh_blocks import (
    KEY_BITS,
    KEY_LIMIT,
    SIDE,
    pack,
    unpack,
)
from pliant.compiler.kernel import kernel

_FIRST_BLOCKS = 512
EMPTY = -1
"""In a table of packed keys: a free place."""
_MIX = 0x9E3779B97F4A7C15


class BlockTable(NamedTuple):
    """An open-addressed table: packed keys (-1: free) and their rows, twice as many as used."""

    packed: Annotated[I64, Shape("S")]
    rows: Annotated[I32, Shape("S")]


class VoxelSums(NamedTuple):
    """What is summed up in the voxels of each block, indexed (row, z, y, x); see ``add_sight``.

    colours: red, green, blue, weight, within the truncation only.
    """

    distances: Annotated[I32, Shape("B", SIDE, SIDE, SIDE)]
    weights: Annotated[I32, Shape("B", SIDE, SIDE, SIDE)]
    colours: Annotated[I32, Shape("B", SIDE, SIDE, SIDE, 4)]


class Scale(NamedTuple):
    """Side of a voxel, and the distance up to which distances are kept; in scene units."""

    voxel: float
    truncation: float


class InMemory:
    """Room for the sums of blocks.   most: blocks that there is ever room for."""

    def __init__(self, most: int) -> None:
        self.most = most

    def grow(self, sums: list[I32], used: int, least: int) -> None:
        """Put into the list arrays of ``least`` rows or more, with the first ``used`` as before."""
        room = min(2 * least, self.most)
        for k, old in enumerate(sums):
            # One after the other, so that at no time all are there twice.
            sums[k] = np.empty((room, *old.shape[1:]), np.int32)
            sums[k][:used] = old[:used]

    def let_go(self) -> None:
        """Called when none of the blocks will be needed soon."""


class BlockPool:
    """The blocks of a volume and room for more.

    Rows 0 to N - 1 are taken, without gaps, in an order that follows from the calls alone.

    keys: (N, 3).    births: (N,) as given.    table: from key to row.    sums: of at least N rows,
    elsewhere in memory after each ``add``.
    """

    def __init__(self, where: InMemory) -> None:
        """where: what gives room for more."""
        self.where = where
        self.keys = np.zeros((0, 3), np.int32)
        self.births = np.zeros(0, np.int64)
        self.table = make_table(self.keys)
        lattice = (min(_FIRST_BLOCKS, where.most), SIDE, SIDE, SIDE)
        self._sums = [np.empty((*lattice, *last), np.int32) for last in ((), (), (4,))]

    @property
    def sums(self) -> VoxelSums:
        """What the voxels hold, to be read and written in place."""
        return VoxelSums(*self._sums)

    @property
    def room(self) -> int:
        """Blocks that there is memory for now."""
        return len(self._sums[0])

    def add(self, keys: I32, birth: int) -> None:
        """Take in (K, 3) keys that are not here, with voxels of zeros.

        Raises ValueError if they are more than there is ever room for; nothing has changed then.
        """
        used, total = len(self.keys), len(self.keys) + len(keys)
        if total > self.where.most:
            raise ValueError(f"{total} blocks, there is room for {self.where.most}")
        if total > self.room:
            self.where.grow(self._sums, used, total)
        for sums in self._sums:
            sums[used:total] = 0
        self.keys = np.concatenate([self.keys, keys])
        self.births = np.concatenate([self.births, np.full(len(keys), birth, np.int64)])
        self.table = make_table(self.keys)

    def remove(self, rows: I32) -> None:
        """Let go of distinct rows: the last ones move into their places."""
        left = len(self.keys) - len(rows)
        gone = np.zeros(len(self.keys), np.bool_)
        gone[rows] = True
        holes, movers = np.flatnonzero(gone[:left]), left + np.flatnonzero(~gone[left:])
        for array in (self.keys, self.births, *self._sums):
            array[holes] = array[movers]
        self.keys, self.births = self.keys[:left].copy(), self.births[:left].copy()
        self.table = make_table(self.keys)


def make_table(keys: I32) -> BlockTable:
    """The table of (N, 3) distinct keys, whose rows are 0 to N - 1."""
    size = 1 << max(4, (2 * len(keys) + 1).bit_length())
    packed, rows = np.full(size, EMPTY, np.int64), np.zeros(size, np.int32)
    _insert_all(pack(keys), packed, rows)
    return BlockTable(packed, rows)


def find_rows(table: BlockTable, keys: I32) -> I32:
    """(N,) rows of (N, 3) keys, -1 where there is none."""
    return _find_all(table, np.ascontiguousarray(keys))


def with_neighbours(keys: I32) -> I32:
    """The keys and the 26 around each, ascending: whose cubes or gradients read these blocks."""
    return unpack(np.sort(_dilate(pack(keys))))


@kernel
def slot_of(packed: I64, key: Any) -> Any:
    """Where a packed key stands in a table, or the free place where it would."""
    mask = len(packed) - 1
    mixed = np.uint64(key) * np.uint64(_MIX)
    at = np.int64(mixed >> np.uint64(40)) & mask
    while packed[at] != EMPTY and packed[at] != key:
        at = (at + 1) & mask
    return at


@kernel
def pack_one(x: Any, y: Any, z: Any) -> Any:
    """One key as a number."""
    return (
        ((np.int64(x) + KEY_LIMIT) << (2 * KEY_BITS))
        | ((np.int64(y) + KEY_LIMIT) << KEY_BITS)
        | (np.int64(z) + KEY_LIMIT)
    )


@kernel
def row_of(table: BlockTable, key: Any) -> Any:
    """The row of a packed key, -1 where it is not in the table."""
    at = slot_of(table.packed, key)
    return table.rows[at] if table.packed[at] == key else -1


@kernel
def _insert_all(keys: I64, packed: I64, rows: I32) -> None:
    for i in range(len(keys)):
        at = slot_of(packed, keys[i])
        packed[at] = keys[i]
        rows[at] = i


@kernel
def _find_all(table: BlockTable, keys: I32) -> I32:
    found = np.empty(len(keys), np.int32)
    for i in range(len(keys)):
        found[i] = row_of(table, pack_one(keys[i, 0], keys[i, 1], keys[i, 2]))
    return found


@kernel
def grown(packed: I64) -> I64:
    """The same keys in a table of twice the size."""
    larger = np.full(2 * len(packed), EMPTY, np.int64)
    for key in packed:
        if key != EMPTY:
            larger[slot_of(larger, key)] = key
    return larger


@kernel
def used_keys(packed: I64, count: int) -> I64:
    """(count,) the keys of a table, in its order."""
    keys = np.empty(count, np.int64)
    n = 0
    for key in packed:
        if key != EMPTY:
            keys[n] = key
            n += 1
    return keys


@kernel
def _dilate(keys: I64) -> I64:
    packed = np.full(1024, EMPTY, np.int64)
    count = 0
    for key in keys:
        for dx in range(-1, 2):
            for dy in range(-1, 2):
                for dz in range(-1, 2):
                    near = key + (dx << (2 * KEY_BITS)) + (dy << KEY_BITS) + dz
                    at = slot_of(packed, near)
                    if packed[at] == EMPTY:
                        packed[at] = near
                        count += 1
        if 2 * (count + 27) > len(packed):
            packed = grown(packed)
    return used_keys(packed, count)

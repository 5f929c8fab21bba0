"""Blocks of voxels: their keys, a table from key to row, and which of them a depth map touches.

Voxel (i, j, k) stands at the lattice point (i, j, k) * voxel; block (a, b, c) has the voxels from
8 (a, b, c) on.  Rows are whatever the owner of the blocks numbers them by.
"""

import math
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, I64, Shape
from pliant.algorithms.kernel import kernel

SIDE = 8
"""Voxels along the side of a block."""
KEY_LIMIT = 1 << 20
"""Keys beyond this have no place in a table: such blocks are passed over."""
_BITS = 21
_MASK = (1 << _BITS) - 1
_EMPTY = -1
_MIX = 0x9E3779B97F4A7C15
_MAX_STRIDE_PX = 8
_RAYS_PER_BLOCK = 6
"""Rays side by side that meet the most distant block, so that none is missed."""
_MAX_STRETCH = 2.0
"""The band along a ray is the truncation over the cosine of the slant, up to so many times."""


@dataclass(frozen=True)
class BlockTable:
    """An open-addressed table: packed keys (-1: free) and their rows, twice as many as used."""

    packed: Annotated[I64, Shape("S")]
    rows: Annotated[I32, Shape("S")]


def make_table(keys: I32) -> BlockTable:
    """The table of (N, 3) distinct keys, whose rows are 0 to N - 1."""
    size = 1 << max(4, (2 * len(keys) + 1).bit_length())
    packed, rows = np.full(size, _EMPTY, np.int64), np.zeros(size, np.int32)
    _insert_all(pack(keys), packed, rows)
    return BlockTable(packed, rows)


def find_rows(table: BlockTable, keys: I32) -> I32:
    """(N,) rows of (N, 3) keys, -1 where there is none."""
    return _find_all(table.packed, table.rows, np.ascontiguousarray(keys))


def pack(keys: I32) -> I64:
    """(N,) numbers in the order of the keys (by x, then y, then z)."""
    shifted = keys.astype(np.int64) + KEY_LIMIT
    return (shifted[:, 0] << 2 * _BITS) | (shifted[:, 1] << _BITS) | shifted[:, 2]


def unpack(packed: I64) -> I32:
    """The inverse of ``pack``."""
    columns = [packed >> 2 * _BITS, packed >> _BITS & _MASK, packed & _MASK]
    return (np.stack(columns, axis=1) - KEY_LIMIT).astype(np.int32)


def sorted_keys(keys: I32) -> I32:
    """Distinct keys, ascending."""
    return unpack(np.unique(pack(keys)))


def with_neighbours(keys: I32) -> I32:
    """The keys and the 26 around each, ascending: whose cubes or gradients read these blocks."""
    return unpack(np.sort(_dilate(pack(keys))))


def blocks_in_band(
    planes: F32, depth: F32, intrinsics: F64, T_world_camera: F64, voxel: float, truncation: float
) -> I32:
    """(K, 3) keys of the blocks within the truncation of the surface that a depth map shows.

    planes, depth: (H, W, 4), (H, W); see ``tsdf_pixels``.    intrinsics: (4,) fx, fy, cx, cy.
    As many pixels are looked at as it takes to meet the most distant block _RAYS_PER_BLOCK times.
    """
    furthest = max(float(depth.max(initial=0.0)), 1e-9)
    across = SIDE * voxel * float(intrinsics[:2].min()) / furthest
    stride = int(np.clip(across / _RAYS_PER_BLOCK, 1, _MAX_STRIDE_PX))
    packed = _band(planes, depth, intrinsics, T_world_camera, voxel, truncation, stride)
    return unpack(np.sort(packed))


@kernel
def slot_of(packed: I64, key: Any) -> Any:
    """Where a packed key stands in a table, or the free place where it would."""
    mask = len(packed) - 1
    mixed = np.uint64(key) * np.uint64(_MIX)
    at = np.int64(mixed >> np.uint64(40)) & mask
    while packed[at] != _EMPTY and packed[at] != key:
        at = (at + 1) & mask
    return at


@kernel
def pack_one(x: Any, y: Any, z: Any) -> Any:
    """One key as a number."""
    return (
        ((np.int64(x) + KEY_LIMIT) << (2 * _BITS))
        | ((np.int64(y) + KEY_LIMIT) << _BITS)
        | (np.int64(z) + KEY_LIMIT)
    )


@kernel
def row_of(packed: I64, rows: I32, key: Any) -> Any:
    """The row of a packed key, -1 where it is not in the table."""
    at = slot_of(packed, key)
    return rows[at] if packed[at] == key else -1


@kernel
def _insert_all(keys: I64, packed: I64, rows: I32) -> None:
    for i in range(len(keys)):
        at = slot_of(packed, keys[i])
        packed[at] = keys[i]
        rows[at] = i


@kernel
def _find_all(packed: I64, rows: I32, keys: I32) -> I32:
    found = np.empty(len(keys), np.int32)
    for i in range(len(keys)):
        found[i] = row_of(packed, rows, pack_one(keys[i, 0], keys[i, 1], keys[i, 2]))
    return found


@kernel
def _grown(packed: I64) -> I64:
    larger = np.full(2 * len(packed), _EMPTY, np.int64)
    for key in packed:
        if key != _EMPTY:
            larger[slot_of(larger, key)] = key
    return larger


@kernel
def _used(packed: I64, count: int) -> I64:
    keys = np.empty(count, np.int64)
    n = 0
    for key in packed:
        if key != _EMPTY:
            keys[n] = key
            n += 1
    return keys


@kernel
def _dilate(keys: I64) -> I64:
    packed = np.full(1024, _EMPTY, np.int64)
    count = 0
    for key in keys:
        for dx in range(-1, 2):
            for dy in range(-1, 2):
                for dz in range(-1, 2):
                    near = key + (dx << (2 * _BITS)) + (dy << _BITS) + dz
                    at = slot_of(packed, near)
                    if packed[at] == _EMPTY:
                        packed[at] = near
                        count += 1
        if 2 * (count + 27) > len(packed):
            packed = _grown(packed)
    return _used(packed, count)


@kernel
def _band(
    planes: F32, depth: F32, intrinsics: F64, T: F64, voxel: float, truncation: float, stride: int
) -> I64:  # fmt: skip
    height, width = depth.shape
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    block = SIDE * voxel
    packed = np.full(1024, _EMPTY, np.int64)
    count = 0
    last = np.int64(_EMPTY)
    for v in range(0, height, stride):
        for u in range(0, width, stride):
            z = depth[v, u]
            if not z > 0.0:
                continue
            x, y = (u - cx) / fx, (v - cy) / fy
            length = math.sqrt(x * x + y * y + 1.0)
            stretch = min(z / (planes[v, u, 3] * length), _MAX_STRETCH)
            reach = truncation * stretch / length
            steps = math.ceil(4.0 * truncation * stretch / block) + 1
            rx = T[0, 0] * x + T[0, 1] * y + T[0, 2]
            ry = T[1, 0] * x + T[1, 1] * y + T[1, 2]
            rz = T[2, 0] * x + T[2, 1] * y + T[2, 2]
            for s in range(steps):
                at_z = max(z - reach + 2.0 * reach * s / (steps - 1), 0.0)
                bx = math.floor((T[0, 3] + rx * at_z) / block + 0.5 / SIDE)
                by = math.floor((T[1, 3] + ry * at_z) / block + 0.5 / SIDE)
                bz = math.floor((T[2, 3] + rz * at_z) / block + 0.5 / SIDE)
                if not max(abs(bx), abs(by), abs(bz)) < KEY_LIMIT - 1:
                    continue
                key = pack_one(int(bx), int(by), int(bz))
                if key == last:
                    continue
                last = key
                at = slot_of(packed, key)
                if packed[at] == _EMPTY:
                    packed[at] = key
                    count += 1
                    if 2 * count > len(packed):
                        packed = _grown(packed)
    return _used(packed, count)

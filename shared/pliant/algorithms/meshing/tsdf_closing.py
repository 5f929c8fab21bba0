"""Extrapolation of a truncated signed distance by a few voxels, to close small holes.

Near a smooth surface the distance is linear.  So an unobserved voxel, with the next two observed
in some direction, has 2 d(1) - d(2); the mean over such directions is used.  (Davis, Marschner,
Garr and Levoy 2002 diffuse the distance itself, which bends the surface.)  ``mesh_finish`` removes
the extrapolated surface beyond the outer border.
"""

import math
from typing import Annotated, NamedTuple

import numpy as np

from pliant.algorithms.arrays import F32, I32, U8, BoolArray, Shape
from pliant.algorithms.meshing.marching_cubes import Tsdf
from pliant.algorithms.meshing.mesh_blocks import SIDE
from pliant.algorithms.meshing.tsdf_blocks import VoxelSums, pack_one, row_of
from pliant.algorithms.meshing.tsdf_integrate import DISTANCE_UNITS, WEIGHT_UNITS
from pliant.compiler.kernel import kernel

CARRIED = 3
"""Number of steps of one voxel: holes of twice this width are closed."""
_PAD = 2
"""Voxels around a block: each direction reads two."""
_WIDE = SIDE + 2 * _PAD
_LEAST_DIRECTIONS = 3
"""Minimum directions for an extrapolated voxel."""
_STEEPEST = 1.5
"""Maximum change of the distance between two voxels, relative to that of a true distance."""


class Evidence(NamedTuple):
    """The evidence for the vertices of a mesh.

    support: the smaller weight of the two voxels of its edge; 0 if one was not observed.
    steps: change of the distance along the edge, in voxels; that of a true distance is one.
    """

    support: Annotated[F32, Shape("V")]
    steps: Annotated[F32, Shape("V")]


@kernel
def carry_on(keys: I32, tsdf: Tsdf, step: int, filled: U8) -> None:
    """Fill unobserved voxels of the blocks (N, 3) beside observed ones; changes the sums.

    filled: (B, SIDE, SIDE, SIDE) of all blocks: the step, from 1, that filled each voxel; 0: none.
    A step reads observed voxels and those of earlier steps.  A filled voxel gets the minimum weight
    of an observed one.
    """
    sums, min_weight = tsdf.sums, tsdf.min_weight
    near = np.empty((3, 3, 3), np.int32)
    field = np.empty((_WIDE, _WIDE, _WIDE), np.float32)
    slope = np.float32(_STEEPEST * tsdf.scale.voxel / tsdf.scale.truncation)
    most = np.empty((3, 3, 3), np.float32)
    for z in range(3):
        for y in range(3):
            for x in range(3):
                square = (z - 1) ** 2 + (y - 1) ** 2 + (x - 1) ** 2
                most[z, y, x] = slope * np.float32(math.sqrt(square))
    for i in range(len(keys)):
        for dz in range(3):
            for dy in range(3):
                for dx in range(3):
                    at = pack_one(keys[i, 0] + dx - 1, keys[i, 1] + dy - 1, keys[i, 2] + dz - 1)
                    near[dz, dy, dx] = row_of(tsdf.table, at)
        if _gather(near, sums, min_weight, step, filled, field):
            _fill(near, field, most, sums, min_weight, step, filled)


@kernel
def _gather(near: I32, sums: VoxelSums, min_weight: int, step: int, filled: U8, field: F32) -> bool:
    """Distances in truncations; 2 from one truncation on, NaN if unobserved.

    Returns whether the block has a voxel to fill, and distances near it.
    """
    lacks, has = False, False
    for z in range(_WIDE):
        for y in range(_WIDE):
            for x in range(_WIDE):
                az, ay, ax = z + SIDE - _PAD, y + SIDE - _PAD, x + SIDE - _PAD
                row = near[az >> 3, ay >> 3, ax >> 3]
                value = np.float32(np.nan)
                if row >= 0:
                    w = sums.weights[row, az & 7, ay & 7, ax & 7]
                    if w >= min_weight and filled[row, az & 7, ay & 7, ax & 7] < step:
                        s = sums.distances[row, az & 7, ay & 7, ax & 7]
                        value = np.float32(s) / (np.float32(DISTANCE_UNITS) * np.float32(w))
                        if abs(value) >= np.float32(1.0):
                            value = np.float32(2.0)
                        else:
                            has = True
                    elif row == near[1, 1, 1]:
                        lacks = True
                field[z, y, x] = value
    return lacks and has


@kernel
def _fill(
    near: I32, field: F32, most: F32, sums: VoxelSums, min_weight: int, step: int, filled: U8
) -> None:
    row = near[1, 1, 1]
    tint = np.empty(3, np.int64)
    for z in range(SIDE):
        for y in range(SIDE):
            for x in range(SIDE):
                cz, cy, cx = z + _PAD, y + _PAD, x + _PAD
                if not np.isnan(field[cz, cy, cx]) or filled[row, z, y, x] > 0:
                    continue
                total, count, tints = np.float32(0.0), 0, 0
                tint[:] = 0
                for dz in range(-1, 2):
                    for dy in range(-1, 2):
                        for dx in range(-1, 2):
                            one = field[cz + dz, cy + dy, cx + dx]
                            other = field[cz + 2 * dz, cy + 2 * dy, cx + 2 * dx]
                            if not max(one, other) < np.float32(1.0):
                                continue
                            if not abs(one - other) <= most[dz + 1, dy + 1, dx + 1]:
                                continue
                            total += np.float32(2.0) * one - other
                            count += 1
                            az, ay, ax = z + dz + SIDE, y + dy + SIDE, x + dx + SIDE
                            there = near[az >> 3, ay >> 3, ax >> 3]
                            colour = sums.colours[there, az & 7, ay & 7, ax & 7]
                            if colour[3] > 0:
                                tints += 1
                                for k in range(3):
                                    tint[k] += colour[k] // colour[3]
                if count < _LEAST_DIRECTIONS:
                    continue
                value = total / np.float32(count)
                if not abs(value) < np.float32(1.0):
                    continue
                filled[row, z, y, x] = step
                level = np.int32(np.rint(value * np.float32(DISTANCE_UNITS)))
                sums.distances[row, z, y, x] = level * np.int32(min_weight)
                sums.weights[row, z, y, x] = min_weight
                sums.colours[row, z, y, x, 3] = min(tints, 1)
                for k in range(3):
                    sums.colours[row, z, y, x, k] = tint[k] // max(tints, 1)


def evidence_of(positions: F32, tsdf: Tsdf, filled: U8) -> Evidence:
    """Of the vertices (V, 3) of a mesh made by marching cubes.    filled: see ``carry_on``."""
    support, steps = _evidence(positions, tsdf, filled)
    return Evidence(support, steps)


@kernel
def _evidence(positions: F32, tsdf: Tsdf, filled: U8) -> tuple[F32, F32]:
    support = np.zeros(len(positions), np.float32)
    steps = np.zeros(len(positions), np.float32)
    voxel = tsdf.scale.voxel
    at = np.empty((2, 3), np.int64)
    for v in range(len(positions)):
        # A vertex is off the lattice along one axis only, that of its edge.
        axis, furthest = 0, -1.0
        for k in range(3):
            place = float(positions[v, k]) / voxel
            whole = np.rint(place)
            at[:, k] = int(whole)
            if abs(place - whole) > furthest:
                axis, furthest = k, abs(place - whole)
        low = math.floor(float(positions[v, axis]) / voxel)
        at[0, axis], at[1, axis] = low, low + 1
        weight, is_seen = np.int64(1 << 31), True
        ends = np.zeros(2)
        for end in range(2):
            x, y, z = at[end]
            row = row_of(tsdf.table, pack_one(x >> 3, y >> 3, z >> 3))
            if row < 0:
                is_seen = False
                continue
            here = np.int64(tsdf.sums.weights[row, z & 7, y & 7, x & 7])
            is_seen &= filled[row, z & 7, y & 7, x & 7] == 0
            weight = min(weight, here)
            ends[end] = tsdf.sums.distances[row, z & 7, y & 7, x & 7] / max(here, 1)
        if is_seen:
            support[v] = np.float32(weight / WEIGHT_UNITS)
        change = abs(ends[1] - ends[0]) / DISTANCE_UNITS
        steps[v] = np.float32(change * tsdf.scale.truncation / voxel)
    return support, steps


def is_guessed(evidence: Evidence, most_steps: float) -> BoolArray:
    """(V,) vertices beside unobserved voxels, or with a change of more than ``most_steps``."""
    return (evidence.support <= 0.0) | (evidence.steps > most_steps)

"""The packed layout: observations alone, for problems in which most cameras see few of the points.

Each observation has a slot and a place.  Slots go camera by camera, in blocks of ``BLOCK``
observations of one camera, so that linearisation is SIMD code with the camera in registers.  Places
go point by point, cameras ascending, which is the order in which points are eliminated.
"""

from dataclasses import dataclass

import numpy as np

from pliant.algorithms.arrays import F32, I32, I64, BoolArray
from pliant.algorithms.bundle.layout import (
    BLOCK,
    Unknowns,
    columns_of,
    finite_points,
    unknowns_of,
    weights_of,
)
from pliant.algorithms.bundle.problem import AnyProblem, BundleProblem
from pliant.algorithms.kernel import kernel

_NOWHERE = -1


@dataclass(kw_only=True)
class PackedLayout(Unknowns):
    """One problem as packed lists of B blocks of slots and of O places.

    block_camera: (B,) the camera of each block.
    points_seen: (B, BLOCK) column of the point of each slot.
    place: (B, BLOCK) place of each slot; O, a dump, where a block is not full.
    u, v, w: (B, BLOCK) pixel and weight, w = 0 in the rest of a block that is not full.
    start, stop: (P,) the places of each point.     camera: (O,) the camera of each place.
    places: (K,) place of each of the problem's own observations, -1 where it is left out.
    """

    block_camera: I32
    points_seen: I32
    place: I32
    u: F32
    v: F32
    w: F32
    start: I64
    stop: I64
    camera: I32
    places: I64


SPARSE = 0.35
"""Share of the cells in blocks that cameras see under which the packed layout is the faster one:
between 0.27 and 0.45 for windows of 10 to 60 cameras and points in the order of their cameras or
in none (measured)."""


def is_sparse(problem: AnyProblem) -> bool:
    """Whether the dense layout would consist of empty cells for the most part."""
    M, N = len(problem.T_world_camera), len(problem.points_world)
    if isinstance(problem, BundleProblem):
        if len(problem.camera_index) >= SPARSE * M * N:
            return False
        camera_index, point_index = problem.camera_index, problem.point_index
    else:
        if np.count_nonzero(problem.weights) >= SPARSE * M * N:
            return False
        camera_index, point_index = list_seen(problem.weights)
    blocks = _count_blocks(camera_index, point_index, columns_of(problem), M)
    return len(camera_index) < SPARSE * blocks * BLOCK


@kernel
def _count_blocks(camera_index: I32, point_index: I32, column: I64, cameras: int) -> int:
    """Pairs of a camera and a block of the dense layout that it sees."""
    seen = np.zeros((cameras, column.size // BLOCK + 1), np.uint8)
    for k in range(camera_index.size):
        seen[camera_index[k], column[point_index[k]] // BLOCK] = 1
    return int(seen.sum())


def build_packed_layout(problem: AnyProblem) -> PackedLayout:
    """Bring a problem into the packed layout.  Nothing in the problem is changed."""
    N, usable = len(problem.points_world), finite_points(problem.points_world)
    unknowns = unknowns_of(problem, columns_of(problem), usable, N)
    if isinstance(problem, BundleProblem):
        camera_index, point_index = problem.camera_index, problem.point_index
        u, v = (np.ascontiguousarray(each) for each in problem.points_px.T)
        weights = weights_of(problem)
    else:
        camera_index, point_index = list_seen(problem.weights)
        at = (camera_index, point_index)
        u, v, weights = problem.u[at], problem.v[at], problem.weights[at]
    order, counts, start = _sort(
        camera_index, point_index, u, v, weights, usable, unknowns.column,
        len(unknowns.cameras), N,
    )  # fmt: skip
    blocks = -(-counts // BLOCK)
    shape = (int(blocks.sum()), BLOCK)
    points_seen, place = np.zeros(shape, np.int32), np.full(shape, len(order), np.int32)
    packed = np.zeros((3, *shape), np.float32)
    camera, places = np.zeros(len(order), np.int32), np.full(len(u), _NOWHERE, np.int64)
    stop = _pack(
        camera_index, point_index, u, v, weights, unknowns.column, order,
        BLOCK * (np.cumsum(blocks) - blocks), start, points_seen.reshape(-1), place.reshape(-1),
        packed.reshape(3, -1), camera, places,
    )  # fmt: skip
    return PackedLayout(
        **vars(unknowns),
        block_camera=np.repeat(np.arange(len(blocks), dtype=np.int32), blocks),
        points_seen=points_seen, place=place, u=packed[0], v=packed[1], w=packed[2],
        start=start, stop=stop, camera=camera, places=places,
    )  # fmt: skip


@kernel
def list_seen(weights: F32) -> tuple[I32, I32]:
    """Camera and point of every cell with a weight."""
    M, N = weights.shape
    count = 0
    for m in range(M):
        for n in range(N):
            count += weights[m, n] > 0.0
    camera, point = np.empty(count, np.int32), np.empty(count, np.int32)
    at = 0
    for m in range(M):
        for n in range(N):
            if weights[m, n] > 0.0:
                camera[at] = m
                point[at] = n
                at += 1
    return camera, point


@kernel
def _sort(
    camera_index: I32,
    point_index: I32,
    u: F32,
    v: F32,
    weights: F32,
    usable: BoolArray,
    column: I64,
    cameras: int,
    points: int,
) -> tuple[I64, I64, I64]:
    """Usable observations in the order of cameras, (M,) how many of each, (P,) start of a point."""
    counts = np.zeros(cameras, np.int64)
    of_point = np.zeros(points, np.int64)
    good = np.zeros(camera_index.size, np.bool_)
    for k in range(camera_index.size):
        finite = np.isfinite(u[k]) and np.isfinite(v[k])
        good[k] = usable[point_index[k]] and finite and weights[k] > 0.0
        if good[k]:
            counts[camera_index[k]] += 1
            of_point[column[point_index[k]]] += 1
    fill = np.cumsum(counts) - counts
    order = np.empty(counts.sum(), np.int64)
    for k in range(camera_index.size):
        if good[k]:
            order[fill[camera_index[k]]] = k
            fill[camera_index[k]] += 1
    return order, counts, np.cumsum(of_point) - of_point


@kernel
def _pack(
    camera_index: I32,
    point_index: I32,
    u: F32,
    v: F32,
    weights: F32,
    column: I64,
    order: I64,
    first_slot: I64,
    start: I64,
    points_seen: I32,
    place: I32,
    packed: F32,
    camera: I32,
    places: I64,
) -> I64:
    """Give every observation its slot and its place; returns where the places of a point end."""
    stop = start.copy()
    slot_of = np.empty(order.size, np.int64)
    next_slot = first_slot.copy()
    for k in order:
        m, n = camera_index[k], column[point_index[k]]
        at = stop[n]
        if at > start[n] and camera[at - 1] == m:
            # A camera that observes a point again: the repetition replaces.
            at -= 1
            slot = slot_of[at]
        else:
            slot = next_slot[m]
            next_slot[m] += 1
            stop[n] += 1
        slot_of[at] = slot
        camera[at] = m
        places[k] = at
        points_seen[slot] = n
        place[slot] = at
        packed[0, slot], packed[1, slot], packed[2, slot] = u[k], v[k], weights[k]
    return stop

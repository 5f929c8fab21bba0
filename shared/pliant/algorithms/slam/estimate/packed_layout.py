"""The packed layout of the Schur complement solver: a list of observations.

Each observation has a slot and a place.  Slots go camera by camera, in blocks of ``BLOCK``
observations of one camera, so that linearisation is SIMD code with the camera in registers.  Places
go point by point, cameras ascending, which is the order in which points are eliminated.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pliant.algorithms.arrays import F32, I32, I64, BoolArray
from pliant.algorithms.slam.estimate.dense_layout import (
    BLOCK,
    Unknowns,
    finite_points,
    unknowns_of,
)
from pliant.algorithms.slam.estimate.problem import AnyProblem, BundleProblem
from pliant.compiler.kernel import kernel

_NOWHERE = -1


class Slots(NamedTuple):
    """Observations camera by camera, in B blocks of ``BLOCK`` observations of one camera.

    camera: (B,) of each block.     point: (B, BLOCK) column of the point of each slot.
    place: (B, BLOCK) place of each slot; O, a dump, where a block is not full.
    u, v, w: (B, BLOCK) pixel and weight, w = 0 in the rest of a block that is not full.
    """

    camera: I32
    point: I32
    place: I32
    u: F32
    v: F32
    w: F32


class Places(NamedTuple):
    """Observations point by point, cameras ascending.

    start, stop: (P,) the places of each point.     camera: (O,) of each place.
    """

    start: I64
    stop: I64
    camera: I32


@dataclass(frozen=True, kw_only=True)
class PackedLayout(Unknowns):
    """One problem as packed lists.

    place: (K,) of each observation of a ``BundleProblem``, -1 where it is left out; else (0,).
    flow: (2, B, BLOCK) the readout flow of each slot, px; (2, 0, BLOCK): there is none.
    """

    slots: Slots
    places: Places
    place: I32
    flow: F32


def build_packed_layout(problem: AnyProblem) -> PackedLayout:
    """Convert a problem to the packed layout, without changing it."""
    N, usable = len(problem.points_world), finite_points(problem.points_world)
    if not isinstance(problem, BundleProblem):
        unknowns = unknowns_of(problem, np.arange(N), usable, N)
        table = (problem.columns, usable, problem.u, problem.v, problem.weights, problem.seen)
        counts, start = _count(*table)
        slots, places, first = _room(counts, start)
        _pack_window(*table, first, slots, places)
        place, flow = np.zeros(0, np.int32), np.zeros((2, 0, BLOCK), np.float32)
        return PackedLayout(**vars(unknowns), slots=slots, places=places, place=place, flow=flow)
    camera_index, point_index = problem.camera_index, problem.point_index
    column = _sort_by_cameras(camera_index, point_index, len(problem.T_world_camera), N)
    unknowns = unknowns_of(problem, column, usable, N)
    u, v = (np.ascontiguousarray(each) for each in problem.points_px.T)
    weights = np.ones(len(u), np.float32) if problem.weights is None else problem.weights
    order, counts, start = _sort(
        camera_index, point_index, u, v, weights, usable, unknowns.column,
        len(unknowns.free), N,
    )  # fmt: skip
    slots, places, first = _room(counts, start)
    place = np.full(len(u), _NOWHERE, np.int32)
    slot = _pack(
        camera_index, point_index, unknowns.column, order, first, slots, places, place
    )  # fmt: skip
    for values, into in ((u, slots.u), (v, slots.v), (weights, slots.w)):
        into.reshape(-1)[slot] = values[order]
    flow = problem.readout_flow
    moved = np.zeros((2, 0 if flow is None else len(slots.u), BLOCK), np.float32)
    if flow is not None:
        moved.reshape(2, -1)[:, slot] = flow[order].T
    return PackedLayout(**vars(unknowns), slots=slots, places=places, place=place, flow=moved)


def _room(counts: I64, start: I64) -> tuple[Slots, Places, I64]:
    """Return the slots for this many observations of each camera (M,), and the first slot of each.

    start: (P,) first place of each point.
    """
    blocks, observations = -(-counts // BLOCK), int(counts.sum())
    shape = (int(blocks.sum()), BLOCK)
    slots = Slots(
        camera=np.repeat(np.arange(len(blocks), dtype=np.int32), blocks),
        point=np.zeros(shape, np.int32),
        place=np.full(shape, observations, np.int32),
        u=np.zeros(shape, np.float32),
        v=np.zeros(shape, np.float32),
        w=np.zeros(shape, np.float32),
    )
    places = Places(start, start.copy(), np.zeros(observations, np.int32))
    return slots, places, BLOCK * (np.cumsum(blocks) - blocks)


@kernel
def _sort_by_cameras(camera_index: I32, point_index: I32, cameras: int, points: int) -> I64:
    """Rank of each point by the first camera that sees it, then the last, then its number."""
    first = np.full(points, cameras, np.int64)
    last = np.zeros(points, np.int64)
    for k in range(camera_index.size):
        n, m = point_index[k], camera_index[k]
        first[n] = min(first[n], m)
        last[n] = max(last[n], m)
    order = np.arange(points)
    rank = np.empty(points, np.int64)
    # Two stable counting sorts, the less important key before the other.
    for key in (last, first):
        start = np.zeros(cameras + 2, np.int64)
        for n in range(points):
            start[key[n] + 1] += 1
        start = np.cumsum(start)
        for n in order:
            rank[n] = start[key[n]]
            start[key[n]] += 1
        for n in range(points):
            order[rank[n]] = n
    return rank


@kernel
def _usable(u: float, v: float, weight: float) -> bool:
    return weight > 0.0 and np.isfinite(u) and np.isfinite(v)


@kernel
def _count(
    columns: I32, usable: BoolArray, u: F32, v: F32, weights: F32, seen: BoolArray
) -> tuple[I64, I64]:
    """(M,) usable observations of each camera of a window, (N,) start of each point."""
    counts, of_point = np.zeros(weights.shape[0], np.int64), np.zeros(usable.size, np.int64)
    for m in range(weights.shape[0]):
        for n in range(columns.size):
            c = columns[n]
            if seen[m, c] and usable[n] and _usable(u[m, c], v[m, c], weights[m, c]):
                counts[m] += 1
                of_point[n] += 1
    return counts, np.cumsum(of_point) - of_point


@kernel
def _pack_window(
    columns: I32,
    usable: BoolArray,
    u: F32,
    v: F32,
    weights: F32,
    seen: BoolArray,
    first: I64,
    slots: Slots,
    places: Places,
) -> None:
    for m in range(weights.shape[0]):
        b, i = first[m] // BLOCK, 0
        for n in range(columns.size):
            c = columns[n]
            if seen[m, c] and usable[n] and _usable(u[m, c], v[m, c], weights[m, c]):
                at = places.stop[n]
                places.stop[n] += 1
                places.camera[at] = m
                slots.point[b, i] = n
                slots.place[b, i] = at
                slots.u[b, i], slots.v[b, i], slots.w[b, i] = u[m, c], v[m, c], weights[m, c]
                i += 1
                if i == BLOCK:
                    b, i = b + 1, 0


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
) -> tuple[I32, I64, I64]:
    """Usable observations in the order of cameras, (M,) how many of each, (P,) start of a point."""
    counts = np.zeros(cameras, np.int64)
    of_point = np.zeros(points, np.int64)
    good = np.zeros(camera_index.size, np.bool_)
    for k in range(camera_index.size):
        good[k] = usable[point_index[k]] and _usable(u[k], v[k], weights[k])
        if good[k]:
            counts[camera_index[k]] += 1
            of_point[column[point_index[k]]] += 1
    fill = np.cumsum(counts) - counts
    order = np.empty(counts.sum(), np.int32)
    for k in range(camera_index.size):
        if good[k]:
            order[fill[camera_index[k]]] = k
            fill[camera_index[k]] += 1
    return order, counts, np.cumsum(of_point) - of_point


@kernel
def _pack(
    camera_index: I32,
    point_index: I32,
    column: I64,
    order: I32,
    next_slot: I64,
    slots: Slots,
    places: Places,
    place: I32,
) -> I32:
    """Assign a place to every observation; returns its slot and place, in the given order.

    next_slot: (M,) the first slot of each camera, counted up.
    """
    start, stop, camera = places.start, places.stop, places.camera
    slot_at = np.empty(order.size, np.int32)
    slot_of = np.empty(order.size, np.int32)
    for i in range(order.size):
        k = order[i]
        m, n = camera_index[k], column[point_index[k]]
        at = stop[n]
        if at > start[n] and camera[at - 1] == m:
            # A repeated observation replaces the earlier one.
            at -= 1
            slot = slot_at[at]
        else:
            slot = next_slot[m]
            next_slot[m] += 1
            stop[n] += 1
        slot_at[at] = slot
        camera[at] = m
        place[k] = at
        slot_of[i] = slot
        slots.point[slot // BLOCK, slot % BLOCK] = n
        slots.place[slot // BLOCK, slot % BLOCK] = at
    return slot_of

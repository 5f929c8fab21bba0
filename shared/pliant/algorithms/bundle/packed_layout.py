"""The packed layout, on which the Schur complement works: a list of observations.

Each observation has a slot and a place.  Slots go camera by camera, in blocks of ``BLOCK``
observations of one camera, so that linearisation is SIMD code with the camera in registers.  Places
go point by point, cameras ascending, which is the order in which points are eliminated.
"""

from dataclasses import dataclass
from typing import NamedTuple

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

    place: (K,) of each of the problem's own observations, -1 where it is left out.
    flow: (2, B, BLOCK) the readout flow of each slot, px; (2, 0, BLOCK): there is none.
    """

    slots: Slots
    places: Places
    place: I32
    flow: F32


def build_packed_layout(problem: AnyProblem) -> PackedLayout:
    """Bring a problem into the packed layout.  Nothing in the problem is changed."""
    N, usable = len(problem.points_world), finite_points(problem.points_world)
    unknowns = unknowns_of(problem, columns_of(problem), usable, N)
    flow = np.zeros((0, 2), np.float32)
    if isinstance(problem, BundleProblem):
        camera_index, point_index = problem.camera_index, problem.point_index
        u, v = (np.ascontiguousarray(each) for each in problem.points_px.T)
        weights = weights_of(problem)
        flow = flow if problem.readout_flow is None else problem.readout_flow
    else:
        camera_index, point_index = list_seen(problem.weights)
        at = (camera_index, point_index)
        u, v, weights = problem.u[at], problem.v[at], problem.weights[at]
    order, counts, start = _sort(
        camera_index, point_index, u, v, weights, usable, unknowns.column,
        len(unknowns.free), N,
    )  # fmt: skip
    blocks = -(-counts // BLOCK)
    shape = (int(blocks.sum()), BLOCK)
    slots = Slots(
        camera=np.repeat(np.arange(len(blocks), dtype=np.int32), blocks),
        point=np.zeros(shape, np.int32),
        place=np.full(shape, len(order), np.int32),
        u=np.zeros(shape, np.float32),
        v=np.zeros(shape, np.float32),
        w=np.zeros(shape, np.float32),
    )
    places = Places(start, start.copy(), np.zeros(len(order), np.int32))
    place = np.full(len(u), _NOWHERE, np.int32)
    slot = _pack(
        camera_index, point_index, unknowns.column, order,
        BLOCK * (np.cumsum(blocks) - blocks), slots, places, place,
    )  # fmt: skip
    for values, into in ((u, slots.u), (v, slots.v), (weights, slots.w)):
        into.reshape(-1)[slot] = values[order]
    moved = np.zeros((2, len(slots.u) if len(flow) else 0, BLOCK), np.float32)
    if len(flow):
        moved.reshape(2, -1)[:, slot] = flow[order].T
    return PackedLayout(**vars(unknowns), slots=slots, places=places, place=place, flow=moved)


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
) -> tuple[I32, I64, I64]:
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
    """Give every observation its place; returns its slot, both in the order given.

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
            # A camera that observes a point again: the repetition replaces.
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

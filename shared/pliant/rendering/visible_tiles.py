"""Visibility: the camera's place in the frame of each solid, and the solids behind each tile."""

from typing import NamedTuple, TypeAlias

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32
from pliant.rendering.solids import SolidArrays

Reals: TypeAlias = F32 | F64

TILE_PX = 16
TILE_RAYS = TILE_PX * TILE_PX
NEAR_M = 0.02  # nothing nearer than this is seen
_CORNERS = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)], np.float64)
_EDGES = np.array(
    [
        (i, j)
        for i in range(8)
        for j in range(i)
        if (np.abs(_CORNERS[i] - _CORNERS[j]) > 0).sum() == 1
    ]
)


class Tiles(NamedTuple):
    """The solids that each tile of TILE_PX x TILE_PX pixels may show, nearest first."""

    start: I32  # (T + 1,) where a tile's list starts in ``solids``
    solids: I32  # the lists, one after the other
    nearest: F64  # (S,) no point of a solid is nearer than this depth, metres


class View(NamedTuple):
    """The camera in the frame of each of S solids."""

    origin: F64  # (S, 3) camera centre, metres
    rotation: F64  # (S, 3, 3) R_solid_camera


def view_of(solids: SolidArrays, T_world_camera: F64) -> View:
    """Express a (4, 4) camera pose in the frame of every solid."""
    R_solid_world = np.swapaxes(solids.rotation, 1, 2)
    origin = (R_solid_world @ (T_world_camera[:3, 3] - solids.centre)[:, :, None])[:, :, 0]
    rotation = R_solid_world @ T_world_camera[:3, :3]
    return View(np.ascontiguousarray(origin), np.ascontiguousarray(rotation))


def tile_bounds(rays: F32 | F64) -> F64:
    """(T, 4) bounds (min x, max x, min y, max y) of the (H, W, 2) rays of each tile."""
    height, width = rays.shape[:2]
    out: list[list[float]] = []
    for row in range(0, height, TILE_PX):
        for col in range(0, width, TILE_PX):
            tile = rays[row : row + TILE_PX, col : col + TILE_PX]
            low, high = tile.min(axis=(0, 1)), tile.max(axis=(0, 1))
            out.append([low[0], high[0], low[1], high[1]])
    return np.array(out, np.float64)


def visible_tiles(solids: SolidArrays, view: View, bounds: F64, margin: float) -> Tiles:
    """List the solids that each tile may show.  margin: added around the bounds, on plane z = 1."""
    corners = _CORNERS[None] * solids.half[:, None, :] - view.origin[:, None, :]
    corners = corners @ view.rotation  # rows times R_solid_camera: the camera frame
    z = corners[:, :, 2]
    # The part of each of the twelve edges that lies in front of the camera.
    first, last = corners[:, _EDGES[:, 0]], corners[:, _EDGES[:, 1]]
    depth_0, depth_1 = first[:, :, 2], last[:, :, 2]
    crossing = (depth_0 < NEAR_M) != (depth_1 < NEAR_M)
    part = np.where(crossing, (NEAR_M - depth_0) / np.where(crossing, depth_1 - depth_0, 1.0), 0.0)
    cut = first + part[:, :, None] * (last - first)
    points = np.concatenate([corners, cut], axis=1)
    front = np.concatenate([z >= NEAR_M, crossing], axis=1)[:, :, None]
    plane = points[:, :, :2] / np.maximum(points[:, :, 2:], NEAR_M)
    low = np.where(front, plane, np.inf).min(axis=1) - margin
    high = np.where(front, plane, -np.inf).max(axis=1) + margin
    shown = (
        (bounds[:, None, 1] >= low[None, :, 0])
        & (bounds[:, None, 0] <= high[None, :, 0])
        & (bounds[:, None, 3] >= low[None, :, 1])
        & (bounds[:, None, 2] <= high[None, :, 1])
    )
    nearest_m = np.where(solids.kind == 0, np.inf, np.maximum(z.min(axis=1), 0.0))
    order = np.argsort(nearest_m, kind="stable")
    start = np.concatenate([[0], np.cumsum(shown.sum(axis=1))]).astype(np.int32)
    # The room comes last: its own bound must not cut it off.
    nearest_m[solids.kind == 0] = 0.0
    return Tiles(start, order[np.nonzero(shown[:, order])[1]].astype(np.int32), nearest_m)

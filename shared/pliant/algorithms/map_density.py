"""How dense a map is: points that are well observed, once duplicates are merged."""

from typing import Any

import numpy as np

from pliant.algorithms.arrays import F64, I32, I64, BoolArray
from pliant.algorithms.camera import PinholeCamera
from pliant.compiler.kernel import kernel

MIN_KEYFRAMES = 3
MIN_PARALLAX_RAD = float(np.radians(1.0))
DUPLICATE_PX = 1.0
"""Two points of one view nearer than this are one: maxima of an image are >= 2 px apart."""
DUPLICATE_DEPTH = 0.05


def well_observed(keyframes: I32, parallax_rad: F64) -> BoolArray:
    """(P,) points seen in at least 3 keyframes under at least 1 degree of parallax."""
    return (keyframes >= MIN_KEYFRAMES) & (parallax_rad >= MIN_PARALLAX_RAD)


def count_distinct(
    points_world: F64,
    frames: I64,
    *,
    camera: PinholeCamera,
    T_world_camera: dict[int, F64],
) -> int:
    """How many points remain when duplicates are merged.

    Two points are duplicates if two conditions hold in the frame of either of them.  They lie
    within ``DUPLICATE_PX`` of each other and their depths differ by at most ``DUPLICATE_DEPTH`` of
    the smaller.  Duplicates of duplicates merge as well, so the count errs on the low side.  Points
    that are not in the image of their own frame stay as they are.

    points_world: (P, 3), of one map segment.      frames: (P,) a frame that observes each point,
        as for ``evaluate_map``.      T_world_camera: estimated pose of each of those frames; the
        points of a frame without one are compared only from the frames of others.
    """
    parent = np.arange(len(points_world), dtype=np.int64)
    points = np.ascontiguousarray(points_world, np.float64)
    head = np.full((camera.height, camera.width), -1, np.int64)
    following = np.zeros(len(points), np.int64)
    for frame in np.unique(frames).tolist():
        T = T_world_camera.get(frame)
        if T is None:
            continue
        in_camera = (points - T[:3, 3]) @ T[:3, :3]
        depths = np.ascontiguousarray(in_camera[:, 2])
        front = depths > 1e-9
        px = camera.project(np.where(front[:, None], in_camera, 1.0))
        limits = (camera.width - 0.5, camera.height - 0.5)
        seen = front & np.all((px > -0.5) & (px < limits), axis=1)
        _merge_in_frame(
            np.flatnonzero(seen),
            frames == frame,
            px,
            depths,
            DUPLICATE_PX,
            DUPLICATE_DEPTH,
            head,
            following,
            parent,
        )
    return int(np.sum(parent == np.arange(len(parent))))


@kernel
def _root(parent: I64, row: Any) -> Any:
    while parent[row] != row:
        parent[row] = parent[parent[row]]
        row = parent[row]
    return row


@kernel
def _merge_in_frame(
    seen: I64,
    own: BoolArray,
    px: F64,
    depths: F64,
    max_distance_px: float,
    max_depth_difference: float,
    head: I64,
    following: I64,
    parent: I64,
) -> None:
    # One list of points for each pixel; only the cells around a point can hold a duplicate.
    height, width = head.shape
    head[:] = -1
    reach = int(np.ceil(max_distance_px))
    for row in seen:
        u, v = int(np.floor(px[row, 0] + 0.5)), int(np.floor(px[row, 1] + 0.5))
        following[row] = head[v, u]
        head[v, u] = row
    for row in seen:
        if not own[row]:
            continue
        u, v = int(np.floor(px[row, 0] + 0.5)), int(np.floor(px[row, 1] + 0.5))
        for y in range(max(v - reach, 0), min(v + reach + 1, height)):
            for x in range(max(u - reach, 0), min(u + reach + 1, width)):
                other = head[y, x]
                while other >= 0:
                    du, dv = px[other, 0] - px[row, 0], px[other, 1] - px[row, 1]
                    near = min(depths[other], depths[row])
                    if (
                        other != row
                        and du * du + dv * dv <= max_distance_px * max_distance_px
                        and abs(depths[other] - depths[row]) <= max_depth_difference * near
                    ):
                        a, b = _root(parent, row), _root(parent, other)
                        parent[max(a, b)] = min(a, b)
                    other = following[other]

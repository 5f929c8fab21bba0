"""The map's points against true depth."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pliant.algorithms.arrays import F64, I64
from pliant.algorithms.camera import PinholeCamera
from pliant.evaluation.criteria import Similarity
from pliant.evaluation.visible_depth import DepthView

DEPTH_LIMIT = 0.05


@dataclass(frozen=True, kw_only=True)
class MapTruth:
    """Points of a map against true depth.

    points: all that were given.      in_view: of those, in the image of their frame.
    within: within 5 % of the true depth.      share: within / points, so that points outside
    the image in which they were first published count as wrong.      median_error: median relative
    error of those in view; NaN without any.      at_jumps: in view, beside a jump in depth.
    """

    points: int
    in_view: int
    at_jumps: int
    within: int
    share: float
    median_error: float


def evaluate_map(
    points_world: F64,
    frames: I64,
    *,
    alignment: Similarity,
    camera: PinholeCamera,
    truth: Callable[[int], tuple[F64, F64]],
) -> MapTruth:
    """Compare the depth of every point with the true depth at the pixel where it is seen.

    A point is moved to the true world by the Sim(3) of the trajectory and projected with the true
    pose into **one** frame: the one whose map update first published the point.
    True depth is interpolated (inverse depth, exact on planes); beside a jump in depth, where
    that makes no sense, the nearest of the four pixels around it in depth is taken.

    points_world: (P, 3) in the world of the estimate.      frames: (P,) the frame of each.
    truth: gives true depth (H, W) in metres (0: none) and T_world_camera (4, 4) of a frame.
    """
    aligned = alignment.apply(points_world)
    errors = np.full(len(aligned), np.inf)
    in_view = np.zeros(len(aligned), np.bool_)
    at_jumps = 0
    for frame in np.unique(frames).tolist():
        rows = np.flatnonzero(frames == frame)
        depth_m, T_world_camera = truth(frame)
        view = DepthView.of(camera, T_world_camera, depth_m)
        points_px, depths = view.project(aligned[rows])
        inside = view.inside(points_px)
        rows, points_px, depths = rows[inside], points_px[inside], depths[inside]
        corners, weights, broken = view.corners(points_px)
        smooth = (corners * weights).sum(axis=1) * depths
        nearest = np.abs(corners * depths[:, None] - 1.0).argmin(axis=1)
        ratio = np.where(broken, corners[np.arange(len(rows)), nearest] * depths, smooth)
        # ratio is estimated over true depth; 0 where there is no surface at all.
        errors[rows] = np.where(ratio > 0.0, np.abs(ratio - 1.0), np.inf)
        in_view[rows] = True
        at_jumps += int(broken.sum())
    within = int(np.sum(errors <= DEPTH_LIMIT))
    return MapTruth(
        points=len(aligned),
        in_view=int(in_view.sum()),
        at_jumps=at_jumps,
        within=within,
        share=within / len(aligned) if len(aligned) else float("nan"),
        median_error=float(np.median(errors[in_view])) if in_view.any() else float("nan"),
    )


def format_map(truth: MapTruth) -> str:
    """Two lines, ready to print."""
    return (
        f"map points within 5 % of the true depth: {100.0 * truth.share:.1f} % of {truth.points}"
        f" (median error {100.0 * truth.median_error:.2f} %)\n"
        f"in view of the frame that first published them: {truth.in_view}, beside a jump in depth: "
        f"{truth.at_jumps}"
    )

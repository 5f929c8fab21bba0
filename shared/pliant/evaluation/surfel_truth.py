"""Surfels against the true depth of every frame: metric, without any alignment, untrimmed.

The surfels that are born in the first frame with any are judged, in the frame of the camera.  Two
errors, since sensors give depth but no correspondences:

- the distance to the true cloud (the depth map's pixels), which needs no correspondences and does
  not show sliding along the surface;
- the distance to tracks: the surfel's place of birth followed from image to image by Lucas-Kanade,
  kept as long as following it back ends within half a pixel, and lifted with the true depth.  It
  shares the tangential error of that tracker, which is no part of the surfels'.

Beside them what others publish: DefSLAM's mean of the best 80 % after one scale a frame, and
NR-SLAM's RMSE of depth over the best 90 %.
"""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from pliant.algorithms.arrays import F32, F64, U8, BoolArray
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import inverse, transform
from pliant.algorithms.surfels.surfel_frame import SurfelFrame, SurfelState
from pliant.evaluation.presentation import table
from pliant.evaluation.surface_distance import nearest

MAX_RETURN_PX = 0.5
MAX_STEP = 0.01
"""Relative range of the four pixels about a track beyond which it is on an edge of the depth."""


@dataclass(frozen=True, kw_only=True)
class SurfelRow:
    """One frame.  Lengths in metres, NaN where there is nothing to compare.

    alive, judged: surfels of the first frame that are tracked, and all of them.
    compared, compared_all: of those, the ones with a lifted track.
    rmse: 3D, alive ones to their tracks.    rmse_all: all, lost ones at their last estimate.
    frozen_rmse: of the places of birth.     cloud, frozen_cloud: median distance to the true cloud.
    scaled_mean_80, depth_rmse_90: alive ones, as DefSLAM and NR-SLAM report.
    """

    frame: int
    alive: int
    judged: int
    compared: int
    compared_all: int
    rmse: float
    rmse_all: float
    frozen_rmse: float
    cloud: float
    frozen_cloud: float
    scaled_mean_80: float
    depth_rmse_90: float


class SurfelTruth:
    """Takes surfels, image and true depth frame by frame; ``rows`` has the figures."""

    def __init__(self, camera: PinholeCamera) -> None:
        self._camera = camera
        self._image: U8 | None = None
        self._ids = np.zeros(0, np.int64)
        self._born: F64 = np.zeros((0, 3))
        self._tracks: F32 = np.zeros((0, 2), np.float32)
        self._followed: BoolArray = np.zeros(0, np.bool_)
        self.rows: list[SurfelRow] = []

    def add(self, frame: int, surfels: SurfelFrame, image: U8, depth_m: F64) -> None:
        """image: (H, W).  depth_m: (H, W), 0 where nothing is known."""
        if self._image is None:
            if not len(surfels.ids):
                return
            self._ids, self._born = surfels.ids, surfels.positions
            self._tracks = surfels.points_px.copy()
            self._followed = np.ones(len(surfels.ids), np.bool_)
        else:
            self._follow(self._image, image)
        self._image = image
        row = np.searchsorted(surfels.ids, self._ids)
        row = np.minimum(row, max(len(surfels.ids) - 1, 0))
        listed = surfels.ids[row] == self._ids if len(surfels.ids) else row < 0
        where = self._born.copy()
        where[listed] = surfels.positions[row[listed]]
        alive = np.zeros(len(self._ids), np.bool_)
        alive[listed] = surfels.state[row[listed]] == SurfelState.TRACKED
        T = inverse(surfels.T_world_camera)
        self.rows.append(
            self._judge(frame, alive, transform(T, where), transform(T, self._born), depth_m)
        )

    def _follow(self, before: U8, now: U8) -> None:
        window: Any = {"winSize": (21, 21), "maxLevel": 4}
        there, good, _ = cv2.calcOpticalFlowPyrLK(before, now, self._tracks, None, **window)  # type: ignore[call-overload]
        back, returned, _ = cv2.calcOpticalFlowPyrLK(now, before, there, None, **window)  # type: ignore[call-overload]
        error = np.linalg.norm(np.asarray(back) - self._tracks, axis=1)
        kept = (np.ravel(good) > 0) & (np.ravel(returned) > 0) & (error < MAX_RETURN_PX)
        self._followed &= kept
        self._tracks = np.asarray(there, np.float32)

    def _judge(
        self, frame: int, alive: BoolArray, where: F64, born: F64, depth_m: F64
    ) -> SurfelRow:
        truth, known = lift(self._tracks, depth_m, self._camera)
        known &= self._followed
        cloud = cloud_of(depth_m, self._camera)
        both = alive & known
        return SurfelRow(
            frame=frame,
            alive=int(alive.sum()),
            judged=len(alive),
            compared=int(both.sum()),
            compared_all=int(known.sum()),
            rmse=rmse(where[both] - truth[both]),
            rmse_all=rmse(where[known] - truth[known]),
            frozen_rmse=rmse(born[known] - truth[known]),
            cloud=_median(nearest(where[alive], cloud, np.inf)[1]),
            frozen_cloud=_median(nearest(born, cloud, np.inf)[1]),
            scaled_mean_80=scaled_mean(where[both], truth[both], 0.8),
            depth_rmse_90=trimmed_rmse(where[both, 2] - truth[both, 2], 0.9),
        )


def lift(points_px: F32, depth_m: F64, camera: PinholeCamera) -> tuple[F64, BoolArray]:
    """(N, 3) points of the camera frame at (N, 2) pixels, and where the depth is known there.

    Bilinear between the four pixels around, which must all be known and of one surface.
    """
    height, width = depth_m.shape
    u, v = points_px[:, 0].astype(np.float64), points_px[:, 1].astype(np.float64)
    inside = (u >= 0.0) & (v >= 0.0) & (u < width - 1.0) & (v < height - 1.0)
    u0 = np.where(inside, np.floor(u), 0).astype(np.int64)
    v0 = np.where(inside, np.floor(v), 0).astype(np.int64)
    corners = np.stack(
        [depth_m[v0 + dv, u0 + du] for dv, du in ((0, 0), (0, 1), (1, 0), (1, 1))], axis=1
    )
    a, b = u - u0, v - v0
    weights = np.stack([(1 - b) * (1 - a), (1 - b) * a, b * (1 - a), b * a], axis=1)
    z = (corners * weights).sum(axis=1)
    low, high = corners.min(axis=1), corners.max(axis=1)
    known = inside & (low > 0.0) & (high - low <= MAX_STEP * high)
    rays = np.concatenate([camera.normalise(points_px), np.ones((len(u), 1))], axis=1)
    return rays * np.where(known, z, 1.0)[:, None], known


def cloud_of(depth_m: F64, camera: PinholeCamera) -> F64:
    """(M, 3) points of all pixels with depth."""
    v, u = np.nonzero(depth_m > 0.0)
    rays = camera.normalise(np.stack([u, v], axis=1).astype(np.float64))
    return np.concatenate([rays, np.ones((len(u), 1))], axis=1) * depth_m[v, u, None]


def rmse(errors: F64) -> float:
    """RMSE of (N, 3) error vectors; NaN without any."""
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=1)))) if len(errors) else float("nan")


def trimmed_rmse(errors: F64, share: float) -> float:
    """RMSE of the smallest share of (N,) errors."""
    kept = np.sort(np.abs(errors))[: int(share * len(errors))]
    return float(np.sqrt(np.mean(kept**2))) if len(kept) else float("nan")


def scaled_mean(points: F64, truth: F64, share: float) -> float:
    """Mean 3D error of the best share, after the scale that fits (N, 3) points best."""
    if not len(points):
        return float("nan")
    scale = float((points * truth).sum() / (points * points).sum())
    errors = np.sort(np.linalg.norm(scale * points - truth, axis=1))
    kept = errors[: max(1, int(share * len(errors)))]
    return float(kept.mean())


def roc(scores: F64, inlier: BoolArray) -> tuple[F64, F64, float]:
    """False and true positive rates over all thresholds of a score, and the area below (AUC).

    scores: (N,), high for inliers.    inlier: (N,) ground truth.    AUC is NaN with one class only.
    """
    order = np.argsort(-scores, kind="stable")
    ends = np.flatnonzero(np.append(np.diff(scores[order]) != 0.0, True))  # ties count as one step
    right, wrong = np.cumsum(inlier[order])[ends], np.cumsum(~inlier[order])[ends]
    if not len(scores) or inlier.all() or not inlier.any():
        return np.zeros(0), np.zeros(0), float("nan")
    true = np.concatenate([[0.0], right / right[-1]])
    false = np.concatenate([[0.0], wrong / wrong[-1]])
    return false, true, float(np.sum(np.diff(false) * 0.5 * (true[1:] + true[:-1])))


def mean_rows(rows: list[SurfelRow]) -> dict[str, float]:
    """Every figure, meaned over the frames after the first."""
    names = SurfelRow.__dataclass_fields__
    return {
        name: float(np.mean([getattr(row, name) for row in rows[1:]])) if rows[1:] else float("nan")
        for name in names
        if name != "frame"
    }


def format_surfels(rows: list[SurfelRow]) -> str:
    """A table of some frames and the mean, in millimetres."""
    heading = (
        *("frame", "alive", "compared", "RMSE", "RMSE all", "frozen", "to cloud", "frozen"),
        *("scaled mean 80 %", "depth RMSE 90 %"),
    )
    chosen = sorted({0, *np.linspace(0, len(rows) - 1, 7).astype(int).tolist()})
    figures = ("rmse", "rmse_all", "frozen_rmse", "cloud", "frozen_cloud")
    figures += ("scaled_mean_80", "depth_rmse_90")
    lines = [heading]
    for number in chosen:
        row = rows[number]
        lengths = [f"{1e3 * getattr(row, name):.2f}" for name in figures]
        lines.append((str(row.frame), f"{row.alive}/{row.judged}", str(row.compared), *lengths))  # type: ignore[arg-type]
    mean = mean_rows(rows)
    lengths = [f"{1e3 * mean[name]:.2f}" for name in figures]
    share = f"{mean['alive'] / max(1.0, mean['judged']):.1%}"
    lines.append(("mean 1-", share, f"{mean['compared']:.0f}", *lengths))  # type: ignore[arg-type]
    return "surfels compared with exact depth, mm, no alignment\n" + table(lines)


def _median(values: F64) -> float:
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if len(finite) else float("nan")

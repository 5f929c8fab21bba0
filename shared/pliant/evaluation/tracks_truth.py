"""Tracks compared with exact depth and poses: which are still on their initial surface point.

Ground truth of a track is the surface point seen at the sub-pixel position of its birth, followed
exactly by the true poses.  Births whose surface is not defined are left out: any of the four
pixels around lies on a depth jump, within 1.5 px of one, or shows no surface.  A track that
continues while its surface point is occluded or out of view still counts.  It is wrong once it
leaves the projection of the point.
"""

from dataclasses import dataclass

import numpy as np

from pliant.algorithms.arrays import F64, I64, BoolArray
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.tracks import FrameTracks
from pliant.evaluation.presentation import table
from pliant.evaluation.visible_depth import DepthView

LIMIT_PX = 2.0
AGES = (1, 10, 30)
MATURE_AGE = 10


@dataclass(frozen=True, kw_only=True)
class AgeRow:
    """Tracks at one age, summed over all frames.

    living: tracks of this age with a defined ground truth.      right: of those, within 2 px of it.
    median_px: median distance of the living ones; NaN without any.
    followable: births whose point stayed in view and unhidden in every frame up to this age.
    alive, alive_right: of the followable, those still tracked, and tracked within 2 px.
    """

    age: int
    living: int
    right: int
    median_px: float
    followable: int
    alive: int
    alive_right: int

    @property
    def share_right(self) -> float:
        """right / living."""
        return self.right / self.living if self.living else float("nan")

    @property
    def share_alive(self) -> float:
        """alive / followable."""
        return self.alive / self.followable if self.followable else float("nan")

    @property
    def share_alive_right(self) -> float:
        """alive_right / followable."""
        return self.alive_right / self.followable if self.followable else float("nan")


@dataclass(frozen=True, kw_only=True)
class TracksEvaluation:
    """All tracks of a run against ground truth.

    living_median: median over the frames, from the first one in which age 10 is possible, of the
        tracks of age >= 10 in a frame, with or without a defined ground truth.
    mature_right: share within 2 px of all tracks of age >= 10 over all frames.
    """

    frames: int
    births: int
    births_without_truth: int
    living_median: float
    mature_right: float
    ages: tuple[AgeRow, ...]


class TracksTruth:
    """Takes a run's tracks and ground truth frame by frame; holds only what is being followed.

    ``for ...: truth.add(tracks, depth_m, T_world_camera)``, then ``truth.evaluation()``.
    """

    def __init__(self, camera: PinholeCamera, *, ages: tuple[int, ...] = AGES) -> None:
        self._camera = camera
        self._ages = ages
        self._frame = 0
        # Every point followed: births up to the oldest age, and tracks for as long as they live.
        self._ids: I64 = np.zeros(0, np.int64)
        self._born: I64 = np.zeros(0, np.int64)
        self._points: F64 = np.zeros((0, 3))
        self._seen: BoolArray = np.zeros(0, np.bool_)
        self._births = self._births_without_truth = 0
        self._last_id = -1
        self._mature: list[int] = []
        self._mature_with_truth = self._mature_right = 0
        self._distances: dict[int, list[F64]] = {age: [] for age in ages}
        self._survival: dict[int, I64] = {age: np.zeros(3, np.int64) for age in ages}

    def add(self, tracks: FrameTracks, depth_m: F64, T_world_camera: F64) -> None:
        """The next frame: its tracks, true depth (H, W) in metres (0: none) and true pose (4, 4).

        Every frame of the run, in order; a broken frame with its empty tracks.
        """
        view = DepthView.of(self._camera, T_world_camera, depth_m)
        points_px = tracks.points_px.astype(np.float64)
        true_px, depths = view.project(self._points)
        self._seen &= view.visible(true_px, depths)
        row, alive = _find(self._ids, tracks.ids)
        distance = np.full(len(self._ids), np.inf)
        distance[alive] = np.linalg.norm(points_px[row[alive]] - true_px[alive], axis=1)
        # Behind the camera ground truth has no pixel: a track that claims one is wrong.
        distance[np.isnan(distance)] = np.inf
        self._count(tracks, self._frame - self._born, alive, distance)
        # Forget dead tracks that are older than every requested age.
        keep = alive | (self._frame - self._born < max(self._ages))
        self._keep(keep)
        self._start(tracks, points_px, view)
        self._frame += 1

    def _count(self, tracks: FrameTracks, age: I64, alive: BoolArray, distance: F64) -> None:
        if self._frame >= MATURE_AGE:
            self._mature.append(int(np.sum(tracks.ages >= MATURE_AGE)))
        mature = alive & (age >= MATURE_AGE)
        self._mature_with_truth += int(mature.sum())
        self._mature_right += int(np.sum(distance[mature] <= LIMIT_PX))
        for wanted in self._ages:
            at = age == wanted
            self._distances[wanted].append(distance[at & alive])
            followable = at & self._seen
            here = followable & alive
            right = here & (distance <= LIMIT_PX)
            self._survival[wanted] += (followable.sum(), here.sum(), right.sum())

    def _keep(self, rows: BoolArray) -> None:
        self._ids, self._born = self._ids[rows], self._born[rows]
        self._points, self._seen = self._points[rows], self._seen[rows]

    def _start(self, tracks: FrameTracks, points_px: F64, view: DepthView) -> None:
        # Ids grow over the whole run, so a new one is larger than all before.
        new = tracks.ids > self._last_id
        if not new.any():
            return
        self._last_id = int(tracks.ids.max())
        points, good = view.lift(points_px[new])
        self._births += len(good)
        self._births_without_truth += int(np.sum(~good))
        count = int(good.sum())
        self._ids = np.concatenate([self._ids, tracks.ids[new][good]])
        self._born = np.concatenate([self._born, np.full(count, self._frame, np.int64)])
        self._points = np.concatenate([self._points, points[good]])
        self._seen = np.concatenate([self._seen, np.ones(count, np.bool_)])

    def evaluation(self) -> TracksEvaluation:
        """The figures over all frames so far."""
        rows: list[AgeRow] = []
        for age in self._ages:
            distance = np.concatenate([*self._distances[age], np.zeros(0)])
            followable, alive, alive_right = (int(n) for n in self._survival[age])
            rows.append(
                AgeRow(
                    age=age,
                    living=len(distance),
                    right=int(np.sum(distance <= LIMIT_PX)),
                    median_px=float(np.median(distance)) if len(distance) else float("nan"),
                    followable=followable,
                    alive=alive,
                    alive_right=alive_right,
                )
            )
        mature = self._mature_with_truth
        return TracksEvaluation(
            frames=self._frame,
            births=self._births,
            births_without_truth=self._births_without_truth,
            living_median=float(np.median(self._mature)) if self._mature else 0.0,
            mature_right=self._mature_right / mature if mature else float("nan"),
            ages=tuple(rows),
        )


def _find(ids: I64, living: I64) -> tuple[I64, BoolArray]:
    """Row in ``living`` (increasing) of each id, and whether it is there."""
    if not len(living):
        return np.zeros(len(ids), np.int64), np.zeros(len(ids), np.bool_)
    row = np.minimum(np.searchsorted(living, ids), len(living) - 1)
    return row, living[row] == ids


def format_tracks(evaluation: TracksEvaluation) -> str:
    """A table, ready to print."""
    heading = ["age", "living", "within 2 px", "median px", "followable", "alive", "alive & right"]
    rows = [heading]
    for row in evaluation.ages:
        rows.append(
            [
                str(row.age),
                str(row.living),
                f"{100.0 * row.share_right:.2f} %",
                f"{row.median_px:.2f}",
                str(row.followable),
                f"{100.0 * row.share_alive:.1f} %",
                f"{100.0 * row.share_alive_right:.1f} %",
            ]
        )
    without = evaluation.births_without_truth
    return "\n".join(
        [
            table(rows),
            "",
            f"tracks of age >= {MATURE_AGE} in a frame, median: {evaluation.living_median:.0f}, "
            f"{100.0 * evaluation.mature_right:.2f} % of them within {LIMIT_PX:g} px",
            f"births: {evaluation.births} in {evaluation.frames} frames, of which {without} on a "
            "jump in depth or without surface have no ground truth",
        ]
    )

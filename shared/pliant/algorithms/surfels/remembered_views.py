"""Recovery of surfels after a loss, by earlier views.

Surfels that were covered, in the dark or relocated are farther away than the image attracts a
patch.  So views are stored: their corners (``places``), each by its position on a surfel.  A
similar frame shows some of these corners again.  P3P and RANSAC over the last positions of their
surfels give the motion on which most agree, then that of the rest, as long as enough agree: the
motion of a moving camera, or of independent objects.  It is a proposal: the surfels' own images
verify it.
"""

from dataclasses import dataclass, field

import numpy as np

from pliant.algorithms.arrays import F32, F64, I64, BoolArray
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import inverse, transform
from pliant.algorithms.slam.estimate.absolute_pose import pose_by_ransac
from pliant.algorithms.slam.estimate.pose import Correspondences, refine_pose
from pliant.algorithms.slam.estimate.problem import BundleParameters
from pliant.algorithms.slam.places.place_index import Features, PlaceIndex, match, repeated_share
from pliant.algorithms.surfels.deformation_models import move_poses
from pliant.algorithms.surfels.patch_sampling import A, B, F, X
from pliant.algorithms.surfels.surfel_table import SurfelTable
from pliant.algorithms.surfels.validation import U, V

_MOST = 50
"""Maximum stored views, some 45 kB each; the oldest are dropped."""
_PLACES = 5
"""Number of most similar views that are tested."""
_MOVED_SHARE = 0.1
"""Share of the image's width: a larger median motion of the surfels makes another view."""
_SHARED = 0.5
"""And so does a smaller share of surfels in common with the last view."""
_AGREEING = 15
"""Minimum corners that agree on a motion, as for lost cameras (``MIN_AGREEING``)."""
_GATE_SHARE = 0.01
"""Share of the image's width: error of an agreeing corner.  Deforming scenes deviate from any rigid
motion.
"""
_SAMPLES = 500
_REPEATED, _SAME_SHIFT = 0.5, 0.1
"""With this share of the corners seen again a step aside, which is at least so long as a share of
the depth, nothing is recognised."""


@dataclass(frozen=True, kw_only=True)
class _View:
    """segment: of the surfels.   ids: (n,) surfel of each corner.   at: (n, 2) positions on their
    planes, along both tangents.
    """

    segment: int
    ids: I64
    at: F64


@dataclass(frozen=True, kw_only=True)
class FoundBack:
    """Proposed surfels of a segment: T_world_camera, and poses (N, POSE_FLOATS) in the world.

    rows: (m,) of the surfels with agreeing corners.
    """

    segment: int
    T_world_camera: F64
    poses: F64
    rows: I64


@dataclass(kw_only=True)
class RememberedViews:
    """index: of the corners of the views.   seen_ids, seen_px: surfels of the newest view."""

    index: PlaceIndex = field(default_factory=PlaceIndex)
    views: dict[int, _View] = field(default_factory=dict[int, _View])
    added: int = 0
    seen_ids: I64 = field(default_factory=lambda: np.zeros(0, np.int64))
    seen_px: F64 = field(default_factory=lambda: np.zeros((0, 2)))

    def is_another(self, table: SurfelTable, camera: PinholeCamera) -> bool:
        """Whether the tracked surfels differ from the newest view."""
        ids, points_px = table.ids[table.tracked], table.validations[table.tracked, U : V + 1]
        _, new, old = np.intersect1d(ids, self.seen_ids, assume_unique=True, return_indices=True)
        if len(new) < _SHARED * len(ids):
            return True
        moved = np.linalg.norm(points_px[new] - self.seen_px[old], axis=1)
        return bool(len(new)) and float(np.median(moved)) > _MOVED_SHARE * camera.width

    def remember(
        self, seen: Features, table: SurfelTable, segment: int, T_world_camera: F64,
        camera: PinholeCamera, patch_px: int,
    ) -> None:  # fmt: skip
        """Store the corners of a frame that lie on tracked surfels."""
        rows = np.flatnonzero(table.tracked)
        self.seen_ids, self.seen_px = table.ids[rows], table.validations[rows, U : V + 1].copy()
        corners, on = _nearest(seen.points_px, self.seen_px, 0.5 * patch_px)
        poses = move_poses(table.poses[rows[on]], inverse(T_world_camera))
        at, hit = _on_plane(poses, camera.normalise(seen.points_px[corners].astype(np.float64)))
        corners, on, at = corners[hit], on[hit], at[hit]
        self.views[self.added] = _View(segment=segment, ids=self.seen_ids[on], at=at)
        some = Features(points_px=seen.points_px[corners], descriptors=seen.descriptors[corners])
        self.index.add(self.added, some)
        self.added += 1
        self._forget([number for number in self.views if number < self.added - _MOST])

    def forget_segment(self, segment: int) -> None:
        """Drop the views of a segment."""
        self._forget([n for n, view in self.views.items() if view.segment == segment])

    def recognise(
        self, seen: Features, tables: dict[int, SurfelTable], T_world_camera: F64 | None,
        camera: PinholeCamera,
    ) -> FoundBack | None:  # fmt: skip
        """Return the surfels of the view on which most corners of a frame agree.

        tables: of the segments to search.   T_world_camera: of a static camera.
        """
        best: FoundBack | None = None
        agreeing = 0
        asked = [n for n in self.index.query(seen) if self.views[n].segment in tables]
        for number in asked[:_PLACES]:
            view = self.views[number]
            table = tables[view.segment]
            pairs = match(seen, self.index.features[number])
            rows = np.minimum(np.searchsorted(table.ids, view.ids), len(table) - 1)
            pairs = pairs[(table.ids[rows] == view.ids)[pairs[:, 1]]]
            rows, at = rows[pairs[:, 1]], view.at[pairs[:, 1]]
            motions = _motions(seen, pairs[:, 0], _points(table.poses[rows], at), camera)
            count = sum(len(corners) for _, corners in motions)
            if count > agreeing:
                agreeing = count
                best = _moved(table, view.segment, rows, motions, T_world_camera)
        return best

    def _forget(self, numbers: list[int]) -> None:
        for number in numbers:
            del self.views[number]
        self.index.forget(numbers)


def _nearest(points_px: F32, surfels_px: F64, reach_px: float) -> tuple[I64, I64]:
    """Which of some points have a surfel within reach, and the nearest of each."""
    if not len(points_px) or not len(surfels_px):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    squares = ((points_px[:, None].astype(np.float64) - surfels_px) ** 2).sum(axis=2)
    nearest = squares.argmin(axis=1)
    near = np.flatnonzero(squares.min(axis=1) < reach_px * reach_px)
    return near, nearest[near]


def _tangents(poses: F64) -> F64:
    """(n, 3, 2) of surfels as they are stretched."""
    a, b = poses[:, A : A + 3], poses[:, B : B + 3]
    f11, f12, f22 = (poses[:, F + k, None] for k in range(3))
    return np.stack([f11 * a + f12 * b, f12 * a + f22 * b], axis=2)


def _on_plane(poses: F64, seen_at: F64) -> tuple[F64, BoolArray]:
    """(n, 2) where rays (n, 2) hit the planes of surfels before the camera, and (n,) whether."""
    M = np.concatenate([_tangents(poses), -np.ones((len(poses), 3, 1))], axis=2)
    M[:, :2, 2] = -seen_at
    flat = np.abs(np.linalg.det(M)) > 1e-12 * np.abs(poses[:, X + 2]) ** 2
    M[~flat] = np.eye(3)
    solved: F64 = np.asarray(np.linalg.solve(M, -poses[:, X : X + 3, None])[:, :, 0], np.float64)
    return solved[:, :2], flat & (solved[:, 2] > 0.0)


def _points(poses: F64, at: F64) -> F64:
    """(n, 3) the same positions on the planes in their current poses."""
    return poses[:, X : X + 3] + np.einsum("nij,nj->ni", _tangents(poses), at)


def _motions(
    seen: Features, corners: I64, points: F64, camera: PinholeCamera
) -> list[tuple[F64, I64]]:
    """T_camera_world of points (n, 3), each seen as some of the corners (n,), and the agreeing
    ones; the most first.  None if the image repeats itself.
    """
    generator, out = np.random.default_rng(0), list[tuple[F64, I64]]()
    seen_at = camera.normalise(seen.points_px[corners].astype(np.float64))
    gate_px, left = _GATE_SHARE * camera.width, np.arange(len(corners))
    loose = BundleParameters(kernel_sigma_px=0.5 * gate_px)
    while len(left) >= _AGREEING:
        found = pose_by_ransac(
            points[left], seen_at[left], generator, gate=gate_px / camera.fx, samples=_SAMPLES
        )
        if found is None or found[1].sum() < _AGREEING:
            break
        agree = left[found[1]]
        refined = refine_pose(
            found[0], Correspondences(points[agree], seen.points_px[corners[agree]]), camera, loose,
            inlier_px=gate_px,
        )  # fmt: skip
        T_camera_world, agree = inverse(refined.T_world_camera), agree[refined.inliers]
        left = left[~found[1]]
        if len(agree) < _AGREEING:
            break
        here = transform(T_camera_world, points[agree])
        step = _SAME_SHIFT * float(np.median(here[:, 2]))
        share = repeated_share(seen, corners[agree], here, camera, gate_px=gate_px, least_step=step)
        if share > _REPEATED:
            return []
        out.append((T_camera_world, agree))
    return out


def _moved(
    table: SurfelTable, segment: int, rows: I64, motions: list[tuple[F64, I64]],
    T_world_camera: F64 | None,
) -> FoundBack:  # fmt: skip
    """Move each surfel with the nearest agreeing corner.  rows: (n,) surfels of the corners."""
    T = inverse(motions[0][0]) if T_world_camera is None else T_world_camera
    agree = np.concatenate([rows[corners] for _, corners in motions])
    of = np.repeat(np.arange(len(motions)), [len(corners) for _, corners in motions])
    apart = table.poses[:, None, X : X + 3] - table.poses[None, agree, X : X + 3]
    motion = of[(apart**2).sum(axis=2).argmin(axis=1)]
    poses = table.poses.copy()
    for k, (T_camera_world, _) in enumerate(motions):
        poses[motion == k] = move_poses(poses[motion == k], T @ T_camera_world)
    return FoundBack(segment=segment, T_world_camera=T, poses=poses, rows=np.unique(agree))

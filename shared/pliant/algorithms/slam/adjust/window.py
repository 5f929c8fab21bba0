"""The keyframes under adjustment, and the current frame, as dense camera x landmark arrays."""

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, BoolArray
from pliant.algorithms.geometry import inverse, lengths, move_by_similarity
from pliant.algorithms.slam.calibration.self_calibration import SelfCalibration
from pliant.algorithms.slam.estimate.observation_table import (
    columns_in_state,
    count_cameras,
    count_in_view,
    flows,
    forget_outliers,
    has_parallax,
    observe,
    seen_in_state,
)
from pliant.algorithms.slam.estimate.pose_prior import NO_PRIOR, PosePrior
from pliant.algorithms.slam.estimate.problem import BundleResult, BundleWindow, shared_intrinsics
from pliant.algorithms.slam.estimate.schur import solve_schur
from pliant.algorithms.slam.estimate.subspace import solve_subspace
from pliant.algorithms.slam.estimate.triangulation import spread_of_rays, triangulate
from pliant.algorithms.slam.locate.inverse_depth import at_infinity, place
from pliant.algorithms.slam.map.keyframe import Keyframe
from pliant.algorithms.slam.map.landmarks import CANDIDATE, MAPPED, Landmarks
from pliant.algorithms.slam.parameters import MappingParameters, PointParameters

OUTSIDE = -1

_CLEAR_SHARE = 0.7
"""Share of the minimum parallax below which noise does not separate rays enough."""

_SETTLED = 0.01
"""Relative decrease of the cost at which iterations end."""


class Window:
    """Fixed keyframes, then those that move, then the current frame in the last slot.

    keyframes: (M,) list, the first ``fixed`` do not move, the first ``outside`` are older than the
    window and are its prior.
      rows: (N,) rows seen by any of them.
    columns: (capacity,) column of each row, OUTSIDE where it is not in the window.
    u, v, seen: (M + 1, N).    w: weights of the observations.    T_world_camera: (M + 1, 4, 4).
    """

    def __init__(
        self,
        keyframes: list[Keyframe],
        *,
        fixed: int,
        outside: int,
        points: Landmarks,
        calibration: SelfCalibration,
    ) -> None:
        """calibration: of the camera whose pixels the keyframes have."""
        self.keyframes = keyframes
        self.fixed = fixed
        self.outside = outside
        self.points = points
        self._calibration, self._camera = calibration, calibration.view.camera
        self.lens: F32 = self._camera.intrinsics.astype(np.float32)
        self.columns: I32 = np.full(len(points.state), OUTSIDE, np.int32)
        for keyframe in keyframes:
            self.columns[keyframe.rows] = 0
        rows = np.flatnonzero(self.columns >= 0).astype(np.int32)
        # Points created together are adjacent, so that solvers skip blocks that a camera never saw.
        self.rows: I32 = rows[np.argsort(points.first_keyframe[rows], kind="stable")]
        self.columns[self.rows] = np.arange(len(self.rows), dtype=np.int32)
        size = (len(keyframes) + 1, len(self.rows))
        self.u: F32 = np.zeros(size, np.float32)
        self.v: F32 = np.zeros(size, np.float32)
        self.w: F32 = np.zeros(size, np.float32)
        self.seen: BoolArray = np.zeros(size, np.bool_)
        self.T_world_camera: F64 = np.zeros((len(keyframes) + 1, 4, 4))
        self.T_world_camera[-1] = np.eye(4)
        for slot, keyframe in enumerate(keyframes):
            self.T_world_camera[slot] = keyframe.T_world_camera
            self._observe(slot, keyframe.rows, keyframe.points_px)

    def _observe(self, slot: int, rows: I32, points_px: F32) -> None:
        weights = self._calibration.weights(points_px)
        observe(
            rows, points_px, weights, self.columns, slot, self.u, self.v, self.w, self.seen
        )  # fmt: skip

    def observe_again(self) -> None:
        """The keyframes have other pixels than when the window was made."""
        for slot, keyframe in enumerate(self.keyframes):
            self._observe(slot, keyframe.rows, keyframe.points_px)
        self.seen[-1] = False

    def see(self, T_world_camera: F64, rows: I32, points_px: F32) -> None:
        """Put the current frame into the last slot."""
        self.seen[-1] = False
        self.T_world_camera[-1] = T_world_camera
        self._observe(len(self.keyframes), rows, points_px)

    def move(self, S: F64) -> None:
        """Move with the world: each keyframe to its pose, the frame by a similarity (4, 4)."""
        frame = move_by_similarity(S, self.T_world_camera[-1])
        # Not in place: keyframes and others may have rows of it.
        self.T_world_camera = np.array([*(k.T_world_camera for k in self.keyframes), frame])

    def sweep_current(self, parameters: MappingParameters, prior: PosePrior = NO_PRIOR) -> F64:
        """Run a few subspace Gauss-Newton sweeps (Eq. 11-12) with the current frame.

        The frame and its landmarks are free; in the paper the keyframes are free as well.
        prior: of the frame's pose.  Returns T_world_camera (4, 4) of the frame.
        """
        columns = seen_in_state(
            self.rows, self.points.state, MAPPED, self.seen, len(self.keyframes), 1
        )
        problem = self._problem(columns)
        problem.fixed_cameras[:-1] = True
        bundle = parameters.bundle.model_copy(update={"max_sweeps": parameters.window.sweeps})
        self._take(columns, solve_subspace(problem, bundle, prior=prior))
        return self.T_world_camera[-1].copy()

    def adjust(self, parameters: MappingParameters) -> None:
        """Run Schur LM over the keyframes and all landmarks of two of them, until it converges or
        for a few
        iterations: the next keyframe continues.

        Using only the longest observed landmarks is faster, but the camera's motion moves these
        least in the image: the scale then drifts ten times as far along a corridor.
        """
        columns = self.mapped_columns()
        columns = columns[count_cameras(columns, self.seen, 0, len(self.seen)) >= 2]
        bundle = parameters.bundle.model_copy(
            update={
                "max_iterations": parameters.window.keyframe_iterations,
                "min_relative_decrease": _SETTLED,
            }
        )
        problem = self._problem(columns)
        problem.fixed_cameras[:-1] |= [keyframe.is_pure_rotation for keyframe in self.keyframes]
        self._take(columns, solve_schur(problem, bundle))

    def place_candidates(self, inverse_distance: float) -> float:
        """Give the candidates provisional positions, about as far as the map.

        inverse_distance: median of the map at the last keyframe.  Returns that of this one.
        """
        mapped = self.rows[self.mapped_columns()]
        if len(mapped):
            centre = self.keyframes[-1].T_world_camera[:3, 3]
            distance = lengths(self.points.xyz.take(mapped, 0) - centre)
            inverse_distance = float(np.median(1.0 / distance))
        columns = columns_in_state(self.rows, self.points.state, CANDIDATE)
        rows = self.rows.take(columns)
        xyz, spread = place(
            self.T_world_camera, self.u, self.v, self.seen, columns, self._camera, inverse_distance
        )
        self.points.place_candidates(rows, xyz, spread)
        return inverse_distance

    def flow_since_keyframe(self, least: int) -> tuple[int, int, float]:
        """How many of the newest keyframe's points are still visible, of how many, and their median
        flow, px.

        least: state of the points.   The flow is without the rotation of the camera.
        """
        fx, fy, cx, cy = self.lens.astype(np.float64)
        K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        turn = self.T_world_camera[-1, :3, :3].T @ self.T_world_camera[-2, :3, :3]
        H = K @ turn @ np.linalg.inv(K)
        before, moved = flows(self.rows, self.points.state, least, self.u, self.v, self.seen, H)
        return len(moved), before, float(np.median(moved)) if len(moved) else 0.0

    def in_view_since_keyframe(self) -> int:
        """How many of the newest keyframe's landmarks project into the current frame."""
        newest = len(self.keyframes) - 1
        columns = seen_in_state(self.rows, self.points.state, MAPPED, self.seen, newest, 1)
        rows = self.rows.take(columns)
        T_camera_world = inverse(self.T_world_camera[-1])
        camera = self._camera
        return count_in_view(
            T_camera_world, rows, self.points.xyz, self.lens, camera.width, camera.height
        )

    def triangulate(self, limits: PointParameters) -> None:
        """Turn candidates whose rays have enough parallax into landmarks."""
        points = self.points
        if self.seen[-1].any():
            candidates = seen_in_state(
                self.rows, points.state, CANDIDATE, self.seen, len(self.keyframes),
                limits.min_observations,
            )  # fmt: skip
            # Nearly parallel rays are rejected without triangulation.
            columns = has_parallax(
                candidates, len(self.keyframes), self.T_world_camera[:, :3, :3], self.u, self.v,
                self.seen, self.lens,
                float(np.cos(_CLEAR_SHARE * np.radians(limits.min_parallax_deg))),
            )  # fmt: skip
        else:
            candidates = columns_in_state(self.rows, points.state, CANDIDATE)
            seen = count_cameras(candidates, self.seen, 0, len(self.seen))
            columns = candidates[seen >= limits.min_observations].astype(np.int64)
        xyz, errors, parallax, sigmas = triangulate(
            self.T_world_camera, self.u, self.v, self.seen, columns, self._camera
        )
        good = (parallax >= np.radians(limits.min_parallax_deg)) & (errors < limits.max_error_px)
        points.place(self.rows[columns[good]], xyz[good], parallax[good], sigmas[good])

    def current_rows(self) -> I32:
        """Rows that the current frame sees."""
        return self.rows[self.seen[-1]]

    def mapped_columns(self) -> I32:
        """Columns of the points of the map."""
        return columns_in_state(self.rows, self.points.state, MAPPED)

    def _problem(self, columns: I32) -> BundleWindow:
        fixed = np.zeros(len(self.keyframes) + 1, np.bool_)
        fixed[: self.fixed] = True
        fixed[-1] = not self.seen[-1].any()
        return BundleWindow(
            T_world_camera=self.T_world_camera,
            points_world=self.points.xyz.take(self.rows.take(columns), 0),
            columns=columns,
            u=self.u,
            v=self.v,
            weights=self.w,
            seen=self.seen,
            intrinsics=shared_intrinsics(self._camera, len(fixed)),
            fixed_cameras=fixed,
        )

    def _take(self, columns: I32, result: BundleResult) -> None:
        self.points.move_to(self.rows.take(columns), result.points_world)
        self.T_world_camera = result.T_world_camera
        for slot, keyframe in enumerate(self.keyframes):
            keyframe.T_world_camera = self.T_world_camera[slot]

    def remove_outliers(self, outlier_px: float) -> None:
        """Remove outlying observations, and landmarks with too few observations.

        A landmark at infinity becomes a candidate again, too.
        """
        columns = self.mapped_columns()
        rows = self.rows.take(columns)
        xyz = self.points.xyz.take(rows, 0)
        forget_outliers(
            self.T_world_camera[:-1], xyz, self.u, self.v, self.seen, columns,
            self._camera, outlier_px,
        )  # fmt: skip
        for slot, keyframe in enumerate(self.keyframes):
            keyframe.keep(self.seen[slot].take(self.columns.take(keyframe.rows)))
        remaining = count_cameras(columns, self.seen, 0, len(self.seen))
        remaining += self.points.base_keyframes[rows]
        far = at_infinity(xyz, self.keyframes[-1].T_world_camera[:3, 3])
        self.points.remove(rows[(remaining < 2) | far])

    def update_statistics(self) -> None:
        """Update observations, parallax and uncertainty of the window's landmarks."""
        points = self.points
        mapped = self.mapped_columns()
        columns, rows = mapped.astype(np.int64), self.rows[mapped]
        moving = count_cameras(mapped, self.seen, self.outside, len(self.keyframes))
        points.keyframes[rows] = points.base_keyframes[rows] + moving
        parallax, sigmas = spread_of_rays(
            self.T_world_camera,
            self.seen,
            columns,
            points.xyz.take(rows, 0),
            focal_px=self._camera.fx,
        )
        points.parallax_rad[rows] = np.maximum(parallax, points.base_parallax_rad[rows])
        known = np.isfinite(sigmas)
        points.sigmas[rows[known]] = sigmas[known]
        points.sigmas[rows[~known]] = np.maximum(points.sigmas[rows[~known]], 1e-3)

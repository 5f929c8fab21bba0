"""The pose of a frame from visible landmarks, and what the camera's motion predicts."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from pliant.algorithms.arrays import F64, BoolArray
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import inverse, move_by_similarity, so3_exp, so3_log
from pliant.algorithms.inertial.gyro import GyroTurn
from pliant.algorithms.slam.calibration.rolling_shutter import motion_between
from pliant.algorithms.slam.estimate.absolute_pose import pose_by_ransac, truncated_cost
from pliant.algorithms.slam.estimate.pose import Correspondences, refine_pose
from pliant.algorithms.slam.estimate.pose_prior import NO_PRIOR, PosePrior
from pliant.algorithms.slam.estimate.problem import BundleParameters
from pliant.algorithms.slam.locate.inverse_depth import refine_moving_or_standing
from pliant.algorithms.slam.parameters import LocalisationParameters

_COARSE_SIGMAS = 4.0
"""The kernel is first this many times wider, so that a poor prediction still converges."""

KERNEL_SIGMA_PX = 2.0
"""Scale of the Geman-McClure kernel of a pose."""

_PREDICTION_GATE_PX = 20.0

MIN_PREDICTED_SHARE = 0.5
"""Inlier share below which the predicted pose is compared with RANSAC."""

RANSAC_GATE_PX = 4.0
"""Maximum reprojection error of an inlier of RANSAC."""

_RANSAC_SAMPLES = 100

_START_PX = 0.3
"""Standard deviation of the last pose's rotation from which the gyro starts: landmarks in one view
err alike by about as much."""

_SPEEDING_UP = 0.5
"""Share of its last acceleration that a prediction keeps: all of it amplifies noise."""


@dataclass(frozen=True, kw_only=True)
class Localisation:
    """T_world_camera of a frame, and which of the points (N,) support it.

    is_pure_rotation: no translation is significant, see ``Spread``.
    """

    T_world_camera: F64
    inliers: BoolArray
    is_pure_rotation: bool = False


def locate(
    predictions: list[F64],
    seen: Correspondences,
    camera: PinholeCamera,
    parameters: LocalisationParameters,
    generator: np.random.Generator,
    samples: int = _RANSAC_SAMPLES,
) -> Localisation:
    """Return the pose on which most points agree, from the best prediction or by P3P and RANSAC.

    predictions: poses (4, 4) to start from, at least one.   The caller decides whether the inliers
    suffice.   samples: of RANSAC.
    """
    points_world, points_n = seen.points_world, camera.normalise(seen.points_px.astype(np.float64))
    gate = _PREDICTION_GATE_PX / camera.fx
    costs = [_cost(T_world_camera, points_world, points_n, gate) for T_world_camera in predictions]
    start = predictions[int(np.argmin(costs))]
    best = refine(start, seen, camera, parameters)
    if best.inliers.sum() < MIN_PREDICTED_SHARE * len(points_n):
        found = pose_by_ransac(
            points_world,
            points_n,
            generator,
            gate=RANSAC_GATE_PX / camera.fx,
            samples=samples,
        )
        if found is not None:
            other = refine(found[0], seen, camera, parameters)
            if other.inliers.sum() > best.inliers.sum():
                best = other
    return best


def refine(
    T_world_camera: F64,
    seen: Correspondences,
    camera: PinholeCamera,
    parameters: LocalisationParameters,
    *,
    near: bool = False,
) -> Localisation:
    """Refine a pose robustly, from a wide kernel to a narrow one; near: narrow immediately.

    A prior that the pose contradicts is left out.
    """
    located = _refine(T_world_camera, seen, camera, parameters, near=near)
    prior = seen.prior.unless_contradicted(located.T_world_camera)
    if prior is seen.prior:
        return located
    return _refine(T_world_camera, seen._replace(prior=prior), camera, parameters, near=near)


def _refine(
    T_world_camera: F64,
    seen: Correspondences,
    camera: PinholeCamera,
    parameters: LocalisationParameters,
    *,
    near: bool,
) -> Localisation:
    is_pure_rotation, limit_px = False, parameters.inlier_px
    inliers = np.zeros(len(seen.points_px), np.bool_)
    for widening in (1.0,) if near else (_COARSE_SIGMAS, 1.0):
        bundle = BundleParameters(kernel_sigma_px=widening * KERNEL_SIGMA_PX)
        if seen.spread is None:
            found = refine_pose(T_world_camera, seen, camera, bundle, inlier_px=limit_px)
        else:
            found, is_pure_rotation = refine_moving_or_standing(
                T_world_camera, seen, seen.spread.standing, camera, bundle, limit_px
            )
        T_world_camera, inliers = found.T_world_camera, found.inliers
    return Localisation(
        T_world_camera=T_world_camera, inliers=inliers, is_pure_rotation=is_pure_rotation
    )


def _cost(T_world_camera: F64, points_world: F64, points_n: F64, gate: float) -> float:
    T = inverse(T_world_camera)
    return truncated_cost(
        np.ascontiguousarray(T[:3, :3]), np.ascontiguousarray(T[:3, 3]), points_world, points_n,
        gate,
    )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Motion:
    """The last motion of the camera: T_world_camera (4, 4) of two frames, the newer one last.

    tracked: tracked landmarks and helping candidates that support the newer one, as far as known.
    to_points: tracks that lead from it to landmarks alone.
    unmapped_s: from the last mapped frame to the newer one.
    turn: the rotation of the camera since then by the gyro, for the frame to come.
    """

    frames: tuple[int, int]
    stamps_ns: tuple[int, int]
    poses: tuple[F64, F64]
    tracked: int = 0
    to_points: int = 0
    unmapped_s: float = 0.0
    turn: GyroTurn | None = None

    @staticmethod
    def at(frame: int, stamp_ns: int, T_world_camera: F64) -> "Motion":
        """Return the motion of a camera with one known pose."""
        twice = (T_world_camera, T_world_camera)
        return Motion(frames=(frame, frame), stamps_ns=(stamp_ns, stamp_ns), poses=twice)

    def then(
        self,
        frame: int,
        stamp_ns: int,
        T_world_camera: F64,
        tracked: int = 0,
        to_points: int = 0,
    ) -> "Motion":
        """Return the motion after one more pose."""
        return Motion(
            frames=(self.frames[1], frame),
            stamps_ns=(self.stamps_ns[1], stamp_ns),
            poses=(self.poses[1], T_world_camera),
            tracked=tracked,
            to_points=to_points,
        )

    def then_unmapped(
        self, frame: int, stamp_ns: int, T_world_camera: F64, tracked: int, to_points: int
    ) -> "Motion":
        """Return the motion after one more pose, of an unmapped frame."""
        after = self.then(frame, stamp_ns, T_world_camera, tracked, to_points)
        return replace(after, unmapped_s=self.unmapped_s + self.lost_s(stamp_ns))

    def moved(self, S: F64) -> "Motion":
        """Return the motion after the world has moved by a similarity (4, 4)."""
        before, last = (move_by_similarity(S, pose) for pose in self.poses)
        return replace(self, poses=(before, last))

    @cached_property
    def velocity(self) -> F64:
        """(6,) between the two frames, as of ``FramePoses.motions``."""
        frames = max(1, self.frames[1] - self.frames[0])
        return motion_between(*self.poses, self.poses[1]) / frames

    def velocity_at(self, frame: int, T_world_camera: F64) -> F64:
        """(6,) at a later frame with this pose."""
        between = self.then(frame, 0, T_world_camera).velocity
        if self.frames[0] == self.frames[1]:
            return between
        # The velocity between the frames has changed since.
        share = (frame - self.frames[1]) / (frame - self.frames[0])
        return between + _SPEEDING_UP * share * (between - self.velocity)

    def interval_s(self) -> float:
        """Seconds between the two."""
        return 1e-9 * (self.stamps_ns[1] - self.stamps_ns[0])

    def lost_s(self, stamp_ns: int) -> float:
        """Seconds since the last pose."""
        return 1e-9 * (stamp_ns - self.stamps_ns[1])

    @cached_property
    def _step(self) -> tuple[F64, F64]:
        """Rotation vector and translation (3,) from one frame to the other."""
        step = inverse(self.poses[0]) @ self.poses[1]
        return so3_log(step[:3, :3]), step[:3, 3]

    def predictions(self, stamp_ns: int) -> list[F64]:
        """Predict T_world_camera by constant velocity, and for a camera that has stopped."""
        last = self.poses[1]
        elapsed = self.stamps_ns[1] - self.stamps_ns[0]
        stopped = last if self.turn is None else _turned(last, self.turn)
        if elapsed <= 0:
            return [stopped]
        share = (stamp_ns - self.stamps_ns[1]) / elapsed
        turn, shift = self._step
        moved = np.eye(4)
        moved[:3, :3] = so3_exp(share * turn) if self.turn is None else self.turn.R
        moved[:3, 3] = share * shift
        return [last @ moved, stopped]

    def prior(self, camera: PinholeCamera) -> PosePrior:
        """The pose of the frame by the gyro; nothing without it."""
        if self.turn is None:
            return NO_PRIOR
        information = np.zeros((6, 6))
        start = (_START_PX / camera.fx) ** 2 * np.eye(3)
        information[3:, 3:] = np.linalg.inv(self.turn.covariance + start)
        return PosePrior(_turned(self.poses[1], self.turn), information)


def _turned(T_world_camera: F64, turn: GyroTurn) -> F64:
    turned = T_world_camera.copy()
    turned[:3, :3] = turned[:3, :3] @ turn.R
    return turned

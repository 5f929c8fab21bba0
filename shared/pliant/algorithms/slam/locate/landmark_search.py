"""Landmarks searched in an image, without tracks, and the pose that they verify.

A camera that is covered, blurred or dark for a moment keeps moving.  The longer that takes, the
farther it may be from any prediction, so landmarks are searched in a radius that grows with the
time since the last pose.  Of the many maxima in it a landmark takes the one whose patch fits best.
P3P and RANSAC find the pose on which the good ones agree, and all landmarks found at their
projection must verify it.
"""

from typing import NamedTuple

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, U8
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.slam.estimate.pose import Correspondences
from pliant.algorithms.slam.locate.localisation import Motion, locate, refine
from pliant.algorithms.slam.locate.reacquisition import MaximaGrid, match_widely, reacquire
from pliant.algorithms.slam.map.landmarks import Landmarks
from pliant.algorithms.slam.parameters import MappingParameters

RANSAC_SAMPLES = 500
"""Samples of P3P and RANSAC without a track."""

MAX_RADIUS_SHARE = 0.15
"""Maximum search radius, share of the image width."""

_RADIUS_SHARE = 0.01
"""Search radius immediately after a loss, share of the image width."""

_GROWTH_SHARE_PER_S = 0.3
"""Growth of the radius per second without a pose, share of the image width."""

_POINTS = 400
"""Landmarks that are searched far from their prediction."""

MIN_AGREEING = 15
"""Minimum inliers before a pose is verified."""

_MIN_SUPPORT_SHARE = 0.015
"""Minimum share of the landmarks in view that support a pose; wrong poses reach 1 %."""

MIN_AGREEMENT = 0.6
"""Minimum share of the matched landmarks that support the pose; wrong poses reach half, because
matches are near the projection."""

NEAR = 0.3
"""Share of the radius that is searched first: usually sufficient, with far fewer false matches."""


class VerifiedPose(NamedTuple):
    """A pose, and the rows of the landmarks that verify it."""

    T_world_camera: F64
    rows: I32


class LandmarkSearch(NamedTuple):
    """A search for landmarks in the image of an ideal camera.

    points: of the map.   maxima: (M, 3) of the image.   grey: (H, W).   generator: of P3P and
    RANSAC.
    """

    points: Landmarks
    maxima: F32
    grey: U8
    camera: PinholeCamera
    parameters: MappingParameters
    generator: np.random.Generator

    def recover(self, motion: Motion, stamp_ns: int, rows: I32) -> F64 | None:
        """Return T_world_camera of a frame without tracks, or None if the image does not verify a
        pose.

        motion: before.   stamp_ns: of the frame.   rows: of landmarks that may be in view.
        """
        predictions = motion.predictions(stamp_ns)
        lost_s = motion.lost_s(stamp_ns)
        radius_px = search_radius_px(lost_s, self.camera)
        for radius in (NEAR * radius_px, radius_px):
            for prediction in predictions:
                proved = self.near(prediction, rows, radius)
                if proved is not None and are_enough(len(proved.rows), self.parameters):
                    return proved.T_world_camera
        return None

    def near(self, T_world_camera: F64, rows: I32, radius_px: float) -> VerifiedPose | None:
        """Search landmarks around their projection in a pose, and return the pose that they verify.

        rows: of the landmarks.
        """
        camera, limits = self.camera, self.parameters.localisation
        grid = MaximaGrid.build(self.maxima, camera.width, camera.height, radius_px)
        found, points_px = match_widely(
            T_world_camera, rows, self.points, grid, self.grey, camera, radius_px, _POINTS,
            self.parameters.reacquisition.min_zncc,
        )  # fmt: skip
        if len(found) < MIN_AGREEING:
            return None
        seen = Correspondences(self.points.xyz.take(found, 0), points_px)
        located = locate(
            [T_world_camera], seen, camera, limits, self.generator, samples=RANSAC_SAMPLES
        )
        if located.inliers.sum() < MIN_AGREEING:
            return None
        return self.verify(located.T_world_camera, rows, MIN_AGREEMENT)

    def verify(self, T_world_camera: F64, rows: I32, min_agreement: float) -> VerifiedPose | None:
        """Refine a pose by all landmarks found at their projection; None if too few support it.

        min_agreement: minimum share of the found landmarks that support it, see
        ``MIN_AGREEMENT``.  A wrong pose finds landmarks too: wherever a maximum is near and
        its patch looks alike.
        """
        limits = self.parameters.localisation
        found = reacquire(
            T_world_camera, rows, self.points, self.maxima, self.maxima, self.grey, self.camera,
            self.parameters.reacquisition,
        )  # fmt: skip
        if len(found.rows) < limits.min_inliers:
            return None
        seen = Correspondences(self.points.xyz.take(found.rows, 0), found.points_px)
        located = refine(T_world_camera, seen, self.camera, limits, near=True)
        enough = max(
            limits.min_inliers,
            _MIN_SUPPORT_SHARE * len(found.visible),
            min_agreement * len(found.rows),
        )
        if located.inliers.sum() < enough:
            return None
        return VerifiedPose(located.T_world_camera, found.rows[located.inliers])


def search_radius_px(lost_s: float, camera: PinholeCamera) -> float:
    """Search radius around a prediction, px, this long after the last pose."""
    return camera.width * min(_RADIUS_SHARE + _GROWTH_SHARE_PER_S * lost_s, MAX_RADIUS_SHARE)


def are_enough(points: int, parameters: MappingParameters) -> bool:
    """Whether this many verified landmarks, or corners, place a camera without tracks.

    A few dozen also agree on a pose a step aside, if the scene repeats there.  No map starts with
    so few, and none continues by them.
    """
    return points >= parameters.start.min_points

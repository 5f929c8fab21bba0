"""Frames between keyframes are placed a second time, in the map as it has become.

A frame is first placed in the map of its time: young landmarks are uncertain, and after a return
hardly any is in view.  Every adjustment corrects keyframes; a frame between them moves with its
reference keyframe and would keep its error relative to it.  So the observations of frames are
stored as long as there is memory, and then place them by the adjusted landmarks.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32
from pliant.algorithms.geometry import inverse
from pliant.algorithms.slam.calibration.changing_focal import RATE
from pliant.algorithms.slam.calibration.corrected_view import CorrectedView, moved_px
from pliant.algorithms.slam.calibration.rolling_shutter import FramePoses
from pliant.algorithms.slam.calibration.self_calibration import SelfCalibration
from pliant.algorithms.slam.estimate.focal_pose import refine_focal, thinning
from pliant.algorithms.slam.estimate.pose import Correspondences, refine_pose
from pliant.algorithms.slam.estimate.trajectory_smoothing import smooth_trajectory
from pliant.algorithms.slam.locate.localisation import MIN_PREDICTED_SHARE
from pliant.algorithms.slam.map.keyframe import Keyframe
from pliant.algorithms.slam.map.landmarks import MAPPED, MAPPED_SHARE, Landmarks
from pliant.algorithms.slam.parameters import MappingParameters

_ROOM = 2_000_000
"""Maximum stored observations, 24 MB: some 250 frames of 8000."""

_ROOM_SHARE = 1 / 3
"""And as a share of the map's maximum."""

STANDING_ROOMS = 2
"""Multiple of that memory if no keyframe comes, as while a camera stands still."""

_COMMON_ERROR = 0.5
"""Maximum common error of a frame's landmarks, as a share of the inlier limit: with more, half of
them would be outliers.  Real video shows 0.10 to 0.15.
"""

_NONE = np.iinfo(np.int64).max


@dataclass(frozen=True, kw_only=True)
class EarlierPose:
    """T_world_camera of a frame, and its reference keyframe.

    inliers: landmarks that support it.
    """

    frame: int
    keyframe: Keyframe
    T_world_camera: F64
    inliers: int


@dataclass(frozen=True, kw_only=True)
class RefinedPose(EarlierPose):
    """information: (6, 6) of the pose, as of a ``PoseEstimate``."""

    information: F64


@dataclass(frozen=True, kw_only=True)
class OrdinaryFrame:
    """A frame with its reference keyframe, its first pose (4, 4), and its observations: rows (n,)
    of landmarks and candidates, at points_px (n, 2).   log_focal: as of a keyframe.
    """

    frame: int
    keyframe: Keyframe
    T_keyframe_camera: F64
    rows: I32
    points_px: F32
    log_focal: float = 0.0


@dataclass
class OrdinaryFrames:
    """Frames of a segment that are no keyframes and are to be placed again, oldest first."""

    _frames: list[OrdinaryFrame] = field(default_factory=list[OrdinaryFrame])
    _size: int = 0  # observations of all of them

    def add(
        self, frame: int, keyframe: Keyframe, T_world_camera: F64, rows: I32, points_px: F32,
        log_focal: float = 0.0,
    ) -> None:  # fmt: skip
        """Add a frame with its reference keyframe and observations in the rows (n,)."""
        self._size += len(rows)
        T_keyframe_camera = inverse(keyframe.T_world_camera) @ T_world_camera
        self._frames.append(
            OrdinaryFrame(
                frame=frame, keyframe=keyframe, T_keyframe_camera=T_keyframe_camera, rows=rows,
                points_px=points_px, log_focal=log_focal,
            )
        )  # fmt: skip

    def forget(self, frames: set[int] | None = None) -> None:
        """Leave these frames, or all, where they are: their observations are no longer valid."""
        kept = [] if frames is None else [f for f in self._frames if f.frame not in frames]
        self._keep(kept)

    def seen_by(self, before: CorrectedView, after: CorrectedView) -> None:
        """Convert the pixels to those of another ideal camera."""
        self._frames = [
            replace(each, points_px=moved_px(each.points_px, before, after))
            for each in self._frames
        ]

    def focus(self, view: CorrectedView, keyframes: list[Keyframe], refocus: F64) -> None:
        """Change the log focal lengths as between the keyframes.

        view: whose pixels they have.   refocus: (K,) change of each keyframe.
        """
        numbers = [keyframe.frame for keyframe in keyframes]
        for n, each in enumerate(self._frames):
            change = float(np.interp(each.frame, numbers, refocus))
            if change:
                factors = np.full(len(each.rows), change)
                points_px = moved_px(each.points_px, view, view, factors)
                log_focal = each.log_focal + change
                self._frames[n] = replace(each, points_px=points_px, log_focal=log_focal)

    def take_in(self, earlier: "OrdinaryFrames") -> None:
        """Add the frames of a merged segment."""
        self._keep([*earlier._frames, *self._frames])

    @property
    def first_keyframe(self) -> int:
        """Id of the oldest reference keyframe; a huge one without frames."""
        return min((each.keyframe.id for each in self._frames), default=_NONE)

    def take_surplus(self, parameters: MappingParameters, rooms: int = 1) -> list[OrdinaryFrame]:
        """Remove and return the oldest frames beyond this multiple of the memory."""
        room = rooms * min(_ROOM, int(_ROOM_SHARE * parameters.window.kept_observations))
        count, size = 0, self._size
        while size > room:
            size -= len(self._frames[count].rows)
            count += 1
        return self._take(count)

    def leave(self, keyframes: set[int]) -> None:
        """Leave the frames of these reference keyframes, by id, where they are."""
        self._keep([each for each in self._frames if each.keyframe.id not in keyframes])

    def take_all(self) -> list[OrdinaryFrame]:
        """Remove and return all frames."""
        return self._take(len(self._frames))

    def _take(self, count: int) -> list[OrdinaryFrame]:
        taken = self._frames[:count]
        if taken:
            self._keep(self._frames[count:])
        return taken

    def _keep(self, frames: list[OrdinaryFrame]) -> None:
        self._frames, self._size = frames, sum(len(each.rows) for each in frames)


def refined_poses(
    frames: Iterable[OrdinaryFrame],
    points: Landmarks,
    seen_by: SelfCalibration,
    parameters: MappingParameters,
) -> list[RefinedPose]:
    """Return poses of the frames with enough observations of the current map.

    seen_by: whose pixels the frames have.
    """
    limits, camera = parameters.localisation, seen_by.view.camera
    placed: list[RefinedPose] = []
    for each in frames:
        keyframe = each.keyframe
        # A reused row begins with a later keyframe.
        still = points.first_keyframe[each.rows] <= keyframe.id
        still &= points.segment[each.rows] == keyframe.segment
        still &= points.state[each.rows] == MAPPED
        if still.sum() < max(limits.min_inliers, MAPPED_SHARE * len(still)):
            continue
        points_px = each.points_px.compress(still, 0)
        xyz = points.xyz.take(each.rows.compress(still), 0)
        start = keyframe.T_world_camera @ each.T_keyframe_camera
        if seen_by.changes:
            centre = seen_by.given.cx, seen_by.given.cy
            every = thinning(len(xyz))
            some = slice(None, None, every)
            change, _ = refine_focal(start, xyz[some], points_px[some], camera, centre, RATE, every)
            factors = np.full(len(points_px), change)
            points_px = moved_px(points_px, seen_by.view, seen_by.view, factors)
        seen = Correspondences(xyz, points_px, seen_by.weights(points_px))
        found = refine_pose(start, seen, camera, parameters.bundle, inlier_px=limits.inlier_px)
        inliers = int(np.count_nonzero(found.inliers))
        if inliers >= max(limits.min_inliers, MIN_PREDICTED_SHARE * len(xyz)):
            placed.append(
                RefinedPose(
                    frame=each.frame, keyframe=keyframe, T_world_camera=found.T_world_camera,
                    inliers=inliers, information=found.information,
                )
            )  # fmt: skip
    return placed


def smoothed_poses(
    keyframes: list[Keyframe],
    path: FramePoses,
    stamps_ns: dict[int, int],
    points: Landmarks,
    seen_by: SelfCalibration,
    parameters: MappingParameters,
) -> list[EarlierPose]:
    """Return the poses of all frames of a segment, smoothed by the motion model
    (``smooth_trajectory``).

    The map is unchanged: a keyframe's frame may differ from its keyframe within the uncertainty of
    the observations.   path: final poses of all other frames.
    stamps_ns: of the frames.   seen_by: whose pixels the keyframes have.
    """
    for keyframe in keyframes:
        if not path.has(keyframe.frame, keyframe):
            continue
        here = points.state[keyframe.rows] == MAPPED
        points_px = keyframe.points_px.compress(here, 0)
        weights = seen_by.weights(points_px)
        found = refine_pose(
            keyframe.T_world_camera,
            Correspondences(points.xyz.take(keyframe.rows[here], 0), points_px, weights),
            seen_by.view.camera, parameters.bundle, inlier_px=parameters.localisation.inlier_px,
            iterations=1,
        )  # fmt: skip
        inliers = int(np.count_nonzero(found.inliers))
        if inliers < parameters.localisation.min_inliers:
            continue  # located by candidates, which never had the parallax for a landmark
        path.refine(keyframe.frame, keyframe, keyframe.T_world_camera, inliers, found.information)
    frames, T_world_camera, information = path.frames_on(keyframes)
    if not frames:
        return []
    times_ns = np.array([stamps_ns[each.frame] for each in frames])
    supported = float(np.median([each.inliers for each in frames]))
    most_noise_px = _COMMON_ERROR * parameters.localisation.inlier_px * np.sqrt(max(supported, 1.0))
    smoothed = smooth_trajectory(T_world_camera, information, times_ns, most_noise_px)
    return [
        EarlierPose(
            frame=each.frame, keyframe=each.keyframe, T_world_camera=pose, inliers=each.inliers
        )
        for each, pose in zip(frames, smoothed, strict=True)
    ]

"""The poses of all frames: as they become known, placed again later, and smoothed at the end."""

from dataclasses import dataclass, field

from pliant.algorithms.arrays import F64
from pliant.algorithms.inertial.gyro import Gyro
from pliant.algorithms.slam.adjust.carried_frames import carried_poses
from pliant.algorithms.slam.adjust.ordinary_frames import (
    OrdinaryFrame,
    refined_poses,
    smoothed_poses,
)
from pliant.algorithms.slam.adjust.segment import Segment
from pliant.algorithms.slam.atlas.atlas import Atlas
from pliant.algorithms.slam.calibration.self_calibration import SelfCalibration
from pliant.algorithms.slam.frame import Frame
from pliant.algorithms.slam.journal import Journal
from pliant.algorithms.slam.map.keyframe import Keyframe
from pliant.algorithms.slam.parameters import MappingParameters


@dataclass
class PoseHistory:
    """Gives every pose to the journal, which publishes it, and to the segment of its keyframe.

    stamps_ns: capture time of each frame.   lost: frames without a pose, in their order.
    """

    atlas: Atlas
    journal: Journal
    parameters: MappingParameters
    stamps_ns: dict[int, int] = field(default_factory=dict[int, int])
    lost: dict[int, None] = field(default_factory=dict[int, None])

    def expect(self, frame: Frame) -> None:
        """Note the capture time of a frame that may get a pose."""
        self.stamps_ns[frame.number] = frame.stamp_ns

    def lose(self, frame: int) -> None:
        """Note that a frame has no pose, at least for now."""
        self.lost[frame] = None

    def add(self, frame: int, keyframe: Keyframe, T_world_camera: F64, inliers: int) -> None:
        """Add the pose of a frame in the active segment.   keyframe: its reference keyframe."""
        self.lost.pop(frame, None)
        self.journal.add_pose(frame, keyframe, T_world_camera, inliers)
        self.atlas.add_pose(frame, keyframe, T_world_camera, inliers)

    def refine(
        self, segment: Segment, frames: list[OrdinaryFrame], seen_by: SelfCalibration
    ) -> None:
        """Place frames again in the current map.   seen_by: the calibration of their pixels."""
        for each in refined_poses(frames, segment.points, seen_by, self.parameters):
            pose = each.frame, each.keyframe, each.T_world_camera, each.inliers
            self.journal.add_pose(*pose)
            segment.path.refine(*pose, each.information)

    def smooth(self, segment: Segment, seen_by: SelfCalibration, gyro: Gyro | None) -> None:
        """Smooth the poses of a segment that is final; the gyro carries them over lost frames."""
        smoothed = smoothed_poses(
            segment.keyframes, segment.path, self.stamps_ns, segment.points, seen_by,
            self.parameters,
        )  # fmt: skip
        if gyro is not None:
            smoothed += carried_poses(smoothed, self.stamps_ns, list(self.lost), gyro)
        for each in smoothed:
            self.journal.add_pose(each.frame, each.keyframe, each.T_world_camera, each.inliers)

"""Frames that wait for a pose: a map may start from them, or they are placed once one resumes."""

from dataclasses import dataclass, field

from pliant.algorithms.arrays import F64
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.slam.active.active_map import ActiveMap
from pliant.algorithms.slam.atlas.atlas import Atlas
from pliant.algorithms.slam.atlas.pose_history import PoseHistory
from pliant.algorithms.slam.calibration.corrected_view import CorrectedView
from pliant.algorithms.slam.frame import IdealFrame
from pliant.algorithms.slam.locate.localisation import Motion
from pliant.algorithms.slam.map.keyframe import Keyframe
from pliant.algorithms.slam.map.landmarks import MAPPED
from pliant.algorithms.slam.parameters import MappingParameters
from pliant.algorithms.slam.start.focal_hypotheses import find_start_of
from pliant.algorithms.slam.start.initialisation_buffer import (
    InitialisationBuffer,
    earlier_poses,
    motion_of_start,
    returned_poses,
)
from pliant.algorithms.slam.start.start import with_minimum_parallax


@dataclass
class WaitingFrames:
    """The frames since the last pose."""

    atlas: Atlas
    poses: PoseHistory
    parameters: MappingParameters
    buffer: InitialisationBuffer = field(default_factory=InitialisationBuffer)

    @property
    def numbers(self) -> list[int]:
        """Numbers of the frames from which a map may still start."""
        return [waiting.frame for waiting in self.buffer.frames]

    def add(self, frame: IdealFrame) -> None:
        """Add a frame without a pose."""
        self.buffer = self.buffer.then(frame, self.parameters)

    def see_by(self, before: CorrectedView, after: CorrectedView) -> None:
        """Convert the pixels to those of another ideal camera."""
        self.buffer = self.buffer.seen_by(before, after)

    def take(self) -> InitialisationBuffer:
        """Remove and return all frames."""
        taken, self.buffer = self.buffer, InitialisationBuffer()
        return taken

    def start_map(self, *, at_last: bool = False) -> Motion | str:
        """Start a map, and give poses to the frames, backwards.

        at_last: with the least parallax, at the end of the stream.   Returns the motion at the
        newest frame, or the reason why no map can start.
        """
        parameters = with_minimum_parallax(self.parameters) if at_last else self.parameters
        found = find_start_of(self.buffer.frames, self.atlas.calibration, parameters)
        if isinstance(found, str):
            return found
        start, calibration = found
        waiting = self.take()
        assert waiting.newest is not None
        latest = IdealFrame.of(waiting.newest, self.atlas.calibration)
        active = self.atlas.begin(start, calibration, waiting.frames, latest)
        limits = self.parameters.localisation
        placed = list(earlier_poses(start, active.keyframes, waiting, self._camera, limits))
        for each in placed:
            self.poses.add(each.frame, each.keyframe, each.T_world_camera, each.inliers)
        return motion_of_start(placed, waiting)

    def place(self, active: ActiveMap, keyframe: Keyframe, T_world_camera: F64) -> None:
        """Place the frames between a loss and a pose (4, 4), and remove them.

        A frame gets a pose if its tracks lead to landmarks in the current view.
        """
        waiting = self.take()
        if not waiting.frames:
            return
        linked = active.linked(MAPPED)
        placed = returned_poses(
            T_world_camera, active.links.ids[linked],
            active.points.xyz[active.links.rows[linked]], waiting, keyframe, self._camera,
            self.parameters.localisation,
        )  # fmt: skip
        for each in placed:
            self.poses.add(each.frame, keyframe, each.T_world_camera, each.inliers)

    @property
    def _camera(self) -> PinholeCamera:
        """The ideal camera of the map."""
        return self.atlas.calibration.view.camera

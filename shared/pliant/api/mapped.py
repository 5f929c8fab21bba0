"""A map as arrays, wherever it comes from."""

from abc import ABC, abstractmethod

from pliant.algorithms.arrays import U8
from pliant.api.open3d_types import PointArray
from pliant.map_history import MapHistory, Points
from pliant.trajectory import Trajectory


class Mapped(ABC):
    """A trajectory and a point cloud in one world frame, whose scale is arbitrary.

    A map that was lost and started again has several segments, each with its own world frame.
    The properties below are those of the longest segment.
    """

    @property
    @abstractmethod
    def history(self) -> MapHistory:
        """Frames, keyframes and points of all segments."""

    @property
    def trajectory(self) -> Trajectory:
        """Final poses T_world_camera, after all corrections, of the frames that have one."""
        return self.history.trajectory_in(self.history.longest_segment(), self.history.placed())

    @property
    def online_trajectory(self) -> Trajectory:
        """Online poses T_world_camera: each as it was when its frame had been processed."""
        return self.history.trajectory_in(self.history.longest_segment(), self.history.online)

    @property
    def points(self) -> PointArray:
        """(P, 3) points in the world frame."""
        points = self._points
        return PointArray.of(points.positions, points.colours)

    @property
    def colours(self) -> U8:
        """(P, 3) RGB of the points."""
        return self._points.colours

    @property
    def _points(self) -> Points:
        return self.history.points_in(self.history.longest_segment())

"""A map as arrays, wherever it comes from."""

from abc import ABC, abstractmethod

from pliant.algorithms.arrays import U8
from pliant.api.open3d_types import PointArray
from pliant.map_history import MapHistory, Points
from pliant.trajectory import Trajectory


class Mapped(ABC):
    """A trajectory and a cloud of points in one world, whose scale is arbitrary.

    Where a map was lost and began anew it has several segments, each a world of its own: what
    follows is of the longest.
    """

    @property
    @abstractmethod
    def history(self) -> MapHistory:
        """All that is known of frames, keyframes and points, of every segment."""

    @property
    def trajectory(self) -> Trajectory:
        """Poses after all corrections, one for each frame that has one."""
        return self.history.trajectory_in(self.history.longest_segment(), self.history.placed())

    @property
    def online_trajectory(self) -> Trajectory:
        """Each pose as it was known when its frame was done."""
        return self.history.trajectory_in(self.history.longest_segment(), self.history.online)

    @property
    def points(self) -> PointArray:
        """(P, 3) points in the world."""
        points = self._points
        return PointArray.of(points.positions, points.colours)

    @property
    def colours(self) -> U8:
        """(P, 3) RGB of the points."""
        return self._points.colours

    @property
    def _points(self) -> Points:
        return self.history.points_in(self.history.longest_segment())

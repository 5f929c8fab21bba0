"""Frames of a map segment as if all rows of each had been exposed at once."""

from functools import lru_cache

import numpy as np

from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import pose_to_matrix
from pliant.algorithms.slam.calibration.corrected_view import corrected_view
from pliant.algorithms.slam.calibration.rolling_shutter import RolledFrame, motion_between
from pliant.results.run import Run


class StillFrames:
    """view: the corrected one.    poses: T_world_camera (4, 4) of each frame that has one."""

    def __init__(self, run: Run, camera: PinholeCamera, segment: int) -> None:
        """camera: of the rectified images of a run."""
        correction = run.correction_of(segment)
        poses = {**run.history.final(), **run.history.keyframe_poses()}
        self.view = corrected_view(camera, correction)
        self.poses = {f: pose_to_matrix(p) for f, (s, p) in poses.items() if s == segment}
        self._readout = correction[3] if len(correction) > 3 else 0.0
        self._positions = run.history.points_in(segment).positions
        self.rolled = lru_cache(maxsize=1)(self._rolled)

    def _rolled(self, frame: int) -> RolledFrame | None:
        """The effect of a rolling shutter on a frame; None without any, or without a pose.

        By the motion between the frames around it, at the median depth of what it sees.
        """
        near = [f for f in (frame - 1, frame, frame + 1) if f in self.poses]
        if not self._readout or frame not in self.poses or len(near) < 2:
            return None
        T, camera = self.poses[frame], self.view.camera
        first, last = self.poses[near[0]], self.poses[near[-1]]
        motion = motion_between(first, last, T) / (near[-1] - near[0])
        local = (self._positions - T[:3, 3]) @ T[:3, :3]
        local = local[local[:, 2] > 0.0]
        pixels, size = camera.project(local), (camera.width - 0.5, camera.height - 0.5)
        depths = local[np.all((pixels > -0.5) & (pixels < size), axis=1), 2]
        inverse_depth = float(1.0 / np.median(depths)) if len(depths) else 0.0
        return RolledFrame(self.view, self._readout, motion, inverse_depth)

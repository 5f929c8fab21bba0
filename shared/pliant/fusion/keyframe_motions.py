"""How the camera moves at keyframes, by the poses of the frames beside them.

The rows of a rolling shutter's image are exposed one after the other, and a hand-held camera moves
by pixels meanwhile: more than dense depth may be off.
"""

from collections.abc import Mapping

import numpy as np

from pliant.algorithms.arrays import F64
from pliant.algorithms.geometry import pose_to_matrix
from pliant.algorithms.map_delta import MapDelta
from pliant.algorithms.slam.calibration.rolling_shutter import motion_between
from pliant.map_history import MIN_INLIERS, Keyframe


class KeyframeMotions:
    """Holds poses of frames: those beside keyframes, and of others the last two, which may be."""

    def __init__(self) -> None:
        self._poses: dict[int, tuple[int, F64]] = {}
        self._last: dict[int, tuple[int, F64]] = {}
        self._keyframes: set[int] = set()

    def take(self, update: MapDelta) -> None:
        """Take the poses of an update."""
        if len(update.moved_keyframes):
            held = [*self._poses.values(), *self._last.values()]
            keyframes = np.array([keyframe for keyframe, _ in held], np.int64)
            matrices = update.map_moves().matrices(keyframes)
            for (_, pose), scale in zip(held, _scales(matrices), strict=True):
                pose[:3] *= scale
        self._keyframes.update(update.keyframe_frames.tolist())
        others = self._last
        for row in np.flatnonzero(update.pose_inliers >= MIN_INLIERS).tolist():
            relative = update.poses_keyframe_camera[row].copy()
            others[int(update.pose_frames[row])] = int(update.pose_keyframes[row]), relative
        newest, self._last = max(others, default=0), {}
        for frame, pose in others.items():
            if not self._keyframes.isdisjoint((frame - 1, frame + 1)):
                self._poses[frame] = pose
            elif frame >= newest - 1:
                self._last[frame] = pose

    def motion(self, keyframe: int, keyframes: Mapping[int, Keyframe]) -> F64 | None:
        """(6,) of a keyframe per frame interval, as of ``FramePoses.motions``; None: unknown.

        keyframes: of the map, by their ids.
        """
        own = keyframes[keyframe]
        if own.frame < 0:  # of an earlier session
            return None
        T = pose_to_matrix(own.pose_world_camera)
        known = {own.frame: T}
        for frame in (own.frame - 1, own.frame + 1):
            number, pose = self._poses.get(frame, (-1, None))
            beside = keyframes.get(number)
            if pose is not None and beside is not None and beside.segment == own.segment:
                known[frame] = pose_to_matrix(beside.pose_world_camera) @ pose_to_matrix(pose)
        if len(known) < 2:
            return None
        first, last = min(known), max(known)
        return motion_between(known[first], known[last], T) / (last - first)


def _scales(matrices: F64) -> F64:
    """(N,) scales of (N, 4, 4) similarities."""
    return np.asarray(np.cbrt(np.linalg.det(matrices[:, :3, :3])), np.float64)

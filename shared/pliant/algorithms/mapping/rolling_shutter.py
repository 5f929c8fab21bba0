"""How a rolling shutter moves observations: the rows of a frame are taken one after the other.

The pose of a frame is that of its middle row.  With the readout as a share of the frame interval,
row v is taken ``readout (v - middle) / height`` frame intervals later, when the camera has moved on
by as much of its motion.  A map that is built without regard to this bends and drifts in scale, at
residuals that hardly grow.
"""

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import inverse, so3_log
from pliant.algorithms.map_delta import MapMoves
from pliant.algorithms.mapping.map_store import Keyframe
from pliant.compiler.kernel import kernel

_SPAN = 2
"""Frames before and after a keyframe over which its motion is measured: poses have noise."""

_MIN_DEPTH = 1e-6


class Path:
    """Poses of the frames of a segment, each relative to its keyframe, which may still move."""

    def __init__(self) -> None:
        self._poses: dict[int, tuple[int, F64]] = {}

    def add(self, frame: int, keyframe: Keyframe, T_world_camera: F64) -> None:
        """A frame whose pose hangs on a keyframe."""
        self._poses[frame] = (keyframe.id, inverse(keyframe.T_world_camera) @ T_world_camera)

    def scale(self, moves: MapMoves) -> None:
        """The whole map moves: distances to a keyframe scale with it."""
        hanging = np.array([keyframe for keyframe, _ in self._poses.values()], np.int64)
        scales = np.cbrt(np.linalg.det(moves.matrices(hanging)[:, :3, :3]))
        for frame, scale in zip(self._poses, scales, strict=True):
            self._poses[frame][1][:3, 3] *= scale

    def forget(self) -> None:
        """Nobody will ask any more."""
        self._poses = {}

    def motions(self, keyframes: list[Keyframe]) -> F64:
        """(M, 6) (omega, nu) of each keyframe: in its camera, points X become
        ``exp(t omega) X + t nu`` after t frame intervals.  0 where no frame is near.
        """
        T_world_keyframe = {keyframe.id: keyframe.T_world_camera for keyframe in keyframes}
        motions = np.zeros((len(keyframes), 6))
        for row, keyframe in enumerate(keyframes):
            near = range(keyframe.frame - _SPAN, keyframe.frame + _SPAN + 1)
            known = [f for f in near if self._poses.get(f, (-1,))[0] in T_world_keyframe]
            if len(known) < 2:
                continue
            first, last = (
                inverse(T_world_keyframe[hanging] @ T_keyframe_camera) @ keyframe.T_world_camera
                for hanging, T_keyframe_camera in (self._poses[known[0]], self._poses[known[-1]])
            )
            turn = so3_log(last[:3, :3] @ first[:3, :3].T)
            both = np.concatenate([turn, last[:3, 3] - first[:3, 3]])
            motions[row] = both / (known[-1] - known[0])
        return motions


def readout_flow(
    T_world_camera: F64,
    motions: F64,
    points_world: F64,
    camera_index: I32,
    point_index: I32,
    points_px: F32,
    camera: PinholeCamera,
) -> F32:
    """(O, 2) px by which a readout of one frame interval moves each observation.

    T_world_camera: (M, 4, 4) and motions (M, 6) of the cameras.   points_world: (N, 3).
    camera_index, point_index, points_px: as in ``BundleProblem``.   0 behind the camera.
    """
    flow = np.zeros((len(points_px), 2), np.float32)
    T_camera_world = np.ascontiguousarray(inverse(T_world_camera)[:, :3])
    K = np.array([camera.fx, camera.fy, camera.height])
    _flow(T_camera_world, motions, points_world, camera_index, point_index, points_px, K, flow)
    return flow


@kernel
def _flow(
    T_camera_world: F64,
    motions: F64,
    points_world: F64,
    camera: I32,
    point: I32,
    points_px: F32,
    K: F64,
    flow: F32,
) -> None:
    middle = 0.5 * (K[2] - 1.0)
    for o in range(camera.size):
        T, motion, X = T_camera_world[camera[o]], motions[camera[o]], points_world[point[o]]
        z = T[2, 0] * X[0] + T[2, 1] * X[1] + T[2, 2] * X[2] + T[2, 3]
        if z < _MIN_DEPTH:
            continue
        x = (T[0, 0] * X[0] + T[0, 1] * X[1] + T[0, 2] * X[2] + T[0, 3]) / z
        y = (T[1, 0] * X[0] + T[1, 1] * X[1] + T[1, 2] * X[2] + T[1, 3]) / z
        # The velocity of the point over its depth.
        a = motion[1] - motion[2] * y + motion[3] / z
        b = motion[2] * x - motion[0] + motion[4] / z
        c = motion[0] * y - motion[1] * x + motion[5] / z
        share = (points_px[o, 1] - middle) / K[2]
        flow[o, 0] = share * K[0] * (a - x * c)
        flow[o, 1] = share * K[1] * (b - y * c)

"""How a rolling shutter moves observations: the rows of a frame are exposed one after the other.

The pose of a frame is that of its middle row.  With the readout as a share of the frame interval,
row v is exposed ``readout (v - middle) / height`` frame intervals later, when the camera has moved
by this share of its motion.  A map that ignores this bends and drifts in scale, while the residuals
hardly grow.  Rows lie along the longer side of a sensor: an upright image is rotated and read out
across, so u and the width replace v and the height.

Once the readout is known, everything is mapped as with a global shutter: an observation at p was at
q when the middle row was exposed, with

    p = q + readout (v_p - middle) / height flow(q),

where the flow follows from the camera's motion and the depth at q: that of its landmark, or a
common one.  Keyframes store p - q, so that a better readout, motion or depth can replace it.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, U8, BoolArray
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import inverse, so3_log
from pliant.algorithms.image.moved_image import Move, moved_image
from pliant.algorithms.map_delta import MapMoves
from pliant.algorithms.slam.calibration.corrected_view import CorrectedView, shows
from pliant.algorithms.slam.map.keyframe import Keyframe
from pliant.compiler.kernel import fast_kernel, kernel

_SPAN = 1
"""Frames before and after a keyframe over which its motion is measured: a hand-held camera shakes
faster than more of them would show.
"""

_MIN_DEPTH = 1e-6

_STEPS = 2
"""Iterations of the fixed point: a shift of a hundredth of the image changes itself by a
hundredth.
"""

_GRID_PX = 16
"""Grid over which the offsets of an image are interpolated: they are nearly quadratic."""


def _read_out_along(camera: PinholeCamera) -> tuple[int, float]:
    """The axis of the image along which rows are read out, 0 across and 1 down, and its px."""
    upright = camera.height > camera.width
    return (0, float(camera.width)) if upright else (1, float(camera.height))


class FrameOnKeyframe(NamedTuple):
    """A frame with its pose relative to a keyframe.   inliers: landmarks that support it."""

    frame: int
    keyframe: Keyframe
    inliers: int


class FramePoses:
    """Poses of a segment's frames, each relative to its reference keyframe, which may still
    move.
    """

    def __init__(self, known: dict[int, F64] | None = None) -> None:
        """known: motions (6,) of keyframes by their ids whose frames are not stored."""
        self._poses: dict[int, tuple[int, F64]] = {}
        self._inliers: dict[int, int] = {}
        self._information: dict[int, F64] = {}
        self._known = known or {}

    def add(self, frame: int, keyframe: Keyframe, T_world_camera: F64, inliers: int = 0) -> None:
        """Add a frame's pose with its reference keyframe.   inliers: landmarks that support it."""
        self._poses[frame] = (keyframe.id, inverse(keyframe.T_world_camera) @ T_world_camera)
        self._inliers[frame] = inliers

    def has(self, frame: int, keyframe: Keyframe) -> bool:
        """Whether the frame has this reference keyframe.  Keyframes of a loaded map have none."""
        return self._poses.get(frame, (-1,))[0] == keyframe.id

    def refine(
        self, frame: int, keyframe: Keyframe, T_world_camera: F64, inliers: int, information: F64
    ) -> None:
        """Replace the pose of a frame with this reference keyframe.   information: (6, 6) of the
        pose, as of a ``PoseEstimate``.
        """
        if self.has(frame, keyframe):
            self.add(frame, keyframe, T_world_camera, inliers)
            self._information[frame] = information

    def frames_on(self, keyframes: list[Keyframe]) -> tuple[list[FrameOnKeyframe], F64, F64]:
        """Return all frames of these reference keyframes, by number, with T_world_camera (N, 4, 4)
        and its information (N, 6, 6), NaN where unknown.
        """
        hosts = {keyframe.id: keyframe for keyframe in keyframes}
        hanging = [(frame, of) for frame, (of, _) in sorted(self._poses.items()) if of in hosts]
        T_world_host = np.array([hosts[of].T_world_camera for _, of in hanging])
        T_host_camera = np.array([self._poses[frame][1] for frame, _ in hanging])
        unknown = np.full((6, 6), np.nan)
        return (
            [FrameOnKeyframe(frame, hosts[of], self._inliers[frame]) for frame, of in hanging],
            T_world_host.reshape(-1, 4, 4) @ T_host_camera.reshape(-1, 4, 4),
            np.array([self._information.get(frame, unknown) for frame, _ in hanging]),
        )

    def take_in(self, other: "FramePoses") -> None:
        """Add the frames of a merged segment."""
        self._poses |= other._poses
        self._inliers |= other._inliers
        self._information |= other._information
        self._known |= other._known

    def scale(self, moves: MapMoves) -> None:
        """Scale the distances to a keyframe when the whole map moves."""
        hanging = np.array([keyframe for keyframe, _ in self._poses.values()], np.int64)
        scales = np.cbrt(np.linalg.det(moves.matrices(hanging)[:, :3, :3]))
        for frame, scale in zip(self._poses, scales, strict=True):
            self._poses[frame][1][:3, 3] *= scale
            if frame in self._information:
                unit = np.repeat([1.0 / scale, 1.0], 3)
                self._information[frame] = self._information[frame] * np.outer(unit, unit)
        known = np.array(list(self._known), np.int64)
        scales = np.cbrt(np.linalg.det(moves.matrices(known)[:, :3, :3]))
        for keyframe, scale in zip(self._known, scales, strict=True):
            self._known[keyframe] = self._known[keyframe] * np.repeat([1.0, scale], 3)

    def motions(self, keyframes: list[Keyframe]) -> F64:
        """(M, 6) (omega, nu) of each keyframe: in its camera, points X become
        ``exp(t omega) X + t nu`` after t frame intervals.  0 where no frame is near.
        """
        T_world_keyframe = {keyframe.id: keyframe.T_world_camera for keyframe in keyframes}
        motions = np.zeros((len(keyframes), 6))
        rows: list[int] = []
        frames: list[int] = []
        between: list[tuple[F64, F64, F64]] = []
        for row, keyframe in enumerate(keyframes):
            if keyframe.id in self._known:
                motions[row] = self._known[keyframe.id]
                continue
            near = range(keyframe.frame - _SPAN, keyframe.frame + _SPAN + 1)
            known = [f for f in near if self._poses.get(f, (-1,))[0] in T_world_keyframe]
            if len(known) < 2:
                continue
            first, last = (
                T_world_keyframe[hanging] @ T_keyframe_camera
                for hanging, T_keyframe_camera in (self._poses[known[0]], self._poses[known[-1]])
            )
            rows.append(row)
            frames.append(known[-1] - known[0])
            between.append((first, last, keyframe.T_world_camera))
        if rows:
            first, last, own = np.array(between).swapaxes(0, 1)
            motions[rows] = motion_between(first, last, own) / np.array(frames)[:, None]
        return motions


def motion_between(first: F64, last: F64, T_world_camera: F64) -> F64:
    """(..., 6) as of ``FramePoses.motions``, from one of two poses (..., 4, 4) to the other.

    T_world_camera: (..., 4, 4) a camera near both, in whose frame the motion is.
    """
    first, last = inverse(first) @ T_world_camera, inverse(last) @ T_world_camera
    turn = so3_log(last[..., :3, :3] @ np.swapaxes(first[..., :3, :3], -1, -2))
    return np.concatenate([turn, last[..., :3, 3] - first[..., :3, 3]], axis=-1)


@dataclass(frozen=True)
class RolledFrame:
    """The effect of a rolling shutter on a frame.

    view: of the frame; pixels are those of its camera, except in images, which are rectified.
    readout: share of the frame interval.   motion: (6,) as of ``FramePoses.motions``.
    inverse_depth: for observations without their own.
    """

    view: CorrectedView
    readout: float
    motion: F64
    inverse_depth: float

    @property
    def camera(self) -> PinholeCamera:
        """The camera of the view."""
        return self.view.camera

    def shifts(self, points_px: F32, inverse_depths: F64 | None = None) -> F32:
        """(N, 2) rolling-shutter offsets, px, of observations at points_px (N, 2)."""
        return self._shifts(points_px, inverse_depths, seen=True)

    def removed(self, points: F32, inverse_depths: F64 | None = None) -> F32:
        """Observations (N, 2 or more), of which the first two columns are px, less ``shifts``."""
        if inverse_depths is None:
            inverse_depths = np.array([self.inverse_depth])
        axis, K = self._read_out()
        still = points.copy()
        _remove(still, inverse_depths, self.readout * self.motion, K, axis)
        return still

    def found(self, points_px: F32, inverse_depths: F64) -> tuple[F32, F32]:
        """Move matches at points_px (N, 2) of ``image`` to the position for their own depth;
        returns it with their offsets.
        """
        seen = points_px + self._shifts(points_px, None, seen=False)
        shifts = self.shifts(seen, inverse_depths)
        return seen - shifts, shifts

    def image(self, pixels: U8) -> U8:
        """The rectified image (H, W) or (H, W, 3) in the view's pixels with a global shutter, at
        one depth.
        """
        return moved_image(pixels, self.places)

    @property
    def shows(self) -> BoolArray:
        """(H, W) as of ``CorrectedView.shows``."""
        return shows(self.places)

    @cached_property
    def places(self) -> Move:
        """(H, W) columns and rows of the rectified image for the pixels of the global-shutter
        image.
        """
        width, height = self.camera.width, self.camera.height
        columns, rows = -(-width // _GRID_PX) + 1, -(-height // _GRID_PX) + 1
        v, u = np.mgrid[:rows, :columns].astype(np.float32) * _GRID_PX
        nodes = np.stack([u.ravel(), v.ravel()], axis=1)
        moves = self.view.seen(nodes + self._shifts(nodes, None, seen=False)) - nodes
        places = np.empty((2, height, width), np.float32)
        _interpolate(moves.reshape(rows, columns, 2), places)
        return places[0], places[1]

    def _shifts(self, points_px: F32, inverse_depths: F64 | None, *, seen: bool) -> F32:
        axis, K = self._read_out()
        if inverse_depths is None:
            inverse_depths = np.array([self.inverse_depth])
        shifts = np.empty((len(points_px), 2), np.float32)
        _shifts(points_px, inverse_depths, self.readout * self.motion, K, axis, shifts, seen)
        return shifts

    def _read_out(self) -> tuple[int, F64]:
        """The axis along which it is read out; intrinsics and the length of that axis (5,)."""
        axis, length = _read_out_along(self.camera)
        return axis, np.array([*self.camera.intrinsics, length])


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
    axis, length = _read_out_along(camera)
    K = np.array([camera.fx, camera.fy, length])
    _flow(
        T_camera_world, motions, points_world, camera_index, point_index, points_px, K, axis, flow
    )
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
    axis: int,
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
        share = (points_px[o, axis] - middle) / K[2]
        a, b = _velocity(motion, x, y, 1.0 / z)
        flow[o, 0], flow[o, 1] = share * K[0] * a, share * K[1] * b


@fast_kernel
def _velocity(motion: F64, x: float, y: float, inverse_depth: float) -> tuple[float, float]:
    """Velocity of a point on the plane z = 1, per frame interval."""
    a = motion[1] - motion[2] * y + motion[3] * inverse_depth
    b = motion[2] * x - motion[0] + motion[4] * inverse_depth
    c = motion[0] * y - motion[1] * x + motion[5] * inverse_depth
    return a - x * c, b - y * c


@kernel
def _shifts(
    points_px: F32, inverse_depths: F64, motion: F64, K: F64, axis: int, shifts: F32, seen: bool
) -> None:
    """Write p - q for the observed points p, or else for the points q.

    inverse_depths: (N,) or (1,) for all.
    """
    last = inverse_depths.size - 1
    for n in range(points_px.shape[0]):
        u, v, inverse_depth = points_px[n, 0], points_px[n, 1], inverse_depths[min(n, last)]
        du, dv = _shift(u, v, inverse_depth, motion, K, axis, seen)
        shifts[n, 0], shifts[n, 1] = du, dv


@kernel
def _remove(points: F32, inverse_depths: F64, motion: F64, K: F64, axis: int) -> None:
    """Subtract the shifts of observed points from their first two columns."""
    last = inverse_depths.size - 1
    for n in range(points.shape[0]):
        u, v, inverse_depth = points[n, 0], points[n, 1], inverse_depths[min(n, last)]
        du, dv = _shift(u, v, inverse_depth, motion, K, axis, True)
        points[n, 0], points[n, 1] = u - np.float32(du), v - np.float32(dv)


@kernel
def _shift(
    u: float, v: float, inverse_depth: float, motion: F64, K: F64, axis: int, seen: bool
) -> tuple[float, float]:
    u, v = float(u), float(v)
    middle = 0.5 * (K[4] - 1.0)
    du, dv = 0.0, 0.0
    for _ in range(_STEPS):
        if seen:
            x, y = (u - du - K[2]) / K[0], (v - dv - K[3]) / K[1]
            row = v if axis else u
        else:
            x, y = (u - K[2]) / K[0], (v - K[3]) / K[1]
            row = v + dv if axis else u + du
        share = (row - middle) / K[4]
        a, b = _velocity(motion, x, y, inverse_depth)
        du, dv = share * K[0] * a, share * K[1] * b
    return du, dv


@kernel
def _interpolate(moves: F32, places: F32) -> None:
    """Write the position (2, H, W) of each pixel by offsets (., ., 2) at the grid nodes.

    Row by row, in SIMD code, from the corners of each pixel's cell.
    """
    height, width = places.shape[1:]
    cell = np.arange(width) // _GRID_PX
    across = (np.arange(width) - _GRID_PX * cell).astype(np.float32) / np.float32(_GRID_PX)
    own = np.arange(width).astype(np.float32)
    corners = np.empty((4, width), np.float32)
    for k in range(2):
        for row in range(height):
            r = row // _GRID_PX
            down = np.float32(row - r * _GRID_PX) / np.float32(_GRID_PX)
            if row == r * _GRID_PX:
                for j in range(width):
                    upper, lower = moves[r, cell[j] :, k], moves[r + 1, cell[j] :, k]
                    corners[0, j], corners[1, j] = upper[0], upper[1]
                    corners[2, j], corners[3, j] = lower[0], lower[1]
            if k:
                own[:] = np.float32(row)
            _interpolate_row(corners, across, down, own, places[k, row])


@kernel
def _interpolate_row(corners: F32, across: F32, down: np.float32, own: F32, places: F32) -> None:
    one = np.float32(1.0)
    s00, s01, s10, s11 = corners[0], corners[1], corners[2], corners[3]
    for j in range(places.size):
        w00, w01 = (one - down) * (one - across[j]), (one - down) * across[j]
        w10, w11 = down * (one - across[j]), down * across[j]
        shift = s00[j] * w00 + s01[j] * w01 + s10[j] * w10 + s11[j] * w11
        places[j] = own[j] + shift

"""The changes of one frame in the map and in its keyframes' observations: all that is published.

One atomic update a frame."""

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, I64, U8, BoolArray, Shape
from pliant.algorithms.geometry import (
    matrix_to_similarity,
    similarity_to_matrix,
    transform_each,
)

WAITING, TRACKING, LOST = 0, 1, 2
"""State of the map after a frame: not started, localised, or lost."""

BY_GYRO = -1
"""Instead of the number of points that support a pose: the gyro places it, between others."""


@dataclass(frozen=True, kw_only=True)
class MapMoves:
    """How an adjustment of the whole map moves it: content moves with its reference keyframe.

    keyframe_ids: ascending.  A keyframe that is not listed moves with the last one listed before
    it, so newer ones move rigidly; those older than the first stay.
    moves: similarities of the world, a pose and a scale each: ``X -> scale R X + t``.
    """

    keyframe_ids: Annotated[I64, Shape("C")]
    moves: Annotated[F64, Shape("C", 8)]

    def matrices(self, keyframes: I64) -> F64:
        """(N, 4, 4) the similarity of each of the keyframes (N,), by id."""
        table = np.concatenate([np.eye(4)[None], similarity_to_matrix(self.moves)])
        return table.take(np.searchsorted(self.keyframe_ids, keyframes, side="right"), 0)

    def then(self, moves: "MapMoves") -> "MapMoves":
        """Both as one, these first."""
        ids = np.union1d(self.keyframe_ids, moves.keyframe_ids)
        both = moves.matrices(ids) @ self.matrices(ids)
        return MapMoves(keyframe_ids=ids, moves=matrix_to_similarity(both))

    def points(self, xyz: F64, hosts: I64) -> F64:
        """Move points (N, 3) with their reference keyframes (N,)."""
        return transform_each(self.matrices(hosts), xyz)


def _no_ids() -> I64:
    return np.zeros(0, np.int64)


@dataclass(frozen=True, kw_only=True)
class MapDelta:
    """The pose of a frame and everything that it changed in the map.

    A pose is position and quaternion, (x, y, z, qx, qy, qz, qw), of a T_a_b that maps points of b
    to a.  The world is the camera of the keyframe that started the segment, from which it drifts
    a little while the map grows; the scale is arbitrary.  Other frames have a reference keyframe
    (T_keyframe_camera) and move with it.

    state: WAITING, TRACKING or LOST.
    reason: why the map cannot start or was lost; when TRACKING why the pose is doubtful, mostly "".
    segment: id of the map segment that the camera is in, or was in last; an earlier one is
        continued when its place is recognised.   -1 before the first.
    inliers: points that support this frame's pose (reprojection error < 1.5 px).
    pose_frames: frames whose pose is new or changed; includes this frame when it is localised.
    pose_segments, pose_keyframes: the segment and the reference keyframe of each.
    poses_keyframe_camera: T_keyframe_camera for each.
    pose_inliers: points that support each; BY_GYRO where no image does.
    keyframe_ids, keyframe_frames, keyframe_segments: keyframes that are new or have moved; frame -1
        for those that an earlier session made.
    keyframe_poses: T_world_camera for each.
    point_ids: points that are new, or changed by more than a share of how uncertain they are; after
        the final adjustment all of it.      point_segments: theirs.
    points_world: positions, as float32 has them.    point_colours: RGB (grey is repeated).
    point_keyframes: keyframes that observe the point.
    point_parallax_rad: largest angle between two of the rays that observe it.
    point_sigmas: standard deviation along the ray, as a share of the depth; both to 12 bits.
    point_hosts: reference keyframe of each.
    removed_point_ids: points that no longer exist (wrong, or merged into another).
    moved_keyframes, moves: how the whole map moved before all else of this update: ``MapMoves``.
        Keyframes and points move; distances of poses to their reference keyframes scale.
    joined: segments that have become one, after ``moves`` and before all else: what belongs to the
        first of each row belongs to the second from now on, where ``moves`` has brought it.
    same_places: pairs of keyframes at the same place, the older one first, from closed loops,
        merged segments and relocalisations.   -1 for a
        frame that is no keyframe.
    calibration_correction: (s, k1, k2, readout, a, b, t), the correction of the calibration by the
        last adjustment: a point of the map at (x, y) on the plane z = 1 is seen in the rectified
        image at ``u = fx e^s ((1 + k1 r^2 + k2 r^4) x + a) + cx``, likewise v with s + t and b, and
        a rolling shutter takes the rows of a frame in this share of the frame interval.   () where
        nothing was estimated.
    calibration_sigmas: standard deviation of each of these, at residuals of 1 px.
    focal_keyframes, log_focals: keyframes whose focal length is e^log_focal times that of the
        corrected calibration: of all of a clip in which it changes, and 0 if it turns out not to.
    snapshot: every keyframe and point of the active window is in it, changed or not.
    """

    state: int
    reason: str
    segment: int
    inliers: int
    pose_frames: Annotated[I64, Shape("F")]
    pose_segments: Annotated[I32, Shape("F")]
    pose_keyframes: Annotated[I64, Shape("F")]
    poses_keyframe_camera: Annotated[F64, Shape("F", 7)]
    pose_inliers: Annotated[I32, Shape("F")]
    keyframe_ids: Annotated[I64, Shape("K")]
    keyframe_frames: Annotated[I64, Shape("K")]
    keyframe_segments: Annotated[I32, Shape("K")]
    keyframe_poses: Annotated[F64, Shape("K", 7)]
    point_ids: Annotated[I64, Shape("P")]
    point_segments: Annotated[I32, Shape("P")]
    points_world: Annotated[F64, Shape("P", 3)]
    point_colours: Annotated[U8, Shape("P", 3)]
    point_keyframes: Annotated[I32, Shape("P")]
    point_parallax_rad: Annotated[F32, Shape("P")]
    point_sigmas: Annotated[F32, Shape("P")]
    removed_point_ids: Annotated[I64, Shape("R")]
    calibration_correction: tuple[float, ...] = ()
    calibration_sigmas: tuple[float, ...] = ()
    snapshot: bool = False
    point_hosts: Annotated[I64, Shape("P")] = field(default_factory=_no_ids)
    moved_keyframes: Annotated[I64, Shape("C")] = field(default_factory=_no_ids)
    moves: Annotated[F64, Shape("C", 8)] = field(default_factory=lambda: np.zeros((0, 8)))
    joined: Annotated[I32, Shape("J", 2)] = field(
        default_factory=lambda: np.zeros((0, 2), np.int32)
    )
    same_places: Annotated[I64, Shape("L", 2)] = field(
        default_factory=lambda: np.zeros((0, 2), np.int64)
    )

    focal_keyframes: Annotated[I64, Shape("Z")] = field(default_factory=_no_ids)
    log_focals: Annotated[F64, Shape("Z")] = field(default_factory=lambda: np.zeros(0))

    def hosts(self) -> I64:
        """(P,) ``point_hosts``; -1 in recordings from before maps moved."""
        known = len(self.point_hosts) == len(self.point_ids)
        return self.point_hosts if known else np.full(len(self.point_ids), -1, np.int64)

    def map_moves(self) -> MapMoves:
        """How the whole map moved; empty where it did not."""
        return MapMoves(keyframe_ids=self.moved_keyframes, moves=self.moves)


@dataclass(frozen=True, kw_only=True)
class KeyframeDelta:
    """Observations of keyframes.  Poses and points are in the MapDelta of the same frame.

    A keyframe is published twice: when it is new, and when nothing about it will change any more
    but by an adjustment of the whole map, as it has left the window, its camera was lost, or the
    stream has ended.

    new: id of the keyframe that this frame became; -1 where it became none.
    keyframe_ids: keyframes whose observations follow.    settled: whether they will not change.
    counts: observations of each; they follow each other in ``point_ids``, ascending in each.
    point_ids: points of the map.    points_px: (u, v) where the keyframe sees them.
    """

    new: int
    keyframe_ids: Annotated[I64, Shape("K")]
    settled: Annotated[BoolArray, Shape("K")]
    counts: Annotated[I32, Shape("K")]
    point_ids: Annotated[I64, Shape("N")]
    points_px: Annotated[F32, Shape("N", 2)]

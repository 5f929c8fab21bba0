"""What one frame changes in the map and in its keyframes' observations: all that is published.

One atomic update a frame."""

from dataclasses import dataclass
from typing import Annotated

from pliant.algorithms.arrays import F32, F64, I32, I64, U8, BoolArray, Shape

WAITING, TRACKING, LOST = 0, 1, 2
"""State of the map after a frame: not started, localised, or lost (a new segment must start)."""


@dataclass(frozen=True, kw_only=True)
class MapDelta:
    """The pose of a frame and everything that it changed in the map.

    A pose is position and quaternion, (x, y, z, qx, qy, qz, qw), of a T_a_b that maps points of b
    to a.  The world is the camera of the keyframe that started the segment; the scale is
    arbitrary.  Ordinary frames hang on a keyframe (T_keyframe_camera), so that moving a keyframe
    moves them for free.

    state: WAITING, TRACKING or LOST.
    reason: why the map cannot start or was lost; "" when TRACKING.
    segment: id of the map segment; segments are never joined.   -1 before the first.
    inliers: points that support this frame's pose (reprojection error < 1.5 px).
    pose_frames: frames whose pose is new or changed; includes this frame when it is localised.
    pose_segments, pose_keyframes: the segment and the keyframe id on which each of them hangs.
    poses_keyframe_camera: T_keyframe_camera for each.
    pose_inliers: points that support each.
    keyframe_ids, keyframe_frames, keyframe_segments: keyframes that are new or have moved.
    keyframe_poses: T_world_camera for each.
    point_ids: points that are new or have changed.      point_segments: theirs.
    points_world: positions.      point_colours: RGB (grey is repeated).
    point_keyframes: keyframes that observe the point.
    point_parallax_rad: largest angle between two of the rays that observe it.
    point_sigmas: standard deviation along the ray, as a share of the depth.
    removed_point_ids: points that no longer exist (wrong, or merged into another).
    calibration_correction: (s, k1, k2, readout), what the last adjustment found wrong with the
        calibration: a point of the map at (x, y) on the plane z = 1 is seen in the rectified image
        at ``u = fx e^s (1 + k1 r^2 + k2 r^4) x + cx``, likewise v, and a rolling shutter takes the
        rows of a frame in this share of the frame interval.   () where nothing was estimated.
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
    snapshot: bool = False


@dataclass(frozen=True, kw_only=True)
class KeyframeDelta:
    """Observations of keyframes.  Poses and points are in the MapDelta of the same frame.

    A keyframe is published twice: when it is new, and when nothing about it will change any more
    but by the final adjustment, as it has left the window, its segment was lost, or the stream has
    ended.

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

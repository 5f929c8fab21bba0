"""Poses of the frames that waited for a map: backwards from its start, or from where it resumes.

They are placed by the landmarks of the start.  Earlier ones, with too few of them, have only
rotated, otherwise backfill would have placed them: they get the position of the first placed frame,
and the rotations between consecutive frames from the tracks that these share.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from pliant.algorithms.arrays import F64, I64
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.slam.adjust.ordinary_frames import EarlierPose
from pliant.algorithms.slam.calibration.corrected_view import CorrectedView, moved_px
from pliant.algorithms.slam.estimate.epipolar import rotation_between
from pliant.algorithms.slam.estimate.pose import Correspondences
from pliant.algorithms.slam.frame import Frame, IdealFrame
from pliant.algorithms.slam.locate.localisation import Motion, refine
from pliant.algorithms.slam.map.keyframe import Keyframe
from pliant.algorithms.slam.parameters import LocalisationParameters, MappingParameters
from pliant.algorithms.slam.start.first_map import BufferedFrame, Start, keep_newest

_SAMPLE = 400
"""Tracks that determine a rotation."""

_KEPT_TURNS = 2000
"""Bounds the memory for a camera that never moves."""


@dataclass(frozen=True, kw_only=True)
class Turn:
    """The rotation of the camera from a frame to the next.

    R_next_frame: (3, 3) maps rays of the frame to the next one's.   inliers: tracks that agree.
    """

    frame: int
    R_next_frame: F64
    inliers: int


def turn_between(
    frame: BufferedFrame,
    following: BufferedFrame,
    camera: PinholeCamera,
    parameters: LocalisationParameters,
) -> Turn:
    """Return the rotation that fits the tracks of two frames best."""
    _, i, j = np.intersect1d(frame.ids, following.ids, assume_unique=True, return_indices=True)
    if len(i) < parameters.min_inliers:
        return Turn(frame=frame.frame, R_next_frame=np.eye(3), inliers=0)
    every = max(1, len(i) // _SAMPLE)
    before = camera.normalise(frame.points_px[i[::every]].astype(np.float64))
    after = camera.normalise(following.points_px[j[::every]].astype(np.float64))
    gate = parameters.inlier_px / camera.fx
    R, residuals = rotation_between(before, after, scale=gate)
    inliers = int((residuals < gate).mean() * len(i))
    return Turn(frame=frame.frame, R_next_frame=R, inliers=inliers)


@dataclass(frozen=True)
class InitialisationBuffer:
    """Frames from which a map may start, and the rotations of all since the last placed one.

    turns: one for each of the frames but the newest, and for earlier ones.   newest: with image.
    """

    frames: list[BufferedFrame] = field(default_factory=list[BufferedFrame])
    turns: list[Turn] = field(default_factory=list[Turn])
    newest: Frame | None = None

    def then(self, frame: IdealFrame, parameters: MappingParameters) -> "InitialisationBuffer":
        """Return the buffer with one more frame."""
        tracks, camera = frame.tracks, frame.calibration.view.camera
        newest = BufferedFrame(
            frame=frame.number, stamp_ns=frame.stamp_ns, ids=tracks.ids,
            points_px=tracks.points_px, kappas=tracks.kappas,
        )  # fmt: skip
        turns = self.turns
        if self.frames:
            turn = turn_between(self.frames[-1], newest, camera, parameters.localisation)
            turns = [*turns[1 - _KEPT_TURNS :], turn]
        frames = keep_newest(self.frames, newest, parameters.start)
        return InitialisationBuffer(frames, turns, frame.given.coloured())

    def seen_by(self, before: CorrectedView, after: CorrectedView) -> "InitialisationBuffer":
        """Return the buffer in the pixels of another ideal camera."""
        frames = [replace(f, points_px=moved_px(f.points_px, before, after)) for f in self.frames]
        return replace(self, frames=frames)


def earlier_poses(
    start: Start,
    keyframes: list[Keyframe],
    waiting: InitialisationBuffer,
    camera: PinholeCamera,
    parameters: LocalisationParameters,
) -> Iterator[EarlierPose]:
    """Yield the poses, the newest first.  keyframes: of the map that starts."""
    keyframe_at = {each.frame: each for each in keyframes}
    frames = {each.frame: each for each in waiting.frames}
    turned = {each.frame: each for each in waiting.turns}
    reference = keyframes[-1]
    T_world_camera = reference.T_world_camera
    unbroken = True
    for frame in sorted(frames.keys() | turned.keys(), reverse=True):
        here, inliers = T_world_camera, 0
        if frame in frames:
            here, inliers = _place(
                T_world_camera, start.ids, start.points_world, frames[frame], camera, parameters
            )
        if frame in keyframe_at:
            reference = keyframe_at[frame]
            here = reference.T_world_camera
        elif inliers < parameters.min_inliers and unbroken and frame in turned:
            inliers = turned[frame].inliers
            here = T_world_camera.copy()
            here[:3, :3] = here[:3, :3] @ turned[frame].R_next_frame
        unbroken = frame in keyframe_at or inliers >= parameters.min_inliers
        if not unbroken:
            continue
        T_world_camera = here
        yield EarlierPose(
            frame=frame, keyframe=reference, T_world_camera=T_world_camera, inliers=inliers
        )


def motion_of_start(placed: list[EarlierPose], waiting: InitialisationBuffer) -> Motion:
    """Return the motion at the newest frame of a start.   placed: its poses, the newest first."""
    stamps_ns = {each.frame: each.stamp_ns for each in waiting.frames}
    newest, before = placed[0], placed[min(1, len(placed) - 1)]
    return Motion(
        frames=(before.frame, newest.frame),
        stamps_ns=(stamps_ns[before.frame], stamps_ns[newest.frame]),
        poses=(before.T_world_camera, newest.T_world_camera),
        tracked=newest.inliers,
        to_points=newest.inliers,
    )


def returned_poses(
    T_world_camera: F64,
    ids: I64,
    points_world: F64,
    waiting: InitialisationBuffer,
    keyframe: Keyframe,
    camera: PinholeCamera,
    parameters: LocalisationParameters,
) -> Iterator[EarlierPose]:
    """Return poses of the frames that waited until a lost camera was recognised, the newest first,
    as far as they share enough of the landmarks seen there.

    T_world_camera: where it was recognised.   ids, points_world: (n,) and (n, 3) of the tracks of
    landmarks in view.   keyframe: their reference keyframe.
    """
    for frame in reversed(waiting.frames):
        here, inliers = _place(T_world_camera, ids, points_world, frame, camera, parameters)
        if inliers >= parameters.min_inliers:
            T_world_camera = here
            yield EarlierPose(
                frame=frame.frame, keyframe=keyframe, T_world_camera=here, inliers=inliers
            )


def _place(
    T_world_camera: F64,
    ids: I64,
    points_world: F64,
    frame: BufferedFrame,
    camera: PinholeCamera,
    parameters: LocalisationParameters,
) -> tuple[F64, int]:
    _, i, j = np.intersect1d(frame.ids, ids, assume_unique=True, return_indices=True)
    if len(i) < parameters.min_inliers:
        return T_world_camera, 0
    seen = Correspondences(points_world[j], frame.points_px[i])
    located = refine(T_world_camera, seen, camera, parameters)
    return located.T_world_camera, int(located.inliers.sum())

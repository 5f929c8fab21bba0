"""A sample of the tracks in all frames of a segment whose camera turns in one place.

It is for the choice of ``second_start``.  Once the camera has moved too far for that, the sample is
dropped for good, so ordinary videos pay no memory for it.

Pixels are those of the rectified image, which no later calibration changes.
"""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from pliant.algorithms.arrays import F32, F64, I64
from pliant.algorithms.geometry import lengths
from pliant.algorithms.slam.map.keyframe import Keyframe
from pliant.algorithms.tracks import FrameTracks

_NEAR = 1 / 6
"""Standard deviation of the positions, as a share of the median depth, until which any motion is
sampled: a start has little rotation.
"""

_LONGEST_ARM = 2 / 3
"""Of a camera that turns in one place, as a share of the median depth.  A camera that orbits the
scene has an arm of one depth.
"""

_EVERY = 8
"""One in this many tracks is in the sample, by its id."""

_ROOM = 1 << 19
"""Maximum stored observations, 8 MB: some 420 frames of 10,000 tracks.  With more, half of the
tracks leave the sample.
"""

_RAREST = 64
"""The sample is dropped once only one in more than this many tracks would be left, after some 3,400
frames of 10,000 tracks: too few to determine the poses of its frames.
"""

_MOST_KEYFRAMES = 256
"""The sample is dropped with more.  Keyframes of a turn meet each other again and again, so their
reduced system is dense, and takes the cube of their number: 490 of them take 75 s for one start.
"""


class SampledTracks(NamedTuple):
    """Tracks ids (n,) at points_px (n, 2) of the rectified image, in a frame."""

    frame: int
    ids: I64
    points_px: F32


@dataclass
class TrackSample:
    """frames: oldest first.   every: one in this many tracks is in it; 0: it has been dropped."""

    every: int = _EVERY
    frames: list[SampledTracks] = field(default_factory=list[SampledTracks])
    _size: int = 0  # observations of all frames

    def add(self, frame: int, tracks: FrameTracks) -> None:
        """Add the sample of a frame."""
        if not self.every:
            return
        some = np.flatnonzero(tracks.ids % self.every == 0)
        self.frames.append(SampledTracks(frame, tracks.ids[some], tracks.points_px.take(some, 0)))
        self._size += len(some)
        while self._size > _ROOM:
            self._thin()

    def _thin(self) -> None:
        self.every *= 2
        if self.every > _RAREST:
            self.drop()
        for n, each in enumerate(self.frames):
            kept = np.flatnonzero(each.ids % self.every == 0)
            points_px = each.points_px.take(kept, 0)
            self.frames[n] = each._replace(ids=each.ids[kept], points_px=points_px)
        self._size = sum(len(each.ids) for each in self.frames)

    def begin_at(self, frame: int) -> None:
        """Forget the frames before this one, from which no map can start any more."""
        while self.frames and self.frames[0].frame < frame:
            self._size -= len(self.frames.pop(0).ids)

    def follow(self, keyframes: list[Keyframe]) -> None:
        """Drop the sample once a segment has too many keyframes, or their camera moved too far.

        Depths are those of keyframes that have left the window: young landmarks are uncertain.
        """
        if len(keyframes) > _MOST_KEYFRAMES:
            self.drop()
        done = [each for each in keyframes if _has_focus(each)] if self.every else []
        if not done:
            return
        T_world_camera = np.array([keyframe.T_world_camera for keyframe in done])
        positions = T_world_camera[:, :3, 3]
        depth = float(np.median(lengths(np.array([each.focus for each in done]) - positions)))
        if spread(positions) > _NEAR * depth and not turns_in_place(T_world_camera, depth):
            self.drop()

    def drop(self) -> None:
        """Drop the sample for good."""
        self.every, self.frames, self._size = 0, [], 0


def _has_focus(keyframe: Keyframe) -> bool:
    return keyframe.focus is not None and bool(np.isfinite(keyframe.focus).all())


def turns_in_place(T_world_camera: F64, depth: float) -> bool:
    """Whether the positions of cameras (K, 4, 4) spread as at the end of a short arm, which moves
    along with the optical axis.   depth: the median one.
    """
    axes, positions = T_world_camera[:, :3, 2], T_world_camera[:, :3, 3]
    return spread(positions) <= _LONGEST_ARM * depth * spread(axes)


def spread(vectors: F64) -> float:
    """Standard deviation of vectors (K, 3)."""
    return float(np.linalg.norm(vectors.std(0)))

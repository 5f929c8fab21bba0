"""A frame on its way through the mapper: as tracking gives it, in ideal pixels, with its pose."""

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from pliant.algorithms.arrays import F32, F64, U8
from pliant.algorithms.image.moved_image import MovedImage
from pliant.algorithms.mapping.keyframe import Observations
from pliant.algorithms.mapping.pose_quality import Support
from pliant.algorithms.mapping.rolling_shutter import RolledFrame
from pliant.algorithms.mapping.self_calibration import SelfCalibration
from pliant.algorithms.tracks import FrameExtrema, FrameTracks


@dataclass(frozen=True)
class Frame:
    """What ingest and tracking give, in pixels of the rectified image.

    stamp_ns: when it was taken, increasing.   grey: (H, W).   colour: (H, W, 3) RGB.
    """

    number: int
    stamp_ns: int
    extrema: FrameExtrema
    grey: U8 | None = None
    colour: U8 | None = None

    @staticmethod
    def of_tracks(number: int, stamp_ns: int, tracks: FrameTracks) -> "Frame":
        """A frame of which there is time for the tracks alone."""
        return Frame(number, stamp_ns, FrameExtrema.without_maxima(tracks))


@dataclass(frozen=True, kw_only=True)
class IdealFrame:
    """A frame as an ideal pinhole camera sees it, at first with the readout of the given one.

    calibration: by which it is corrected.   tracks: in pixels of the ideal camera.
    rolled: the readout that ``to_global_shutter`` has taken out; None: none.
    rolled_px: (N, 2) by how much farther that had moved the tracks.
    """

    given: Frame
    calibration: SelfCalibration
    tracks: FrameExtrema
    rolled_px: F32
    rolled: RolledFrame | None = None

    @staticmethod
    def of(frame: Frame, calibration: SelfCalibration) -> "IdealFrame":
        """Correct the lens."""
        tracks = calibration.ideal(frame.extrema)
        none = np.zeros_like(tracks.points_px)
        return IdealFrame(given=frame, calibration=calibration, tracks=tracks, rolled_px=none)

    @property
    def number(self) -> int:
        """As of the given frame."""
        return self.given.number

    @property
    def stamp_ns(self) -> int:
        """As of the given frame."""
        return self.given.stamp_ns

    def to_global_shutter(self, rolled: RolledFrame, inverse_depths: F64) -> "IdealFrame":
        """The frame, had it been taken at once.   inverse_depths: (N,) of the tracks."""
        before = self.tracks
        maxima = before.maxima.copy()
        maxima[:, :2] -= rolled.shifts(np.ascontiguousarray(maxima[:, :2]))
        points_px = before.points_px - rolled.shifts(before.points_px, inverse_depths)
        tracks = replace(before, points_px=points_px, maxima=maxima)
        return replace(self, tracks=tracks, rolled=rolled, rolled_px=before.points_px - points_px)

    @property
    def has_image(self) -> bool:
        """Whether there is more than tracks."""
        return self.given.grey is not None

    @cached_property
    def image(self) -> U8:
        """The grey image (H, W) where the tracks are.  Only if it has one."""
        assert self.given.grey is not None
        return self._moved(self.given.grey).whole

    @property
    def colours(self) -> MovedImage | None:
        """The colour image, or else the grey one, where the tracks are."""
        given = self.given
        pixels = given.grey if given.colour is None else given.colour
        return None if pixels is None else self._moved(pixels)

    def _moved(self, pixels: U8) -> MovedImage:
        view = self.calibration.frame_view
        return MovedImage(pixels, view.move if self.rolled is None else self.rolled.places)


@dataclass(frozen=True, kw_only=True)
class PlacedFrame:
    """A frame with its pose in the map.

    found: points that it sees without a track.   support: for the pose, once that is adjusted.
    is_pure_rotation: since the last keyframe.
    """

    frame: IdealFrame
    T_world_camera: F64
    found: Observations = field(default_factory=Observations.none)
    support: Support = field(default_factory=Support)
    is_pure_rotation: bool = False

"""A frame in the mapper: from tracking, in ideal pixels, and with its pose."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from pliant.algorithms.arrays import F32, F64, U8
from pliant.algorithms.image.moved_image import MovedImage
from pliant.algorithms.slam.calibration.rolling_shutter import RolledFrame
from pliant.algorithms.slam.calibration.self_calibration import SelfCalibration
from pliant.algorithms.slam.estimate.pose_prior import NO_PRIOR, PosePrior
from pliant.algorithms.slam.locate.pose_quality import Support
from pliant.algorithms.slam.map.keyframe import Observations
from pliant.algorithms.tracks import FrameExtrema, FrameTracks


@dataclass(frozen=True)
class Frame:
    """The output of ingest and tracking, in pixels of the rectified image.

    stamp_ns: capture time, increasing.   grey: (H, W).
    colour: (H, W, 3) RGB, or what makes it of the few frames that need it.
    """

    number: int
    stamp_ns: int
    extrema: FrameExtrema
    grey: U8 | None = None
    colour: U8 | Callable[[], U8 | None] | None = None

    def coloured(self) -> "Frame":
        """Return the frame with its colours made."""
        return replace(self, colour=self.colour()) if callable(self.colour) else self

    def pixels(self) -> U8 | None:
        """The colour image, or otherwise the grey one."""
        colour = self.colour() if callable(self.colour) else self.colour
        return self.grey if colour is None else colour

    @staticmethod
    def of_tracks(number: int, stamp_ns: int, tracks: FrameTracks) -> "Frame":
        """A frame without images, if there is only time for the tracks."""
        return Frame(number, stamp_ns, FrameExtrema.without_maxima(tracks))


@dataclass(frozen=True, kw_only=True)
class IdealFrame:
    """A frame as an ideal pinhole camera sees it, at first with its rolling shutter.

    calibration: by which it is corrected.   tracks: in pixels of the ideal camera.
    rolled: the readout that ``to_global_shutter`` has removed, or None.
    rolled_px: (N, 2) rolling-shutter offset of the tracks that was removed.
    """

    given: Frame
    calibration: SelfCalibration
    tracks: FrameExtrema
    rolled_px: F32
    rolled: RolledFrame | None = None

    @staticmethod
    def of(frame: Frame, calibration: SelfCalibration) -> "IdealFrame":
        """Correct the lens of a frame."""
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
        """Return the frame with a global shutter.   inverse_depths: (N,) of the tracks."""
        before = self.tracks
        points_px = rolled.removed(before.points_px, inverse_depths)
        tracks = replace(before, points_px=points_px, maxima=rolled.removed(before.maxima))
        return replace(self, tracks=tracks, rolled=rolled, rolled_px=before.points_px - points_px)

    @property
    def has_image(self) -> bool:
        """Whether the frame has images."""
        return self.given.grey is not None

    @cached_property
    def image(self) -> U8:
        """The grey image (H, W) in the tracks' pixels, if the frame has images."""
        assert self.given.grey is not None
        return self._moved(self.given.grey).whole

    @property
    def colours(self) -> MovedImage | None:
        """The colour image, or otherwise the grey one, in the tracks' pixels."""
        pixels = self.given.pixels()
        return None if pixels is None else self._moved(pixels)

    def _moved(self, pixels: U8) -> MovedImage:
        view = self.calibration.frame_view
        return MovedImage(pixels, view.move if self.rolled is None else self.rolled.places)


@dataclass(frozen=True, kw_only=True)
class PlacedFrame:
    """A frame with its pose in the map.

    found: visible landmarks without a track.   support: of the pose, after its adjustment.
    is_pure_rotation: since the last keyframe.   prior: of the pose.
    """

    frame: IdealFrame
    T_world_camera: F64
    found: Observations = field(default_factory=Observations.none)
    support: Support = field(default_factory=Support)
    is_pure_rotation: bool = False
    prior: PosePrior = NO_PRIOR

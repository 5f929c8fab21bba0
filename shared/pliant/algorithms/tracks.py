"""The tracks of one frame: what the tracker hands to bundle adjustment."""

from dataclasses import dataclass, fields
from typing import Annotated

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, I64, U8, Shape

EXTREMUM = 0
"""State of a track that lies on a curvature extremum of this frame."""
COASTING = 1
"""State of a track carried by its patch through a frame without an extremum."""


@dataclass(frozen=True, kw_only=True)
class FrameTracks:
    """Living tracks of one frame.

    Pixels are (u, v) with (0, 0) at the centre of the top-left pixel of the rectified image.

    ids: unique for the whole run, strictly increasing within a frame; never used again.
    points_px: sub-pixel positions.
    ages: frames since birth, 0 in the frame of birth.
    kappas: curvature (Eq. 1) at the extremum, DN^3, to 8 bits, negative at a minimum (a bright
        feature); of the last extremum while coasting.
    states: EXTREMUM or COASTING.
    dominant_flow: [A | b] of Eq. 4, previous frame to this one; identity where there is none.
    """

    ids: Annotated[I64, Shape("N")]
    points_px: Annotated[F32, Shape("N", 2)]
    ages: Annotated[I32, Shape("N")]
    kappas: Annotated[F32, Shape("N")]
    states: Annotated[U8, Shape("N")]
    dominant_flow: Annotated[F64, Shape(2, 3)]

    @staticmethod
    def empty() -> "FrameTracks":
        """No tracks: what a dropped or broken frame gets."""
        return FrameTracks(
            ids=np.zeros(0, np.int64),
            points_px=np.zeros((0, 2), np.float32),
            ages=np.zeros(0, np.int32),
            kappas=np.zeros(0, np.float32),
            states=np.zeros(0, np.uint8),
            dominant_flow=np.eye(2, 3),
        )


@dataclass(frozen=True, kw_only=True)
class FrameExtrema(FrameTracks):
    """Living tracks and all curvature maxima of one frame.

    maxima: every local extremum of curvature in the frame as (u, v, kappa), in scan order, tracked
        or not.
    """

    maxima: Annotated[F32, Shape("M", 3)]

    @staticmethod
    def of(tracks: FrameTracks, maxima: F32) -> "FrameExtrema":
        """Tracks and the maxima (M, 3) of their frame, not copied."""
        own = {field.name: getattr(tracks, field.name) for field in fields(FrameTracks)}
        return FrameExtrema(**own, maxima=maxima)

    @staticmethod
    def without_maxima(tracks: FrameTracks) -> "FrameExtrema":
        """Tracks of a frame without an image."""
        return FrameExtrema.of(tracks, np.zeros((0, 3), np.float32))

    @staticmethod
    def empty() -> "FrameExtrema":
        """No tracks and no maxima."""
        return FrameExtrema.without_maxima(FrameTracks.empty())

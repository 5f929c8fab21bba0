"""A keyframe of a map that is kept over sessions."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, I64, U8, Shape
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.slam.estimate.problem import SHARED

MAP_VERSION = 3
"""Version of the meaning and the encoding of the fields; newer maps are refused.
2: arrays are in planes, see ``pliant.messages.planes``.   3: corrections have an aspect ratio."""


@dataclass(frozen=True, kw_only=True)
class KeptKeyframe:
    """A keyframe of a saved map, and the landmarks of which it is the reference.

    id: ascending in a map, also over sessions.   segment: segments are worlds of their own.
    session, source_frame: the run that made it, from 0, and its frame there.
    turned: see ``Keyframe``.
    given: width, height, fx, fy, cx, cy of the camera as it was given; correction, sigmas: its
    estimated correction, as ``MapDelta.calibration_correction``.  Pixels are those of the ideal
    camera that these two make.
    T_world_camera: (4, 4).   motion: (6,) of the camera per frame interval, see ``Path``; 0 where
    it is unknown.
    seen_ids, seen_px, rolled_px: observed landmarks, their pixels, and the rolling-shutter offsets
    that were removed. corners_px, descriptors: of its ORB features; none where it is no place.
    point_ids ... point_patches: of its landmarks, as in ``Landmarks``; S x S grey levels of a
    patch.
    """

    id: int
    segment: int
    session: int
    source_frame: int
    turned: bool
    given: Annotated[F64, Shape(6)]
    correction: Annotated[F64, Shape("Q")]
    sigmas: Annotated[F64, Shape("Q")]
    T_world_camera: Annotated[F64, Shape(4, 4)]
    motion: Annotated[F64, Shape(6)]
    seen_ids: Annotated[I64, Shape("N")]
    seen_px: Annotated[F32, Shape("N", 2)]
    rolled_px: Annotated[F32, Shape("N", 2)]
    corners_px: Annotated[F32, Shape("C", 2)]
    descriptors: Annotated[U8, Shape("C", 32)]
    point_ids: Annotated[I64, Shape("P")]
    points_world: Annotated[F64, Shape("P", 3)]
    point_colours: Annotated[U8, Shape("P", 3)]
    point_keyframes: Annotated[I32, Shape("P")]
    point_parallax_rad: Annotated[F32, Shape("P")]
    point_sigmas: Annotated[F32, Shape("P")]
    point_kappas: Annotated[F32, Shape("P")]
    point_patches: Annotated[U8, Shape("P", "S", "S")]

    def __post_init__(self) -> None:
        """Add the aspect ratio, which was correct, to corrections of versions before 3."""
        for name in ("correction", "sigmas"):
            known = getattr(self, name)
            if known.shape == (SHARED - 1,):
                object.__setattr__(self, name, np.append(known, 0.0))

    @property
    def given_camera(self) -> PinholeCamera:
        """The camera as it was given."""
        width, height, fx, fy, cx, cy = self.given.tolist()
        return PinholeCamera(width=int(width), height=int(height), fx=fx, fy=fy, cx=cx, cy=cy)

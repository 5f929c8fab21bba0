"""The published state of the surfels in one frame."""

from dataclasses import dataclass, field
from enum import IntEnum
from typing import Annotated

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, I64, U8, Shape, check_arrays


class SurfelState(IntEnum):
    """State of a surfel in a frame.  All but TRACKED keep the last good estimate."""

    TRACKED = 0  # found, ZNCC above the threshold
    OUTLIER = 1  # ZNCC below the threshold
    OCCLUDED = 2  # too much of its patch is saturated, covered or on a highlight
    OUTSIDE = 3  # left the image, or went behind the camera
    LOST = 4  # not tracked for long; still searched


def _none_tried() -> F64:
    return np.zeros((0, 3))


def _no_floats() -> F32:
    return np.zeros(0, np.float32)


def _none_confirmed() -> U8:
    return np.zeros(0, np.uint8)


@dataclass(frozen=True)
class SurfelFrame:
    """N surfels in one frame, ordered by id.  No entry is ever NaN or infinite."""

    frame: int  # 0 at the start, of this tracker
    segment: int  # one more at each start, or a resumed one; each has its own ids
    lost: bool  # too few surfels are tracked; waits for depth
    T_world_camera: Annotated[F64, Shape(4, 4)]
    ids: Annotated[I64, Shape("N")]
    positions: Annotated[F64, Shape("N", 3)]  # metres, world
    tangents: Annotated[F64, Shape("N", 3, 2)]  # J^t of Eq. 1, world: metres per normalised unit
    deformations: Annotated[F64, Shape("N", 3)]  # f11, f12, f22 of F, 1 0 1 at birth
    points_px: Annotated[F32, Shape("N", 2)]  # where the centre is seen
    zncc: Annotated[F32, Shape("N")]
    visible: Annotated[F32, Shape("N")]  # share of the patch that is seen and fits
    sigma: Annotated[F32, Shape("N")]  # of the position, metres; mostly along the ray
    gains: Annotated[F32, Shape("N")]  # alpha of Eq. 5
    biases: Annotated[F32, Shape("N")]  # beta of Eq. 5, DN
    state: Annotated[U8, Shape("N")]  # SurfelState
    age: Annotated[I32, Shape("N")]  # frames since birth
    born: Annotated[I32, Shape("N")]  # frame of birth
    # (N, 3) metres, world: of the pose that zncc and visible speak of, kept or not; or (0, 3)
    # in recordings that were made before it was published.
    tried: Annotated[F64, Shape("T", 3)] = field(default_factory=_none_tried)
    # (N,) ZNCC with the birth template; 1 where a surfel is tracked and that template is in use.
    # Or (0,) in recordings that were made before they were published.
    birth_zncc: Annotated[F32, Shape("B")] = field(default_factory=_no_floats)
    confirmed: Annotated[U8, Shape("B")] = field(default_factory=_none_confirmed)
    # (N,) probability that the position is within 1 % of the depth; or (0,) in older recordings.
    confidence: Annotated[F32, Shape("P")] = field(default_factory=_no_floats)

    def __post_init__(self) -> None:
        check_arrays(self)

    @staticmethod
    def empty() -> "SurfelFrame":
        """Return no surfels: for a frame without pixels, or before the start."""
        floats = np.zeros(0, np.float32)
        return SurfelFrame(
            frame=0,
            segment=0,
            lost=True,
            T_world_camera=np.eye(4),
            ids=np.zeros(0, np.int64),
            positions=np.zeros((0, 3)),
            tangents=np.zeros((0, 3, 2)),
            deformations=np.zeros((0, 3)),
            points_px=np.zeros((0, 2), np.float32),
            zncc=floats,
            visible=floats,
            sigma=floats,
            gains=floats,
            biases=floats,
            state=np.zeros(0, np.uint8),
            age=np.zeros(0, np.int32),
            born=np.zeros(0, np.int32),
        )

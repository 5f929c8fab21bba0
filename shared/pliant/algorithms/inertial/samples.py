"""Measurements of an inertial sensor and of a satellite receiver, and blocks of them."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Annotated, Any, TypeVar

import numpy as np

from pliant.algorithms.arrays import F64, I64, Shape

BLOCK_BYTES = 1 << 18
"""A block of measurements as large as this never changes: see ``append``."""

_R = TypeVar("_R")


@dataclass(frozen=True, kw_only=True)
class ImuSamples:
    """Samples of one inertial measurement unit, in the order of their stamps.

    The axes are those of the sensor, whose orientation relative to the camera is unknown.
    Samples may be missing, and the clock may differ from the camera's by a constant.

    stamps_ns: strictly ascending.
    gyro_rad_s: angular velocity.
    accel_m_s2: specific force: acceleration minus gravity, +9.81 upwards at rest.
    """

    stamps_ns: Annotated[I64, Shape("N")]
    gyro_rad_s: Annotated[F64, Shape("N", 3)]
    accel_m_s2: Annotated[F64, Shape("N", 3)]

    @staticmethod
    def empty() -> "ImuSamples":
        """No samples."""
        return ImuSamples(
            stamps_ns=np.empty(0, np.int64),
            gyro_rad_s=np.empty((0, 3)),
            accel_m_s2=np.empty((0, 3)),
        )


@dataclass(frozen=True, kw_only=True)
class GpsFixes:
    """Positions of one satellite receiver, in the order of their stamps.

    stamps_ns: strictly ascending.
    latitude_deg, longitude_deg: WGS84.
    altitude_m: above the ellipsoid, or above the mean sea level where a source has only that.
    sigma_m: standard deviations east, north and up; NaN where the source does not say, infinite up
    where it has no altitude.
    """

    stamps_ns: Annotated[I64, Shape("N")]
    latitude_deg: Annotated[F64, Shape("N")]
    longitude_deg: Annotated[F64, Shape("N")]
    altitude_m: Annotated[F64, Shape("N")]
    sigma_m: Annotated[F64, Shape("N", 3)]

    @staticmethod
    def empty() -> "GpsFixes":
        """No fixes."""
        none = np.empty(0)
        return GpsFixes(
            stamps_ns=np.empty(0, np.int64),
            latitude_deg=none,
            longitude_deg=none,
            altitude_m=none,
            sigma_m=np.empty((0, 3)),
        )


def bytes_of(record: Any) -> int:
    """Bytes of the arrays of a record."""
    return sum(int(values.nbytes) for values in vars(record).values())


def joined(records: Sequence[_R]) -> _R:
    """One record with every array of records, of which all are arrays, end to end."""
    if len(records) == 1:
        return records[0]
    first: Any = records[0]
    names = [each.name for each in fields(first)]
    arrays = {name: np.concatenate([getattr(r, name) for r in records]) for name in names}
    made: _R = type(first)(**arrays)
    return made


def append(blocks: list[_R], more: _R) -> None:
    """Add a record of arrays to the last of the blocks, or as a new one if that is full."""
    if blocks and bytes_of(blocks[-1]) < BLOCK_BYTES:
        more = joined([blocks.pop(), more])
    blocks.append(more)

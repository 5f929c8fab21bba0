"""Inertial samples and satellite fixes as messages, and back from a recording."""

from collections.abc import Iterable, Iterator
from dataclasses import fields
from typing import Any

import numpy as np

from pliant.algorithms.inertial.samples import GpsFixes, ImuSamples
from pliant.messages import topics
from pliant.messages.types import GPS_FRAME_ID, IMU_FRAME_ID, GpsPiece, Header, ImuPiece
from pliant.recording.reader import Recording

_PIECE = 4096
"""Samples of a message: 56 bytes each."""


def imu_pieces(samples: ImuSamples) -> Iterator[ImuPiece]:
    """The samples as messages, in order; none without samples."""
    for number, rows in _parts(len(samples.stamps_ns)):
        yield ImuPiece(
            frame=number,
            stamp_ns=0,
            frame_id=IMU_FRAME_ID,
            stamps_ns=samples.stamps_ns[rows],
            gyro_rad_s=samples.gyro_rad_s[rows],
            accel_m_s2=samples.accel_m_s2[rows],
        )


def gps_pieces(fixes: GpsFixes) -> Iterator[GpsPiece]:
    """The fixes as messages, in order; none without fixes."""
    for number, rows in _parts(len(fixes.stamps_ns)):
        yield GpsPiece(
            frame=number,
            stamp_ns=0,
            frame_id=GPS_FRAME_ID,
            stamps_ns=fixes.stamps_ns[rows],
            latitude_deg=fixes.latitude_deg[rows],
            longitude_deg=fixes.longitude_deg[rows],
            altitude_m=fixes.altitude_m[rows],
            sigma_m=fixes.sigma_m[rows],
        )


def imu_of(recording: Recording) -> ImuSamples:
    """The inertial samples of the source that a run recorded, on the clock of its images.

    Raises MessageError.
    """
    return imu_in(recording.decoded(topics.IMU))


def imu_in(pieces: Iterable[Header]) -> ImuSamples:
    """The samples of ``imu_pieces``."""
    return ImuSamples(**_joined(pieces, ImuSamples.empty()))


def fixes_of(recording: Recording) -> GpsFixes:
    """The satellite fixes of the source that a run recorded, on the clock of its images.

    Raises MessageError.
    """
    return GpsFixes(**_joined(recording.decoded(topics.GPS), GpsFixes.empty()))


def _parts(count: int) -> Iterator[tuple[int, slice]]:
    for number, start in enumerate(range(0, count, _PIECE)):
        yield number, slice(start, min(count, start + _PIECE))


def _joined(pieces: Iterable[Header], empty: ImuSamples | GpsFixes) -> dict[str, Any]:
    """Every array of pieces, end to end."""
    each = [empty, *pieces]
    return {
        field.name: np.concatenate([getattr(piece, field.name) for piece in each])
        for field in fields(empty)
    }

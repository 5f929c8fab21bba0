"""Inertial samples and satellite fixes as messages, and back from a recording."""

from collections.abc import Iterable, Iterator
from typing import Any

from pliant.algorithms.inertial.samples import GpsFixes, ImuSamples, joined
from pliant.messages import topics
from pliant.messages.types import GPS_FRAME_ID, IMU_FRAME_ID, GpsPiece, Header, ImuPiece
from pliant.recording.reader import Recording

_PIECE = 4096
"""Samples of a message: 56 bytes each."""


def imu_pieces(samples: ImuSamples) -> Iterator[ImuPiece]:
    """The samples as messages, in order; none without samples."""
    for number, rows in _parts(len(samples.stamps_ns)):
        part = {name: values[rows] for name, values in vars(samples).items()}
        yield imu_piece(ImuSamples(**part), number)


def imu_piece(samples: ImuSamples, number: int) -> ImuPiece:
    """The samples as one message."""
    header = Header(frame=number, stamp_ns=0, frame_id=IMU_FRAME_ID)
    return ImuPiece.of(header, samples)


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
    each: list[Any] = [ImuSamples.empty(), *pieces]
    found: ImuSamples = joined(each)
    return found


def fixes_of(recording: Recording) -> GpsFixes:
    """The satellite fixes of the source that a run recorded, on the clock of its images.

    Raises MessageError.
    """
    each: list[Any] = [GpsFixes.empty(), *recording.decoded(topics.GPS)]
    found: GpsFixes = joined(each)
    return found


def _parts(count: int) -> Iterator[tuple[int, slice]]:
    for number, start in enumerate(range(0, count, _PIECE)):
        yield number, slice(start, min(count, start + _PIECE))

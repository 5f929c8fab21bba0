"""Inertial samples and satellite fixes in files of messages: bags and MCAP files.

Samples: sensor_msgs Imu.   Fixes: sensor_msgs NavSatFix, foxglove LocationFix.
Times are those of the headers, as of the images.
"""

import re
from array import array
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pliant.algorithms.inertial.samples import ImuSamples
from pliant.datasets.image_messages import FOREIGN, capture_time
from pliant.datasets.measured.base import (
    Measurements,
    Series,
    gps_measurements,
    imu_measurements,
)
from pliant.datasets.measured.csv_log import in_m_s2, likely_factor
from pliant.datasets.message_files import MessageFile, MessageTopic, OpenMessages
from pliant.datasets.source_spec import SourceSpec
from pliant.errors import DatasetError

IMU_TYPES = ("sensor_msgs/Imu",)
FIX_TYPES = ("sensor_msgs/NavSatFix", "foxglove/LocationFix")
_NO_FIX = -1
_ENOUGH = 20
"""Accelerations that show their unit."""
_AT_ONCE = 4096
"""Samples of a piece: 56 bytes each."""
_GAP_NS = 10**9
"""The time of a sample that is so far ahead may be wrong: it counts with the next one."""


@dataclass
class ImuStream:
    """Samples of topics that are published now, a piece at a time.

    Each is given once an acceleration of its time, or a later one, has come.
    """

    file: MessageFile
    topics: Sequence[MessageTopic]
    _gyro: Series = field(default_factory=lambda: Series.of([], []))
    _accel: Series = field(default_factory=lambda: Series.of([], []))
    _factor: float | None = None
    _last_ns: int = -1

    def take(self) -> ImuSamples:
        """The next samples."""
        with self.file.open() as opened:
            each = [_read(opened, topic, _gyro_and_accel, 6)[0] for topic in self.topics]
        gyro = self._gyro.and_then(each[0].columns(0, 3))
        self._gyro = gyro.rows(gyro.stamps_ns > self._last_ns)
        self._accel = self._accel.and_then(each[-1].columns(3, 6))
        gyro, accel = self._gyro.in_order(), self._accel.in_order()
        if self._factor is None and len(accel) >= _ENOUGH:
            self._factor = likely_factor(accel.values)
        if self._factor is None or not len(gyro):
            return ImuSamples.empty()
        before_ns = gyro.stamps_ns[-2] if len(gyro) > 1 else self._last_ns
        if gyro.stamps_ns[-1] - before_ns > _GAP_NS:
            return ImuSamples.empty()
        ready = gyro.stamps_ns <= accel.stamps_ns[-1]
        ready[_AT_ONCE:] = False
        used = np.searchsorted(accel.stamps_ns, gyro.stamps_ns[ready][-1:]).sum()
        scaled = Series(accel.stamps_ns, self._factor * accel.values)
        found = imu_measurements(gyro.rows(ready), scaled, "").imu
        self._gyro = gyro.rows(~ready)
        self._accel = accel.rows(np.arange(len(accel)) >= used - _ENOUGH)
        self._last_ns = int(found.stamps_ns[-1]) if len(found.stamps_ns) else self._last_ns
        return found


def sensors_of(file: MessageFile, spec: SourceSpec) -> Measurements:
    """Samples from the sensor topics that are named, or the only ones of their kind.

    Raises DatasetError if a topic is named that is not there, or the choice is not clear.
    """
    with file.open() as opened:
        imu, fixes = sensor_topics(opened, spec, file)
        found = Measurements()
        if imu:
            found = found.and_those_of(_imu(opened, imu, file))
        return found.and_those_of(fixes_of(opened, fixes, file))


def fixes_of(
    opened: OpenMessages, topics: Sequence[MessageTopic], file: MessageFile
) -> Measurements:
    """Satellite fixes of a topic; nothing without one."""
    found = Measurements()
    for topic in topics:
        series, unreadable = _read(opened, topic, _fix, 6)
        where = f"{file.path.name}: {topic.name}"
        found = found.and_those_of(gps_measurements(series, where, unreadable=unreadable))
    return found


def sensor_topics(
    opened: OpenMessages, spec: SourceSpec, file: MessageFile
) -> tuple[list[MessageTopic], list[MessageTopic]]:
    """Topics of inertial samples, and of satellite fixes.  Raises as ``sensors_of``."""
    return (
        _chosen(opened, IMU_TYPES, spec.imu, file, "inertial samples", "--imu"),
        _chosen(opened, FIX_TYPES, spec.gps, file, "satellite fixes", "--gps"),
    )


def _chosen(
    opened: OpenMessages,
    kinds: Sequence[str],
    named: str,
    file: MessageFile,
    what: str,
    option: str,
) -> list[MessageTopic]:
    """The one topic; or the gyro's and the accelerometer's, which some cameras publish apart."""
    there = sorted(
        (topic for topic in opened.topics if topic.kind in kinds and topic.count != 0),
        key=lambda topic: topic.name,
    )
    listed = ", ".join(topic.name for topic in there) or "none"
    if named:
        found = [topic for topic in there if topic.name.strip("/") == named.strip("/")]
        if not found:
            raise DatasetError(
                f"{option} {named}: neither a file nor a topic with {what} of {file.path}; its "
                f"topics with {what}: {listed}"
            )
        return found
    apart = [[t for t in there if re.search(word, t.name)] for word in ("accel", "gyro")]
    if len(there) == 2 and all(len(each) == 1 for each in apart) and apart[0] != apart[1]:
        return [apart[1][0], apart[0][0]]
    if len(there) > 1:
        raise DatasetError(
            f"{file.path.name}: several topics with {what}; choose one with {option}: {listed}"
        )
    return there


def _imu(opened: OpenMessages, topics: Sequence[MessageTopic], file: MessageFile) -> Measurements:
    """Samples of one topic with both sensors, or of the gyro's and the accelerometer's."""
    where = f"{file.path.name}: {' and '.join(topic.name for topic in topics)}"
    gyro, unreadable = _read(opened, topics[0], _gyro_and_accel, 6)
    accel, more = (gyro, 0) if len(topics) == 1 else _read(opened, topics[1], _gyro_and_accel, 6)
    accelerations, note = in_m_s2(accel.values[:, 3:], None, where)
    return imu_measurements(
        Series(gyro.stamps_ns, gyro.values[:, :3]),
        Series(accel.stamps_ns, accelerations),
        where,
        unreadable=unreadable + more,
        notes=[note] if note else [],
    )


def _read(
    opened: OpenMessages, topic: MessageTopic, values_of: Callable[[Any], list[float]], width: int
) -> tuple[Series, int]:
    """The values of a topic, and how many messages have none."""
    stamps, values, unreadable = array("q"), array("d"), 0  # a tenth of lists of numbers
    for each in opened.messages(topic):
        try:
            stamp, row = capture_time(each), values_of(each.message)
        except FOREIGN:  # also those that are damaged
            unreadable += 1
            continue
        stamps.append(min(max(stamp, 0), (1 << 63) - 1))
        values.extend(row)
    rows = np.array(values, np.float64).reshape(-1, width)
    return Series(np.array(stamps, np.int64), rows), unreadable


def _gyro_and_accel(message: Any) -> list[float]:
    vectors = (message.angular_velocity, message.linear_acceleration)
    return [float(getattr(vector, axis)) for vector in vectors for axis in "xyz"]


def _fix(message: Any) -> list[float]:
    """Latitude, longitude, altitude, and sigmas east, north and up."""
    status = getattr(getattr(message, "status", None), "status", 0)
    position = [float(message.latitude), float(message.longitude), float(message.altitude)]
    if int(status) <= _NO_FIX:
        position = [float("nan")] * 3
    variances = [float(message.position_covariance[row]) for row in (0, 4, 8)]
    known = int(message.position_covariance_type) > 0
    return [*position, *(v**0.5 if known and v > 0.0 else float("nan") for v in variances)]

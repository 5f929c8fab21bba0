"""Inertial samples as text, a line a sample, whose header names the columns.

    imu0/data.csv     EuRoC and others in ASL format
    imu.csv           loggers of phones: time, gyro and accelerometer in one file

Columns are found by their names: time or timestamp; gyro, rotation rate, angular velocity or w; and
accelerometer, acceleration or a, each with x, y and z.  Units are those that the header gives in
brackets or behind the name, else those that are likely: times by the usual rates of such sensors,
accelerations by their length.  Accelerations without gravity are refused.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from math import radians
from pathlib import Path

import numpy as np

from pliant.algorithms.arrays import F64, I64
from pliant.datasets.measured.base import (
    STANDARD_GRAVITY_M_S2,
    Measurements,
    Series,
    imu_measurements,
)
from pliant.datasets.times import UNITS, likely_unit, nanoseconds, utc_ns
from pliant.errors import DatasetError
from pliant.text_files import decoded
from pliant.wording import shown

_STEP_S = 0.005
"""Usual time between two samples."""
_LOOKED_AT = 1000
_LATEST, _LARGEST = Decimal(1 << 62), 1e15
"""Larger numbers measure nothing."""
_ASL = [
    *("timestamp [ns]", "w_x [rad/s]", "w_y [rad/s]", "w_z [rad/s]"),
    *("a_x [m/s^2]", "a_y [m/s^2]", "a_z [m/s^2]"),
]
"""The columns of a table without a header."""
_NAME = re.compile(r"([^\[(]*)[\[(]?([^\])]*)[\])]?")
_AXIS = re.compile(r"(.*)([xyz])()|(.*)[_.\s-]([xyz])[_.\s-]+(.*)", re.IGNORECASE)
"""The quantity, its axis, and its unit if the column has one."""
_TIME = re.compile(r"(?:t|time|timestamp|time_?stamp|sensor_?time|seconds_elapsed)_?([nmu]?s|sec)?")
_TIME_UNITS = {
    **dict.fromkeys(("s", "sec", "seconds", "secs"), "seconds"),
    **dict.fromkeys(("ms", "msec", "milliseconds", "millis"), "milliseconds"),
    **dict.fromkeys(("us", "µs", "usec", "microseconds", "micros"), "microseconds"),
    **dict.fromkeys(("ns", "nsec", "nanoseconds", "nanos"), "nanoseconds"),
}
_GYRO = re.compile(r"w|w[_ ].*|g|gyr.*|omega.*|.*angular_?vel.*|.*rotation_?rate.*|.*gyro.*")
_ACCEL = re.compile(r"a|a[_ ].*|acc.*|.*acceleration.*|.*accelero.*|.*specific_force.*")
_OTHER = re.compile(r"gravity|motion")
_WITHOUT_GRAVITY = re.compile(r"user|linear(?!_acceleration)")
"""ROS calls linear_acceleration what others call so without gravity: taken where there is no other,
and then refused by its length."""
_ANY = re.compile(r".*")
_APPLE = re.compile(r"accelerometeracceleration")
"""Of loggers that write CoreMotion's numbers: in g, and -1 upwards at rest."""


@dataclass(frozen=True)
class _Columns:
    """Indices of columns: of the time, and of x, y and z; and what values are multiplied by."""

    time: int
    time_unit: str
    gyro: Sequence[int]
    accel: Sequence[int]
    gyro_factor: float
    accel_factor: float | None


def read_csv(file: Path) -> Measurements:
    """The samples of a table, on its own clock.  Raises DatasetError."""
    header, rows = table_of(file)
    columns = _columns(header, file)
    wanted = [*columns.gyro, *columns.accel]
    times, table, unreadable = numbers(rows, columns.time, wanted)
    if not times:
        raise DatasetError(f"{file}: no line has a time, three angular velocities and three "
                           "accelerations")  # fmt: skip
    accel, note = in_m_s2(table[:, 3:], columns.accel_factor, file)
    gyro = Series(_ns(times, columns.time_unit, file), table[:, :3] * columns.gyro_factor)
    return imu_measurements(
        gyro,
        Series(gyro.stamps_ns, accel),
        file.name,
        unreadable=unreadable,
        notes=[note] if note else [],
    )


def text_lines(file: Path) -> list[str]:
    """The lines of a text file that are not empty.  Raises DatasetError."""
    try:
        text = decoded(file.read_bytes(), "replace")
    except OSError as error:
        raise DatasetError(f"{file}: cannot be read: {error.strerror}") from None
    return [line for line in text.splitlines() if line and not line.isspace()]


def read_sensor(file: Path, *, gyro: bool) -> tuple[Series, float | None, int]:
    """Columns x, y and z of the table of one sensor; what they are multiplied by for SI units
    (None: unknown); and how many lines are unreadable.   gyro: or accelerometer.

    Raises DatasetError.
    """
    header, rows = table_of(file)
    found, (time, unit) = _triple(header, _ANY), time_column(header)
    if found is None or time < 0:
        raise DatasetError(f"{file}: no columns of time, x, y and z in its header")
    times, values, unreadable = numbers(rows, time, found[0])
    if not times:
        raise DatasetError(f"{file}: no line has a time, x, y and z")
    factor = gyro_factor(found[1]) if gyro else accel_factor(found[1], header[found[0][0]])
    return Series(_ns(times, unit, file), values), factor, unreadable


def _ns(times: Sequence[Decimal], unit: str, file: Path) -> I64:
    return np.array(stamps_of(times, unit, file), np.int64)


def table_of(file: Path) -> tuple[list[str], list[list[str]]]:
    """(names of the columns, fields of the lines); a table without a header is in ASL format.

    Raises DatasetError.
    """
    lines = [line.replace('"', "") for line in text_lines(file)]
    first = lines[0] if lines else ""
    split = next((each for each in ";\t," if first.count(each) >= 3), None)
    if split != ",":  # then commas are decimal ones
        lines = [first, *(line.replace(",", ".") for line in lines[1:])]
    if not re.search("[a-zA-Z]", first):
        return _ASL, [line.split(split) for line in lines]
    header = [name.strip() for name in first.lstrip("#% ").split(split)]
    rows = [line.split(split) for line in lines[1:] if not line.startswith("#")]
    return header, rows


def numbers(
    rows: Sequence[Sequence[str]], time: int, wanted: Sequence[int]
) -> tuple[list[Decimal], F64, int]:
    """Times and values (N, ``wanted``) of the lines that have them, and how many have not.

    A date is a time in seconds.
    """
    times, values, unreadable = list[Decimal](), list[list[float]](), 0
    for row in rows:
        try:
            at = _time(row[time])
            found = [float(row[column]) for column in wanted]
            usable = -_LATEST < at < _LATEST
        except (ArithmeticError, ValueError, IndexError):  # also of a time that is no number
            usable = False
            at, found = Decimal(0), []
        if not usable:
            unreadable += 1
            continue
        times.append(at)
        values.append(found)
    table = np.array(values, float).reshape(-1, len(wanted))
    return times, np.where(np.abs(table) < _LARGEST, table, np.nan), unreadable


def _time(text: str) -> Decimal:
    """A number as it is written, or the seconds of a date.  Raises ValueError."""
    try:
        return Decimal(text)
    except InvalidOperation:
        return Decimal(utc_ns(text)).scaleb(-9)


def stamps_of(
    times: Sequence[Decimal], known: str, file: Path, *, usual_step_s: float = _STEP_S
) -> list[int]:
    """Nanoseconds of times; those before zero count from the earliest.  Raises DatasetError."""
    earliest = min(times)
    if earliest < 0:
        times = [each - earliest for each in times]
    unit = likely_unit(times[:_LOOKED_AT], known, usual_step_s=usual_step_s)
    longest = (1 << 62) / UNITS[unit]
    return [nanoseconds(min(each, Decimal(longest)), unit, str(file)) for each in times]


def in_m_s2(accel: F64, factor: float | None, where: Path | str) -> tuple[F64, str]:
    """Accelerations (N, 3) in m/s^2, and a note.  factor: that of their unit; None: unknown.

    At rest an accelerometer measures gravity, and a camera that is held by hand, by a car or by a
    drone accelerates less than that most of the time.  Raises DatasetError if it is missing.
    """
    if not np.isfinite(accel).all(axis=1).any():
        raise DatasetError(f"{where}: none of its accelerations is a number")
    median, note = _median_length(accel), ""
    if factor is None:
        factor = likely_factor(accel)
        note = f"{where}: accelerations are taken as g, not m/s^2" if factor != 1.0 else ""
    if median * abs(factor) < 0.5 * STANDARD_GRAVITY_M_S2:
        raise DatasetError(
            f"{where}: its accelerations are without gravity (median {median * abs(factor):.2g} "
            "m/s^2), which the estimate of the scale needs: record the raw accelerometer"
        )
    return accel * factor, note


def likely_factor(accel: F64) -> float:
    """By what accelerations (N, 3) of an unknown unit are multiplied to be in m/s^2."""
    return STANDARD_GRAVITY_M_S2 if 0.5 <= _median_length(accel) <= 2.0 else 1.0


def _median_length(accel: F64) -> float:
    lengths = np.linalg.norm(accel[np.isfinite(accel).all(axis=1)], axis=1)
    return float(np.median(lengths)) if len(lengths) else 0.0


def _columns(header: Sequence[str], file: Path) -> _Columns:
    """Raises DatasetError if one is missing."""
    gyro, accel = _triple(header, _GYRO), _triple(header, _ACCEL)
    time, unit = time_column(header)
    what = [
        name
        for name, found in (("time", time >= 0), ("gyro", gyro), ("accelerometer", accel))
        if not found
    ]
    if what:
        raise DatasetError(
            f"{file}: no columns of {' and '.join(what)} in its header {shown(','.join(header))}; "
            "name them time, gyro_x, gyro_y, gyro_z, accel_x, accel_y and accel_z"
        )
    assert gyro is not None
    assert accel is not None
    return _Columns(
        time=time,
        time_unit=unit,
        gyro=gyro[0],
        accel=accel[0],
        gyro_factor=gyro_factor(gyro[1]),
        accel_factor=accel_factor(accel[1], header[accel[0][0]]),
    )


def gyro_factor(unit: str) -> float:
    """The factor from a unit of angular velocity to rad/s."""
    return radians(1.0) if re.search("deg|°|dps", unit) else 1.0


def accel_factor(unit: str, name: str) -> float | None:
    """The factor from a unit of acceleration to m/s^2; None without a unit."""
    if _APPLE.match(name.lower()):
        return -STANDARD_GRAVITY_M_S2
    if unit in ("g", "gs", "g-force"):
        return STANDARD_GRAVITY_M_S2
    return 1.0 if re.match("m *[/ _]? *s|m.s", unit) else None


def time_column(header: Sequence[str]) -> tuple[int, str]:
    """Index of the column of times, and its unit ("" unknown); -1 where there is none."""
    names = [name.strip().lower() for name in header]
    parts = [_NAME.fullmatch(name) for name in names]
    for column, part in enumerate(parts):
        match = _TIME.fullmatch(part.group(1).strip()) if part else None
        if part is not None and match is not None:
            unit = _TIME_UNITS.get(part.group(2).strip() or match.group(1) or "", "")
            return column, "seconds" if names[column] == "seconds_elapsed" else unit
    for column, part in enumerate(parts):
        if part is not None and "timestamp" in names[column]:
            return column, _TIME_UNITS.get(part.group(2).strip(), "")
    return -1, ""


def _triple(header: Sequence[str], pattern: re.Pattern[str]) -> tuple[list[int], str] | None:
    """Columns of x, y and z of the first name that fits, and the unit that the header gives."""
    found: dict[str, dict[str, int]] = {}
    units: dict[str, str] = {}
    for column, name in enumerate(header):
        parts = _NAME.fullmatch(name.strip())
        axis = _AXIS.fullmatch(parts.group(1).strip()) if parts else None
        if parts is None or axis is None:
            continue
        stem, letter, unit = (each for each in axis.groups() if each is not None)
        stem = stem.lower().rstrip("_. -")
        if not pattern.fullmatch(stem) or _OTHER.search(stem):
            continue
        found.setdefault(stem, {}).setdefault(letter.lower(), column)
        units.setdefault(stem, (parts.group(2) or unit).strip().lower())
    for stem in sorted(found, key=lambda stem: _WITHOUT_GRAVITY.search(stem) is not None):
        axes = found[stem]
        if len(axes) == 3:
            return [axes[axis] for axis in "xyz"], units[stem]
    return None

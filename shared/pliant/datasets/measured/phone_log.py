"""Folders of phone loggers, with a table for each sensor, such as Sensor Logger and phyphox write.

Gyroscope.csv            time, x, y, z: rad/s
TotalAcceleration.csv    with gravity; or Accelerometer.csv, if that has it
Gravity.csv              added to an Accelerometer.csv without
Location.csv             optional: latitude, longitude, altitude, and their accuracies
"""

import re
from pathlib import Path

import numpy as np

from pliant.algorithms.arrays import F64
from pliant.datasets.measured.base import (
    STANDARD_GRAVITY_M_S2,
    Measurements,
    Series,
    imu_measurements,
)
from pliant.datasets.measured.csv_log import in_m_s2, read_sensor
from pliant.datasets.measured.fix_files import read_fix_table
from pliant.errors import DatasetError

_GYRO = r"gyro(scope|meter)?(uncalibrated)?"
_TOTAL = r"total_?acceleration|acceleration"
_LEAST_M_S2 = 0.5 * STANDARD_GRAVITY_M_S2
_ACCEL = r"accelerometer(uncalibrated)?"


def is_phone_log(folder: Path) -> bool:
    """Whether it has the table of a gyro."""
    return folder.is_dir() and _table(folder, _GYRO) is not None


def read_phone_log(folder: Path) -> Measurements:
    """The samples and fixes in a folder, on its own clock.  Raises DatasetError."""
    gyro = _table(folder, _GYRO)
    total, accel = _table(folder, _TOTAL), _table(folder, _ACCEL)
    file = total or accel
    if gyro is None or file is None:
        raise DatasetError(f"{folder}: needs Gyroscope.csv, and TotalAcceleration.csv or "
                           "Accelerometer.csv")  # fmt: skip
    turning, rate, bad = read_sensor(gyro, gyro=True)
    measured, factor, more = read_sensor(file, gyro=False)
    values = measured.values
    gravity = None if total is not None else _table(folder, "gravity")
    if gravity is not None and _median(values) * (factor or 1.0) < _LEAST_M_S2:
        values = values + _at(measured, read_sensor(gravity, gyro=False)[0].in_order())
    values, note = in_m_s2(values, factor, file)
    found = imu_measurements(
        Series(turning.stamps_ns, turning.values * (rate or 1.0)),
        Series(measured.stamps_ns, values),
        folder.name,
        unreadable=bad + more,
        notes=[note] if note else [],
    )
    location = _table(folder, "location")
    return found if location is None else found.and_those_of(read_fix_table(location))


def _median(values: F64) -> float:
    lengths = np.linalg.norm(values[np.isfinite(values).all(axis=1)], axis=1)
    return float(np.median(lengths)) if len(lengths) else 0.0


def _at(measured: Series, gravity: Series) -> F64:
    """Gravity at the times of another sensor."""
    if not len(gravity):
        return np.zeros_like(measured.values)
    columns = [np.interp(measured.stamps_ns, gravity.stamps_ns, c) for c in gravity.values.T]
    return np.stack(columns, axis=1)


def _table(folder: Path, pattern: str) -> Path | None:
    """The first file with a name, ignoring case and spaces."""
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() == ".csv" and path.is_file():
            name = re.sub(r"[\s-]", "", path.stem.lower())
            if re.fullmatch(pattern, name):
                return path
    return None

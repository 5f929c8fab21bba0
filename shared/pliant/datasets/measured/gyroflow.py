"""Logs of Gyroflow (.gcsv): a header of "key,value" lines, then a table of integers.

The format is that of docs.gyroflow.xyz, "gcsv": ``t`` times ``tscale`` are seconds from the first
frame, ``gx gy gz`` times ``gscale`` radians a second, ``ax ay az`` times ``ascale`` are in g.
``orientation`` names the axes of the three columns.
"""

from pathlib import Path

import numpy as np

from pliant.datasets.measured.axes import axis_order
from pliant.datasets.measured.base import (
    STANDARD_GRAVITY_M_S2,
    Measurements,
    Series,
    imu_measurements,
)
from pliant.datasets.measured.csv_log import in_m_s2, numbers, text_lines
from pliant.errors import DatasetError

_BEGINNINGS = ("GYROFLOW IMU LOG", "CAMERA IMU LOG")
_LARGEST = 1e6
"""Scales turn integers into units of a sensor."""
_COLUMNS = ("t", "gx", "gy", "gz", "ax", "ay", "az")


def read_gcsv(file: Path) -> Measurements:
    """The samples of a log, from the first frame on.  Raises DatasetError."""
    lines = text_lines(file)
    if not lines or not lines[0].startswith(_BEGINNINGS):
        raise DatasetError(f"{file}: is no Gyroflow log: its first line is not {_BEGINNINGS[0]}")
    rows = [line.split(",") for line in lines]
    begin = next((row for row, line in enumerate(rows) if line[0].strip() == "t"), len(rows))
    header = [name.strip() for name in rows[begin]] if begin < len(rows) else []
    missing = [name for name in _COLUMNS if name not in header]
    if missing:
        raise DatasetError(f"{file}: without the columns {', '.join(missing)}")
    settings = {row[0].strip(): row[1].strip() for row in rows[1:begin] if len(row) > 1}
    scales = [_scale(settings, key, file) for key in ("tscale", "gscale", "ascale")]
    wanted = [header.index(name) for name in _COLUMNS[1:]]
    times, table, unreadable = numbers(rows[begin + 1 :], header.index("t"), wanted)
    stamps = np.clip(np.array(times, float) * scales[0] * 1e9, -(2.0**62), 2.0**62)
    turn = axis_order(settings.get("orientation", "XYZ")).T
    gyro = Series(np.rint(stamps).astype(np.int64), table[:, :3] @ turn * scales[1])
    accel, _ = in_m_s2(table[:, 3:] @ turn, scales[2] * STANDARD_GRAVITY_M_S2, file)
    return imu_measurements(gyro, Series(gyro.stamps_ns, accel), file.name, unreadable=unreadable)


def _scale(settings: dict[str, str], key: str, file: Path) -> float:
    try:
        scale = float(settings.get(key, "1"))
    except ValueError:
        scale = 0.0
    if not 0.0 < scale < _LARGEST:
        raise DatasetError(f"{file}: {key} is no positive number below {_LARGEST:g}")
    return scale

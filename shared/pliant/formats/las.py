"""Points on the Earth as LAS 1.4 (ASPRS), in the UTM zone where they lie."""

from datetime import UTC, date, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

from pliant.algorithms.arrays import F64, U8
from pliant.errors import ResultError
from pliant.version import __version__

_UNIT_M = 1e-3
"""Coordinates are whole numbers of it."""
_POINT_FORMAT = 7
"""With colours, and with the coordinate system as text."""
_ZONE_DEG = 6.0


def load_las() -> tuple[Any, Any]:
    """laspy and pyproj.  Raises ResultError where one is missing."""
    try:
        import laspy
        import pyproj
    except ImportError:
        raise ResultError(
            "LAS needs laspy and pyproj, which are not installed: pip install 'pliant[earth]'"
        ) from None
    return laspy, pyproj


def write_las(
    path: Path, *, latitude_deg: F64, longitude_deg: F64, altitude_m: F64, colours: U8,
    stamp_ns: int,
) -> None:  # fmt: skip
    """Write (N,) positions in WGS84 with (N, 3) RGB colours; N is at least 1.

    stamp_ns: the date of the file, since 1970.  Raises ResultError where the disk fails, or where
    laspy or pyproj is missing.
    """
    laspy, pyproj = load_las()
    middle = np.angle(np.mean(np.exp(1j * np.radians(longitude_deg))), deg=True)
    system = pyproj.CRS.from_epsg(utm_epsg(float(np.mean(latitude_deg)), float(middle)))
    to_utm = pyproj.Transformer.from_crs(4326, system, always_xy=True)
    east, north = to_utm.transform(longitude_deg, latitude_deg)
    header = laspy.LasHeader(version="1.4", point_format=_POINT_FORMAT)
    header.add_crs(system)
    header.creation_date = _date(stamp_ns)
    header.generating_software = f"Pliant {__version__}"
    header.scales = np.full(3, _UNIT_M)
    header.offsets = np.floor([np.min(east), np.min(north), np.min(altitude_m)])
    points = laspy.LasData(header)
    try:
        points.x, points.y, points.z = east, north, altitude_m
    except OverflowError:
        raise ResultError(
            f"{path}: points are too far apart for LAS: crop them with --crop"
        ) from None
    wide = colours.astype(np.uint16) * np.uint16(257)  # 0 to 65535, as the format has them
    points.red, points.green, points.blue = wide.T
    try:
        points.write(path)
    except OSError as error:
        raise ResultError(f"{path}: cannot be written ({error.strerror})") from None


def utm_epsg(latitude_deg: float, longitude_deg: float) -> int:
    """The EPSG number of the UTM zone of a place, WGS84."""
    zone = int((longitude_deg + 180.0) % 360.0 // _ZONE_DEG) + 1
    return (32600 if latitude_deg >= 0.0 else 32700) + zone


def _date(stamp_ns: int) -> date:
    return (datetime(1970, 1, 1, tzinfo=UTC) + timedelta(microseconds=stamp_ns // 1000)).date()

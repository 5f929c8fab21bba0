"""Satellite fixes in files: GPX, the subtitles of DJI's drones, and tables.

.gpx    track points with a time; on the clock of UTC
.srt    a subtitle for each frame or second: [latitude: ...] [longitude: ...] [abs_alt: ...], or
        GPS (longitude, latitude, altitude); in the time of the video
.csv    columns latitude, longitude and altitude, and a time; horizontalAccuracy and
        verticalAccuracy where they are there
"""

import re
from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from pliant.datasets.measured.base import NOTHING, Measurements, Series, gps_measurements
from pliant.datasets.measured.csv_log import numbers, stamps_of, table_of, text_lines, time_column
from pliant.datasets.times import utc_ns
from pliant.errors import DatasetError

_NAN = float("nan")
_STEP_S = 1.0
"""Usual time between two fixes."""
_NUMBER = r"\s*[:=]?\s*(-?\d+(?:\.\d+)?)"
_RADIUS = 1.51
"""Standard deviations within which 68 % of the fixes in a plane lie: what phones give."""
_CUE = re.compile(r"(\d{1,4}):(\d\d):(\d\d)[,.](\d{1,3})\s*-->")
_LATITUDE = re.compile(rf"latitude{_NUMBER}", re.IGNORECASE)
_LONGITUDE = re.compile(rf"longt?itude{_NUMBER}", re.IGNORECASE)
_ALTITUDES = [re.compile(rf"{name}{_NUMBER}") for name in ("abs_alt", "altitude", "rel_alt")]
_PLACE = re.compile(rf"GPS\s*\({_NUMBER}\s*,{_NUMBER}\s*,{_NUMBER}")
_NAMES = {
    "latitude": ("latitude", "lat", "locationlatitude"),
    "longitude": ("longitude", "lon", "lng", "long", "locationlongitude"),
    "altitude": ("altitude", "alt", "ele", "elevation", "height", "locationaltitude"),
    "horizontal": ("horizontalaccuracy", "locationhorizontalaccuracy", "accuracy"),
    "vertical": ("verticalaccuracy", "locationverticalaccuracy"),
}


def read_gpx(file: Path) -> Measurements:
    """The track points of a file that have a time.  Raises DatasetError."""
    text = "\n".join(text_lines(file))
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise DatasetError(f"{file}: has a document type, which GPX has not")
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError) as error:
        raise DatasetError(f"{file}: is not XML ({error}); export the track again") from None
    stamps, values, unreadable = list[int](), list[list[float]](), 0
    for point in root.iter():
        if point.tag.rpartition("}")[2] not in ("trkpt", "wpt"):
            continue
        inside = {child.tag.rpartition("}")[2]: child.text or "" for child in point}
        try:
            stamps.append(utc_ns(inside["time"]))
            position = [float(point.attrib[name]) for name in ("lat", "lon")]
            values.append([*position, float(inside.get("ele", "nan")), _NAN, _NAN, _NAN])
        except (KeyError, ValueError, OverflowError):
            del stamps[len(values) :]
            unreadable += 1
    return _fixes(stamps, values, file, unreadable)


def read_srt(file: Path) -> Measurements:
    """The fixes in the subtitles of a video, each once; nothing in those of other cameras.

    Raises DatasetError if it cannot be read.
    """
    stamps, values, stamp = list[int](), list[list[float]](), -1
    before: list[float] = []
    for block in re.split(
        r"(?=^\d+:\d\d:\d\d[,.]\d+\s*-->)", "\n".join(text_lines(file)), flags=re.M
    ):
        cue = _CUE.match(block)
        if cue is None:
            continue
        hours, minutes, seconds, fraction = cue.groups()
        stamp = (int(hours) * 3600 + int(minutes) * 60 + int(seconds)) * 10**9
        stamp += int(fraction.ljust(3, "0")) * 10**6
        position = _position(block)
        if position and position != before:  # a receiver is slower than a camera
            before = position
            stamps.append(stamp)
            values.append([*position, _NAN, _NAN, _NAN])
    return _fixes(stamps, values, file, 0) if values else NOTHING


def read_fix_table(file: Path) -> Measurements:
    """The fixes of a table, on its own clock.  Raises DatasetError."""
    header, rows = table_of(file)
    names = [re.sub(r"[\[(].*|[^a-z]", "", name.lower()) for name in header]
    columns = {
        key: next((names.index(name) for name in known if name in names), -1)
        for key, known in _NAMES.items()
    }
    time, unit = time_column(header)
    missing = [key for key in ("latitude", "longitude") if columns[key] < 0]
    missing += ["time"] if time < 0 else []
    if missing:
        raise DatasetError(f"{file}: no columns of {' and '.join(missing)} in its header")
    wanted = [key for key in _NAMES if columns[key] >= 0]
    times, read, unreadable = numbers(rows, time, [columns[key] for key in wanted])
    if not times:
        raise DatasetError(f"{file}: no line has a time and a position")
    found = dict(zip(wanted, read.T, strict=True))
    unknown = np.full(len(times), np.nan)
    across = found.get("horizontal", unknown) / _RADIUS
    parts = [found[key] for key in ("latitude", "longitude")]
    parts += [found.get("altitude", unknown), across, across, found.get("vertical", unknown)]
    values = np.array(parts).T.tolist()
    return _fixes(stamps_of(times, unit, file, usual_step_s=_STEP_S), values, file, unreadable)


def _fixes(
    stamps_ns: Sequence[int], values: Sequence[Sequence[float]], file: Path, unreadable: int
) -> Measurements:
    if not values:
        raise DatasetError(f"{file}: has no position with a time")
    series = Series(np.array(stamps_ns, np.int64), np.array(values, float).reshape(-1, 6))
    return gps_measurements(series, file.name, unreadable=unreadable)


def _position(text: str) -> list[float]:
    """Latitude, longitude and altitude; [] without."""
    latitude, longitude = _LATITUDE.search(text), _LONGITUDE.search(text)
    if latitude and longitude:
        altitude = next((m for each in _ALTITUDES if (m := each.search(text))), None)
        last = float(altitude.group(1)) if altitude else _NAN
        return [float(latitude.group(1)), float(longitude.group(1)), last]
    place = _PLACE.search(text)
    if place is None:
        return []
    return [float(place.group(2)), float(place.group(1)), float(place.group(3))]

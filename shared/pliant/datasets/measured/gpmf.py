"""GoPro's metadata format (GPMF): a tree of keys, types and values in a track of the video.

The format is open (github.com/gopro/gpmf-parser, README): an entry is a key of four letters, a
letter for the type, the size of a structure, how many there are, and their bytes, padded to a
multiple of four; type 0 holds entries.  A payload, about a second, has for each device (DEVC) its
streams (STRM), each with entries that describe it (SCAL, ORIN, TSMP, ...) before its samples.

A payload that ends early gives what came before its end, and memory is that of the payload.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from pliant.algorithms.arrays import F64
from pliant.datasets.measured.axes import axis_order
from pliant.datasets.measured.base import (
    NOTHING,
    Measurements,
    Series,
    gps_measurements,
    imu_measurements,
)

_HEAD = 8
_INTEGERS = {"b": "i1", "B": "u1", "s": ">i2", "S": ">u2", "l": ">i4", "L": ">u4", "j": ">i8"}
_TYPES = {**_INTEGERS, "J": ">u8", "f": ">f4", "d": ">f8", "q": ">i4", "Q": ">i8"}
"""Types of numbers as numpy names them."""
_FIXED_POINT = {"q": 2.0**-16, "Q": 2.0**-32}
_DEFAULT_ORDER = "ZXY"
"""Order of axes of cameras whose stream lacks it: HERO5 and later."""
_FIX_3D = 3
_LEAST_PAYLOADS = 4
"""Minimum payloads for a straight line through their times."""


@dataclass(frozen=True)
class Payload:
    """The metadata of a piece of a video.  begin_ns, end_ns: its time."""

    data: bytes
    begin_ns: int
    end_ns: int


@dataclass
class _Stream:
    """The samples of one key of one device over all payloads.

    first: per payload, number of its first sample, counted by the camera.    begin_ns: its time.
    """

    values: list[F64] = field(default_factory=list[F64])
    first: list[int] = field(default_factory=list[int])
    begin_ns: list[int] = field(default_factory=list[int])
    end_ns: list[int] = field(default_factory=list[int])
    stamp_us: list[int] = field(default_factory=list[int])
    axes: F64 = field(default_factory=lambda: axis_order(_DEFAULT_ORDER))

    def add(self, values: F64, payload: Payload, about: "Mapping[str, Entry]") -> None:
        counted = about["TSMP"].numbers() if "TSMP" in about else np.empty(0)
        begun = about["STMP"].numbers() if "STMP" in about else np.empty(0)
        follows = self.first[-1] + len(self.values[-1]) if self.first else 0
        # TSMP is the number of samples until the end of this payload.
        first = int(counted.flat[0]) - len(values) if counted.size else follows
        self.first.append(first if follows <= first < follows + (1 << 24) else follows)
        self.values.append(values)
        self.begin_ns.append(payload.begin_ns)
        self.end_ns.append(payload.end_ns)
        self.stamp_us += [int(begun.flat[0])] if begun.size else []
        if "ORIN" in about:
            self.axes = axis_order(about["ORIN"].text())
        elif "MTRX" in about and about["MTRX"].numbers().size == 9:
            turn = about["MTRX"].numbers().reshape(3, 3)
            self.axes = axis_order(about["ORIO"].text() if "ORIO" in about else "XYZ") @ turn


@dataclass(frozen=True)
class Entry:
    """An entry of the tree.   kind: letter of its type.   size: bytes of a structure."""

    key: str
    kind: str
    size: int
    data: bytes

    def text(self) -> str:
        """As characters."""
        return self.data.split(b"\0")[0].decode("latin-1")

    def numbers(self, kinds: str = "") -> F64:
        """(structures, numbers in each); (0, 0) where it holds something else.

        kinds: the letters of a structure of type "?", from its TYPE.
        """
        kinds = kinds if self.kind == "?" else self.kind * self._each()
        sizes = [np.dtype(_TYPES[kind]).itemsize if kind in _TYPES else 0 for kind in kinds]
        if not sizes or 0 in sizes or sum(sizes) != self.size:
            return np.empty((0, 0))
        layout = np.dtype([(f"{row}", _TYPES[kind]) for row, kind in enumerate(kinds)])
        rows = np.frombuffer(self.data, layout, len(self.data) // self.size)
        columns = [rows[f"{n}"] * _FIXED_POINT.get(kind, 1.0) for n, kind in enumerate(kinds)]
        return np.stack(columns, axis=1).astype(float)

    def _each(self) -> int:
        return self.size // np.dtype(_TYPES[self.kind]).itemsize if self.kind in _TYPES else 0


def entries(data: bytes) -> Iterator[Entry]:
    """The entries of a level, as far as they are whole."""
    at = 0
    while at + _HEAD <= len(data):
        size, count = data[at + 5], int.from_bytes(data[at + 6 : at + 8])
        end = at + _HEAD + size * count
        if end > len(data):
            return
        kind = "" if data[at + 4] == 0 else chr(data[at + 4])
        yield Entry(data[at : at + 4].decode("latin-1"), kind, size, data[at + _HEAD : end])
        at = _HEAD + at + (size * count + 3) // 4 * 4


def read_gpmf(payloads: Sequence[Payload], where: str) -> Measurements:
    """The samples of a camera, in the time of its payloads.   where: what they are from."""
    streams: dict[tuple[int, str], _Stream] = {}
    for payload in payloads:
        devices = (entry for entry in entries(payload.data) if entry.key == "DEVC")
        for number, device in enumerate(devices):
            for stream in entries(device.data):
                if stream.key == "STRM" and stream.kind == "":
                    _take(streams, number, stream.data, payload)
    found = NOTHING
    for device in sorted({number for number, _ in streams}):
        gyro, accel = streams.get((device, "GYRO")), streams.get((device, "ACCL"))
        origin_us = gyro.stamp_us[0] if gyro is not None and gyro.stamp_us else None
        if gyro is not None and accel is not None and not found.imu_notes:
            imu = imu_measurements(
                _turned(_series(gyro, origin_us), gyro.axes),
                _turned(_series(accel, origin_us), accel.axes),
                where,
            )
            found = found.and_those_of(imu)
        fixes = streams.get((device, "GPS9")) or streams.get((device, "GPS5"))
        if fixes is not None and not found.gps_notes:
            found = found.and_those_of(gps_measurements(_series(fixes, origin_us), where))
    return found


def _turned(series: Series, axes: F64) -> Series:
    return Series(series.stamps_ns, series.values @ axes.T)


def _take(
    streams: dict[tuple[int, str], _Stream], device: int, data: bytes, payload: Payload
) -> None:
    """Take in a stream of a payload."""
    about: dict[str, Entry] = {}
    for entry in entries(data):
        if entry.key not in _READERS:
            about[entry.key] = entry
            continue
        values = _scaled(entry, about)
        values = _READERS[entry.key](values, about) if values.size else values
        if values.size:
            streams.setdefault((device, entry.key), _Stream()).add(values, payload, about)


def _scaled(entry: Entry, about: Mapping[str, Entry]) -> F64:
    """Numbers in the units of the stream."""
    kinds = about["TYPE"].text() if "TYPE" in about else ""
    values = entry.numbers(kinds)
    scale = about["SCAL"].numbers().reshape(-1) if "SCAL" in about else np.ones(1)
    if len(scale) not in (1, values.shape[1]) or np.any(scale == 0.0):
        return np.empty((0, 0))
    return values / scale


def _three(values: F64, _about: Mapping[str, Entry]) -> F64:
    return values if values.shape[1] == 3 else np.empty((0, 0))


def _gps5(values: F64, about: Mapping[str, Entry]) -> F64:
    """Latitude, longitude, altitude, two speeds; the kind of fix holds for the whole payload."""
    fix = about["GPSF"].numbers() if "GPSF" in about else np.empty(0)
    if values.shape[1] != 5 or (fix.size and int(fix.flat[0]) < _FIX_3D):
        return np.empty((0, 0))
    return _without_sigma(values)


def _gps9(values: F64, _about: Mapping[str, Entry]) -> F64:
    """As GPS5, then days, seconds, dilution of precision, and the kind of fix."""
    if values.shape[1] != 9:
        return np.empty((0, 0))
    values[values[:, 8] < _FIX_3D] = np.nan
    return _without_sigma(values)


def _without_sigma(values: F64) -> F64:
    """Precision is given as a dilution, whose unit the format does not name."""
    return np.concatenate([values[:, :3], np.full((len(values), 3), np.nan)], axis=1)


_READERS = {"GYRO": _three, "ACCL": _three, "GPS5": _gps5, "GPS9": _gps9}


def _series(stream: _Stream, origin_us: int | None) -> Series:
    """Samples with their times.

    A payload has what was measured by its end, so its number of samples jitters while the sensor's
    clock does not.  So times are a straight line through the beginnings of all payloads over the
    numbers of their first samples.  The first payload begins with the sensor, and not where another
    one ends: it is left out.  The camera's own times (STMP, microseconds) are 500 times as exact
    where it gives them.   origin_us: which of these is the beginning of the first payload.
    """
    counts = np.array([len(values) for values in stream.values])
    first = np.array(stream.first, float)
    begin = np.array(stream.begin_ns, float)
    used = slice(1 if len(first) > _LEAST_PAYLOADS else 0, None)
    if origin_us is not None and len(stream.stamp_us) == len(first):
        begin = begin[0] + 1e3 * (np.array(stream.stamp_us, float) - origin_us)
        used = slice(0, None)
    within = np.concatenate([np.arange(count, dtype=float) for count in counts])
    numbers = np.repeat(first, counts) + within
    length = float(stream.end_ns[-1] - stream.begin_ns[-1])
    if len(first) >= _LEAST_PAYLOADS:
        rate, start = np.polyfit(first[used] - first[0], begin[used] - begin[0], 1)
        off = np.abs(begin - begin[0] - start - rate * (first - first[0]))
        if rate > 0.0 and off.max() < 0.5 * length:
            times = begin[0] + start + rate * (numbers - first[0])
            return Series(np.rint(times).astype(np.int64), np.concatenate(stream.values))
    # A pause, or hardly more than one payload: each by itself.
    steps = np.append(np.diff(begin), length) / counts
    times = np.repeat(begin, counts) + within * np.repeat(steps, counts)
    return Series(np.rint(times).astype(np.int64), np.concatenate(stream.values))

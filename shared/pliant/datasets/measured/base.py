"""Measurements of a source besides its images, put in order.

Sensors are not synchronised, and their files are not perfect.  So a sample whose time is doubled,
set back or far ahead, or that is no number, costs that sample alone, and is counted.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol, runtime_checkable

import numpy as np

from pliant.algorithms.arrays import F64, I64, BoolArray
from pliant.algorithms.inertial.samples import GpsFixes, ImuSamples
from pliant.datasets.frame_times import increasing
from pliant.wording import counted

STANDARD_GRAVITY_M_S2 = 9.80665
_LONGEST_GAP = 8.0
"""Median steps of the accelerometer: across a longer gap nothing is interpolated."""
_MOST_NS = 1 << 62
"""Later ones are none: year 2116."""


@dataclass(frozen=True, kw_only=True)
class Measurements:
    """Samples of other sensors of a source, on the clock of its images.

    imu_notes, gps_notes: what a user should know of each, in lines.
    """

    imu: ImuSamples = field(default_factory=ImuSamples.empty)
    gps: GpsFixes = field(default_factory=GpsFixes.empty)
    imu_notes: tuple[str, ...] = ()
    gps_notes: tuple[str, ...] = ()

    @property
    def notes(self) -> tuple[str, ...]:
        """All of them."""
        return (*self.imu_notes, *self.gps_notes)

    def without_imu(self) -> "Measurements":
        """The fixes alone."""
        return Measurements(gps=self.gps, gps_notes=self.gps_notes)

    def without_gps(self) -> "Measurements":
        """The inertial samples alone."""
        return Measurements(imu=self.imu, imu_notes=self.imu_notes)

    def and_those_of(self, other: "Measurements") -> "Measurements":
        """These, and of sensors that are missing here those of another."""
        imu, gps = self, self
        if not len(self.imu.stamps_ns):
            imu = replace(other, imu_notes=(*self.imu_notes, *other.imu_notes))
        if not len(self.gps.stamps_ns):
            gps = replace(other, gps_notes=(*self.gps_notes, *other.gps_notes))
        return replace(imu, gps=gps.gps, gps_notes=gps.gps_notes)

    def later(self, ns: int) -> "Measurements":
        """The same, later by that many nanoseconds."""
        return replace(
            self,
            imu=replace(self.imu, stamps_ns=self.imu.stamps_ns + ns),
            gps=replace(self.gps, stamps_ns=self.gps.stamps_ns + ns),
        )


NOTHING = Measurements()


@runtime_checkable
class HearsSensors(Protocol):
    """A live source that hears other sensors while its images come.

    has_imu: whether inertial samples are among what it may hear.
    """

    has_imu: bool

    def next_imu(self) -> ImuSamples:
        """The inertial samples since the last call, on the clock of the images.

        They are at most as many as a message has; the next call has the rest.
        """
        ...

    def heard(self) -> Measurements:
        """All other measurements so far, on the clock of the images."""
        ...


@dataclass(frozen=True)
class Series:
    """Samples of one sensor as they came.  stamps_ns: (N,), in any order.   values: (N, D)."""

    stamps_ns: I64
    values: F64

    @staticmethod
    def of(stamps_ns: Sequence[int], values: Sequence[Sequence[float]], width: int = 3) -> "Series":
        """From lists."""
        return Series(np.array(stamps_ns, np.int64), np.array(values, float).reshape(-1, width))

    def and_then(self, later: "Series") -> "Series":
        """These, and then others."""
        stamps_ns = np.concatenate([self.stamps_ns, later.stamps_ns])
        return Series(stamps_ns, np.concatenate([self.values, later.values]))

    def columns(self, first: int, end: int) -> "Series":
        """Some of the values."""
        return Series(self.stamps_ns, self.values[:, first:end])

    def rows(self, chosen: BoolArray) -> "Series":
        """Some of the samples."""
        return Series(self.stamps_ns[chosen], self.values[chosen])

    def in_order(self, *, needed: int | None = None) -> "Series":
        """Those whose time increases, and whose first ``needed`` values (None: all) are numbers."""
        numbers = np.isfinite(self.values[:, :needed]).all(axis=1)
        rows = np.flatnonzero(numbers & (np.abs(self.stamps_ns) < _MOST_NS))
        if np.any(np.diff(self.stamps_ns[rows]) <= 0):
            rows = rows[increasing(self.stamps_ns[rows].tolist())]
        return Series(self.stamps_ns[rows], self.values[rows])

    def __len__(self) -> int:
        return len(self.stamps_ns)


def imu_measurements(
    gyro: Series, accel: Series, where: str, *, unreadable: int = 0, notes: Sequence[str] = ()
) -> Measurements:
    """Samples at the times of the gyro, with the accelerometer's interpolated linearly.

    gyro: rad/s.   accel: m/s^2, at times of its own.   where: what they are from, for people.
    unreadable: samples that are missing already.
    """
    ordered, other = gyro.in_order(), accel.in_order()
    wrong = unreadable + max(len(gyro) - len(ordered), len(accel) - len(other))
    rows = _within(ordered.stamps_ns, other.stamps_ns)
    samples = ImuSamples.empty()
    if len(rows):
        stamps = ordered.stamps_ns[rows]
        between = [np.interp(stamps, other.stamps_ns, column) for column in other.values.T]
        samples = ImuSamples(
            stamps_ns=stamps,
            gyro_rad_s=ordered.values[rows],
            accel_m_s2=np.stack(between, axis=1),
        )
    alone = len(ordered) - len(rows)
    note = _summary(samples, where) + _left_out(wrong)
    note += f"; {alone} without an accelerometer sample near left out" if alone else ""
    return Measurements(imu=samples, imu_notes=(note, *notes))


def gps_measurements(fixes: Series, where: str, *, unreadable: int = 0) -> Measurements:
    """Fixes of rows: latitude and longitude in degrees, altitude, and sigma east, north and up in
    metres, NaN where unknown.   where: what they are from.   unreadable: rows missing already.

    An unknown altitude is 0, with an infinite sigma.
    """
    ordered = fixes.in_order(needed=2)
    latitude, longitude = ordered.values[:, 0], ordered.values[:, 1]
    rows = (np.abs(latitude) <= 90.0) & (np.abs(longitude) <= 180.0)
    rows &= (latitude != 0.0) | (longitude != 0.0)  # what receivers write without a fix
    values = ordered.values[rows]
    flat = ~np.isfinite(values[:, 2])
    sigma = np.where(values[:, 3:] > 0.0, values[:, 3:], np.nan)
    sigma[flat, 2] = np.inf
    found = GpsFixes(
        stamps_ns=ordered.stamps_ns[rows],
        latitude_deg=values[:, 0].copy(),
        longitude_deg=values[:, 1].copy(),
        altitude_m=np.where(flat, 0.0, values[:, 2]),
        sigma_m=sigma,
    )
    wrong = len(fixes) + unreadable - len(found.stamps_ns)
    note = f"{where}: satellite fixes: {len(found.stamps_ns)}"
    return Measurements(gps=found, gps_notes=(f"{note}{_left_out(wrong)}",))


def _within(stamps_ns: I64, others_ns: I64) -> I64:
    """Rows of stamps that lie between two others that are near, or at most a step outside."""
    if len(others_ns) < 2:
        return np.empty(0, np.int64)
    step = float(np.median(np.diff(others_ns)))
    after = np.clip(np.searchsorted(others_ns, stamps_ns), 1, len(others_ns) - 1)
    gaps = others_ns[after] - others_ns[after - 1]
    inside = (stamps_ns >= others_ns[0] - step) & (stamps_ns <= others_ns[-1] + step)
    near = np.minimum(
        np.abs(stamps_ns - others_ns[after]), np.abs(stamps_ns - others_ns[after - 1])
    )
    return np.flatnonzero(inside & ((gaps <= _LONGEST_GAP * step) | (near <= step)))


def _summary(samples: ImuSamples, where: str) -> str:
    stamps = samples.stamps_ns
    if len(stamps) < 2:
        return f"{where}: no inertial samples with gyro and accelerometer at one time"
    rate = 1e9 / float(np.median(np.diff(stamps)))
    return f"{where}: {len(stamps)} inertial samples, {rate:.3g} Hz"


def _left_out(wrong: int) -> str:
    if wrong == 0:
        return ""
    return f"; {counted(wrong, 'damaged one')} (no number, or time not increasing) left out"

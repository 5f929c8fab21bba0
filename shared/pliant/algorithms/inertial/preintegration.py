"""Preintegration of inertial samples between two times (Forster et al. 2017).

Forster, Carlone, Dellaert, Scaramuzza: On-Manifold Preintegration for Real-Time Visual-Inertial
Odometry, IEEE T-RO 33(1), 2017.  Their equations are quoted as (F-n).

The samples between times ``a`` and ``b`` are summed once to the motion of the sensor, independent
of its pose, its velocity and gravity (F-33)::

    rotation  = R_a^T R_b
    velocity  = R_a^T (v_b - v_a - g (b - a))
    position  = R_a^T (p_b - p_a - v_a (b - a) - g (b - a)^2 / 2)

Between samples the measurements are linear in time; each step takes those of its middle, which
leaves an error of the third order in its length.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from pliant.algorithms.arrays import F64, I64, BoolArray, Shape
from pliant.algorithms.geometry import hat, so3_exp

_SHORTEST_S = 1e-9
"""A stamp: shorter steps have no length."""


@dataclass(frozen=True, kw_only=True)
class GyroSignal:
    """Angular velocities with their times as numbers.

    times_s: (N,) ascending, of the sensor's clock.  gyro: (N, 3) rad/s.
    """

    times_s: F64
    gyro: F64

    def rates(self, times_s: F64) -> F64:
        """Angular velocity (..., 3) at times (...), interpolated."""
        before, part = self._places(times_s)
        return (1.0 - part) * self.gyro[before] + part * self.gyro[before + 1]

    def between(self, start_s: float, end_s: float) -> "GyroSignal":
        """The samples of an interval, and one more at each end: two at least."""
        first = int(np.searchsorted(self.times_s, start_s, side="right")) - 1
        last = int(np.searchsorted(self.times_s, end_s, side="left")) + 1
        first = max(min(first, len(self.times_s) - 2), 0)
        rows = slice(first, max(last, first + 2))
        return GyroSignal(times_s=self.times_s[rows], gyro=self.gyro[rows])

    def _places(self, times_s: F64) -> tuple[I64, F64]:
        """The sample before each time (...), and the part of the step to the next (..., 1)."""
        last = len(self.times_s) - 1
        after = np.clip(np.searchsorted(self.times_s, times_s, side="right"), 1, last)
        before = after - 1
        part = (times_s - self.times_s[before]) / (self.times_s[after] - self.times_s[before])
        return before, np.clip(part, 0.0, 1.0)[..., None]

    def covers(self, starts_s: F64, ends_s: F64, longest_gap_s: float) -> BoolArray:
        """Whether samples no farther apart than ``longest_gap_s`` enclose each interval (K,)."""
        wide = np.concatenate([[0], np.cumsum(np.diff(self.times_s) > longest_gap_s)])
        first = np.searchsorted(self.times_s, starts_s, side="right") - 1
        last = np.searchsorted(self.times_s, ends_s, side="left")
        inside = (first >= 0) & (last < len(self.times_s))
        first, last = np.maximum(first, 0), np.minimum(last, len(self.times_s) - 1)
        return inside & (wide[first] == wide[last])


@dataclass(frozen=True, kw_only=True)
class ImuSignal(GyroSignal):
    """With specific forces.  accel: (N, 3) m/s^2."""

    accel: F64

    def at(self, times_s: F64) -> tuple[F64, F64]:
        """Angular velocity and specific force (..., 3) at times (...), interpolated."""
        before, part = self._places(times_s)
        accel = (1.0 - part) * self.accel[before] + part * self.accel[before + 1]
        return self.rates(times_s), accel


@dataclass(frozen=True, kw_only=True)
class Preintegrated:
    """What the samples of K intervals say, with derivatives.

    The nine rows of the latter are of rotation, velocity and position; errors of a rotation are
    right-multiplied: R Exp(error).  by_bias: by the biases of gyro and accelerometer (F-44).
    by_offset: by a shift of both ends in time.
    """

    seconds: Annotated[F64, Shape("K")]
    rotation: Annotated[F64, Shape("K", 3, 3)]
    velocity: Annotated[F64, Shape("K", 3)]
    position: Annotated[F64, Shape("K", 3)]
    by_bias: Annotated[F64, Shape("K", 9, 6)]
    by_offset: Annotated[F64, Shape("K", 9)]
    covariance: Annotated[F64, Shape("K", 9, 9)]


@dataclass(frozen=True, kw_only=True)
class NoiseDensity:
    """Of white noise: gyro in rad/s/sqrt(Hz), accelerometer in m/s^2/sqrt(Hz)."""

    gyro: float
    accel: float


def right_jacobian(vectors: F64) -> F64:
    """(..., 3) rotation vectors to (..., 3, 3): Exp(v + d) = Exp(v) Exp(J d) (F-8)."""
    angle = np.linalg.norm(vectors, axis=-1)[..., None, None]
    W = hat(vectors)
    small = angle < 1e-4
    safe = np.where(small, 1.0, angle)
    a = np.where(small, 0.5 - angle**2 / 24.0, (1.0 - np.cos(safe)) / safe**2)
    b = np.where(small, 1.0 / 6.0 - angle**2 / 120.0, (safe - np.sin(safe)) / safe**3)
    return np.eye(3) - a * W + b * (W @ W)


def preintegrate(
    signal: ImuSignal, starts_s: F64, ends_s: F64, gyro_bias: F64, accel_bias: F64,
    noise: NoiseDensity,
) -> Preintegrated:  # fmt: skip
    """Sum up intervals (K,) of the signal's clock, less the biases (K, 3).

    The signal must cover the intervals.
    """
    times = _step_times(signal, starts_s, ends_s)
    gyro, accel = signal.at(times)
    gyro, accel = gyro - gyro_bias[:, None], accel - accel_bias[:, None]
    seconds = ends_s - starts_s
    sums = _Sums(len(starts_s))
    for step in range(times.shape[1] - 1):
        sums.add(
            times[:, step + 1] - times[:, step],
            0.5 * (gyro[:, step] + gyro[:, step + 1]),
            0.5 * (accel[:, step] + accel[:, step + 1]),
            noise,
        )
    return Preintegrated(
        seconds=seconds,
        rotation=sums.rotation,
        velocity=sums.velocity,
        position=sums.position,
        by_bias=sums.by_bias,
        by_offset=_by_offset(sums, seconds, gyro, accel),
        covariance=sums.covariance,
    )


def _step_times(signal: ImuSignal, starts_s: F64, ends_s: F64) -> F64:
    """(K, M + 1) ends of steps: the samples' times, cut to each interval.  Steps that an interval
    with fewer samples does not need have the length zero."""
    first = np.searchsorted(signal.times_s, starts_s, side="right")
    last = np.searchsorted(signal.times_s, ends_s, side="left")
    most = int(np.max(last - first, initial=0))
    rows = np.minimum(first[:, None] + np.arange(most), len(signal.times_s) - 1)
    inner = np.clip(signal.times_s[rows], starts_s[:, None], ends_s[:, None])
    return np.concatenate([starts_s[:, None], inner, ends_s[:, None]], axis=1)


class _Sums:
    """The sums (F-35 to F-37), their derivatives by the biases, and their covariance (F-63)."""

    def __init__(self, count: int) -> None:
        self.rotation: F64 = np.tile(np.eye(3), (count, 1, 1))
        self.velocity, self.position = np.zeros((count, 3)), np.zeros((count, 3))
        self.by_bias, self.covariance = np.zeros((count, 9, 6)), np.zeros((count, 9, 9))

    def add(self, dt: F64, gyro: F64, accel: F64, noise: NoiseDensity) -> None:
        """One step of (K,) seconds with the measurements (K, 3) of its middle."""
        h, turn = dt[:, None, None], gyro * dt[:, None]
        half = so3_exp(0.5 * turn)
        whole_t = (half @ half).swapaxes(1, 2)
        middle = self.rotation @ half
        # An error e of the sums becomes A e + G n by an error n of the measurements.
        A, G = np.tile(np.eye(9), (len(dt), 1, 1)), np.zeros((len(dt), 9, 6))
        by_turn = -middle @ hat(accel)
        by_start = by_turn @ half.swapaxes(1, 2)
        by_gyro = by_turn @ right_jacobian(0.5 * turn) * (0.5 * h)
        A[:, 0:3, 0:3] = whole_t
        A[:, 3:6, 0:3], A[:, 6:9, 0:3] = by_start * h, by_start * (0.5 * h**2)
        A[:, 6:9, 3:6] = np.eye(3) * h
        G[:, 0:3, 0:3] = right_jacobian(turn) * h
        G[:, 3:6, 0:3], G[:, 6:9, 0:3] = by_gyro * h, by_gyro * (0.5 * h**2)
        G[:, 3:6, 3:6], G[:, 6:9, 3:6] = middle * h, middle * (0.5 * h**2)
        self.by_bias = A @ self.by_bias - G
        # The mean over a step of white noise of density s has the variance s^2 / h.
        spread = G * np.repeat([noise.gyro, noise.accel], 3)
        spread /= np.sqrt(np.maximum(h, _SHORTEST_S))
        self.covariance = A @ self.covariance @ A.swapaxes(1, 2) + spread @ spread.swapaxes(1, 2)
        # Within the step a position has noise that the velocity at its end does not show.
        own = np.arange(6, 9)
        self.covariance[:, own, own] += (noise.accel**2 / 12.0) * dt[:, None] ** 3
        force = (middle @ accel[:, :, None])[:, :, 0]
        self.position = self.position + self.velocity * dt[:, None] + 0.5 * force * dt[:, None] ** 2
        self.velocity = self.velocity + force * dt[:, None]
        self.rotation = self.rotation @ whole_t.swapaxes(1, 2)


def _by_offset(sums: _Sums, seconds: F64, gyro: F64, accel: F64) -> F64:
    """Derivatives (K, 9) by a shift of both ends: of the integrals above by their limits.

    With w and f the measurements at the ends a and b::

        rotation (right error)   w_b - R^T w_a
        velocity                 R f_b - f_a - w_a x velocity
        position                 velocity - (b - a) f_a - w_a x position
    """
    w_a, w_b, f_a, f_b = gyro[:, 0], gyro[:, -1], accel[:, 0], accel[:, -1]
    rotation = w_b - (sums.rotation.swapaxes(1, 2) @ w_a[:, :, None])[:, :, 0]
    velocity = (sums.rotation @ f_b[:, :, None])[:, :, 0] - f_a - np.cross(w_a, sums.velocity)
    position = sums.velocity - seconds[:, None] * f_a - np.cross(w_a, sums.position)
    return np.concatenate([rotation, velocity, position], axis=1)

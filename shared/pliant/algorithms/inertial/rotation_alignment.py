"""The rotation between a camera and a gyro, and the offset of their clocks, from the camera's
motion alone.

Of both, angular velocities in the sensor's own axes are compared, averaged over the same time.
With w_c of the camera and w_g of the gyro, t_imu = t_camera + offset::

    w_c(t) = R_camera_imu (w_g(t + offset) - bias)

For one offset the least squares rotation is Wahba's problem: with the singular values s of
``C = sum (w_c - mean) (w_g - mean)^T = U S V^T``, the best proper rotation is
``U diag(1, 1, d) V^T`` with ``d = det(U V^T)``, and it reaches the sum
``s_1 + s_2 + d s_3`` (Markley 1988, J. Astronautical Sciences 36(3); as Umeyama 1991, eq. 40).
Means cancel the bias.  As a share of both signals' lengths the sum is a coefficient of correlation
r: r^2 is the share of the camera's angular velocity that the gyro explains.

C is computed for all offsets at once by the fast Fourier transform, so neither the order of the
axes nor the offset needs a start value.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pliant.algorithms.arrays import F64, BoolArray
from pliant.algorithms.geometry import so3_exp, so3_log
from pliant.algorithms.inertial.preintegration import GyroSignal

_STEP_S = 0.02
AVERAGED_S = 0.2
"""Below it hands and drones hardly turn differently, and the noise of single poses is large."""
_LONGEST_STEP_S = 0.25
"""Between two poses: what happens in a longer one is not known."""
_FINE_S = 0.001
_LONGEST_GAP = 4.0
"""Between two samples, in usual intervals."""
_LEAST_OVERLAP_S = 3.0
_TINY = 1e-12
_ONE_AXIS = 0.05
"""Of the squares of angular velocity, what is not about the main axis: less does not determine the
rotation about it."""
_STARTS = 8


@dataclass(frozen=True, kw_only=True)
class RotationAlignment:
    """offset_s: t_imu - t_camera.   correlation: r above.   mirrored: r of the best reflection,
    which fits instead if the axes of the gyro are left-handed.   explained: the share of the square
    of the camera's angular velocity that the gyro explains as it is: r^2 if its unit is right, less
    otherwise.   gain: the gyro's angular velocity in units of the camera's.   rate_rad_s: root mean
    square of the camera's angular velocity about its mean.
    starts: (S, 3, 3) rotations to try.  They are several if all turns are about one axis, as then
    the rotation about that axis is open.
    """

    offset_s: float
    R_camera_imu: F64
    gyro_bias: F64
    correlation: float
    explained: float
    gain: float
    mirrored: float
    rate_rad_s: float
    starts: F64


@dataclass(frozen=True, kw_only=True)
class Rates:
    """Averages (N, 3) on a grid of time; weight (N,) is 0 where they are unknown."""

    first_s: float
    rates: F64
    weights: F64

    @property
    def independent(self) -> "Rates":
        """Those whose intervals do not overlap."""
        apart = round(AVERAGED_S / _STEP_S)
        return replace(self, rates=self.rates[::apart], weights=self.weights[::apart])


def align_rotation(
    times_s: F64, turns: F64, signal: GyroSignal, gap_s: float
) -> RotationAlignment | None:
    """From poses at times (N,), and the turns (N - 1, 3) from each to the next.  None if no offset
    leaves enough overlap."""
    camera = camera_rates(times_s, turns)
    gyro = gyro_rates(signal, gap_s, float(signal.times_s[0]))
    coarse = _coarse_offset(camera, gyro)
    if coarse is None:
        return None
    best: RotationAlignment | None = None
    around_s = 3.0 * _STEP_S + AVERAGED_S
    signal = signal.between(
        float(times_s[0]) + coarse - around_s, float(times_s[-1]) + coarse + around_s
    )
    for offset in coarse + np.arange(-2.0 * _STEP_S, 2.0 * _STEP_S, _FINE_S):
        found = _wahba(camera, gyro_rates(signal, gap_s, camera.first_s + offset), offset)
        if found is not None and (best is None or found.correlation > best.correlation):
            best = found
    return best


def _averaged(times_s: F64, angles: F64, known: BoolArray, first_s: float) -> Rates:
    """times_s: (N,).  angles: (N, 3) integrals of the angular velocity.  known: (N - 1,) whether
    each step between two times is known."""
    count = int((times_s[-1] - first_s - AVERAGED_S) / _STEP_S) + 1
    starts = first_s + _STEP_S * np.arange(max(count, 0))
    ends = starts + AVERAGED_S
    unknown_s = np.concatenate([[0.0], np.cumsum(np.where(known, 0.0, np.diff(times_s)))])

    def between(values: F64) -> F64:
        return np.interp(ends, times_s, values) - np.interp(starts, times_s, values)

    rates = np.column_stack([between(column) for column in angles.T]) / AVERAGED_S
    inside = (starts >= times_s[0]) & (between(unknown_s) < 1e-9)
    return Rates(first_s=first_s, rates=rates * inside[:, None], weights=inside.astype(np.float64))


def turns_of(R_world_camera: F64) -> F64:
    """(N - 1, 3) rotation vectors from each of the rotations (N, 3, 3) to the next."""
    return so3_log(R_world_camera[:-1].swapaxes(1, 2) @ R_world_camera[1:])


def longest_gap_s(signal: GyroSignal) -> float:
    """Between two samples, beyond which some are missing."""
    return _LONGEST_GAP * float(np.median(np.diff(signal.times_s)))


def camera_rates(times_s: F64, turns: F64) -> Rates:
    """Of the camera.  turns: as of ``align_rotation``."""
    angles = np.concatenate([np.zeros((1, 3)), np.cumsum(turns, axis=0)])
    return _averaged(times_s, angles, np.diff(times_s) <= _LONGEST_STEP_S, float(times_s[0]))


def gyro_rates(signal: GyroSignal, gap_s: float, first_s: float) -> Rates:
    """Of the gyro, from a time of its clock on."""
    steps = np.diff(signal.times_s)
    turns = 0.5 * (signal.gyro[1:] + signal.gyro[:-1]) * steps[:, None]
    angles = np.concatenate([np.zeros((1, 3)), np.cumsum(turns, axis=0)])
    return _averaged(signal.times_s, angles, steps <= gap_s, float(first_s))


def _coarse_offset(camera: Rates, gyro: Rates) -> float | None:
    """The offset on the grid with the largest correlation, over all offsets."""
    length = len(camera.rates) + len(gyro.rates)
    if not len(camera.rates) or not len(gyro.rates):
        return None
    size = 1 << int(np.ceil(np.log2(length)))

    def spectrum(rates: Rates) -> NDArray[np.complex128]:
        squares = (rates.rates**2).sum(axis=1)
        columns = np.column_stack([rates.weights, rates.rates, squares])
        return np.fft.rfft(columns, size, axis=0)

    # products[k] = sum over n of a column of the camera at n and one of the gyro at n + k.
    a, b = spectrum(camera).conj(), spectrum(gyro)
    products = np.fft.irfft(a[:, :, None] * b[:, None, :], size, axis=0)
    count = products[:, 0, 0]
    enough = count * _STEP_S >= max(_LEAST_OVERLAP_S, 0.5 * count.max() * _STEP_S)
    if not enough.any():
        return None
    shifts = np.flatnonzero(enough)
    products, count = products[shifts], count[shifts]
    mean_a, mean_b = products[:, 1:4, 0] / count[:, None], products[:, 0, 1:4] / count[:, None]
    covariance = products[:, 1:4, 1:4] - count[:, None, None] * mean_a[:, :, None] * mean_b[:, None]
    length_a = products[:, 4, 0] - count * (mean_a**2).sum(axis=1)
    length_b = products[:, 0, 4] - count * (mean_b**2).sum(axis=1)
    U, s, Vt = np.linalg.svd(covariance)
    s[:, 2] *= np.sign(np.linalg.det(U @ Vt))
    lengths = np.sqrt(np.maximum(length_a, 1e-12) * np.maximum(length_b, 1e-12))
    best = int(shifts[np.argmax(s.sum(axis=1) / lengths)])
    shift = best if best < len(gyro.rates) else best - size
    return shift * _STEP_S + gyro.first_s - camera.first_s


def _wahba(camera: Rates, gyro: Rates, offset_s: float) -> RotationAlignment | None:
    """The least squares rotation of two signals on the same grid."""
    both = min(len(camera.rates), len(gyro.rates))
    rows = np.flatnonzero(camera.weights[:both] * gyro.weights[:both])
    if len(rows) * _STEP_S < _LEAST_OVERLAP_S:
        return None
    w_c, w_g = camera.rates[rows], gyro.rates[rows]
    mean_c, mean_g = w_c.mean(axis=0), w_g.mean(axis=0)
    w_c, w_g = w_c - mean_c, w_g - mean_g
    U, s, Vt = np.linalg.svd(w_c.T @ w_g)
    handed = float(np.sign(np.linalg.det(U @ Vt)))
    R = (U * [1.0, 1.0, handed]) @ Vt
    reached = float(s[0] + s[1] + handed * s[2])
    square_c, square_g = float((w_c**2).sum()) + _TINY, float((w_g**2).sum()) + _TINY
    angles = np.zeros(1)
    if s[1] + handed * s[2] < _ONE_AXIS * s[0]:
        angles = np.linspace(0.0, 2.0 * np.pi, _STARTS, endpoint=False)
    return RotationAlignment(
        offset_s=float(offset_s),
        R_camera_imu=R,
        gyro_bias=mean_g - R.T @ mean_c,
        correlation=reached / float(np.sqrt(square_c * square_g)),
        explained=(2.0 * reached - square_g) / square_c,
        gain=square_g / max(reached, _TINY),
        mirrored=(reached - 2.0 * handed * float(s[2])) / float(np.sqrt(square_c * square_g)),
        rate_rad_s=float(np.sqrt(square_c / len(rows))),
        starts=so3_exp(angles[:, None] * U[:, 0]) @ R,
    )

"""How a camera turns between its frames, by a gyro that is aligned with it on the way.

The gyro is unknown at first.  The rotation of the first seconds that the map sees is compared with
that of the gyro at all offsets in time (``rotation_alignment``), and what that finds must explain
frames that come later.  Only then the gyro is believed, and only as long as it agrees with what
the images show.

The alignment is the least squares solution of ``rotation_alignment``'s equation over independent
intervals, by Gauss-Newton with the unknowns ``C <- Exp(c) C``, bias b and offset o::

    r = w_c - C (w_g(o) - b),    d r = [C (w_g - b)] c + C d b - C w_g' d o

and its covariance P is that of the solution.  A turn G of the gyro between two times is the turn
C G C^T of the camera.  With the right errors of G that ``preintegration`` derives, its error is

    e = C (d G / d b) d b + C (d G / d o) d o + (C G^T C^T - I) c.

Samples of a live source arrive in parallel with its frames.  Those that are too late for the pose
of a frame still count for the alignment, and for the judgement of the gyro.

Where the camera was lost since, the solution begins with few turns.  What the earlier ones have
shown is then its prior: the estimate before the loss, with P and what the bias has walked since.
"""

from bisect import bisect_left, bisect_right
from dataclasses import dataclass, field, replace

import numpy as np

from pliant.algorithms.arrays import F64
from pliant.algorithms.geometry import hat, so3_exp, so3_log
from pliant.algorithms.inertial.alignment import (
    averaged_signal,
    gyro_noise_density,
    rotation_fault,
)
from pliant.algorithms.inertial.preintegration import GyroSignal, right_jacobian
from pliant.algorithms.inertial.rotation_alignment import (
    AVERAGED_S,
    Rates,
    RotationAlignment,
    align_rotation,
    camera_rates,
    gyro_rates,
    longest_gap_s,
)
from pliant.algorithms.inertial.samples import ImuSamples, append, joined

_FIRST_S, _LATER = 3.5, 1.5
"""Seconds of poses after which the gyro is aligned, and by which factor more from then on."""
_MOST_S, _DRIFTS_S = 60.0, 30.0
"""Of poses that an alignment is found from, and between two alignments at the most: biases drift.
"""
_GIVEN_UP_S = 450.0
"""Seconds of poses without an alignment that explains them, after which none is tried any more."""
_ITERATIONS = 4
_CHANGE = 0.002
"""Seconds by which offsets differ for the derivative."""
_AROUND_S = 2.0
"""Seconds of samples kept on both sides of the turns: the offset never changes by more."""
_BIAS, _OFFSET = np.arange(3, 6), 6
"""Rows among the unknowns."""
_BIAS_RAD_S, _TURN_RAD, _OFFSET_S = 0.2, 10.0, 1.0
"""Standard deviations of priors: that of cheap sensors; the others keep the equations regular."""
_HUBER = 3.4
"""Of the length of a residual of 3 numbers: 1 of 100 is longer (chi-square)."""
_SHARE = 0.01
"""Standard deviation of a turn, as a share of it: factors of scale, and errors of focal lengths."""
_WALK = 3e-5
"""Of the bias, rad/s^2/sqrt(Hz): of a sensor of middle quality."""
_CLOCKS = 2e-5
"""Two clocks differ by this share."""
_NO_SAMPLES = GyroSignal(times_s=np.zeros(2), gyro=np.zeros((2, 3)))
_APART = 0.3
"""Two turns that differ by more, as a share, contradict each other: less than 90 % of its square
is explained."""
_SIGMAS = 3.0
_PROOFS, _OF = 8, 10
"""This many of the last intervals must agree before the gyro is believed, and contradict it before
it no longer is."""


@dataclass(frozen=True, kw_only=True)
class GyroTurn:
    """R: (3, 3) from the camera's axes at the first time to those at the second: R_first_second.
    covariance: (3, 3) of its right error, rad^2."""

    R: F64
    covariance: F64


@dataclass(frozen=True, kw_only=True)
class _Aligned:
    """covariance: (7, 7) of c, b, o.   noise: standard deviation of the camera's turn in an
    interval of ``AVERAGED_S``, radians.   at_s: the last of the turns that show it."""

    at_s: float
    offset_s: float
    R_camera_imu: F64
    bias: F64
    covariance: F64
    noise: float


@dataclass(kw_only=True)
class Gyro:
    """A gyro, and its alignment with the camera so far.

    A function of the samples and of the turns that were seen, in their order.

    is_believed: from some time on.   dropped: since then, as it contradicts the images.
    given_up: never believed, and never will be.
    frames: that were placed with its help.   carried: frames that were placed by it alone.
    late: frames that were located without it, as the samples did not reach their time.
    blocks: the samples so far.
    """

    blocks: list[GyroSignal]
    origin_ns: int
    gap_s: float
    density: float
    dropped: bool = False
    given_up: bool = False
    is_believed: bool = False
    frames: int = 0
    carried: int = 0
    late: int = 0
    _aligned: _Aligned | None = None
    _earlier: _Aligned | None = None  # before the camera was lost
    _unexplained_s: float = 0.0
    _next_s: float = _FIRST_S
    _seen_s: float = 0.0
    _times_s: list[float] = field(default_factory=list[float])
    _turns: list[F64] = field(default_factory=list[F64])
    _interval: tuple[int, F64, float] | None = None
    _unjudged: list[tuple[int, int, F64, float]] = field(
        default_factory=list[tuple[int, int, F64, float]]
    )
    _agreed: list[bool] = field(default_factory=list[bool])

    @staticmethod
    def of(samples: ImuSamples) -> "Gyro | None":
        """None of too few samples."""
        if len(samples.stamps_ns) < 2:
            return None
        origin_ns = int(samples.stamps_ns[0])
        signal = averaged_signal(samples, origin_ns)
        if len(signal.times_s) < 5:
            return None
        rates = GyroSignal(times_s=signal.times_s, gyro=signal.gyro)
        gap_s, density = longest_gap_s(rates), gyro_noise_density(rates)
        return Gyro(blocks=[rates], origin_ns=origin_ns, gap_s=gap_s, density=density)

    def add_samples(self, samples: ImuSamples) -> None:
        """Take in the next samples."""
        if self.is_over:
            return
        times_s = np.float64(1e-9) * (samples.stamps_ns - self.origin_ns)
        append(self.blocks, GyroSignal(times_s=times_s, gyro=samples.gyro_rad_s))
        if len(self.blocks) == 1:
            self.gap_s = longest_gap_s(self.blocks[0])
            self.density = gyro_noise_density(self.blocks[0])

    @property
    def signal(self) -> GyroSignal:
        """All samples so far."""
        return joined(self.blocks)

    @property
    def counters(self) -> dict[str, int]:
        """Counts for the summary of a run."""
        counts = {"frames": self.frames, "carried": self.carried, "late": self.late}
        counts["dropped"] = int(self.dropped)
        return {f"gyro_{name}": count for name, count in counts.items()}

    @property
    def is_over(self) -> bool:
        """Whether the gyro is no longer used."""
        return self.dropped or self.given_up

    def turn(self, first_ns: int, second_ns: int) -> GyroTurn | None:
        """The camera's turn between two times; None where the gyro does not tell."""
        aligned = self._aligned
        if aligned is None or not self.is_believed or self.dropped:
            return None
        return self._turned(aligned, first_ns, second_ns)

    def predict(self, first_ns: int, second_ns: int) -> GyroTurn | None:
        """The camera's turn to a frame whose pose is to be found."""
        turn = self.turn(first_ns, second_ns)
        is_used = self.is_believed and not self.dropped
        self.late += is_used and turn is None and not self._reaches(second_ns)
        return turn

    def see(
        self,
        first_ns: int,
        second_ns: int,
        R_first_second: F64,
        variances: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        """Take in the rotation between successive frames by their images alone.

        variances: of the largest error of the first and the second rotation, rad^2, where known.
        """
        if self.is_over:
            return
        first_s, second_s = self._seconds(first_ns), self._seconds(second_ns)
        if not self._times_s or self._times_s[-1] != first_s:
            self.lose()
            self._times_s.append(first_s)
        self._times_s.append(second_s)
        self._turns.append(so3_log(R_first_second))
        self._seen_s += second_s - first_s
        self._unexplained_s += 0.0 if self.is_believed else second_s - first_s
        if second_s - self._times_s[0] > 2.0 * _MOST_S:
            self._forget_before(second_s - _MOST_S)
        self._judge(first_ns, second_ns, R_first_second, variances)
        if not self.is_believed and self._unexplained_s > _GIVEN_UP_S:
            self.given_up = True
            self._leave()
        elif self._seen_s >= self._next_s and not self.dropped:
            later = _LATER * self._next_s
            self._next_s = later if self._aligned is None else min(later, self._next_s + _DRIFTS_S)
            self._align()

    def lose(self) -> None:
        """The camera's path is interrupted: its turns are unknown."""
        self._times_s, self._turns, self._interval = [], [], None
        self._earlier = self._aligned
        if self.is_believed:  # a few frames would replace what many have shown
            self._next_s = max(self._next_s, self._seen_s + _FIRST_S)
        else:
            self._seen_s, self._next_s = 0.0, _FIRST_S

    def _seconds(self, stamp_ns: int) -> float:
        return (stamp_ns - self.origin_ns) * 1e-9

    def _forget_before(self, time_s: float) -> None:
        kept = bisect_left(self._times_s, time_s)
        self._times_s, self._turns = self._times_s[kept:], self._turns[kept:]

    def _leave(self) -> None:
        """Discard what is no longer used."""
        self.blocks, self._unjudged = [_NO_SAMPLES], []
        self._times_s, self._turns, self._interval = [], [], None
        self._aligned = self._earlier = None

    def _judge(
        self, first_ns: int, second_ns: int, R_first_second: F64, variances: tuple[float, float]
    ) -> None:
        """Compare intervals of frames with the gyro, once samples reach their end.  The rotations
        between the ends of an interval cancel.
        """
        start_ns, R_before, at_start = self._interval or (first_ns, np.eye(3), variances[0])
        R = R_before @ R_first_second
        self._interval = (start_ns, R, at_start)
        if (second_ns - start_ns) * 1e-9 < AVERAGED_S or self._aligned is None:
            return
        self._interval = None
        self._unjudged = [*self._unjudged, (start_ns, second_ns, R, at_start + variances[1])][-_OF:]
        self._judge_waiting()

    def _judge_waiting(self) -> None:
        while self._unjudged and self._aligned and self._reaches(self._unjudged[0][1]):
            self._compare(self._aligned, *self._unjudged.pop(0))

    def _compare(
        self, aligned: _Aligned, start_ns: int, second_ns: int, R: F64, variance: float
    ) -> None:
        """Judge the gyro by the turn R (3, 3) of the images, and the variance of its ends."""
        told = self._turned(aligned, start_ns, second_ns)
        if told is None:
            return
        allowed = _APART * float(max(np.linalg.norm(so3_log(R)), np.linalg.norm(so3_log(told.R))))
        apart = float(np.linalg.norm(so3_log(told.R.T @ R)))
        variance += aligned.noise**2 + float(np.linalg.norm(told.covariance, 2))
        unsure = _SIGMAS * float(np.sqrt(variance))
        if apart > allowed + unsure:
            self._agreed.append(False)
        elif allowed > unsure:  # else any gyro would agree
            self._agreed.append(True)
        self._agreed = self._agreed[-_OF:]
        agreed = sum(self._agreed)
        if not self.is_believed and agreed >= _PROOFS:
            self.is_believed = True
        elif len(self._agreed) - agreed >= _PROOFS:
            self._agreed, self._unjudged = [], []
            if self.is_believed:
                self.dropped = True
                self._leave()
            self._aligned = self._earlier = None

    def _align(self) -> None:
        self._forget_before(self._times_s[-1] - _MOST_S)
        times_s, turns = np.array(self._times_s), np.array(self._turns)
        start, prior = self._aligned, self._earlier
        if start is None:
            found = align_rotation(times_s, turns, self.signal, self.gap_s)
            if found is None or rotation_fault(found):
                return
            start = _start(found)
        found = _refined(start, prior, times_s, turns, self.signal, self.gap_s)
        self._aligned = found or self._aligned

    def _reaches(self, stamp_ns: int) -> bool:
        """Whether the samples so far reach the time of a frame."""
        offset_s = 0.0 if self._aligned is None else self._aligned.offset_s
        return self._seconds(stamp_ns) + offset_s <= float(self.blocks[-1].times_s[-1])

    def _between(self, start_s: float, end_s: float) -> GyroSignal:
        first = bisect_right(self.blocks, start_s, key=lambda block: block.times_s[0]) - 1
        last = bisect_left(self.blocks, end_s, key=lambda block: block.times_s[-1]) + 1
        return joined(self.blocks[max(first, 0) : last]).between(start_s, end_s)

    def _turned(self, aligned: _Aligned, first_ns: int, second_ns: int) -> GyroTurn | None:
        a = self._seconds(first_ns) + aligned.offset_s
        b = self._seconds(second_ns) + aligned.offset_s
        signal = self._between(a, b)
        if b <= a or not signal.covers(np.array([a]), np.array([b]), self.gap_s)[0]:
            return None
        G, by_bias, by_offset = integrated(signal, a, b, aligned.bias)
        C = aligned.R_camera_imu
        R = C @ G @ C.T
        J = np.column_stack([R.T - np.eye(3), C @ by_bias, C @ by_offset])
        shared = aligned.covariance.copy()
        shared[_BIAS, _BIAS] += _WALK**2 * _DRIFTS_S
        seconds, share = b - a, _SHARE * so3_log(R)
        covariance = J @ shared @ J.T + np.outer(share, share)
        covariance += np.eye(3) * self.density**2 * seconds
        return GyroTurn(R=R, covariance=covariance)


def integrated(signal: GyroSignal, start_s: float, end_s: float, bias: F64) -> tuple[F64, F64, F64]:
    """The rotation (3, 3) of the sensor between two times of its clock, and the derivatives of its
    right error by the bias (3, 3) and by a shift of both times (3,).  The signal covers them."""
    first = int(np.searchsorted(signal.times_s, start_s, side="right"))
    last = int(np.searchsorted(signal.times_s, end_s, side="left"))
    times = np.concatenate([[start_s], signal.times_s[first:last], [end_s]])
    rates = signal.rates(times) - bias
    steps = np.diff(times)[:, None]
    turns = 0.5 * (rates[1:] + rates[:-1]) * steps
    parts, slopes = so3_exp(turns), right_jacobian(turns) * steps[:, :, None]
    turn, by_bias = np.eye(3), np.zeros((3, 3))
    for part, slope in zip(parts, slopes, strict=True):
        turn = turn @ part
        by_bias = part.T @ by_bias - slope
    return turn, by_bias, rates[-1] - turn.T @ rates[0]


def _start(found: RotationAlignment) -> _Aligned:
    return _Aligned(
        at_s=0.0, offset_s=found.offset_s, R_camera_imu=found.R_camera_imu, bias=found.gyro_bias,
        covariance=np.eye(7), noise=0.0,
    )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class _Prior:
    """Of the solution: mean, and information (7, 7) of c, b, o."""

    R_camera_imu: F64
    bias: F64
    offset_s: float
    information: F64

    @staticmethod
    def of(earlier: _Aligned | None, start: _Aligned, at_s: float) -> "_Prior":
        """Of an earlier estimate, whose bias has walked until a time; None: of any sensor."""
        if earlier is None:
            sigmas = np.repeat([_TURN_RAD, _BIAS_RAD_S, _OFFSET_S], [3, 3, 1])
            return _Prior(
                R_camera_imu=start.R_camera_imu, bias=np.zeros(3), offset_s=start.offset_s,
                information=np.diag(sigmas**-2),
            )  # fmt: skip
        covariance = earlier.covariance.copy()
        since_s = max(at_s - earlier.at_s, 0.0)
        covariance[_BIAS, _BIAS] += _WALK**2 * since_s
        covariance[_OFFSET, _OFFSET] += (_CLOCKS * since_s) ** 2
        return _Prior(
            R_camera_imu=earlier.R_camera_imu, bias=earlier.bias, offset_s=earlier.offset_s,
            information=np.asarray(np.linalg.inv(covariance), np.float64),
        )  # fmt: skip

    def pull(self, at: _Aligned) -> F64:
        """(7,) from an estimate to the mean."""
        turn = so3_log(self.R_camera_imu @ at.R_camera_imu.T)
        return np.concatenate([turn, self.bias - at.bias, [self.offset_s - at.offset_s]])


def _refined(
    start: _Aligned, earlier: _Aligned | None, times_s: F64, turns: F64, signal: GyroSignal,
    gap_s: float,
) -> _Aligned | None:  # fmt: skip
    """The least squares solution near a start, robust against wrong poses; None without one.

    earlier: by other turns.
    """
    aligned: _Aligned | None = replace(start, at_s=float(times_s[-1]))
    prior = _Prior.of(earlier, start, aligned.at_s)
    camera = camera_rates(times_s, turns).independent
    first_s, last_s = float(times_s[0]) + start.offset_s, float(times_s[-1]) + start.offset_s
    signal = signal.between(first_s - _AROUND_S, last_s + _AROUND_S)
    for _ in range(_ITERATIONS):
        aligned = None if aligned is None else _step(aligned, prior, camera, signal, gap_s)
    return aligned


def _step(
    before: _Aligned, prior: _Prior, camera: Rates, signal: GyroSignal, gap_s: float
) -> _Aligned | None:
    C, b, o = before.R_camera_imu, before.bias, before.offset_s
    here = gyro_rates(signal, gap_s, camera.first_s + o).independent
    later = gyro_rates(signal, gap_s, camera.first_s + o + _CHANGE).independent
    both = min(len(camera.rates), len(here.rates), len(later.rates))
    known = camera.weights[:both] * here.weights[:both] * later.weights[:both]
    rows = np.flatnonzero(known)
    if len(rows) < 7:
        return None
    w_g = here.rates[rows]
    turned = (w_g - b) @ C.T
    r = camera.rates[rows] - turned
    J = np.zeros((len(rows), 3, 7))
    J[:, :, :3] = -hat(turned)
    J[:, :, 3:6] = -C
    J[:, :, 6] = ((later.rates[rows] - w_g) / _CHANGE) @ C.T
    squares = (r**2).sum(axis=1)
    variance = float(np.median(squares)) / 2.37 + 1e-12  # of one number: chi-square of 3
    weights = np.minimum(1.0, _HUBER * np.sqrt(variance / np.maximum(squares, variance)))
    H = np.einsum("kri,k,krj->ij", J, weights, J) / variance + prior.information
    g = np.einsum("kri,k,kr->i", J, weights, r) / variance
    g += prior.information @ prior.pull(before)
    step = np.linalg.solve(H, g)
    return _Aligned(
        at_s=before.at_s,
        offset_s=o + float(step[6]),
        R_camera_imu=so3_exp(step[:3]) @ C,
        bias=b + step[3:6],
        covariance=np.asarray(np.linalg.inv(H), np.float64),
        noise=float(np.sqrt(variance)) * AVERAGED_S,
    )

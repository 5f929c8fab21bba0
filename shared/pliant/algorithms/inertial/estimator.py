"""Gauss-Newton of the estimate in ``residuals``, the noise of its poses, and its covariance."""

from dataclasses import dataclass

import numpy as np

from pliant.algorithms.arrays import F64, I64
from pliant.algorithms.geometry import so3_log
from pliant.algorithms.inertial.chain import solve_chain
from pliant.algorithms.inertial.preintegration import ImuSignal, NoiseDensity, preintegrate
from pliant.algorithms.inertial.residuals import (
    ACCEL,
    COMMON,
    GYRO,
    LEVER,
    OFFSET,
    OWN,
    TURN,
    VELOCITY,
    Linear,
    Nodes,
    State,
    linearised,
    of_each,
)

_LEVER_M = 0.05
_ACCEL_BIAS_M_S2 = 0.2
_GYRO_BIAS_RAD_S = 0.2
_SPEED_M_S = 50.0
_OFFSET_S = 1.0
_TURN_RAD = 10.0
"""Standard deviations of the priors: lever arm and biases of cameras with cheap sensors; the others
only keep the equations regular."""
_GYRO_WALK = 3e-5
_ACCEL_WALK = 3e-3
"""Densities of the biases' random walks, rad/s^2/sqrt(Hz) and m/s^3/sqrt(Hz): of a sensor of middle
quality (EuRoC's ADIS16448), as those of a phone are unknown."""
_FIRST_NOISE = 3e-3
NOISE_RANGE = (1e-5, 0.1)
"""Of poses: radians, and shares of the trajectory's extent.  Poses that would have to be worse than
the upper limit are not explained by the samples at all."""
_ITERATIONS = 30
_CONVERGED = 1e-5
"""Of the scale, as a share; of rotations in radians."""
_SETTLED = 0.01
"""Change of the poses' standard deviations, as a share."""
_HUBER = 3.4
"""Of the length of a residual of 3 numbers: 1 of 100 is longer (chi-square)."""


@dataclass(frozen=True, kw_only=True)
class PoseNoise:
    """Standard deviations of the poses: radians, and units of the map."""

    rotation: float
    position: float


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """covariance: (COMMON, COMMON), from the spread of blocks of time (``System.covariance``).
    information: what the covariance would be the inverse of if errors of poses were independent.
    """

    state: State
    noise: PoseNoise
    covariance: F64
    information: F64


def estimate(
    nodes: Nodes, signal: ImuSignal, start: State, densities: NoiseDensity, *, block_s: float
) -> Estimate | None:
    """Iterate from a start.  block_s: errors of poses farther apart in time are independent.

    Returns None if the equations are singular.
    """
    try:
        return _iterated(nodes, signal, start, densities, block_s)
    except np.linalg.LinAlgError:
        return None


def _iterated(
    nodes: Nodes, signal: ImuSignal, start: State, densities: NoiseDensity, block_s: float
) -> Estimate:
    noise = PoseNoise(rotation=_FIRST_NOISE, position=_FIRST_NOISE)
    system = System(nodes, signal, start, densities)
    for _ in range(_ITERATIONS):
        common, own = system.solve(noise)
        state = system.state.moved(common, own)
        system = System(nodes, signal, state, densities)
        before, noise = noise, system.better_noise(noise)
        settled = abs(np.log(noise.position / before.position)) < _SETTLED
        if settled and np.abs(common[:6]).max() < _CONVERGED:
            break
    system.solve(noise)
    return Estimate(
        state=system.state, noise=noise, covariance=system.covariance(block_s),
        information=system.information,
    )  # fmt: skip


class System:
    """The normal equations at a state."""

    def __init__(
        self, nodes: Nodes, signal: ImuSignal, state: State, densities: NoiseDensity
    ) -> None:
        self.state = state
        self._times_s, self._tied = nodes.times_s, np.flatnonzero(nodes.tied)
        starts = (nodes.times_s + state.offset_s)[self._tied]
        ends = (nodes.times_s + state.offset_s)[self._tied + 1]
        gyro, accel = state.gyro_bias[self._tied], state.accel_bias[self._tied]
        sums = preintegrate(signal, starts, ends, gyro, accel, densities)
        linear = linearised(state, sums, self._tied)
        root: F64 = np.asarray(np.linalg.inv(np.linalg.cholesky(sums.covariance)), np.float64)
        walks = bias_walks(state, self._tied, ends - starts)
        self._inertial = Linear(
            residual=np.concatenate([of_each(root, linear.residual), walks.residual], axis=1),
            by_first=np.concatenate([root @ linear.by_first, walks.by_first], axis=1),
            by_second=np.concatenate([root @ linear.by_second, walks.by_second], axis=1),
            by_common=np.concatenate([root @ linear.by_common, walks.by_common], axis=1),
        )
        turned = so3_log(nodes.R.swapaxes(1, 2) @ state.R)
        self._moved = np.concatenate([turned, state.p - nodes.p], axis=1)
        self._prior, self._deviation = prior_of_common(state)

    def solve(self, noise: PoseNoise) -> tuple[F64, F64]:
        """The step, (COMMON,) and (N, OWN).  Raises LinAlgError."""
        count, rows, inertial = len(self._times_s), self._tied, self._inertial
        first, second, common = inertial.by_first, inertial.by_second, inertial.by_common
        first_t, second_t = first.swapaxes(1, 2), second.swapaxes(1, 2)
        known = np.concatenate([common, -inertial.residual[:, :, None]], axis=2)
        diagonal, upper = np.zeros((count, OWN, OWN)), np.zeros((count - 1, OWN, OWN))
        right = np.zeros((count, OWN, COMMON + 1))
        diagonal[rows] += first_t @ first
        diagonal[rows + 1] += second_t @ second
        upper[rows] = first_t @ second
        right[rows] += first_t @ known
        right[rows + 1] += second_t @ known
        diagonal[:, _POSE, _POSE] += self._pose_weights(noise)
        right[:, :6, COMMON] -= self._pose_weights(noise) * self._moved
        for part, sigma, value in own_priors(self.state, self._tied):
            diagonal[:, part, part] += 1.0 / sigma[:, None] ** 2
            right[:, part, COMMON] -= value / sigma[:, None] ** 2
        solved = solve_chain(diagonal, upper, right)
        border, self._carried = right[:, :, :COMMON], solved[:, :, :COMMON]
        self._noise = noise
        self.information = (
            np.einsum("kri,krj->ij", common, common)
            + self._prior
            - np.einsum("nri,nrj->ij", border, self._carried)
        )
        force = -np.einsum("kri,kr->i", common, inertial.residual) - self._prior @ self._deviation
        force -= np.einsum("nri,nr->i", border, solved[:, :, COMMON])
        step = np.linalg.solve(self.information, force)
        return step, solved[:, :, COMMON] - self._carried @ step

    def _pose_weights(self, noise: PoseNoise) -> F64:
        """(N, 6): inverse variances, less where a pose is an outlier."""
        weights = np.empty(self._moved.shape)
        for part, sigma in ((slice(0, 3), noise.rotation), (slice(3, 6), noise.position)):
            length = np.linalg.norm(self._moved[:, part], axis=1) / sigma
            huber = np.minimum(1.0, _HUBER / np.maximum(length, _HUBER))
            weights[:, part] = (huber / sigma**2)[:, None]
        return weights

    def better_noise(self, noise: PoseNoise) -> PoseNoise:
        """Standard deviations by which the squares of the residuals sum up to their number less
        that of the unknowns: of rotations, and of positions with velocities."""
        tied = len(self._tied)
        count = len(np.union1d(self._tied, self._tied + 1))
        squares = self._pose_weights(noise) * self._moved**2  # 0 of a pose that nothing ties
        inertial = self._inertial.residual**2
        turned = squares[:, :3].sum() + inertial[:, :3].sum()
        moved = squares[:, 3:].sum() + inertial[:, 3:9].sum()
        turned /= max(3 * tied - 7, 1)
        moved /= max(6 * tied - 3 * count - 9, 1)
        return PoseNoise(
            rotation=float(np.clip(noise.rotation * np.sqrt(turned), *NOISE_RANGE)),
            position=float(np.clip(noise.position * np.sqrt(moved), *NOISE_RANGE)),
        )

    def covariance(self, block_s: float) -> F64:
        """Of the common unknowns, if errors of poses near in time are alike; after ``solve``.

        The sum over blocks of time of the outer product of the block's gradient, between the
        inverse information on both sides (the sandwich of White 1980 with clusters; Cameron and
        Miller 2015, equation 11).  A node's part in a derivative by a common unknown is what is
        left after the node has followed it.
        """
        rows, inertial = self._tied, self._inertial
        left = inertial.by_common - inertial.by_first @ self._carried[rows]
        left -= inertial.by_second @ self._carried[rows + 1]
        gradients = np.zeros((len(self._times_s), COMMON))
        gradients[rows] += np.einsum("kri,kr->ki", left, inertial.residual)
        pulls = self._pose_weights(self._noise) * self._moved
        gradients -= np.einsum("nri,nr->ni", self._carried[:, :6], pulls)
        blocks = ((self._times_s - self._times_s[0]) / block_s).astype(np.int64)
        sums = np.zeros((int(blocks[-1]) + 1, COMMON))
        np.add.at(sums, blocks, gradients)
        outer = sums.T @ sums * (len(sums) / max(len(sums) - 1, 1))
        inverse = np.linalg.inv(self.information)
        return inverse @ (outer + self._prior) @ inverse


_POSE = np.arange(6)


def prior_of_common(state: State) -> tuple[F64, F64]:
    """Information (COMMON, COMMON) of the common unknowns, and how far a state is from its mean."""
    sigmas, deviation = np.full(COMMON, np.inf), np.zeros(COMMON)
    sigmas[TURN], sigmas[LEVER], sigmas[OFFSET] = _TURN_RAD, _LEVER_M, _OFFSET_S
    deviation[LEVER] = state.p_camera_imu
    return np.diag(1.0 / sigmas**2), deviation


def own_priors(state: State, tied: I64) -> list[tuple[I64, F64, F64]]:
    """Unknowns, standard deviations (N,) and values (N, 3).  The biases' is of the start of each
    stretch without gaps: the walk starts there.   tied: nodes that are tied to the next."""
    count = len(state.v)
    start = np.ones(count, np.bool_)
    start[tied + 1] = False
    gyro, accel = (np.where(start, each, np.inf) for each in (_GYRO_BIAS_RAD_S, _ACCEL_BIAS_M_S2))
    own = np.arange(OWN)
    return [
        (own[VELOCITY], np.full(count, _SPEED_M_S), state.v),
        (own[GYRO], gyro, state.gyro_bias),
        (own[ACCEL], accel, state.accel_bias),
    ]


def bias_walks(state: State, tied: I64, seconds: F64) -> Linear:
    """The biases' random walks over intervals: 6 residuals of unit variance."""
    sigmas = np.repeat([_GYRO_WALK, _ACCEL_WALK], 3) * np.sqrt(seconds)[:, None]
    biases = np.concatenate([state.gyro_bias, state.accel_bias], axis=1)
    by_second = np.zeros((len(tied), 6, OWN))
    by_second[:, np.arange(6), np.arange(9, 15)] = 1.0 / sigmas
    return Linear(
        residual=(biases[tied + 1] - biases[tied]) / sigmas,
        by_first=-by_second,
        by_second=by_second,
        by_common=np.zeros((len(tied), 6, COMMON)),
    )

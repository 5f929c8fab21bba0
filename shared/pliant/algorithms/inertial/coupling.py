"""The most probable poses of keyframes by images and inertial samples together.

Images determine neighbouring keyframes well, but their small errors add up along a path.  Inertial
samples determine the path between keyframes up to gravity, scale, velocity and biases.  Both are
weighed here (tight coupling; Forster et al. 2017, section VI)::

    d^T V d / s^2  +  sum |r_k|^2 / g^2

V (6 N, 6 N) is the information of the keyframes' poses by images with residuals of 1 px: the
reduced system of bundle adjustment at its minimum, landmarks and calibration eliminated.
d = (Log(R^T R'), p' - p) is the change of each pose.  r_k are the residuals of ``residuals``
between keyframe k and the next, whitened, with those of the biases' random walk.  So the unknowns
are those of the alignment, with the poses tied to each other by V instead of each to itself.

Velocities and biases (9 of each keyframe) form a chain and are eliminated first (``chain``)::

    (K  B^T) (x_k)   (f_k)
    (B  P  ) (x_p) = (f_p)      S = P - B K^-1 B^T

A keyframe's columns of B touch only its neighbours, so S costs N^2.  s is more than the noise of
pixels, because errors of tracks are alike; g is more than 1 for a sensor with other errors than
noise.  Both are estimated as variance components (Foerstner 1979): with the redundancies, which
add up to the number of residuals less that of the unknowns, ::

    s^2 <- s^2 (d^T V d / s^2) / (rho_V + 3 sqrt(2 rho_V))
    g^2 <- g^2 (sum |r_k|^2 / g^2) / rho_r      rho_V = 6 N - 7 - trace(V / s^2  S^-1)

The sum of rho_V squares has a standard deviation of sqrt(2 rho_V).  So s is the least that the
residuals do not contradict: a few keyframes cannot show that images are worse than their pixels.

A sensor that contradicts neighbouring keyframes so gets a large g, and hardly moves them.
"""

from dataclasses import dataclass

import numpy as np

from pliant.algorithms.arrays import F64, BoolArray
from pliant.algorithms.geometry import so3_log
from pliant.algorithms.inertial.chain import solve_chain
from pliant.algorithms.inertial.estimator import bias_walks, own_priors, prior_of_common
from pliant.algorithms.inertial.preintegration import ImuSignal, NoiseDensity, preintegrate
from pliant.algorithms.inertial.residuals import (
    COMMON,
    OWN,
    Nodes,
    State,
    linearised,
    of_each,
)

_ITERATIONS = 20
_CONVERGED = 0.02
"""Change of a variance, as a share; and of a pose, in its standard deviations by the images."""
_HUBER = 4.7
"""Of the length of a residual of 9 numbers: 1 of 100 is longer (chi-square)."""
_FIXED = 1e9
"""Information of what is held, relative to the mean of the poses' own."""
_COLUMNS = 1024
"""Eliminated at a time: bounds memory."""
_SIGMAS = 3.0
_POSE = np.arange(6)


@dataclass(frozen=True, kw_only=True)
class Coupled:
    """The estimate.   cost: by how much that of the images grows, px^2.   pixel_sigma, in px, and
    inertial_sigma: s and g."""

    state: State
    cost: float
    pixel_sigma: float
    inertial_sigma: float


def couple(
    nodes: Nodes, information: F64, held: BoolArray, signal: ImuSignal, start: State,
    densities: NoiseDensity, *, least_px: float,
) -> Coupled | None:  # fmt: skip
    """Iterate from a start to convergence; None without it.

    information: V.   held: (N,) keyframes that do not move.
    least_px: s is at least this.
    """
    visual = _with_gauge(information, nodes, held)
    state, s2, g2 = start, 1.0, 1.0
    for _ in range(_ITERATIONS):
        try:
            found = System(nodes, visual, signal, state, densities, s2, g2)
            step, s_factor, g_factor = found.solve()
        except np.linalg.LinAlgError:
            return None
        if not np.isfinite(step.own).all():
            return None
        state = state.moved(step.common, step.own)
        before, poses = (s2, g2), step.own[:, :6].ravel()
        change = np.sqrt(float(poses @ information @ poses) / (s2 * len(poses)))
        s2, g2 = max(s2 * s_factor, least_px**2), max(g2 * g_factor, 1.0)
        changes = abs(np.log(s2 / before[0])), abs(np.log(g2 / before[1])), change
        if max(changes) < _CONVERGED:
            turned = so3_log(nodes.R.swapaxes(1, 2) @ state.R)
            moved = np.concatenate([turned, state.p - nodes.p], axis=1).ravel()
            return Coupled(
                state=state, cost=0.5 * float(moved @ information @ moved),
                pixel_sigma=float(np.sqrt(s2)), inertial_sigma=float(np.sqrt(g2)),
            )  # fmt: skip
    return None


def _with_gauge(information: F64, nodes: Nodes, held: BoolArray) -> F64:
    """V, with what images leave open: the pose of held keyframes, and the unit of length."""
    count = len(nodes.p)
    visual = information.copy()
    typical = float(np.trace(visual)) / len(visual)
    along = np.zeros((count, 6))
    along[:, 3:] = nodes.p - nodes.p[int(np.argmax(held))]
    unit = along.ravel() / max(float(np.linalg.norm(along)), 1e-12)
    visual += typical * np.outer(unit, unit)
    own = (6 * np.flatnonzero(held)[:, None] + _POSE).ravel()
    visual[own, own] += _FIXED * typical
    return visual


@dataclass(frozen=True, kw_only=True)
class Step:
    """common: (COMMON,).   own: (N, OWN) of keyframes."""

    common: F64
    own: F64


class System:
    """The equations at a state."""

    def __init__(
        self, nodes: Nodes, visual: F64, signal: ImuSignal, state: State, densities: NoiseDensity,
        s2: float, g2: float,
    ) -> None:  # fmt: skip
        self._rows = tied = np.flatnonzero(nodes.tied)
        starts = (nodes.times_s + state.offset_s)[tied]
        ends = (nodes.times_s + state.offset_s)[tied + 1]
        gyro, accel = state.gyro_bias[tied], state.accel_bias[tied]
        sums = preintegrate(signal, starts, ends, gyro, accel, densities)
        linear = linearised(state, sums, tied)
        root: F64 = np.asarray(np.linalg.inv(np.linalg.cholesky(sums.covariance)), np.float64)
        length = np.linalg.norm(of_each(root, linear.residual), axis=1) / np.sqrt(g2)
        root *= np.sqrt(np.minimum(1.0, _HUBER / np.maximum(length, _HUBER)))[:, None, None]
        walk = bias_walks(state, tied, ends - starts)
        parts = (linear.residual[:, :, None], linear.by_first, linear.by_second, linear.by_common)
        whole = [root @ part for part in parts]
        others = (walk.residual[:, :, None], walk.by_first, walk.by_second, walk.by_common)
        joined = [np.concatenate(each, axis=1) for each in zip(whole, others, strict=True)]
        residual, self._first, self._second, self._common = joined
        self._residual = residual[:, :, 0]
        turned = so3_log(nodes.R.swapaxes(1, 2) @ state.R)
        self._moved = np.concatenate([turned, state.p - nodes.p], axis=1).ravel()
        self._visual, self._state, self._nodes = visual, state, nodes
        self._s2, self._g2 = s2, g2

    def solve(self) -> tuple[Step, float, float]:
        """The step, and the factors of both variances.  Raises LinAlgError."""
        chain = self._chain()
        S, b = self._poses_and_common(chain)
        X = self._eliminate(chain, S, b)
        covariance: F64 = np.asarray(np.linalg.inv(S), np.float64)
        solution = covariance @ b
        count = len(self._nodes.p)
        own = np.empty((count, OWN))
        own[:, :6] = solution[: 6 * count].reshape(count, 6)
        own[:, 6:] = X[:, :, -1] - X[:, :, :-1] @ solution
        step = Step(common=solution[6 * count :], own=own)
        return step, *self._factors(step, covariance)

    def _chain(self) -> "_Chain":
        """The equations of the samples, and the priors of each keyframe."""
        count, rows, common = len(self._nodes.p), self._rows, self._common
        first_t = self._first.swapaxes(1, 2) / self._g2
        second_t = self._second.swapaxes(1, 2) / self._g2
        chain = _Chain(
            own=np.zeros((count, OWN, OWN)), after=np.zeros((count - 1, OWN, OWN)),
            common=np.zeros((count, OWN, COMMON)), force=np.zeros((count, OWN)),
        )  # fmt: skip
        chain.own[rows] += first_t @ self._first
        chain.own[rows + 1] += second_t @ self._second
        chain.after[rows] = first_t @ self._second
        chain.common[rows] += first_t @ common
        chain.common[rows + 1] += second_t @ common
        chain.force[rows] -= of_each(first_t, self._residual)
        chain.force[rows + 1] -= of_each(second_t, self._residual)
        for part, sigma, value in own_priors(self._state, rows):
            chain.own[:, part, part] += 1.0 / sigma[:, None] ** 2
            chain.force[:, part] -= value / sigma[:, None] ** 2
        return chain

    def _poses_and_common(self, chain: "_Chain") -> tuple[F64, F64]:
        """P and f_p: (6 N + COMMON) square, and the right side."""
        count = len(self._nodes.p)
        some, tail = slice(0, 6 * count), slice(6 * count, None)
        P, b = np.zeros(2 * (6 * count + COMMON,)), np.zeros(6 * count + COMMON)
        P[some, some] = self._visual / self._s2
        b[some] = chain.force[:, :6].ravel() - self._visual @ self._moved / self._s2
        for n in range(count):
            here, after = slice(6 * n, 6 * n + 6), slice(6 * n + 6, 6 * n + 12)
            P[here, here] += chain.own[n, :6, :6]
            if n < count - 1:
                P[here, after] += chain.after[n, :6, :6]
                P[after, here] += chain.after[n, :6, :6].T
        P[some, tail] = chain.common[:, :6].reshape(6 * count, COMMON)
        P[tail, some] = P[some, tail].T
        prior, deviation = prior_of_common(self._state)
        P[tail, tail] = np.einsum("kri,krj->ij", self._common, self._common) / self._g2 + prior
        b[tail] = -np.einsum("kri,kr->i", self._common, self._residual) / self._g2
        b[tail] -= prior @ deviation
        return P, b

    def _eliminate(self, chain: "_Chain", S: F64, b: F64) -> F64:
        """Turn P into S.  Returns K^-1 (B^T, f_k): (N, 9, 6 N + COMMON + 1)."""
        count, wide = len(self._nodes.p), len(b)
        B = np.zeros((count, OWN - 6, wide + 1))
        for n in range(count):
            here, after = slice(6 * n, 6 * n + 6), slice(6 * n + 6, 6 * n + 12)
            B[n, :, here] = chain.own[n, 6:, :6]
            if n < count - 1:
                B[n, :, after] = chain.after[n, 6:, :6]
                B[n + 1, :, here] = chain.after[n, :6, 6:].T
        B[:, :, 6 * count : wide], B[:, :, wide] = chain.common[:, 6:], chain.force[:, 6:]
        X = np.empty(B.shape)
        for left in range(0, wide + 1, _COLUMNS):
            some = slice(left, left + _COLUMNS)
            X[:, :, some] = solve_chain(
                chain.own[:, 6:, 6:], chain.after[:, 6:, 6:], np.ascontiguousarray(B[:, :, some])
            )
        for n in range(count):
            near = slice(6 * max(n - 1, 0), 6 * min(n + 2, count))
            S[near] -= B[n, :, near].T @ X[n, :, :wide]
            b[near] -= B[n, :, near].T @ X[n, :, wide]
        across = B[:, :, 6 * count : wide].reshape(-1, COMMON)
        S[6 * count :] -= across.T @ X[:, :, :wide].reshape(-1, wide)
        b[6 * count :] -= across.T @ X[:, :, wide].ravel()
        return X

    def _factors(self, step: Step, covariance: F64) -> tuple[float, float]:
        """By which s^2 and g^2 change, with the residuals after the step."""
        count, rows = len(self._nodes.p), self._rows
        moved = self._moved + step.own[:, :6].ravel()
        after = self._residual + of_each(self._first, step.own[rows])
        after += of_each(self._second, step.own[rows + 1]) + self._common @ step.common
        explained = float((covariance[: 6 * count, : 6 * count] * self._visual).sum()) / self._s2
        of_images = 6 * count - explained
        # Of lever arm and offset, the biases of each stretch, and velocities that nothing ties.
        untied = count - len(np.union1d(rows, rows + 1))
        priors = 4 + 6 * (count - len(rows)) + 3 * untied
        residuals = after.size + 6 * count + priors
        of_samples = residuals - (OWN * count + COMMON) - of_images
        squares = float(moved @ self._visual @ moved) / self._s2, float((after**2).sum()) / self._g2
        of_images, of_samples = max(of_images, 1.0), max(of_samples, 1.0)
        expected = of_images + _SIGMAS * np.sqrt(2.0 * of_images)
        return float(squares[0] / expected), squares[1] / of_samples


@dataclass(frozen=True, kw_only=True)
class _Chain:
    """Blocks of the normal equations, and their right side.

    own: (N, OWN, OWN) of each keyframe.   after: (N - 1, OWN, OWN) of it and the next.
    common: (N, OWN, COMMON).   force: (N, OWN).
    """

    own: F64
    after: F64
    common: F64
    force: F64

"""Smooth the poses of a camera by a motion model, as far as their own noise requires.

Each frame is placed by the map alone, with an error of its own: of the lens, of motion blur, of
the rows of a rolling shutter.  Hands, vehicles and drones move more smoothly than these errors do.
The prior is a camera whose velocity changes at random (white noise on acceleration, Barfoot, State
Estimation for Robotics, section 11.1): with T = T_camera_world, xi the (6,) correction of a pose
(translation first, T <- exp(xi) T), and w its velocity,

    xi' = Ad(D) xi + dt w - log(D) + n,   w' = w + m,   D = T' T^-1,
    cov(n, m) = diag(q) kron [[dt^3/3, dt^2/2], [dt^2/2, dt]],

where q has one value for translation and one for rotation.  The map measures xi = 0 with the
covariance ``s^2 H^-1`` (H: information of the pose for a noise of one pixel).  The variance s^2 and
both q maximise the likelihood of the poses (prediction errors of a Kalman filter).  So poses
without an error of their own stay unchanged.  Both noises have heavy tails: residuals of frames and
of steps are weighted as those of a Student-t distribution.  Otherwise a sudden turn would be
rounded off, and one bad pose would move its neighbours.  All is linear in xi, which is small: one
pass of filter and smoother (Bryson and Frazier's form, which inverts 6 x 6 matrices alone) is
exact.
"""

import numpy as np

from pliant.algorithms.arrays import F64, I64
from pliant.algorithms.geometry import hat, inverse, so3_exp, so3_log
from pliant.compiler.kernel import kernel

_LEAST_FRAMES = 10
"""Fewer tell nothing of three variances."""

_TAILS = 4.0
"""Degrees of freedom of the Student-t distributions, usual for noise with outliers."""

_ROUNDS = 8
"""Of weights and variances in turn."""

_FIRST_NOISE = (0.0, -8.0)
"""ln of the variances of noise from which the search begins."""

_MOST_CHANGE = 20.0
"""Of the logarithms from the first guess: keeps exact poses from variances of zero."""

_FIRST_STEP, _LAST_STEP = 2.0, 0.1
"""Of the search for the logarithms of the variances."""


_CONTRADICTION = 4.0
"""A smoothed pose contradicts its own observations from this multiple of the most noise on."""


def smooth_trajectory(
    T_world_camera: F64, information: F64, stamps_ns: I64, most_noise_px: float
) -> F64:
    """Most likely poses of frames that follow each other.

    T_world_camera: (N, 4, 4) as measured.   information: (N, 6, 6) of ``T_camera_world``
    (translation, rotation) for one pixel of noise; NaN or 0 where it is unknown, and then the pose
    stays.   stamps_ns: (N,) increasing.   most_noise_px: what s may be at the most.
    Returns (N, 4, 4).  Poses stay where there are too few frames, or where only more noise would
    make their motion smooth.  A trajectory is split where a pose would contradict its own
    observations, as at a cut.
    """
    diagonals = np.diagonal(information, axis1=1, axis2=2)
    known = np.isfinite(information).all(axis=(1, 2)) & (diagonals > 0.0).all(axis=1)
    smoothed, runs = T_world_camera.copy(), [np.flatnonzero(known)]
    while runs:
        run = runs.pop()
        if len(run) < _LEAST_FRAMES:
            continue
        poses, cut = _smooth_run(
            T_world_camera[run], information[run], stamps_ns[run], most_noise_px
        )
        if cut:
            runs += [run[:cut], run[cut:]]
        else:
            smoothed[run] = poses
    return smoothed


def _smooth_run(
    T_world_camera: F64, information: F64, stamps_ns: I64, most_noise_px: float
) -> tuple[F64, int]:
    """The poses, and the frame before which the trajectory has to be split; 0: nowhere."""
    T = inverse(T_world_camera)
    D = T[1:] @ T_world_camera[:-1]
    steps, adjoints = _se3_log(D), _adjoints(D)
    dt = 1e-9 * np.diff(stamps_ns)
    motion = _Motion(_covariances(information), steps, adjoints, dt, steps / dt[:, None])
    variances = motion.first_fit()
    for _ in range(_ROUNDS):
        motion.weigh(variances)
        variances, _ = motion.fit(variances, 0.5 * _FIRST_STEP)
    if variances[0] > 2.0 * np.log(most_noise_px):
        return T_world_camera, 0
    xi, chi2_steps = motion.corrections(variances)
    if not np.isfinite(xi).all():  # rounding: poses are exact but for a few
        return T_world_camera, 0
    moved_px2 = np.einsum("ni,nij,nj->n", xi, information, xi)
    worst = int(np.argmax(moved_px2))
    if moved_px2[worst] > (_CONTRADICTION * most_noise_px) ** 2:
        beside = [n for n in (worst, worst + 1) if 0 < n < len(xi)]
        return T_world_camera, max(beside, key=lambda n: float(chi2_steps[n]))
    return inverse(_se3_exp(xi) @ T), 0


class _Motion:
    """The linear system of a trajectory.  Variances are ln (s^2, q of translation, of rotation)."""

    def __init__(self, covariance: F64, steps: F64, adjoints: F64, dt: F64, velocity: F64) -> None:
        N = len(covariance)
        self._guess = _first_guess(velocity, dt)
        self._covariance, self._steps, self._adjoints, self._dt = covariance, steps, adjoints, dt
        self._spread = 100.0 * (velocity**2).mean(axis=0) + 1e-12
        self._frame_weights, self._step_weights = np.ones(N), np.ones(N)
        self._states = np.zeros((N, 12))
        self._chi2_frames, self._chi2_steps = np.zeros(N), np.zeros(N)

    def fit(self, variances: F64, step: float) -> tuple[F64, float]:
        """The most likely variances near those given, and their likelihood: a compass search."""
        best, likelihood = variances, self._run(variances, smooth=False)
        while step >= _LAST_STEP:
            improved = False
            for move in (*np.eye(3), *-np.eye(3)):
                tried = best + step * move
                if np.abs(tried - self._guess).max() > _MOST_CHANGE:
                    continue
                value = self._run(tried, smooth=False)
                if value > likelihood:
                    best, likelihood, improved = tried, value, True
            if not improved:
                step *= 0.5
        return best, likelihood

    def first_fit(self) -> F64:
        """The most likely variances, from a noise of one pixel or of hardly any: the search may
        find a local maximum."""
        starts = [self._guess + np.array([noise, 0.0, 0.0]) for noise in _FIRST_NOISE]
        fits = [self.fit(start, _FIRST_STEP) for start in starts]
        return max(fits, key=lambda fit: fit[1])[0]

    def weigh(self, variances: F64) -> None:
        """Weigh frames and steps by what the smoothed trajectory leaves of them."""
        self._run(variances, smooth=True)
        self._frame_weights = (_TAILS + 6.0) / (_TAILS + self._chi2_frames)
        self._step_weights = (_TAILS + 12.0) / (_TAILS + self._chi2_steps)

    def corrections(self, variances: F64) -> tuple[F64, F64]:
        """(N, 6) of the smoothed poses; (N,) squared residuals of the step to each frame."""
        self._run(variances, smooth=True)
        return self._states[:, :6].copy(), self._chi2_steps.copy()

    def _run(self, variances: F64, *, smooth: bool) -> float:
        s2, q_translation, q_rotation = np.exp(variances).tolist()
        return _filter(
            self._covariance, self._steps, self._adjoints, self._dt, self._frame_weights,
            self._step_weights, self._spread, s2, q_translation, q_rotation, smooth, self._states,
            self._chi2_frames, self._chi2_steps,
        )  # fmt: skip


def _first_guess(velocity: F64, dt: F64) -> F64:
    """ln of the variances: a noise of one pixel, and all changes of velocity are the camera's."""
    changes = np.diff(velocity, axis=0) ** 2 / dt[1:, None]
    q = np.maximum(changes.mean(axis=0), 1e-9 * (velocity**2).mean(axis=0)) + 1e-18
    return np.array([0.0, *np.log(q.reshape(2, 3).mean(axis=1))])


def _covariances(information: F64) -> F64:
    """(N, 6, 6) for one pixel of noise."""
    # A direction of which nothing is known must not make the inverse infinite.
    floor = 1e-9 * np.diagonal(information, axis1=1, axis2=2).max(axis=1)
    return np.asarray(np.linalg.inv(information + floor[:, None, None] * np.eye(6)), np.float64)


def _adjoints(D: F64) -> F64:
    """(N, 6, 6) of (N, 4, 4): ``D exp(xi) = exp(Ad xi) D``, translation first."""
    R, t = D[:, :3, :3], D[:, :3, 3]
    adjoints = np.zeros((len(D), 6, 6))
    adjoints[:, :3, :3] = adjoints[:, 3:, 3:] = R
    adjoints[:, :3, 3:] = hat(t) @ R
    return adjoints


def _se3_log(D: F64) -> F64:
    """(N, 6) of (N, 4, 4)."""
    theta = so3_log(D[:, :3, :3])
    rho = np.linalg.solve(_left_jacobian(theta), D[:, :3, 3, None])
    return np.asarray(np.concatenate([rho[:, :, 0], theta], axis=1), np.float64)


def _se3_exp(xi: F64) -> F64:
    """(N, 4, 4) of (N, 6)."""
    T = np.tile(np.eye(4), (len(xi), 1, 1))
    T[:, :3, :3] = so3_exp(xi[:, 3:])
    T[:, :3, 3] = (_left_jacobian(xi[:, 3:]) @ xi[:, :3, None])[:, :, 0]
    return T


def _left_jacobian(theta: F64) -> F64:
    """(N, 3, 3) of rotation vectors (N, 3): the translation of exp((rho, theta)) is V rho."""
    angle = np.linalg.norm(theta, axis=1)[:, None, None]
    small = angle < 1e-4
    safe = np.where(small, 1.0, angle)
    W = hat(theta)
    first = np.where(small, 0.5 - angle**2 / 24.0, (1.0 - np.cos(safe)) / safe**2)
    second = np.where(small, 1 / 6 - angle**2 / 120.0, (safe - np.sin(safe)) / safe**3)
    return np.eye(3) + first * W + second * (W @ W)


@kernel
def _filter(
    covariance: F64, steps: F64, adjoints: F64, dt: F64, frame_weights: F64, step_weights: F64,
    spread: F64, s2: float, q_translation: float, q_rotation: float, smooth: bool, states: F64,
    chi2_frames: F64, chi2_steps: F64,
) -> float:  # fmt: skip
    """ln of the likelihood of a trajectory, but for a constant; with ``smooth`` its states, too.

    states: (N, 12) (xi, w).   chi2_frames, chi2_steps: (N,) squared residuals of the smoothed
    states by their covariances, without weights.
    """
    N = covariance.shape[0]
    kept = N if smooth else 1
    means, predicted_P = np.zeros((kept, 12)), np.zeros((12, 12))
    P, all_P = np.zeros((12, 12)), np.zeros((kept, 12, 12))
    all_K, all_S, all_v = np.zeros((kept, 12, 6)), np.zeros((kept, 6, 6)), np.zeros((kept, 6))
    x, xm, F = np.zeros(12), np.zeros(12), np.zeros((12, 12))
    L, K, v, z = np.zeros((6, 6)), np.zeros((12, 6)), np.zeros(6), np.zeros(6)
    for i in range(6):
        for j in range(6):
            P[i, j] = s2 * covariance[0, i, j] / frame_weights[0]
        P[6 + i, 6 + i] = spread[i]
    if smooth:
        all_P[0] = P
    likelihood = 0.0
    for n in range(1, N):
        _transition(F, adjoints[n - 1], dt[n - 1])
        for i in range(12):
            xm[i] = 0.0
            for j in range(12):
                xm[i] += F[i, j] * x[j]
        for i in range(6):
            xm[i] -= steps[n - 1, i]
        _predict(P, F, predicted_P)
        _add_process_noise(predicted_P, dt[n - 1], q_translation, q_rotation, step_weights[n])
        for i in range(6):
            v[i] = -xm[i]
            for j in range(i + 1):
                L[i, j] = predicted_P[i, j] + s2 * covariance[n, i, j] / frame_weights[n]
        _cholesky(L)
        _solve_lower(L, v, z)
        for i in range(6):
            likelihood -= 0.5 * z[i] * z[i] + np.log(L[i, i])
        for row in range(12):  # K = P H^T S^-1, row by row
            _solve_both(L, predicted_P[row, :6], K[row])
        for i in range(12):
            x[i] = xm[i]
            for k in range(6):
                x[i] += K[i, k] * v[k]
            for j in range(12):
                P[i, j] = predicted_P[i, j]
                for k in range(6):
                    P[i, j] -= K[i, k] * predicted_P[k, j]
        for i in range(12):
            for j in range(i):
                P[i, j] = P[j, i] = 0.5 * (P[i, j] + P[j, i])
        if smooth:
            means[n], all_P[n], all_K[n], all_S[n], all_v[n] = x, P, K, L, v
    if smooth:
        _smooth(means, all_P, all_K, all_S, all_v, adjoints, dt, states)
        _residuals(
            states, covariance, steps, adjoints, dt, s2, q_translation, q_rotation, chi2_frames,
            chi2_steps,
        )  # fmt: skip
    return likelihood


@kernel
def _transition(F: F64, adjoint: F64, dt: float) -> None:
    for i in range(6):
        for j in range(6):
            F[i, j] = adjoint[i, j]
        F[i, 6 + i] = dt
        F[6 + i, 6 + i] = 1.0


@kernel
def _predict(P: F64, F: F64, out: F64) -> None:
    """F P F^T; the lower half of F is (0, I)."""
    FP = np.zeros((6, 12))
    for i in range(6):
        for j in range(12):
            value = F[i, 6 + i] * P[6 + i, j]
            for k in range(6):
                value += F[i, k] * P[k, j]
            FP[i, j] = value
    for i in range(6):
        for j in range(6):
            value = FP[i, 6 + j] * F[j, 6 + j]
            for k in range(6):
                value += FP[i, k] * F[j, k]
            out[i, j] = value
            out[i, 6 + j] = out[6 + j, i] = FP[i, 6 + j]
            out[6 + i, 6 + j] = P[6 + i, 6 + j]


@kernel
def _add_process_noise(
    P: F64, dt: float, q_translation: float, q_rotation: float, weight: float
) -> None:
    for i in range(6):
        q = (q_translation if i < 3 else q_rotation) / weight
        P[i, i] += q * dt**3 / 3.0
        P[i, 6 + i] += q * dt**2 / 2.0
        P[6 + i, i] += q * dt**2 / 2.0
        P[6 + i, 6 + i] += q * dt


@kernel
def _cholesky(A: F64) -> None:
    """The lower factor, in place of the lower half."""
    for i in range(A.shape[0]):
        for j in range(i + 1):
            value = A[i, j]
            for k in range(j):
                value -= A[i, k] * A[j, k]
            A[i, j] = np.sqrt(max(value, 1e-300)) if i == j else value / A[j, j]


@kernel
def _solve_lower(L: F64, b: F64, out: F64) -> None:
    for i in range(L.shape[0]):
        value = b[i]
        for k in range(i):
            value -= L[i, k] * out[k]
        out[i] = value / L[i, i]


@kernel
def _solve_both(L: F64, b: F64, out: F64) -> None:
    """(L L^T)^-1 b."""
    _solve_lower(L, b, out)
    for i in range(L.shape[0] - 1, -1, -1):
        value = out[i]
        for k in range(i + 1, L.shape[0]):
            value -= L[k, i] * out[k]
        out[i] = value / L[i, i]


@kernel
def _smooth(
    means: F64, all_P: F64, all_K: F64, all_L: F64, all_v: F64, adjoints: F64, dt: F64, states: F64
) -> None:
    """Modified Bryson-Frazier: lam carries the information of later frames on each state."""
    N = means.shape[0]
    lam, moved, z, back = np.zeros(12), np.zeros(12), np.zeros(6), np.zeros(12)
    for n in range(N - 1, -1, -1):
        for i in range(12):
            states[n, i] = means[n, i]
            for j in range(12):
                states[n, i] -= all_P[n, i, j] * lam[j]
        if n == 0:
            break
        # moved = (I - K H)^T lam - H^T S^-1 v
        _solve_both(all_L[n], all_v[n], z)
        for i in range(12):
            moved[i] = lam[i]
        for k in range(6):
            for i in range(12):
                moved[k] -= all_K[n, i, k] * lam[i]
            moved[k] -= z[k]
        # lam = F^T moved
        for j in range(6):
            back[j] = 0.0
            for i in range(6):
                back[j] += adjoints[n - 1, i, j] * moved[i]
            back[6 + j] = dt[n - 1] * moved[j] + moved[6 + j]
        for i in range(12):
            lam[i] = back[i]


@kernel
def _residuals(
    states: F64, covariance: F64, steps: F64, adjoints: F64, dt: F64, s2: float,
    q_translation: float, q_rotation: float, chi2_frames: F64, chi2_steps: F64,
) -> None:  # fmt: skip
    L, z = np.zeros((6, 6)), np.zeros(6)
    for n in range(states.shape[0]):
        for i in range(6):
            for j in range(i + 1):
                L[i, j] = covariance[n, i, j]
        _cholesky(L)
        _solve_lower(L, states[n, :6], z)
        chi2_frames[n] = 0.0
        for i in range(6):
            chi2_frames[n] += z[i] * z[i] / s2
        chi2_steps[n] = 0.0
        if n == 0:
            continue
        d = dt[n - 1]
        for i in range(6):
            moved = states[n, i] + steps[n - 1, i] - d * states[n - 1, 6 + i]
            for j in range(6):
                moved -= adjoints[n - 1, i, j] * states[n - 1, j]
            faster = states[n, 6 + i] - states[n - 1, 6 + i]
            q = q_translation if i < 3 else q_rotation
            chi2_steps[n] += (
                12.0 * moved * moved / d**3 - 12.0 * moved * faster / d**2 + 4.0 * faster**2 / d
            ) / q

"""The similarity between a map and the Earth, from a trajectory and satellite fixes.

A fix p_i (east, north, up) with covariance C_i, at time t_i, and the trajectory x(t):

    p_i = c + s R (x(t_i + tau) - m) + e_i,    e_i ~ N(0, k^2 C_i)

m is the mean of the trajectory, so that c, the place of the middle, is nearly independent of scale
s and rotation R (Umeyama 1991 has the closed form for C_i = 1 and tau = 0).  tau is the offset of
the receiver's clock from the camera's.  k is the factor by which fixes are worse, or better, than
their receiver reports; without a report C_i is that of 1 m, and k is the error in metres.

The unknowns (log s, omega, c, tau), R <- exp(omega) R, are found by Gauss-Newton.  With
v_i = s R (x_i - m) and the velocity w_i = s R dx/dt, the residual r_i = p_i - c - v_i has

    dr/dlog s = -v_i,   dr/domega = [v_i]x,   dr/dc = -1,   dr/dtau = -w_i.

With gravity, R is a rotation about the vertical after the map's up has been turned there, and omega
has one component.  Errors are weighted by Cauchy's function of their length in sigmas, since fixes
between houses are wrong by tens of metres.

Errors of fixes change slowly: those of one second are those of the second before.  So covariances
are multiplied by (1 + a) / (1 - a), what an autoregressive process of correlation a does to the
variance of a mean (Bartlett 1935).
"""

from dataclasses import dataclass

import numpy as np

from pliant.algorithms.arrays import F64, I64, BoolArray
from pliant.algorithms.geometry import hat, so3_exp
from pliant.algorithms.inertial.geodesy import EnuOrigin, enu_of
from pliant.algorithms.inertial.samples import GpsFixes

_LEAST_FIXES = 8
_LONGEST_GAP_S = 1.0
"""Across a longer gap of the trajectory, positions are not interpolated."""
_OFFSET_RANGE_S, _OFFSET_STEP_S, _OFFSET_SIGMA_S = 5.0, 0.25, 2.0
"""Receivers are late by tenths of a second, and clocks of two devices differ by some."""
_VERTICAL = 2.0
"""Vertical errors relative to horizontal ones where the receiver does not say them: geometry of the
satellites (Langley, GPS World 1999: typical VDOP / HDOP)."""
_CAUCHY = 2.385
"""In sigmas: 95 % efficiency for normal errors (Holland and Welsch 1977)."""
_VAGUE = 1e-12
"""Information that keeps the equations regular where fixes have no component, such as a height."""
_ROUNDS = 30
_START_ROUNDS = 5
_TRIMMED = 0.7
"""Share of the fixes, the best ones, that an offset is judged by: the others may be wrong."""
_AGREES = 3.0
"""Sigmas within which a fix agrees."""
_LEAST_AGREEING = 0.6
_MOST_SCALE_SIGMA = 0.1
_MOST_TURN_SIGMA_RAD = np.radians(5.0)
_MEDIAN_OF_CHI = (0.6745, 1.1774, 1.5382)
"""Medians of the length of 1, 2 and 3 normal numbers."""


@dataclass(frozen=True, kw_only=True)
class GpsFit:
    """A map on the Earth: ``p_enu = metres_per_unit R_enu_world p_world + p_enu_world``.

    scale_sigma: relative standard deviation of the scale.    origin: of the frame ENU.
    offset_s: the fix of time t is where the trajectory is at t + offset_s.
    error_m: root mean square horizontal distance of the fixes that agree.
    fixes, agreeing: how many were used, and how many of these agree.
    """

    metres_per_unit: float
    R_enu_world: F64
    p_enu_world: F64
    origin: EnuOrigin
    scale_sigma: float
    turn_sigma_rad: float
    offset_s: float
    offset_sigma_s: float
    error_m: float
    fixes: int
    agreeing: int

    @property
    def S_enu_world(self) -> F64:
        """(4, 4): the similarity as a matrix."""
        S = np.eye(4)
        S[:3, :3] = self.metres_per_unit * self.R_enu_world
        S[:3, 3] = self.p_enu_world
        return S


@dataclass(frozen=True)
class GpsRefusal:
    """Why fixes do not determine where a map lies, for people."""

    reason: str


@dataclass
class State:
    """The unknowns, as in the formulas of this module."""

    log_scale: float
    R: F64
    centre: F64
    tau: float


@dataclass(frozen=True)
class Problem:
    """fixes: (N, 3) ENU.  inverse_sigma: (N, 3).  stamps_s, times_s: of fixes and trajectory.

    positions: (M, 3) minus their mean.   R_up: the map's up to z; None: unknown.
    """

    fixes: F64
    inverse_sigma: F64
    stamps_s: F64
    times_s: F64
    positions: F64
    velocities: F64
    R_up: F64 | None

    def at(self, tau: float) -> tuple[F64, F64, BoolArray]:
        """Positions and velocities (N, 3) at the times of the fixes, and which there are."""
        wanted = self.stamps_s + tau
        columns = [
            np.stack([np.interp(wanted, self.times_s, column) for column in values.T], axis=1)
            for values in (self.positions, self.velocities)
        ]
        after = np.clip(np.searchsorted(self.times_s, wanted), 1, len(self.times_s) - 1)
        inside = (wanted >= self.times_s[0]) & (wanted <= self.times_s[-1])
        near = self.times_s[after] - self.times_s[after - 1] <= _LONGEST_GAP_S
        return columns[0], columns[1], inside & near


def fit_to_fixes(
    stamps_ns: I64,
    positions: F64,
    fixes: GpsFixes,
    up_world: F64 | None = None,
    *,
    oriented: bool = True,
) -> GpsFit | GpsRefusal:
    """Fit a trajectory to fixes.

    stamps_ns, positions: (N,), (N, 3) of the camera, of one segment of the map.
    up_world: (3,) direction against gravity in the map, where it is known.
    oriented: refuse an uncertain orientation, which the scale does not need.
    """
    if len(stamps_ns) < 2 or not len(fixes.stamps_ns):
        return GpsRefusal("there are no fixes during the trajectory")
    if up_world is None and np.isinf(fixes.sigma_m[:, 2]).all():
        # A plane's picture of a path in space fits two paths, mirrored at the plane.
        return GpsRefusal("the fixes have no altitude, and gravity is unknown")
    mean = positions.mean(axis=0)
    problem, origin = _problem(stamps_ns, positions - mean, fixes, up_world)
    state = _start(problem)
    if state is None:
        return GpsRefusal(
            f"fewer than {_LEAST_FIXES} fixes are during the trajectory, or it does not move"
        )
    for _ in range(_ROUNDS):
        step, _, _ = _step(problem, state)
        moved_by(problem, state, step)
        if np.abs(step).max() < 1e-9 * max(1.0, np.abs(state.centre).max()):
            break
    _, covariance, lengths = _step(problem, state)
    scale = float(np.exp(state.log_scale))
    off, _ = linearised(problem, state)
    agreeing = lengths < _AGREES
    across = np.linalg.norm(off[agreeing][:, :2], axis=1)
    turns = slice(1, 2) if up_world is not None else slice(1, 4)
    sigmas = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    fit = GpsFit(
        metres_per_unit=scale,
        R_enu_world=state.R,
        p_enu_world=state.centre - scale * state.R @ mean,
        origin=origin,
        scale_sigma=float(sigmas[0]),
        turn_sigma_rad=float(sigmas[turns].max()),
        offset_s=state.tau,
        offset_sigma_s=float(sigmas[-1]),
        error_m=float(np.sqrt(np.mean(across * across))) if len(across) else np.inf,
        fixes=len(off),
        agreeing=int(agreeing.sum()),
    )
    why = _fault(fit, scale * _extent(problem.positions))
    if not why and oriented and fit.turn_sigma_rad > _MOST_TURN_SIGMA_RAD:
        what = "short" if up_world is not None else "straight"
        turn = np.degrees(fit.turn_sigma_rad)
        why = f"the trajectory is too {what}: its orientation is uncertain by {turn:.0f} degrees"
    return GpsRefusal(why) if why else fit


def _fault(fit: GpsFit, extent_m: float) -> str:
    """Why the scale is not to be believed; "" if it is."""
    if fit.agreeing < _LEAST_AGREEING * fit.fixes:
        return (
            f"only {fit.agreeing} of {fit.fixes} fixes agree with the trajectory (error "
            f"{fit.error_m:.1f} m)"
        )
    if fit.scale_sigma > _MOST_SCALE_SIGMA:
        return (
            f"the trajectory of {extent_m:.0f} m is too short for fixes with an error of "
            f"{fit.error_m:.1f} m: the scale is uncertain by {fit.scale_sigma:.0%}"
        )
    return ""


def _extent(positions: F64) -> float:
    return float(np.linalg.norm(np.ptp(positions, axis=0)))


def _problem(
    stamps_ns: I64, positions: F64, fixes: GpsFixes, up_world: F64 | None
) -> tuple[Problem, EnuOrigin]:
    origin = EnuOrigin(
        latitude_deg=float(fixes.latitude_deg[0]),
        longitude_deg=float(fixes.longitude_deg[0]),
        altitude_m=float(fixes.altitude_m[0]),
    )
    times = 1e-9 * (stamps_ns - stamps_ns[0])
    default = np.where(np.isinf(fixes.sigma_m), np.inf, [1.0, 1.0, _VERTICAL])
    said = np.isfinite(fixes.sigma_m[:, :2]).all()
    sigma = np.where(np.isnan(fixes.sigma_m) | (not said), default, fixes.sigma_m)
    enu = enu_of(fixes.latitude_deg, fixes.longitude_deg, fixes.altitude_m, origin)
    problem = Problem(
        fixes=enu,
        inverse_sigma=1.0 / sigma,
        stamps_s=1e-9 * (fixes.stamps_ns - stamps_ns[0]),
        times_s=times,
        positions=positions,
        velocities=np.gradient(positions, times, axis=0),
        R_up=None if up_world is None else _to_vertical(up_world),
    )
    return problem, origin


def _to_vertical(up: F64) -> F64:
    """A rotation of a direction to z (Rodrigues)."""
    up = up / np.linalg.norm(up)
    if up[2] < -1.0 + 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    K = hat(np.cross(up, [0.0, 0.0, 1.0]))
    return np.eye(3) + K + K @ K / (1.0 + up[2])


def _start(problem: Problem) -> State | None:
    """The best of closed forms over a grid of offsets."""
    best: tuple[float, State] | None = None
    counts = [int(problem.at(tau)[2].sum()) for tau in _offsets()]
    for tau, count in zip(_offsets(), counts, strict=True):
        if count < max(_LEAST_FIXES, 0.8 * max(counts)):
            continue
        x, _, used = problem.at(tau)
        found = _closed_form(problem, x[used], problem.fixes[used])
        if found is None:
            continue
        state, lengths = found
        state.tau = tau
        kept = np.sort(lengths)[: max(3, int(_TRIMMED * count))]
        cost = float(np.mean(kept * kept)) * (1.0 + 1e-3 * (tau / _OFFSET_SIGMA_S) ** 2)
        if best is None or cost < best[0]:
            best = cost, state
    return None if best is None else best[1]


def _offsets() -> list[float]:
    steps = round(_OFFSET_RANGE_S / _OFFSET_STEP_S)
    return [_OFFSET_STEP_S * step for step in range(-steps, steps + 1)]


def _closed_form(problem: Problem, x: F64, p: F64) -> tuple[State, F64] | None:
    """Umeyama's similarity with weights, again and again with those of 1 / error, and the errors
    (N,) in metres; None where nothing moves."""
    weights = np.ones(len(x))
    state, errors = None, weights
    for _ in range(_START_ROUNDS):
        share = weights / weights.sum()
        mean_x, mean_p = share @ x, share @ p
        dx, dp = x - mean_x, p - mean_p
        if problem.R_up is None:
            variance = float(share @ (dx * dx).sum(axis=1))
            U, D, Vt = np.linalg.svd((share[:, None] * dp).T @ dx)
            sign = np.array([1.0, 1.0, np.sign(np.linalg.det(U) * np.linalg.det(Vt))])
            turn, product = (U * sign) @ Vt, float((D * sign).sum())
        else:
            dx = dx @ problem.R_up.T
            variance = float(share @ (dx[:, :2] * dx[:, :2]).sum(axis=1))
            turned = np.sum(share * (dx[:, 0] - 1j * dx[:, 1]) * (dp[:, 0] + 1j * dp[:, 1]))
            turn = so3_exp(np.array([0.0, 0.0, np.angle(turned)])) @ problem.R_up
            product = float(abs(turned))
        if variance <= 0.0 or product <= 0.0:
            return None
        scale = product / variance
        state = State(float(np.log(scale)), turn, mean_p - scale * turn @ mean_x, 0.0)
        off = (p - state.centre - scale * x @ turn.T)[:, : 3 if problem.R_up is None else 2]
        errors = np.linalg.norm(off, axis=1)
        weights = 1.0 / np.maximum(errors, 1e-3 * scale * np.sqrt(variance))
    return None if state is None else (state, errors)


def _step(problem: Problem, state: State) -> tuple[F64, F64, F64]:
    """The step of Gauss-Newton, the covariance of the unknowns, and the lengths (N,) of the errors
    of the fixes that are used, in sigmas."""
    off, by_unknowns = linearised(problem, state)
    inverse_sigma = problem.inverse_sigma[problem.at(state.tau)[2]]
    r, J = off * inverse_sigma, by_unknowns * inverse_sigma[:, :, None]
    known = int((inverse_sigma > 0.0).all(axis=0).sum())
    factor = float(np.median(np.linalg.norm(r, axis=1))) / _MEDIAN_OF_CHI[max(known, 1) - 1]
    factor = max(factor, 1e-9)
    lengths = np.linalg.norm(r, axis=1) / factor
    weights = 1.0 / (1.0 + (lengths / _CAUCHY) ** 2)
    H = np.einsum("n,nai,naj->ij", weights, J, J)
    b = np.einsum("n,nai,na->i", weights, J, r)
    # The offset's prior, in units of the fixes' errors as all else here.
    H[-1, -1] += (factor / _OFFSET_SIGMA_S) ** 2
    b[-1] += (factor / _OFFSET_SIGMA_S) ** 2 * state.tau
    H[np.diag_indices(len(H))] += _VAGUE
    covariance = np.linalg.inv(H) * factor * factor * _correlation(r * weights[:, None])
    return -np.linalg.solve(H, b), covariance, lengths


def linearised(problem: Problem, state: State) -> tuple[F64, F64]:
    """Residuals (N, 3) of the fixes that are used, in metres, and their derivatives (N, 3, 8), or
    (N, 3, 6) with gravity."""
    x, w, used = problem.at(state.tau)
    scale = np.exp(state.log_scale)
    v, velocity = scale * x[used] @ state.R.T, scale * w[used] @ state.R.T
    turns = hat(v) if problem.R_up is None else hat(v)[:, :, 2:]
    fixed = np.broadcast_to(-np.eye(3), (len(v), 3, 3))
    J = np.concatenate([-v[:, :, None], turns, fixed, -velocity[:, :, None]], axis=2)
    return problem.fixes[used] - state.centre - v, J


def _correlation(errors: F64) -> float:
    """By how much the variance of a mean grows, as errors (N, 3) follow each other."""
    before, after = errors[:-1].reshape(-1), errors[1:].reshape(-1)
    square = float(errors.reshape(-1) @ errors.reshape(-1))
    a = float(before @ after) / square if square > 0.0 else 0.0
    a = min(max(a, 0.0), 0.99)
    return (1.0 + a) / (1.0 - a)


def moved_by(problem: Problem, state: State, step: F64) -> None:
    """Apply a step to the unknowns, in place."""
    state.log_scale += float(np.clip(step[0], -0.5, 0.5))
    omega = step[1:-4] if problem.R_up is None else np.array([0.0, 0.0, step[1]])
    state.R = so3_exp(omega) @ state.R
    state.centre = state.centre + step[-4:-1]
    state.tau = float(np.clip(state.tau + step[-1], -2 * _OFFSET_RANGE_S, 2 * _OFFSET_RANGE_S))

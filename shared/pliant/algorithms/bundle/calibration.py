"""Bundle adjustment that corrects the calibration too (self-calibration).

Schur complement LM (Eq. 9-10) with more unknowns that all cameras share: the logarithm of the
focal length's factor, the radial distortion that rectification left, and the readout of a rolling
shutter; derivation in ``calibration_kernels``.  Several views tell the focal length from rotation,
and from parallax that differs across the image.  Where they cannot (no rotation, one plane, forward
motion) the prior holds it.
"""

import dataclasses
from dataclasses import dataclass

import numpy as np

from pliant.algorithms.arrays import F32, F64
from pliant.algorithms.bundle.calibration_kernels import (
    PAIRS,
    UNKNOWNS,
    calibrated_substitution,
    calibrated_system,
)
from pliant.algorithms.bundle.camera_step import move_cameras
from pliant.algorithms.bundle.cost import limits_of, total_cost
from pliant.algorithms.bundle.damped import damped_iterations
from pliant.algorithms.bundle.layout import Layout, build_layout
from pliant.algorithms.bundle.problem import AnyProblem, BundleParameters, BundleResult
from pliant.algorithms.bundle.reduced import add_cameras, solve_reduced
from pliant.algorithms.bundle.result import OnIteration, make_result
from pliant.algorithms.bundle.uncertainty import CalibrationUncertainty
from pliant.algorithms.camera import PinholeCamera

_LOWER = np.tril_indices(UNKNOWNS)
_NEWTON_STEPS = 8
_LEAST_SLOPE = 0.1


@dataclass(frozen=True)
class _State:
    cameras: F64
    points: F64
    calibration: F64


def solve_calibrating(
    problem: AnyProblem,
    parameters: BundleParameters,
    uncertainty: CalibrationUncertainty,
    on_iteration: OnIteration | None = None,
    flow: F32 | None = None,
) -> tuple[BundleResult, F64]:
    """``solve_schur`` with an unknown calibration.

    flow: (2, M, N) px by which a rolling shutter moves the observation of point n in camera m when
    its readout fills the frame interval; None: there is none, and the readout stays 0.
    Returns the result, whose costs include the prior, and (4,) the correction (s, k1, k2, readout):
    the observations follow ``u = fx e^s (1 + k1 r^2 + k2 r^4) x + cx + readout flow``.  k1 and k2
    of the problem's intrinsics are the start and centre of the prior.  Raises ValueError for
    cameras that differ in their lenses.
    """
    lens = problem.intrinsics[:, 4:]
    if len(lens) == 0 or (lens != lens[0]).any():
        raise ValueError("an unknown calibration must be that of all cameras")
    given = np.array([0.0, lens[0, 0], lens[0, 1], 0.0])
    solver = _Solver(problem, parameters, uncertainty, given, flow)
    state, costs, converged = damped_iterations(
        solver.start(), solver.cost, solver.step, parameters, on_iteration
    )
    layout = solver.at(state.calibration)
    result = make_result(problem, layout, state.cameras, state.points, costs, converged, parameters)
    return result, state.calibration


class _Solver:
    def __init__(
        self,
        problem: AnyProblem,
        parameters: BundleParameters,
        uncertainty: CalibrationUncertainty,
        given: F64,
        flow: F32 | None,
    ) -> None:
        self.layout = build_layout(problem)
        self.flow: F32 = np.zeros((2, *self.layout.u.shape), np.float32)
        if flow is not None:
            self.flow[:, :, self.layout.column] = flow
        self.parameters = parameters
        self.given = given
        sigmas = uncertainty.sigmas
        self.known = sigmas == 0.0
        self.known[3] |= flow is None
        self.precision = uncertainty.prior_px**2 / np.where(self.known, 1.0, sigmas) ** 2
        w = self.layout.w
        self.w: F32 = np.concatenate([w, w.max(axis=0, keepdims=True)])

    def start(self) -> _State:
        return _State(self.layout.cameras, self.layout.points, self.given)

    def at(self, calibration: F64) -> Layout:
        """The layout with the cameras of a calibration."""
        layout = self.layout
        pinholes = layout.pinholes.copy()
        pinholes[:, :2] *= np.exp(calibration[0])
        lenses = np.tile(calibration[1:3], (len(pinholes), 1))
        moved = np.float32(calibration[3]) * self.flow
        return dataclasses.replace(
            layout, pinholes=pinholes, lenses=lenses, u=layout.u - moved[0], v=layout.v - moved[1]
        )

    def cost(self, state: _State) -> float:
        departure = state.calibration - self.given
        seen = total_cost(self.at(state.calibration), state.cameras, state.points, self.parameters)
        return seen + 0.5 * float(self.precision @ departure**2)

    def step(self, state: _State, damping: float) -> _State | None:
        layout, limits = self.at(state.calibration), limits_of(self.parameters)
        moving = np.flatnonzero(layout.free >= 0)
        M, F = len(layout.cameras), len(moving)
        S, b = np.zeros((6 * F + 6, 6 * F + 6)), np.zeros(6 * F + 6)
        normal, cross, shared = (
            np.zeros((M, 27)),
            np.zeros((M, 6 * UNKNOWNS)),
            np.zeros(PAIRS + UNKNOWNS),
        )
        calibrated_system(
            state.cameras, layout.pinholes, layout.lenses, layout.free, state.points,
            layout.movable, layout.u, layout.v, self.flow, self.w, layout.seen, limits, damping, S,
            b, normal, cross, shared,
        )  # fmt: skip
        diagonal = np.zeros(6 * F + 6)
        diagonal[: 6 * F] = add_cameras(S[: 6 * F, : 6 * F], b[: 6 * F], normal[moving])
        at = slice(6 * F, 6 * F + UNKNOWNS)
        own = np.diag(self.precision)
        own[_LOWER] += shared[:PAIRS]
        S[at, at] += own
        S[at, : 6 * F] += (
            cross[moving].reshape(F, UNKNOWNS, 6).transpose(1, 0, 2).reshape(UNKNOWNS, 6 * F)
        )
        b[at] += shared[PAIRS:] - self.precision * (state.calibration - self.given)
        diagonal[at] = np.diag(own)
        S[:] = np.tril(S) + np.tril(S, -1).T
        held = 6 * F + np.flatnonzero(self.known)
        S[held], S[:, held], b[held] = 0.0, 0.0, 0.0
        solution = solve_reduced(S, b, damping * diagonal)
        if solution is None:
            return None
        steps = np.zeros((M, 6))
        steps[moving] = solution[: 6 * F].reshape(-1, 6)
        change = np.ascontiguousarray(solution[at])
        moved = np.empty_like(state.points)
        calibrated_substitution(
            state.cameras, layout.pinholes, layout.lenses, state.points, layout.movable, layout.u,
            layout.v, self.flow, layout.w, layout.seen, limits, damping, steps, change, moved,
        )  # fmt: skip
        return _State(move_cameras(state.cameras, steps), moved, state.calibration + change)


def ideal_pixels(u: F32, v: F32, camera: PinholeCamera, correction: F64) -> tuple[F32, F32]:
    """Move pixels (N,) of the image to where ``camera``, were it right, would have seen them.

    correction: (4,) of ``solve_calibrating``; what the readout does is not undone here.  Newton's
    method on the radius, to rounding for corrections under which the radius still grows with the
    angle; elsewhere the nearest it gets.
    """
    s, k1, k2 = correction[:3].tolist()
    x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    wanted = np.exp(-s) * np.hypot(x, y).astype(np.float64)
    r = wanted.copy()
    for _ in range(_NEWTON_STEPS):
        r2 = r * r
        slope = np.maximum(1.0 + r2 * (3.0 * k1 + 5.0 * k2 * r2), _LEAST_SLOPE)
        r -= (r * (1.0 + r2 * (k1 + k2 * r2)) - wanted) / slope
    share = np.exp(-s) * np.divide(r, wanted, out=np.ones_like(r), where=wanted > 0.0)
    return (
        (camera.cx + camera.fx * x * share).astype(np.float32),
        (camera.cy + camera.fy * y * share).astype(np.float32),
    )

"""Bundle adjustment by Levenberg-Marquardt with the Schur complement (Eq. 9-10)."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeAlias

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, BoolArray
from pliant.algorithms.slam.estimate.calibration import (
    SharedCalibration,
    no_shared_blocks,
)
from pliant.algorithms.slam.estimate.dense_layout import points_of, poses_of
from pliant.algorithms.slam.estimate.normal_equations import (
    FACTOR,
    RECORD,
    CameraSystem,
    Linearised,
    cost_of_observations,
    eliminate_points,
    linearise_observations,
    scratch_for,
    squared_residuals,
    substitute,
)
from pliant.algorithms.slam.estimate.packed_layout import (
    PackedLayout,
    Places,
    Slots,
    build_packed_layout,
)
from pliant.algorithms.slam.estimate.problem import (
    INITIAL_DAMPING,
    SHARED,
    AnyProblem,
    BundleParameters,
    BundleProblem,
    BundleResult,
    CalibrationUncertainty,
)
from pliant.algorithms.slam.estimate.projection import Cameras, limits_of, move_cameras
from pliant.algorithms.slam.estimate.reduced import (
    LOWER,
    factor_reduced,
    find_pattern,
    solve_reduced,
    substitute_reduced,
)
from pliant.algorithms.slam.estimate.varying_focal import FocalWalk, VaryingFocal
from pliant.compiler.kernel import kernel

MIN_DAMPING, MAX_DAMPING = 1e-12, 1e8

_GAUGE_DAMPING = 1e-9
"""Keeps the system regular although the scale of a map is undetermined."""

_NONE: F64 = np.zeros(0)
_HELD = 1e9
"""Damping of fixed unknowns."""

OnIteration: TypeAlias = Callable[[float], None]
"""Called with the cost after each iteration, for benchmarks."""


def solve_schur(
    problem: AnyProblem,
    parameters: BundleParameters,
    on_iteration: OnIteration | None = None,
    *,
    uncertainty: CalibrationUncertainty | None = None,
    start: F64 | None = None,
    with_covariance: bool = False,
    doubled: bool = False,
    walk: FocalWalk | None = None,
) -> BundleResult:
    """Minimise Eq. 6 over all movable cameras and points by damped Gauss-Newton steps.

    Each step eliminates the points exactly.  float64 throughout.  A step is accepted only if it
    does not increase the cost.

    uncertainty: of the calibration, which is then a further unknown that all cameras share; None:
    it is fixed.  The result's ``correction`` (s, k1, k2, readout, a, b, t) means that the
    observations follow ``u = fx e^s ((1 + k1 r^2 + k2 r^4) x + a) + cx + readout flow``, likewise
    for v with s + t and b.
    The costs include the prior, at k1 and k2 of the problem's intrinsics.
    with_covariance: the result contains the covariance of the correction.
    start: (SHARED,) initial correction, None: the mean of the prior.  Several views determine the
    focal length by rotation, and by parallax that differs across the image.  Otherwise (no
    rotation, one plane, forward motion) the prior determines it, as ``covariance`` then shows.
    doubled: twice each step is tried as well, which takes some 0.6 of the iterations to
    convergence.
    walk: prior of the focal length of each camera relative to the shared one; None: they are equal.
    Raises ValueError if cameras have different lenses.
    """
    layout = build_packed_layout(problem)
    calibration, focal = None, None
    if uncertainty is not None:
        calibration = SharedCalibration(layout, problem.intrinsics[:, 4:], uncertainty, start)
        focal = None if walk is None else VaryingFocal(layout, walk, uncertainty.prior_px)
    system = SchurSystem(layout, parameters, calibration, focal)
    state, costs, converged = _iterate(system, parameters, on_iteration, doubled)
    return BundleResult(
        T_world_camera=poses_of(layout, problem, state.motion),
        points_world=points_of(layout, problem, state.points),
        initial_cost=costs[0],
        final_cost=costs[-1],
        iterations=len(costs) - 1,
        converged=converged,
        squared_residuals=system.squared_residuals(state),
        costs=np.array(costs),
        correction=state.calibration,
        covariance=system.calibration_covariance(state)
        if with_covariance
        else np.zeros((SHARED, SHARED)),
        log_focal=state.focal,
    )


def system_at(
    problem: BundleProblem,
    found: BundleResult,
    parameters: BundleParameters,
    uncertainty: CalibrationUncertainty,
    walk: FocalWalk | None = None,
) -> "SchurSystem":
    """Return the system that starts where an adjustment ended, to compute the gain of further
    unknowns.

    uncertainty: with these unknowns.   walk: as of ``solve_schur``.
    """
    moved = replace(problem, T_world_camera=found.T_world_camera, points_world=found.points_world)
    layout = build_packed_layout(moved)
    calibration = SharedCalibration(
        layout, problem.intrinsics[:, 4:], uncertainty, found.correction
    )
    focal = None if walk is None else VaryingFocal(layout, walk, uncertainty.prior_px)
    return SchurSystem(layout, parameters, calibration, focal)


@dataclass(frozen=True)
class State:
    """Cameras and observations under a calibration (SHARED,), points (3, P) and the cost, px^2.

    focal: (M,) of ``varying_focal``; (0,) where all cameras have the same.
    """

    cameras: Cameras
    slots: Slots
    points: F64
    calibration: F64
    cost: float
    focal: F64

    @property
    def motion(self) -> F64:
        """(M, 12) of the cameras."""
        return self.cameras.motion


def _iterate(
    system: "SchurSystem",
    parameters: BundleParameters,
    on_iteration: OnIteration | None,
    doubled: bool,
) -> tuple[State, list[float], bool]:
    """Iterate until the cost converges: (state, cost curve, converged)."""
    state = system.start()
    costs = [state.cost]
    damping, growth = INITIAL_DAMPING, 2.0
    for _ in range(parameters.max_iterations):
        trial = system.step(state, damping, doubled)
        decrease = -np.inf if trial is None else state.cost - trial.cost
        if trial is not None and decrease >= 0.0:
            state = trial
            damping, growth = max(damping * 0.1, MIN_DAMPING), 2.0
        else:
            damping, growth = damping * growth, growth * 2.0
        costs.append(state.cost)
        if on_iteration is not None:
            on_iteration(state.cost)
        small = 0.0 <= decrease <= parameters.min_relative_decrease * state.cost
        if small or damping > MAX_DAMPING:
            return state, costs, True
    return state, costs, False


class SchurSystem:
    """Linearises states of one problem and takes damped steps from them.

    normal: see ``normal_equations``.    shared: see ``calibration``; both of the state ``at``.
    """

    def __init__(
        self,
        layout: PackedLayout,
        parameters: BundleParameters,
        calibration: SharedCalibration | None = None,
        focal: VaryingFocal | None = None,
    ) -> None:
        self.layout = layout
        self.limits = limits_of(parameters)
        self.calibration = calibration
        self.focal = focal
        M = len(layout.free)
        self._moving = np.flatnonzero(layout.free)
        free = np.full(M, -1, np.int32)
        free[self._moving] = np.arange(len(self._moving), dtype=np.int32)
        if focal is None:
            met = _meetings(layout.places, free, len(self._moving))
        else:
            all_met = _meetings(layout.places, np.arange(M, dtype=np.int32), M)
            met = focal.meetings(all_met, self._moving)
        self.pattern = find_pattern(met, borders=0 if calibration is None else calibration.borders)
        self._position = free
        self._position[self._moving] = self.pattern.position[: len(self._moving)]
        if focal is not None:
            focal.position = self.pattern.position[len(self._moving) :]
        self.at: State | None = None
        self.normal = np.empty((M, 27))
        self.shared = no_shared_blocks()
        self._records = _records_for(len(layout.places.camera))
        self._factors = np.empty((layout.points.shape[1], FACTOR))
        self._S = np.empty((len(self.pattern.row), 36))
        blocks = 0 if focal is None else len(focal.position)
        self._scratch = scratch_for(M + blocks)

    def start(self) -> State:
        """The state that the problem starts from."""
        start = np.zeros(SHARED) if self.calibration is None else self.calibration.start
        z = np.zeros(0) if self.focal is None else self.focal.start
        return self.state(self.layout.cameras.motion, self.layout.points, start, z)

    def state(self, motion: F64, points: F64, q: F64, z: F64 = _NONE) -> State:
        """The state of given cameras, points, calibration and focal lengths."""
        cameras, slots = self.layout.cameras, self.layout.slots
        if self.calibration is not None:
            cameras, slots = self.calibration.at(q)
        if self.focal is not None:
            cameras = self.focal.scaled(cameras, z)
        cameras = cameras._replace(motion=motion)
        cost = cost_of_observations(cameras, points, slots, self.limits)
        if self.calibration is not None:
            cost += self.calibration.prior_cost(q)
        if self.focal is not None:
            cost += self.focal.prior_cost(z)
        return State(cameras, slots, points, q, cost, z)

    def linearise(self, state: State) -> None:
        """Linearise at a state, independent of the damping."""
        if state is self.at:
            return
        cameras = state.cameras
        linearise_observations(
            cameras, state.points, state.slots, self.limits, self._records, self.normal
        )  # fmt: skip
        if self.calibration is not None:
            self.shared = self.calibration.linearise(cameras, self._records, state.calibration)
            if self.focal is not None:
                unknown, principal = self.calibration.unknown, state.calibration[4:6]
                self.focal.linearise(cameras, self._records, unknown, principal)
        self.at = state

    def step(self, state: State, damping: float, doubled: bool = False) -> State | None:
        """Return the state after one damped Gauss-Newton step, or None without a solution.

        doubled: or after twice that step, if the cost is lower there.  The weights of the robust
        kernel replace the cost by a parabola that touches it and lies above it elsewhere, because
        rho is concave in r^2: so steps are too short.  At the doubled step the parabola has its
        initial value again, and the cost, below it, is no higher than before.  If steps leave the
        share r of an error, doubled ones leave 2 r - 1 (Hunter and Lange 2004, A tutorial on MM
        algorithms).
        """
        self.linearise(state)
        S, b, diagonal = self._reduced_system(state, damping)
        solution = solve_reduced(self.pattern, S, b, damping * diagonal)
        if solution is None:
            return None
        steps = np.zeros((len(state.motion), 6))
        steps[self._moving] = solution[self._position[self._moving]]
        change, padded = np.zeros(SHARED), _NONE
        if self.calibration is not None:
            change = self.calibration.change(solution)
            padded = self.calibration.padded(change)
        moved = np.empty_like(state.points)
        substitute(self._linearised(state), steps, padded, self._factors, state.points, moved)
        refocus = state.focal  # (0,): there is none
        if self.focal is not None:
            refocus = self.focal.steps(solution)
            self.focal.substitute(self._linearised(state), refocus, self._factors, moved)
        near = self.state(
            move_cameras(state.motion, steps), moved, state.calibration + change,
            state.focal + refocus,
        )  # fmt: skip
        if not doubled:
            return near
        motion, points = move_cameras(state.motion, 2.0 * steps), 2.0 * moved - state.points
        far = self.state(
            motion, points, state.calibration + 2.0 * change, state.focal + 2.0 * refocus
        )
        return far if far.cost < near.cost else near

    def calibration_covariance(self, state: State) -> F64:
        """(SHARED, SHARED) of the calibration with everything else unknown, at residuals of 1 px.

        Its block of the inverse of S: the calibration is eliminated last.  0 where it is fixed.
        """
        covariance = np.zeros((SHARED, SHARED))
        if self.calibration is None:
            return covariance
        self.linearise(state)
        S, b, diagonal = self._reduced_system(state, _GAUGE_DAMPING)
        factored = factor_reduced(self.pattern, S, _GAUGE_DAMPING * diagonal)
        for k in np.flatnonzero(self.calibration.unknown):
            b[:] = 0.0
            b[k // 6 - self.calibration.borders, k % 6] = 1.0
            solution = substitute_reduced(self.pattern, S, b) if factored else None
            covariance[:, k] = np.inf if solution is None else self.calibration.change(solution)
        return covariance

    def pose_information(self) -> F64:
        """(6 M, 6 M) inverse covariance of the cameras' poses at the start, with everything else
        unknown, at residuals of 1 px; 0 where a camera is fixed.

        Of changes (a, d) of a pose: R Exp(a), p + d.  A step (rho, theta) of ``projection`` is
        (-R^T d, -a).
        """
        S, _, _ = self._undamped
        pattern, M = self.pattern, len(self.layout.free)
        N, F = len(pattern.start) - 1, len(self._moving)
        blocks = np.zeros((N, 6, N, 6))
        columns = np.repeat(np.arange(N), np.diff(pattern.start))
        blocks[pattern.row, :, columns, :] = S.reshape(-1, 6, 6)
        dense = np.tril(blocks.reshape(6 * N, 6 * N))
        dense += np.tril(dense, -1).T
        own = np.arange(6 * F, 6 * N)
        dense[own, own] += np.where(dense[own, own] == 0.0, 1.0, 0.0)  # no unknowns
        border = dense[: 6 * F, 6 * F :]
        poses = dense[: 6 * F, : 6 * F] - border @ np.linalg.solve(
            dense[6 * F :, 6 * F :], border.T
        )
        by_change = np.zeros((F, 6, 6))
        by_change[:, :3, 3:] = -self.layout.cameras.motion[self._moving, :9].reshape(F, 3, 3)
        by_change[:, 3:, :3] = -np.eye(3)
        at = self._position[self._moving]
        poses = poses.reshape(F, 6, F, 6)[at][:, :, at]
        poses = np.einsum("mri,mrnc->minc", by_change, poses)
        poses = np.einsum("minc,ncj->minj", poses, by_change)
        information = np.zeros((M, 6, M, 6))
        information[self._moving[:, None], :, self._moving, :] = poses.transpose(0, 2, 1, 3)
        return information.reshape(6 * M, 6 * M)

    def gain_of_focal(self) -> tuple[float, F64]:
        """Decrease of the cost, px^2, by a linear step from the start with a focal length per
        camera; and these (M,).  Zeros if the step has no solution.
        """
        assert self.focal is not None
        unknowns = np.zeros((len(self.pattern.start) - 1, 6), np.bool_)
        unknowns[self.focal.position] = True
        gain, solution = self._gain_of(unknowns)
        return gain, self.focal.steps(solution)

    def gain_of_shared(self, some: slice) -> float:
        """As ``gain_of_focal``, px^2, for some of the unknowns (SHARED,) that all cameras share."""
        assert self.calibration is not None
        unknowns = np.zeros((len(self.pattern.start) - 1, 6), np.bool_)
        chosen = np.zeros(SHARED)
        chosen[some] = 1.0
        borders = self.calibration.borders
        unknowns[-borders:] = self.calibration.padded(chosen).reshape(-1, 6) > 0.0
        return self._gain_of(unknowns)[0]

    def _gain_of(self, unknowns: BoolArray) -> tuple[float, F64]:
        """With b the right side of Eq. 9 and S its matrix: ``b^T S^-1 b`` minus the same with some
        unknowns (N, 6) fixed, and ``S^-1 b``.
        """
        S, b, diagonal = self._undamped
        small = _GAUGE_DAMPING * diagonal
        held = np.where(unknowns, _HELD * diagonal, small)
        free = solve_reduced(self.pattern, S.copy(), b, small)
        alone = solve_reduced(self.pattern, S.copy(), b, held)
        if free is None or alone is None:
            return 0.0, np.zeros_like(b)
        return float((b * (free - alone)).sum()), free

    @cached_property
    def _undamped(self) -> tuple[F64, F64, F64]:
        """As ``_reduced_system``, at the start, damped no more than the gauge needs."""
        state = self.start()
        self.linearise(state)
        S, b, diagonal = self._reduced_system(state, _GAUGE_DAMPING)
        return S.copy(), b, diagonal

    def _reduced_system(self, state: State, damping: float) -> tuple[F64, F64, F64]:
        """Of Eq. 9, at a linearised state: S without damping, the right side (N, 6) and diag(H)
        (N, 6)."""
        pattern, S = self.pattern, self._S
        N = len(pattern.start) - 1
        b, diagonal = np.zeros((2, N, 6))
        S[:] = 0.0
        system = CameraSystem(self._position, pattern.block, S, b)
        eliminate_points(
            self._linearised(state), damping, system, self._scratch, self._factors
        )  # fmt: skip
        at, normal = self._position[self._moving], self.normal[self._moving]
        S[pattern.start[at, None], 6 * LOWER[0] + LOWER[1]] += normal[:, :21]
        b[at] += normal[:, 21:]
        diagonal[at] = normal[:, np.flatnonzero(LOWER[0] == LOWER[1])]
        if self.calibration is not None:
            shared, known = self.shared, self.calibration
            own = shared.own + np.diag(known.padded(known.precision))
            cross = shared.cameras[self._moving]
            first = N - known.borders
            for r in range(known.borders):
                for c in range(r + 1):
                    block = own[6 * r : 6 * r + 6, 6 * c : 6 * c + 6]
                    S[pattern.block[first + r, first + c]] += block.ravel()
                S[pattern.block[first + r, at]] += cross[:, 36 * r : 36 * r + 36]
            pull = known.precision * (state.calibration - known.given)
            b[-known.borders :] += (shared.gradient - known.padded(pull)).reshape(-1, 6)
            diagonal[-known.borders :] = np.diag(own).reshape(-1, 6)
        if self.focal is not None:
            self.focal.add_to(
                system, self._linearised(state), self._scratch, self._factors, diagonal, state.focal
            )
        return S, b, diagonal

    def _linearised(self, state: State) -> Linearised:
        """Return the linearised observations of a state."""
        return Linearised(self._records, self.shared.points, self.layout.places, state.motion)

    def squared_residuals(self, state: State) -> F32:
        """px^2 of the observations of a ``BundleProblem``; inf where left out, or behind."""
        if not self.layout.place.size:
            return np.zeros(0, np.float32)
        squared = np.full(len(self._records), np.inf, np.float32)
        squared_residuals(state.cameras, state.points, state.slots, self.limits, squared)
        squared[-1] = np.inf
        return squared[self.layout.place]


def _records_for(observations: int) -> F64:
    """Return memory for this many records and a dump, each in its own cache line: they are written
    in the order of cameras and read in that of points.
    """
    room = np.empty((observations + 2) * RECORD)
    skipped = -(room.ctypes.data // room.itemsize) % RECORD
    return room[skipped : skipped + (observations + 1) * RECORD].reshape(-1, RECORD)


@kernel
def _meetings(places: Places, free: I32, cameras: int) -> BoolArray:
    """(F, F) whether two of the movable cameras observe a common point."""
    met = np.zeros((cameras, cameras), np.bool_)
    for m in range(cameras):
        met[m, m] = True
    for n in range(places.start.size):
        for a in range(places.start[n], places.stop[n]):
            i = free[places.camera[a]]
            if i < 0:
                continue
            for c in range(places.start[n], a):
                k = free[places.camera[c]]
                if k >= 0:
                    met[i, k] = met[k, i] = True
    return met

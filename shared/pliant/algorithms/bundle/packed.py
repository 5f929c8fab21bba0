"""Schur complement steps on the packed layout."""

from dataclasses import dataclass, replace

import numpy as np

from pliant.algorithms.arrays import F32, F64
from pliant.algorithms.bundle.camera_step import move_cameras
from pliant.algorithms.bundle.cost import limits_of
from pliant.algorithms.bundle.damped import damped_iterations
from pliant.algorithms.bundle.layout import points_of, poses_of
from pliant.algorithms.bundle.packed_kernels import (
    FACTOR,
    RECORD,
    eliminate_points,
    linearise_observations,
    squared_residuals_of_blocks,
    substitute,
)
from pliant.algorithms.bundle.packed_layout import PackedLayout, build_packed_layout, list_seen
from pliant.algorithms.bundle.problem import (
    AnyProblem,
    BundleParameters,
    BundleProblem,
    BundleResult,
)
from pliant.algorithms.bundle.reduced import add_cameras, solve_reduced
from pliant.algorithms.bundle.result import OnIteration


@dataclass(frozen=True)
class Linearised:
    """A state and everything about it that no damping changes; see ``packed_kernels``.

    foretold: by how much the step that led here should have lowered the cost, px^2.
    """

    cameras: F64
    points: F64
    cost: float
    records: F64
    normal: F64
    foretold: float = 0.0


def solve_packed(
    problem: AnyProblem, parameters: BundleParameters, on_iteration: OnIteration | None = None
) -> BundleResult:
    """``solve_schur`` on the packed layout."""
    layout = build_packed_layout(problem)
    system = PackedSystem(layout, parameters)
    state, costs, converged = damped_iterations(
        system.linearise(layout.cameras, layout.points),
        lambda state: state.cost,
        system.step,
        parameters,
        on_iteration,
        foretold=lambda state: state.foretold,
    )
    squared = system.squared_residuals(state)
    if not isinstance(problem, BundleProblem):
        listed, squared = squared, np.full(problem.u.shape, np.inf, np.float32)
        squared[list_seen(problem.weights)] = listed
    return BundleResult(
        T_world_camera=poses_of(layout, problem, state.cameras),
        points_world=points_of(layout, problem, state.points),
        initial_cost=costs[0],
        final_cost=costs[-1],
        iterations=len(costs) - 1,
        converged=converged,
        squared_residuals=squared,
        costs=np.array(costs),
    )


class PackedSystem:
    """Linearises states of one problem and takes damped steps from them."""

    def __init__(self, layout: PackedLayout, parameters: BundleParameters) -> None:
        self.layout = layout
        self.limits = limits_of(parameters)
        M, F = len(layout.cameras), int((layout.free >= 0).sum())
        self._moving = np.flatnonzero(layout.free >= 0)
        # Two states live at a time: the current one and the trial.
        self._records = [np.empty((len(layout.camera) + 1, RECORD)) for _ in range(2)]
        self._factors = np.empty((layout.points.shape[1], FACTOR))
        self._blocks = np.empty((F * F, 36))
        self._room = np.empty((M, 9)), np.empty((M, 18)), np.empty(M, np.int64)

    def linearise(self, cameras: F64, points: F64, other: F64 | None = None) -> Linearised:
        """The state of given cameras and points; ``other``: records that must stay."""
        layout = self.layout
        records = self._records[0] if other is not self._records[0] else self._records[1]
        normal = np.empty((len(cameras), 27))
        cost = linearise_observations(
            cameras, layout.pinholes, layout.lenses, points, layout.block_camera,
            layout.points_seen, layout.place, layout.u, layout.v, layout.w, self.limits, records,
            normal,
        )  # fmt: skip
        return Linearised(cameras, points, cost, records, normal)

    def step(self, state: Linearised, damping: float) -> Linearised | None:
        """The state after one damped Gauss-Newton step; None where it has no solution."""
        steps, foretold = self._camera_steps(state, damping)
        if steps is None:
            return None
        layout = self.layout
        moved = np.empty_like(state.points)
        foretold += substitute(
            state.records, layout.start, layout.stop, layout.camera, state.cameras, steps,
            self._factors, damping, state.points, moved,
        )  # fmt: skip
        trial = self.linearise(move_cameras(state.cameras, steps), moved, state.records)
        return replace(trial, foretold=0.5 * foretold)

    def _camera_steps(self, state: Linearised, damping: float) -> tuple[F64 | None, float]:
        """(M, 6) steps (Eq. 9), and their part of twice the decrease that is foretold."""
        layout, moving = self.layout, self._moving
        F = len(moving)
        blocks, b = self._blocks, np.zeros((F, 6))
        blocks[:] = 0.0
        eliminate_points(
            state.records, layout.start, layout.stop, layout.camera, layout.free, state.cameras,
            layout.movable, damping, *self._room, self._factors, blocks, b,
        )  # fmt: skip
        S, gradient = _in_rows(blocks, F), np.zeros(6 * F)
        diagonal = add_cameras(S, gradient, state.normal[moving])
        solution = solve_reduced(S, b.reshape(-1) + gradient, damping * diagonal)
        if solution is None:
            return None, 0.0
        steps = np.zeros((len(state.cameras), 6))
        steps[moving] = solution.reshape(-1, 6)
        return steps, float(solution @ (gradient + damping * diagonal * solution))

    def squared_residuals(self, state: Linearised) -> F32:
        """px^2 of the problem's own observations; inf where left out, or behind the camera."""
        layout = self.layout
        squared = np.full(len(layout.camera) + 1, np.inf, np.float32)
        squared_residuals_of_blocks(
            state.cameras, layout.pinholes, layout.lenses, state.points, layout.block_camera,
            layout.points_seen, layout.place, layout.u, layout.v, layout.w, self.limits, squared,
        )  # fmt: skip
        squared[-1] = np.inf
        return squared[layout.places]


def _in_rows(blocks: F64, F: int) -> F64:
    """(6F, 6F) matrix of (F F, 36) blocks."""
    return blocks.reshape(F, F, 6, 6).transpose(0, 2, 1, 3).reshape(6 * F, 6 * F)

"""The Levenberg-Marquardt loop, whatever is adjusted."""

from collections.abc import Callable
from typing import TypeVar

import numpy as np

from pliant.algorithms.bundle.problem import BundleParameters
from pliant.algorithms.bundle.result import OnIteration

MIN_DAMPING, MAX_DAMPING = 1e-12, 1e8

_State = TypeVar("_State")


def damped_iterations(
    state: _State,
    cost_of: Callable[[_State], float],
    step: Callable[[_State, float], _State | None],
    parameters: BundleParameters,
    on_iteration: OnIteration | None = None,
    foretold: Callable[[_State], float] | None = None,
) -> tuple[_State, list[float], bool]:
    """Iterate until the cost settles: (state, cost curve, converged).

    step: the state after one step of the given damping, None where there is none; it is taken only
    if it does not raise the cost.
    foretold: by how much the step to a state should have lowered the cost, by the linearisation it
    came from.  Damping then falls by the share that came true (Nielsen 1999); without, to a tenth.
    """
    cost = cost_of(state)
    costs = [cost]
    damping, growth = parameters.initial_damping, 2.0
    for _ in range(parameters.max_iterations):
        trial = step(state, damping)
        new_cost = np.inf if trial is None else cost_of(trial)
        decrease = cost - new_cost
        if trial is not None and decrease >= 0.0:
            state, cost = trial, new_cost
            share = 0.1 if foretold is None else _share_kept(decrease, foretold(state))
            damping, growth = max(damping * share, MIN_DAMPING), 2.0
        else:
            damping, growth = damping * growth, growth * 2.0
        costs.append(cost)
        if on_iteration is not None:
            on_iteration(cost)
        small = 0.0 <= decrease <= parameters.min_relative_decrease * cost
        if small or damping > MAX_DAMPING:
            return state, costs, True
    return state, costs, False


def _share_kept(decrease: float, foretold: float) -> float:
    gain = decrease / foretold if foretold > 0.0 else 0.0
    # A gain far above 1 (points came back in front of a camera) is as good as 1.
    return max(1.0 / 3.0, 1.0 - (2.0 * min(max(gain, 0.0), 1.0) - 1.0) ** 3)

"""A surface that holds together: all surfels step as one (beyond the paper).

A surfel's depth comes from its size in the image alone, so a patch that stretches by one per cent
is wrong by one per cent of its depth.  Over a surface such strains average out.  So two surfels
that were born as neighbours, d apart, cost omega_E w times

    |X_j - X_i - (R_i + R_j) d / 2|^2 / (strain |d|)^2 + |(R_j - R_i) d|^2 / (bend |d|)^2

beside Eq. 11 or 13: as rigid as possible, at the middle of the pair, where curvature cancels.  w
lets go of what is torn apart.  Each surfel keeps its own six parameters and its own image; F, gain
and bias are eliminated from its block, and one sparse system moves all.  A surfel that is not seen
is carried along.
"""

import numpy as np

from pliant.algorithms.arrays import F64, U8, BoolArray
from pliant.algorithms.surfels import together_kernels as kernels
from pliant.algorithms.surfels.align import Limits, Templates, Workspace
from pliant.algorithms.surfels.motion import MOST_PARAMETERS, RIGID
from pliant.algorithms.surfels.neighbours import Edges
from pliant.algorithms.surfels.parameters import SurfelParameters
from pliant.algorithms.surfels.rest import OMEGA_E, Rest
from pliant.algorithms.surfels.sampling import Level, X
from pliant.algorithms.surfels.sums import FEATURES

STEPS, COARSE_STEPS = 3, 2
"""Steps of all surfels, at full size and at half the size."""
_TEAR = 0.3
"""Strain at which neighbours hold on by a quarter only: what tears or slides."""
_CG_ITERATIONS = 60
_CG_TOLERANCE = 1e-4
_FEW = 3
_HELD_SHARE = 0.25
_DIAGONAL = np.arange(RIGID)


def align_together(
    poses: F64, start: F64, active: U8, edges: Edges, rest: Rest, level: Level,
    templates: Templates, limits: Limits, work: Workspace, parameters: SurfelParameters, steps: int,
) -> BoolArray:  # fmt: skip
    """Move all surfels as one, from the present poses, which are overwritten.

    poses: (N, POSE_FLOATS) in the camera's frame.  start: the same of the last frame: from there
    what is not seen is carried.  active: (N,) 1 where the image may be looked at.  rest: Eq. 20
    for a camera that is held; the pairs know nothing of it, since a motion of all leaves them as
    they are.  Returns (N,) which surfels have torn themselves off their neighbours: their pose is
    that of ``start``.
    """
    n, pairs, p = len(poses), len(edges.ends), parameters
    costs, sums = np.zeros(n), np.zeros((n, FEATURES))
    matrices = np.zeros((n, FEATURES, FEATURES))
    seen = active.copy()
    kernels.look_at_all(
        poses, start, seen, level, templates, limits, work, p.min_zncc, p.min_visible,
        costs, sums, matrices,
    )  # fmt: skip
    S, b, x = np.zeros((n, RIGID, RIGID)), np.zeros((n, RIGID)), np.zeros((n, RIGID))
    inner = np.zeros((n, MOST_PARAMETERS - RIGID))
    follow = np.zeros((n, MOST_PARAMETERS - RIGID, RIGID))
    w, residuals, arms = np.zeros(pairs), np.zeros((pairs, 2, 3)), np.zeros((pairs, 2, 3))
    damping, travelled = np.full(n, limits.start_lambda), np.zeros(n)
    # What is not seen goes where its neighbours do.
    weights = np.where(seen[:, None, None] > 0, rest.weights, 0.0)
    for _ in range(steps):
        kernels.reduce_all(poses, seen, level, limits, work, sums, matrices, S, b, inner, follow)
        kernels.edge_rows(poses, edges, _TEAR, w, residuals, arms)
        damped, descent = S.copy(), b.copy()
        damped[:, _DIAGONAL, _DIAGONAL] *= 1.0 + damping[:, None]
        held = weights @ (poses[:, X : X + 3] - rest.points)[:, :, None]
        damped[:, :3, :3] += weights
        descent[:, :3] += held[:, :, 0]
        pull = OMEGA_E * w / edges.lengths**2
        kernels.solve_together(
            damped, descent, edges, arms, residuals, pull / p.strain**2, pull / p.bend**2,
            _CG_ITERATIONS, _CG_TOLERANCE, x,
        )  # fmt: skip
        if not np.isfinite(x).all():
            break
        kernels.step_together(
            poses, seen, level, templates, limits, work, S, b, inner, follow, x, damping,
            travelled, costs, sums, matrices,
        )  # fmt: skip
    kernels.edge_rows(poses, edges, _TEAR, w, residuals, arms)
    torn = torn_off(edges, w, n)
    poses[torn] = start[torn]
    return torn


def torn_off(edges: Edges, weights: F64, count: int) -> BoolArray:
    """(count,) which surfels are held by no more than a few of their neighbours.

    weights: (E,) of ``edge_rows``.  Where two surfaces slide along each other, each surfel still
    has neighbours of its own; one that has left them all has run away along its ray.
    """
    ends = edges.ends.ravel()
    degree = np.bincount(ends, minlength=count)
    held = np.bincount(ends, weights=np.repeat(weights, 2), minlength=count)
    return (degree >= _FEW) & (held < _HELD_SHARE * degree)

"""NLTGV: smooths inverse depth on a Delaunay graph and keeps steps, creases and slanted planes.

Second-order non-local total generalised variation on a graph (VITAMIN-E section 4; Greene and Roy,
"FLaME", ICCV 2017; Ranftl et al., ECCV 2014).  Vertex i at p_i has inverse depth x_i, slope w_i and
data z_i with standard deviation s_i.  With lengths in median edges and inverse depths in median
sigmas, so that the parameters have no unit, the energy is

    E(x, w) = sum_e a_e |x_j - x_i - <(w_i + w_j) / 2, p_j - p_i>| + b_e (|w_j - w_i|_1)
            + sum_i d_i h(x_i - z_i)

over edges e = (i, j), with a_e = m_e / |p_j - p_i|, b_e = m_e * slope_weight, d_i = n_i *
data_weight / s_i, and h the Huber norm |r| - c/2 beyond c = huber_sigmas * s_i, r^2 / 2c within.
The mean slope (FLaME has w_i) makes it the same for (j, i), and exact for parabolas too.

Dual.  With K the linear map in the norms, E = max_q <K (x, w), q> + data over |q_e| <= (a_e, b_e,
b_e).  The primal-dual iteration (Chambolle and Pock 2011), over-relaxed by rho, is

    y' = prox_data(y - T K^T q),   q' = clip(q + S K (2 y' - y)),   (y, q) += rho (y' - y, q' - q)

where prox_data is closed: the deviation r from z becomes r c / (c + t d), or is shrunk by t d where
it stays beyond c.  T and S are the diagonal steps of Pock and Chambolle, ICCV 2011 (alpha = 1):
T_k = 1 / sum_e |K_ek| and S_e = 1 / sum_k |K_ek|, written for the weighted q above.  It converges
for any weights, however much they and the lengths of edges differ.

Steps.  A convex energy rounds a step, or closes it over an outlier.  So the weights m_e and n_i
fall with the residuals, 1 / (1 + (r / k sigma)^2), taken anew ``reweightings`` times; for each set
the convex problem is solved from where the last one ended, at first from planes averaged among
neighbours that agree.  Before each set vertices that were outvoted at a step change to a
neighbour's surface that agrees with their data, and those whose data agree with none (outliers)
to the side of the step's border on which they lie: with outliers given to the wrong side most of
the error would be theirs.  The result is the optimum for the last weights, which come back with it.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import Field

from pliant.algorithms.arrays import F32, I32, BoolArray, Shape
from pliant.algorithms.meshing.nltgv_kernels import (
    iterate,
    out_edges,
    weigh,
)
from pliant.algorithms.meshing.nltgv_start import rings, settle, start, usual_rise
from pliant.algorithms.meshing.nltgv_steps import change_sides, choose_sides
from pliant.algorithms.parameters import Parameters

_MIN_SHIFT_SIGMAS = 3.0


class NltgvParameters(Parameters):
    """What a user may change about smoothing.  Weights have no unit; see the module."""

    data_weight: float = Field(
        default=0.5, gt=0.0, description="Weight of the data against the smoothness (lambda)."
    )
    slope_weight: float = Field(
        default=3.0, gt=0.0, description="Weight of changes of slope against those of depth."
    )
    huber_sigmas: float = Field(
        default=1.0, ge=0.0, description="Data deviate squared up to so many sigmas, then linearly."
    )
    edge_sigmas: float = Field(
        default=5.0,
        ge=0.0,
        description="An edge that misses the surface by so many sigmas weighs half.  0: all alike.",
    )
    data_sigmas: float = Field(
        default=5.0,
        ge=0.0,
        description="Data off the surface by so many sigmas weigh half.  0: all alike.",
    )
    reweightings: int = Field(
        default=2, ge=1, le=50, description="How often weights are taken from the residuals."
    )
    max_iterations: int = Field(
        default=200, ge=1, description="Most primal-dual iterations for one set of weights."
    )
    min_change_sigmas: float = Field(
        default=0.04,
        ge=0.0,
        description="Stop when an iteration changes inverse depth less (rms, in median sigmas).",
    )
    relaxation: float = Field(
        default=1.9, ge=1.0, lt=2.0, description="Over-relaxation of the iteration (rho)."
    )


@dataclass(frozen=True)
class NltgvStart:
    """Where to start: NaN inverse depth where nothing is known, zero duals likewise.

    slopes: change of inverse depth per px along u and v.    duals: as in NltgvResult.
    """

    inverse_depths: Annotated[F32, Shape("M")]
    slopes: Annotated[F32, Shape("M", 2)]
    duals: Annotated[F32, Shape("E", 3)]


@dataclass(frozen=True)
class NltgvResult:
    """The smooth surface.

    slopes: change of inverse depth per px along u and v.    duals: of the edges, without unit, for
    the next start.    edge_weights: m_e in (0, 1], small across steps.    inliers: data within
    3 sigmas of the surface.    iterations: of all sets of weights together.    converged: the last
    set of weights came to its stopping rule.
    """

    inverse_depths: Annotated[F32, Shape("M")]
    slopes: Annotated[F32, Shape("M", 2)]
    duals: Annotated[F32, Shape("E", 3)]
    edge_weights: Annotated[F32, Shape("E")]
    inliers: Annotated[BoolArray, Shape("M")]
    iterations: int
    converged: bool


def smooth(
    points_px: F32,
    inverse_depths: F32,
    sigmas: F32,
    edges: I32,
    parameters: NltgvParameters,
    start_from: NltgvStart | None = None,
) -> NltgvResult:
    """Minimise the energy above.

    points_px: (M, 2).    inverse_depths, sigmas: (M,) one unit; vertices whose values are not
    finite or whose sigma is not positive have no data and follow their neighbours.
    edges: (E, 2), ascending, as of a Triangulation; with vertices in raster order the result is the
    same for any order of the points.    start_from: its surface gives the weights at once, so one
    set of weights is enough.

    Raises ValueError where sizes differ.
    """
    M, E = len(points_px), len(edges)
    if inverse_depths.shape != (M,) or sigmas.shape != (M,):
        raise ValueError(
            f"{M} points need as many inverse depths and sigmas, got "
            f"{inverse_depths.shape} and {sigmas.shape}"
        )
    if start_from is not None and (len(start_from.slopes) != M or len(start_from.duals) != E):
        raise ValueError("start_from: not of these vertices and edges")
    known = np.isfinite(inverse_depths) & np.isfinite(sigmas) & (sigmas > 0.0)
    if E == 0 or not known.any():
        return _unchanged(inverse_depths, known, E)
    unit = float(np.median(sigmas[known]))
    u, v, table, length = _geometry(points_px, edges)
    data = np.where(known, inverse_depths / unit, 0.0).astype(np.float32)
    sigma = np.where(known, sigmas / unit, np.inf).astype(np.float32)
    bounds, neighbours = rings(edges, M)
    usual = usual_rise(data, sigma, bounds, neighbours)
    state, duals, unknown = _start_state(start_from, M, E, unit, length)
    start(u, v, data, sigma, usual, bounds, neighbours, unknown, state)
    settle(u, v, data, sigma, usual, bounds, neighbours, unknown, state)

    bend = np.where(known, parameters.huber_sigmas * sigma, 0.0).astype(np.float32)
    steps, weight = np.zeros((M, 4), np.float32), np.zeros(M, np.float32)
    starts, ends = out_edges(edges, M), np.ascontiguousarray(edges[:, 1])
    total, change = 0, np.inf
    for _ in range(parameters.reweightings if start_from is None else 1):
        change_sides(state, edges, table, data, sigma, _MIN_SHIFT_SIGMAS)
        choose_sides(u, v, state, data, sigma, bounds, neighbours, _MIN_SHIFT_SIGMAS)
        weigh(
            state, edges, table, steps, data, sigma, weight,
            parameters.edge_sigmas, parameters.data_sigmas,
            parameters.data_weight, parameters.slope_weight,
        )  # fmt: skip
        done, change = iterate(
            state, duals, starts, ends, table, steps, data, bend, weight,
            parameters.relaxation, parameters.min_change_sigmas, parameters.max_iterations,
        )  # fmt: skip
        total += done
    return NltgvResult(
        inverse_depths=state[:, 0] * np.float32(unit),
        slopes=state[:, 1:3] * np.float32(unit / length),
        duals=duals[:, :3].copy(),
        edge_weights=table[:, 3] / np.float32(parameters.slope_weight),
        inliers=np.abs(state[:, 0] - data) <= _MIN_SHIFT_SIGMAS * sigma,
        iterations=total,
        converged=bool(change <= parameters.min_change_sigmas),
    )


def carry_duals(duals: F32, edges: I32, ids: I32, new_edges: I32, new_ids: I32) -> F32:
    """(E', 3) duals of new edges: those of the old edge between the same two ids, else zero.

    ids, new_ids: (M,), (M',) distinct ids of the vertices to which the edges point.
    """
    result = np.zeros((len(new_edges), 3), np.float32)
    if len(edges) == 0 or len(new_edges) == 0:
        return result
    old, new = ids[edges].astype(np.int64), new_ids[new_edges].astype(np.int64)
    base = int(max(old.max(), new.max())) + 1
    keys = old.min(axis=1) * base + old.max(axis=1)
    new_keys = new.min(axis=1) * base + new.max(axis=1)
    order = np.argsort(keys)
    at = np.minimum(np.searchsorted(keys[order], new_keys), len(keys) - 1)
    row = order[at]
    found = keys[row] == new_keys
    # An edge that runs the other way now has the opposite residual, and so the opposite dual.
    sign = np.where((old[row, 0] == new[:, 0]), 1.0, -1.0)
    result[found] = (duals[row] * sign[:, None])[found]
    return result


def _geometry(points_px: F32, edges: I32) -> tuple[F32, F32, F32, float]:
    """u and v in median edges, the table with its first two columns, the median edge in px."""
    rise = points_px[edges[:, 1]] - points_px[edges[:, 0]]
    squares = rise[:, 0] ** 2 + rise[:, 1] ** 2
    length = max(float(np.sqrt(np.median(squares))), 1e-6)
    scaled = points_px / np.float32(length)
    table = np.zeros((len(edges), 6), np.float32)
    table[:, :2] = rise * np.float32(0.5 / length)
    return scaled[:, 0].copy(), scaled[:, 1].copy(), table, length


def _start_state(
    given: NltgvStart | None, M: int, E: int, unit: float, length: float
) -> tuple[F32, F32, I32]:
    """(M, 4) vertices and (E, 4) duals to start from, and the rows of which nothing is known."""
    state, duals = np.zeros((M, 4), np.float32), np.zeros((E, 4), np.float32)
    unknown = np.ones(M, np.bool_)
    if given is not None:
        unknown = ~(np.isfinite(given.inverse_depths) & np.isfinite(given.slopes).all(axis=1))
        state[:, 0] = np.where(unknown, 0.0, given.inverse_depths / unit)
        state[:, 1:3] = np.where(unknown[:, None], 0.0, given.slopes * (length / unit))
        duals[:, :3] = given.duals
    return state, duals, np.flatnonzero(unknown).astype(np.int32)


def _unchanged(inverse_depths: F32, known: BoolArray, edges: int) -> NltgvResult:
    return NltgvResult(
        inverse_depths=inverse_depths.astype(np.float32),
        slopes=np.zeros((len(inverse_depths), 2), np.float32),
        duals=np.zeros((edges, 3), np.float32),
        edge_weights=np.ones(edges, np.float32),
        inliers=known,
        iterations=0,
        converged=True,
    )

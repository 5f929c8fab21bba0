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
fall with the residuals, 1 / (1 + (r / k sigma)^2), recomputed ``reweightings`` times; for each set
the convex problem is solved from where the last one ended, at first from planes averaged among
neighbours that agree.  Before each set vertices that were outvoted at a step change to a
neighbour's surface that agrees with their data, and those whose data agree with none (outliers)
to the side of the step's border on which they lie: with outliers given to the wrong side most of
the error would be theirs.  The result is the optimum for the last weights, which come back with it.
"""

from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np

from pliant.algorithms.arrays import F32, I32, I64, BoolArray, Shape
from pliant.algorithms.meshing.nltgv_start import (
    Graph,
    change_sides,
    choose_sides,
    rings,
    settle,
    start,
    usual_rise,
)
from pliant.algorithms.meshing.parameters import NltgvParameters
from pliant.compiler.kernel import fast_kernel, kernel

_MIN_SHIFT_SIGMAS = 3.0
_HALF_U, _HALF_V, _FIRST, _SECOND, _FIRST_STEP, _SECOND_STEP = range(6)
_RELAXATION = 1.9
"""Over-relaxation of the iteration (rho)."""
_MIN_LENGTH = 0.2
"""Edges shorter than this (in mean edges) weigh no more: their slopes are noise."""
_MIN_WEIGHT = 1e-3
"""The least share of its weight that an edge keeps, so that nothing is left without a surface."""


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


class _Edges(NamedTuple):
    """pairs: ascending.    ends: their second vertices, those of vertex i from ``starts[i]`` on."""

    pairs: Annotated[I32, Shape("E", 2)]
    starts: Annotated[I64, Shape("N")]
    ends: Annotated[I32, Shape("E")]


class _Weights(NamedTuple):
    """table: of edges: half its u, half its v, weight of the first order, of the second order, dual
    step of the first order, of the second order.    steps: primal, three used.    data: weights.
    bend: residual at which the data term turns from square to absolute.
    """

    table: Annotated[F32, Shape("E", 6)]
    steps: Annotated[F32, Shape("M", 4)]
    data: Annotated[F32, Shape("M")]
    bend: Annotated[F32, Shape("M")]


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

    Raises ValueError if sizes differ.
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
    bounds, neighbours = rings(edges, M)
    data = np.where(known, inverse_depths / unit, 0.0).astype(np.float32)
    sigma = np.where(known, sigmas / unit, np.inf).astype(np.float32)
    graph = Graph(u, v, data, sigma, bounds, neighbours)
    usual = usual_rise(graph)
    state, duals, unknown = _start_state(start_from, M, E, unit, length)
    start(graph, usual, unknown, state)
    settle(graph, usual, unknown, state)

    bend = np.where(known, parameters.huber_sigmas * sigma, 0.0).astype(np.float32)
    steps, weight = np.zeros((M, 4), np.float32), np.zeros(M, np.float32)
    weights = _Weights(table, steps, weight, bend)
    directed = _Edges(edges, _out_edges(edges, M), np.ascontiguousarray(edges[:, 1]))
    total, change = 0, np.inf
    for _ in range(parameters.reweightings if start_from is None else 1):
        change_sides(graph, edges, table, state, _MIN_SHIFT_SIGMAS)
        choose_sides(graph, state, _MIN_SHIFT_SIGMAS)
        _weigh(
            graph, directed, weights, state, parameters.edge_sigmas, parameters.data_sigmas,
            parameters.data_weight, parameters.slope_weight,
        )  # fmt: skip
        done, change = _iterate(
            data, directed, weights, state, duals,
            _RELAXATION, parameters.min_change_sigmas, parameters.max_iterations,
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


@kernel
def _out_edges(edges: I32, count: int) -> I64:
    """(M + 1,) where the edges of each first vertex begin; edges must be ascending."""
    starts = np.zeros(count + 1, np.int64)
    for e in range(len(edges)):
        starts[edges[e, 0] + 1] += 1
    for i in range(count):
        starts[i + 1] += starts[i]
    return starts


@fast_kernel
def _residual(state: F32, edge: F32, i: int, j: int) -> np.float32:
    """How far the inverse depth of j lies off the surface that goes through i."""
    rise = edge[_HALF_U] * (state[i, 1] + state[j, 1]) + edge[_HALF_V] * (state[i, 2] + state[j, 2])
    return state[j, 0] - state[i, 0] - rise


@fast_kernel
def _weigh(
    graph: Graph, edges: _Edges, weights: _Weights, state: F32,
    edge_sigmas: float, data_sigmas: float, data_weight: float, slope_weight: float,
) -> None:  # fmt: skip
    """Set the weights for where the surface is now, and with them the preconditioned steps.

    edge_sigmas, data_sigmas: 0: all weigh alike.  A vertex without data joins a surface as if its
    sigma were the median.
    """
    data, sigma, pairs = graph.data, graph.sigma, edges.pairs
    table, steps, weight = weights.table, weights.steps, weights.data
    steps[:] = 0.0
    for e in range(len(pairs)):
        i, j = pairs[e, 0], pairs[e, 1]
        hu, hv = abs(table[e, _HALF_U]), abs(table[e, _HALF_V])
        length = max(2.0 * np.sqrt(hu * hu + hv * hv), _MIN_LENGTH)
        share = 1.0
        if edge_sigmas > 0.0:
            sigma_i = sigma[i] if sigma[i] < np.inf else 1.0
            sigma_j = sigma[j] if sigma[j] < np.inf else 1.0
            spread = 0.5 * (sigma_i + sigma_j)
            off = _residual(state, table[e], i, j) / (edge_sigmas * spread)
            share = max(1.0 / (1.0 + off * off), _MIN_WEIGHT)
        first, second = share / length, share * slope_weight
        table[e, _FIRST], table[e, _SECOND] = first, second
        table[e, _FIRST_STEP] = first / (2.0 + 2.0 * (hu + hv))
        table[e, _SECOND_STEP] = second / 2.0
        for k in (i, j):
            steps[k, 0] += first
            steps[k, 1] += first * hu + second
            steps[k, 2] += first * hv + second
    for i in range(len(state)):
        for c in range(3):
            steps[i, c] = 1.0 / max(steps[i, c], 1e-6)
        weight[i] = 0.0
        if sigma[i] < np.inf:
            off = 0.0
            if data_sigmas > 0.0:
                off = (state[i, 0] - data[i]) / (data_sigmas * sigma[i])
            weight[i] = data_weight / (sigma[i] * (1.0 + off * off))


@fast_kernel
def _iterate(
    data: F32, edges: _Edges, weights: _Weights, state: F32, duals: F32,
    relaxation: float, min_change: float, max_iterations: int,
) -> tuple[int, float]:  # fmt: skip
    """Primal-dual iterations in place; how many, and the last change of inverse depth (rms).

    duals: (E, 4), three used.
    """
    starts, ends = edges.starts, edges.ends
    table, steps, weight, bend = weights
    M = len(state)
    ahead = state.copy()
    pull = np.zeros((M, 4), np.float32)
    rho = np.float32(relaxation)
    for j in range(len(ends)):
        for c in range(3):
            limit = table[j, _FIRST] if c == 0 else table[j, _SECOND]
            duals[j, c] = min(max(duals[j, c], -limit), limit)
    change = np.inf
    done = 0
    while done < max_iterations and change > min_change:
        pull[:] = 0.0
        for i in range(M):
            x, s, t = ahead[i, 0], ahead[i, 1], ahead[i, 2]
            p0, p1, p2 = pull[i, 0], pull[i, 1], pull[i, 2]
            for e in range(starts[i], starts[i + 1]):
                j = np.uint32(ends[e])
                hu, hv = table[e, _HALF_U], table[e, _HALF_V]
                first, second = table[e, _FIRST], table[e, _SECOND]
                q0, q1, q2 = duals[e, 0], duals[e, 1], duals[e, 2]
                sj, tj = ahead[j, 1], ahead[j, 2]
                off = ahead[j, 0] - x - hu * (s + sj) - hv * (t + tj)
                n0 = min(max(q0 + table[e, _FIRST_STEP] * off, -first), first)
                n1 = min(max(q1 + table[e, _SECOND_STEP] * (sj - s), -second), second)
                n2 = min(max(q2 + table[e, _SECOND_STEP] * (tj - t), -second), second)
                q0 += rho * (n0 - q0)
                q1 += rho * (n1 - q1)
                q2 += rho * (n2 - q2)
                duals[e, 0], duals[e, 1], duals[e, 2] = q0, q1, q2
                lever_u, lever_v = hu * q0, hv * q0
                p0 -= q0
                p1 -= lever_u + q1
                p2 -= lever_v + q2
                pull[j, 0] += q0
                pull[j, 1] += q1 - lever_u
                pull[j, 2] += q2 - lever_v
            pull[i, 0], pull[i, 1], pull[i, 2] = p0, p1, p2
        total = 0.0
        for i in range(M):
            step = steps[i, 0]
            force = step * weight[i]
            d = state[i, 0] - step * pull[i, 0] - data[i]
            if abs(d) <= bend[i] + force:
                d = d * bend[i] / max(bend[i] + force, np.float32(1e-20))
            else:
                d -= force if d > 0.0 else -force
            c = data[i] + d - state[i, 0]
            total += c * c
            ahead[i, 0] = state[i, 0] + np.float32(2.0) * c
            state[i, 0] += rho * c
            c = -steps[i, 1] * pull[i, 1]
            ahead[i, 1] = state[i, 1] + np.float32(2.0) * c
            state[i, 1] += rho * c
            c = -steps[i, 2] * pull[i, 2]
            ahead[i, 2] = state[i, 2] + np.float32(2.0) * c
            state[i, 2] += rho * c
        change = np.sqrt(total / M)
        done += 1
    return done, change

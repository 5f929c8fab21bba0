"""Kernels of NLTGV: the weights of edges and the primal-dual iteration.

A vertex is a row (inverse depth, slope along u, slope along v, unused) of float32 in the units of
``nltgv``; an edge is a row (half its u, half its v, weight of the first order, weight of the
second order, dual step of the first order, dual step of the second order).
"""

import numpy as np

from pliant.algorithms.arrays import F32, I32, I64
from pliant.algorithms.kernel import fast_kernel, kernel

HALF_U, HALF_V, FIRST, SECOND, FIRST_STEP, SECOND_STEP = range(6)
MIN_LENGTH = 0.2
"""Edges shorter than this (in mean edges) weigh no more: their slopes are noise."""
MIN_WEIGHT = 1e-3
"""The least share of its weight that an edge keeps, so that nothing is left without a surface."""


@kernel
def out_edges(edges: I32, count: int) -> I64:
    """(M + 1,) where the edges of each first vertex begin; edges must be ascending."""
    starts = np.zeros(count + 1, np.int64)
    for e in range(len(edges)):
        starts[edges[e, 0] + 1] += 1
    for i in range(count):
        starts[i + 1] += starts[i]
    return starts


@fast_kernel
def residual(state: F32, edge: F32, i: int, j: int) -> np.float32:
    """How far the inverse depth of j lies off the surface that goes through i."""
    rise = edge[HALF_U] * (state[i, 1] + state[j, 1]) + edge[HALF_V] * (state[i, 2] + state[j, 2])
    return state[j, 0] - state[i, 0] - rise


@fast_kernel
def weigh(
    state: F32, edges: I32, table: F32, steps: F32, data: F32, sigma: F32, weight: F32,
    edge_sigmas: float, data_sigmas: float, data_weight: float, slope_weight: float,
) -> None:  # fmt: skip
    """Set the weights for where the surface is now, and with them the preconditioned steps.

    table: (E, 6) of which the first two columns are read.    steps: (M, 4) primal steps.
    weight: (M,) of the data.    edge_sigmas, data_sigmas: 0: all weigh alike.
    A vertex without data joins a surface as if its sigma were the median.
    """
    steps[:] = 0.0
    for e in range(len(edges)):
        i, j = edges[e, 0], edges[e, 1]
        hu, hv = abs(table[e, HALF_U]), abs(table[e, HALF_V])
        length = max(2.0 * np.sqrt(hu * hu + hv * hv), MIN_LENGTH)
        share = 1.0
        if edge_sigmas > 0.0:
            sigma_i = sigma[i] if sigma[i] < np.inf else 1.0
            sigma_j = sigma[j] if sigma[j] < np.inf else 1.0
            spread = 0.5 * (sigma_i + sigma_j)
            off = residual(state, table[e], i, j) / (edge_sigmas * spread)
            share = max(1.0 / (1.0 + off * off), MIN_WEIGHT)
        first, second = share / length, share * slope_weight
        table[e, FIRST], table[e, SECOND] = first, second
        table[e, FIRST_STEP] = first / (2.0 + 2.0 * (hu + hv))
        table[e, SECOND_STEP] = second / 2.0
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
def iterate(
    state: F32, duals: F32, starts: I64, ends: I32, table: F32, steps: F32, data: F32, bend: F32,
    weight: F32, relaxation: float, min_change: float, max_iterations: int,
) -> tuple[int, float]:  # fmt: skip
    """Primal-dual iterations in place; how many, and the last change of inverse depth (rms).

    starts, ends: the edges by their first vertex.    duals: (E, 4), three used.
    bend: (M,) residual at which the data term turns from square to absolute.
    """
    M = len(state)
    ahead = state.copy()
    pull = np.zeros((M, 4), np.float32)
    rho = np.float32(relaxation)
    for j in range(len(ends)):
        for c in range(3):
            limit = table[j, FIRST] if c == 0 else table[j, SECOND]
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
                hu, hv = table[e, HALF_U], table[e, HALF_V]
                first, second = table[e, FIRST], table[e, SECOND]
                q0, q1, q2 = duals[e, 0], duals[e, 1], duals[e, 2]
                sj, tj = ahead[j, 1], ahead[j, 2]
                off = ahead[j, 0] - x - hu * (s + sj) - hv * (t + tj)
                n0 = min(max(q0 + table[e, FIRST_STEP] * off, -first), first)
                n1 = min(max(q1 + table[e, SECOND_STEP] * (sj - s), -second), second)
                n2 = min(max(q2 + table[e, SECOND_STEP] * (tj - t), -second), second)
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

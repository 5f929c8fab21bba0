"""A first surface for NLTGV: outliers replaced by what neighbours agree on, then averaged.

The iteration carries news by one edge at a time and is slow to flatten what is wide, so a surface
that is already nearly flat where it should be saves most of it.
"""

from typing import Any

import numpy as np

from pliant.algorithms.arrays import F32, I32, I64
from pliant.algorithms.kernel import fast_kernel, kernel

_RIDGE = 0.02
"""Mean edges squared that hold a slope at zero: few noisy neighbours in a row give none."""
MAX_RING = 32
"""Neighbours of a vertex that are looked at."""
_TOLERANCE = 2.0
"""Neighbours agree within so many sigmas, or so many times what is usual on a slope."""
_ENOUGH = 2.5
"""Neighbours that must agree with a vertex for it to keep its data (6 is usual)."""
_PASSES = 8
_SLACK_DECAY = 0.5
"""From pass to pass, of what is added to sigma: in the end slopes explain a steep surface."""
_DATA_SIGMAS = 3.0
"""Data off the surface by so many sigmas hold it half as much as one neighbour does."""
_SLOPE_INERTIA = 0.5
"""How much a vertex's own slope counts beside one neighbour's."""
_ONE, _HALF = np.float32(1.0), np.float32(0.5)


@kernel
def rings(edges: I32, count: int) -> tuple[I64, I32]:
    """(M + 1,) bounds and (2E,) neighbours of each vertex, ascending."""
    starts = np.zeros(count + 1, np.int64)
    for e in range(len(edges)):
        starts[edges[e, 0] + 1] += 1
        starts[edges[e, 1] + 1] += 1
    for i in range(count):
        starts[i + 1] += starts[i]
    neighbours = np.empty(2 * len(edges), np.int32)
    place = starts[:-1].copy()
    for side in (1, 0):  # first the smaller neighbours of each vertex
        for e in range(len(edges)):
            i = edges[e, side]
            neighbours[place[i]] = edges[e, 1 - side]
            place[i] += 1
    return starts, neighbours


@kernel
def _ranked(values: F32, count: int, rank: int) -> np.float32:
    """The value of that rank among the first few, by insertion; the values are sorted."""
    for a in range(1, count):
        value = values[a]
        b = a
        while b > 0 and values[b - 1] > value:
            values[b] = values[b - 1]
            b -= 1
        values[b] = value
    return values[rank]


@kernel
def usual_rise(data: F32, sigma: F32, starts: I64, neighbours: I32) -> F32:
    """(M,) what neighbours differ by on the surface here: small at steps, large on slopes.

    A third of the neighbours differ by less from a vertex; of that, the median over its ring, as
    an outlier's own is anything.
    """
    M = len(data)
    own, usual = np.zeros(M, np.float32), np.zeros(M, np.float32)
    values = np.empty(MAX_RING, np.float32)
    for i in range(M):
        n = 0
        for k in range(starts[i], min(starts[i + 1], starts[i] + MAX_RING)):
            j = neighbours[k]
            if sigma[i] < np.inf and sigma[j] < np.inf:
                values[n] = abs(data[j] - data[i])
                n += 1
        own[i] = _ranked(values, n, n // 3) if n else 0.0
    for i in range(M):
        n = 0
        for k in range(starts[i], min(starts[i + 1], starts[i] + MAX_RING)):
            values[n] = own[neighbours[k]]
            n += 1
        usual[i] = _ranked(values, n, n // 2) if n else 0.0
    return usual


@fast_kernel
def start(
    u: F32, v: F32, data: F32, sigma: F32, usual: F32, starts: I64, neighbours: I32, rows: I32,
    state: F32,
) -> None:  # fmt: skip
    """Write inverse depth and slopes of the rows listed.

    usual: (M,) see usual_rise.  A vertex keeps its data where enough neighbours agree; else it
    takes that of the neighbour that most of the ring agree with.  Slopes are a weighted plane
    through those that agree.
    """
    values, sigmas = np.empty(MAX_RING + 1, np.float32), np.empty(MAX_RING + 1, np.float32)
    for i in rows:
        n = 0
        if sigma[i] < np.inf:
            values[0], sigmas[0], n = data[i], sigma[i], 1
        for k in range(starts[i], min(starts[i + 1], starts[i] + MAX_RING)):
            j = neighbours[k]
            if sigma[j] < np.inf:
                values[n], sigmas[n] = data[j], sigma[j]
                n += 1
        best, chosen = -1.0, data[i]
        for a in range(n):
            support = 0.0
            for b in range(n):
                if b != a:
                    support += _agreement(values[b] - values[a], sigmas[a], sigmas[b], usual[i])
            if a == 0 and sigma[i] < np.inf and support >= _ENOUGH:
                chosen = values[0]
                break
            if support > best:
                best, chosen = support, values[a]
        state[i, 0] = chosen
    for i in rows:
        uu, uv, vv, ur, vr = _RIDGE, 0.0, _RIDGE, 0.0, 0.0
        for k in range(starts[i], min(starts[i + 1], starts[i] + MAX_RING)):
            j = neighbours[k]
            rise = state[j, 0] - state[i, 0]
            scale = min(sigma[i], sigma[j])
            w = _agreement(rise, scale, scale, usual[i])
            du, dv = u[j] - u[i], v[j] - v[i]
            uu += w * du * du
            uv += w * du * dv
            vv += w * dv * dv
            ur += w * du * rise
            vr += w * dv * rise
        determinant = uu * vv - uv * uv
        state[i, 1] = (vv * ur - uv * vr) / determinant
        state[i, 2] = (uu * vr - uv * ur) / determinant


@fast_kernel
def _agreement(difference: Any, sigma_a: Any, sigma_b: Any, usual: Any) -> Any:
    """1 where two inverse depths agree, 0 where they do not."""
    scale = _TOLERANCE * max(np.sqrt(sigma_a * sigma_a + sigma_b * sigma_b), usual)
    off = difference / scale
    return 1.0 / (1.0 + off * off * off * off)


@fast_kernel
def settle(
    u: F32, v: F32, data: F32, sigma: F32, usual: F32, starts: I64, neighbours: I32, rows: I32,
    state: F32,
) -> None:  # fmt: skip
    """Average the planes of neighbours that agree, a few times, in the rows listed and in place.

    usual: (M,) see usual_rise.  All rows of a pass come from the pass before, so that the order of
    the vertices does not matter.  It is the iteration's energy with squares for norms and weights
    taken anew in every pass, by Jacobi: near its optimum after few of them, but rounder.
    """
    later = np.empty((len(rows), 3), np.float32)
    slack, inertia = _ONE, np.float32(_SLOPE_INERTIA)
    for _ in range(_PASSES):
        for r in range(len(rows)):
            i = rows[r]
            x, s, t = state[i, 0], state[i, 1], state[i, 2]
            own = sigma[i] if sigma[i] < np.inf else _ONE
            reach = np.float32(_TOLERANCE) * (own + slack * usual[i])
            scale = _ONE / (reach * reach)
            sum_x, sum_s, sum_t, sum_w = data[i] - x, inertia * s, inertia * t, np.float32(0.0)
            off = sum_x / (np.float32(_DATA_SIGMAS) * own)
            off *= off
            hold = _ONE / (_ONE + off * off) if sigma[i] < np.inf else np.float32(0.0)
            sum_x *= hold
            for k in range(starts[i], starts[i + 1]):
                j = np.uint32(neighbours[k])
                sj, tj = state[j, 1], state[j, 2]
                lift = _HALF * ((s + sj) * (u[j] - u[i]) + (t + tj) * (v[j] - v[i]))
                miss = state[j, 0] - lift - x
                off = miss * miss * scale
                w = _ONE / (_ONE + off * off)
                sum_x += w * miss
                sum_s += w * sj
                sum_t += w * tj
                sum_w += w
            later[r, 0] = x + sum_x / max(sum_w + hold, np.float32(1e-6))
            later[r, 1] = sum_s / (sum_w + inertia)
            later[r, 2] = sum_t / (sum_w + inertia)
        for r in range(len(rows)):
            for c in range(3):
                state[rows[r], c] = later[r, c]
        slack *= np.float32(_SLACK_DECAY)

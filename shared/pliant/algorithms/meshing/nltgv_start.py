"""Where NLTGV starts, and which side of a step a vertex is on: kernels before each set of weights.

Start.  Outliers are replaced by what neighbours agree on, then planes are averaged.  The iteration
spreads a change by one edge at a time and flattens wide areas slowly.  So a start with a surface
that is already nearly flat there saves most of it.

Sides.  A convex energy, like any vote among the neighbours, gives a vertex at a step to the side
with more of them.  Vertices with data are moved by their data, the others by where the border must
run.
"""

from typing import Annotated, Any, NamedTuple

import numpy as np

from pliant.algorithms.arrays import F32, I32, I64, BoolArray, Shape
from pliant.compiler.kernel import fast_kernel, kernel

_RIDGE = 0.02
"""Mean edges squared that hold a slope at zero: few noisy neighbours in a row give none."""
_MAX_RING = 32
"""Neighbours of a vertex that are looked at."""
_TOLERANCE = 2.0
"""Neighbours agree within this many sigmas, or times the usual difference on a slope."""
_ENOUGH = 2.5
"""Neighbours that must agree with a vertex for it to keep its data (6 is usual)."""
_PASSES = 8
_SLACK_DECAY = 0.5
"""From pass to pass, of what is added to sigma: in the end slopes explain a steep surface."""
_DATA_SIGMAS = 3.0
"""Data off the surface by this many sigmas hold it half as much as one neighbour does."""
_SLOPE_INERTIA = 0.5
"""How much a vertex's own slope counts beside one neighbour's."""
_ONE, _HALF = np.float32(1.0), np.float32(0.5)
_APART = 6.0
"""Surfaces this many sigmas apart at a vertex are two."""
_FEWEST = 3
"""Neighbours that another surface needs."""
_MOST = 512
"""Neighbours of neighbours that are looked at."""
_REACH = 2.0
"""Median edges squared at which a neighbour counts a quarter in the border."""
_BORDER_RIDGE = 0.3
"""Median edges squared that hold the direction of the border."""


class Graph(NamedTuple):
    """The vertices and who is around each, in the units of ``nltgv``.

    u, v: places.    data, sigma: inverse depths and their standard deviations; infinite: no data.
    neighbours: of vertex i from ``starts[i]`` to before ``starts[i + 1]``, ascending.
    """

    u: Annotated[F32, Shape("M")]
    v: Annotated[F32, Shape("M")]
    data: Annotated[F32, Shape("M")]
    sigma: Annotated[F32, Shape("M")]
    starts: Annotated[I64, Shape("N")]
    neighbours: Annotated[I32, Shape("L")]


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
def usual_rise(graph: Graph) -> F32:
    """(M,) what neighbours differ by on the surface here: small at steps, large on slopes.

    A third of the neighbours differ by less from a vertex; of that, the median over its ring, as
    an outlier's own is anything.
    """
    _, _, data, sigma, starts, neighbours = graph
    M = len(data)
    own, usual = np.zeros(M, np.float32), np.zeros(M, np.float32)
    values = np.empty(_MAX_RING, np.float32)
    for i in range(M):
        n = 0
        for k in range(starts[i], min(starts[i + 1], starts[i] + _MAX_RING)):
            j = neighbours[k]
            if sigma[i] < np.inf and sigma[j] < np.inf:
                values[n] = abs(data[j] - data[i])
                n += 1
        own[i] = _ranked(values, n, n // 3) if n else 0.0
    for i in range(M):
        n = 0
        for k in range(starts[i], min(starts[i + 1], starts[i] + _MAX_RING)):
            values[n] = own[neighbours[k]]
            n += 1
        usual[i] = _ranked(values, n, n // 2) if n else 0.0
    return usual


@fast_kernel
def start(graph: Graph, usual: F32, rows: I32, state: F32) -> None:
    """Write inverse depth and slopes of the rows listed.

    usual: (M,) see usual_rise.  A vertex keeps its data where enough neighbours agree; else it
    takes that of the neighbour that most of the ring agree with.  Slopes are a weighted plane
    through those that agree.
    """
    u, v, data, sigma, starts, neighbours = graph
    values, sigmas = np.empty(_MAX_RING + 1, np.float32), np.empty(_MAX_RING + 1, np.float32)
    for i in rows:
        n = 0
        if sigma[i] < np.inf:
            values[0], sigmas[0], n = data[i], sigma[i], 1
        for k in range(starts[i], min(starts[i + 1], starts[i] + _MAX_RING)):
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
        for k in range(starts[i], min(starts[i + 1], starts[i] + _MAX_RING)):
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
def settle(graph: Graph, usual: F32, rows: I32, state: F32) -> None:
    """Average the planes of neighbours that agree, a few times, in the rows listed and in place.

    usual: (M,) see usual_rise.  All rows of a pass come from the pass before, so that the order of
    the vertices does not matter.  It is the iteration's energy with squares for norms and weights
    recomputed in every pass, by Jacobi: near its optimum after few of them, but rounder.
    """
    u, v, data, sigma, starts, neighbours = graph
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


@fast_kernel
def change_sides(graph: Graph, edges: I32, halves: F32, state: F32, sigmas: float) -> int:
    """Move vertices that left their data to a neighbour's surface that agrees with it; how many.

    At a step the majority of neighbours may be on the wrong side.    edges: (E, 2).
    halves: (E, 2+) half of each edge along u and v, in the first two columns.
    """
    data, sigma = graph.data, graph.sigma
    M = len(state)
    sums = np.zeros((M, 4), np.float32)
    for e in range(len(edges)):
        i, j = edges[e, 0], edges[e, 1]
        du, dv = np.float32(2.0) * halves[e, 0], np.float32(2.0) * halves[e, 1]
        at_i = state[j, 0] - state[j, 1] * du - state[j, 2] * dv
        if abs(at_i - data[i]) < sigmas * sigma[i]:
            sums[i, 0] += at_i
            sums[i, 1] += state[j, 1]
            sums[i, 2] += state[j, 2]
            sums[i, 3] += _ONE
        at_j = state[i, 0] + state[i, 1] * du + state[i, 2] * dv
        if abs(at_j - data[j]) < sigmas * sigma[j]:
            sums[j, 0] += at_j
            sums[j, 1] += state[i, 1]
            sums[j, 2] += state[i, 2]
            sums[j, 3] += _ONE
    moved = 0
    for i in range(M):
        if abs(state[i, 0] - data[i]) > sigmas * sigma[i] and sums[i, 3] > 0.0:
            for c in range(3):
                state[i, c] = sums[i, c] / sums[i, 3]
            moved += 1
    return moved


@fast_kernel
def choose_sides(graph: Graph, state: F32, sigmas: float) -> int:
    """Move vertices whose data count for nothing to the side of a step where they lie; how many.

    An outlier has a place, though no inverse depth.  Where neighbours and theirs are on two
    surfaces, the line that separates the two best (least squares of +-1, nearer ones heavier)
    has the side of the vertex.    sigmas: data farther off the surface count for nothing.
    """
    u, v, data, sigma, starts, neighbours = graph
    seen, far = np.empty((_MOST, 4), np.float32), np.zeros(len(state), np.bool_)
    for i in range(len(state)):
        far[i] = not (sigma[i] < np.inf and abs(state[i, 0] - data[i]) <= sigmas * sigma[i])
    before, moved = state.copy(), 0
    for i in range(len(state)):
        if not far[i]:
            continue
        own = before[i, 0]
        count = _look_around(graph, before, far, i, seen)
        support, other = _other_surface(seen, count, own)
        if support < _FEWEST or not _beyond_border(seen, count, own, other):
            continue
        x, s, t, n = np.float32(0.0), np.float32(0.0), np.float32(0.0), np.float32(0.0)
        for k in range(starts[i], starts[i + 1]):
            j = neighbours[k]
            at_i = before[j, 0] - before[j, 1] * (u[j] - u[i]) - before[j, 2] * (v[j] - v[i])
            if not far[j] and abs(at_i - other) <= _APART * sigma[j]:
                x += at_i
                s += before[j, 1]
                t += before[j, 2]
                n += _ONE
        if n > 0.0:
            state[i, 0], state[i, 1], state[i, 2] = x / n, s / n, t / n
            moved += 1
    return moved


@fast_kernel
def _look_around(graph: Graph, state: F32, far: BoolArray, i: int, seen: F32) -> int:
    """Rows of ``seen``: place from i, inverse depth at i by the plane there, tolerance; how many.

    Neighbours, and theirs.  Those of several neighbours come several times, and so count more.
    """
    u, v, _, sigma, starts, neighbours = graph
    count = 0
    for a in range(starts[i], starts[i + 1]):
        j = neighbours[a]
        for b in range(starts[j] - 1, starts[j + 1]):
            k = neighbours[b] if b >= starts[j] else j
            if k != i and not far[k] and count < _MOST:
                du, dv = u[k] - u[i], v[k] - v[i]
                seen[count, 0], seen[count, 1] = du, dv
                seen[count, 2] = state[k, 0] - state[k, 1] * du - state[k, 2] * dv
                seen[count, 3] = np.float32(_APART) * sigma[k]
                count += 1
    return count


@fast_kernel
def _other_surface(seen: F32, count: int, own: np.float32) -> tuple[int, np.float32]:
    """How many are not on the surface ``own``, and where most of them agree."""
    support, best, other = 0, 0, np.float32(0.0)
    for a in range(count):
        if abs(seen[a, 2] - own) <= seen[a, 3]:
            continue
        support += 1
        agree = 0
        for b in range(count):
            if abs(seen[b, 2] - seen[a, 2]) <= seen[a, 3]:
                agree += 1
        if agree > best:
            best, other = agree, seen[a, 2]
    return support, other


@fast_kernel
def _beyond_border(seen: F32, count: int, own: np.float32, other: np.float32) -> bool:
    """Whether the origin is on the side of ``other``: the sign of a fitted plane there."""
    ww, wu, wv, uu, uv, vv = 0.0, 0.0, 0.0, _BORDER_RIDGE, 0.0, _BORDER_RIDGE
    w_side, u_side, v_side = 0.0, 0.0, 0.0
    for a in range(count):
        to_own, to_other = abs(seen[a, 2] - own), abs(seen[a, 2] - other)
        if min(to_own, to_other) <= seen[a, 3]:
            du, dv = seen[a, 0], seen[a, 1]
            w = 1.0 / (1.0 + (du * du + dv * dv) / _REACH) ** 2
            side = w if to_own <= to_other else -w
            ww += w
            wu += w * du
            wv += w * dv
            uu += w * du * du
            uv += w * du * dv
            vv += w * dv * dv
            w_side += side
            u_side += side * du
            v_side += side * dv
    # Cramer's rule: the determinant of a Gram matrix with a ridge is positive.
    at_origin = (uu * vv - uv * uv) * w_side
    at_origin += (wv * uv - wu * vv) * u_side
    at_origin += (wu * uv - wv * uu) * v_side
    return bool(at_origin < 0.0)

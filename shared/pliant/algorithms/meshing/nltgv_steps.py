"""Which side of a step a vertex is on: kernels of NLTGV between two sets of weights.

A convex energy, like any vote among the neighbours, gives a vertex at a step to the side with more
of them.  Vertices with data are moved by their data, the others by where the border must run.
"""

import numpy as np

from pliant.algorithms.arrays import F32, I32, I64, BoolArray
from pliant.algorithms.kernel import fast_kernel
from pliant.algorithms.meshing.nltgv_kernels import HALF_U, HALF_V

_APART = 6.0
"""Surfaces so many sigmas apart at a vertex are two."""
_FEWEST = 3
"""Neighbours that another surface needs."""
_MOST = 512
"""Neighbours of neighbours that are looked at."""
_REACH = 2.0
"""Median edges squared at which a neighbour counts a quarter in the border."""
_RIDGE = 0.3
"""Median edges squared that hold the direction of the border."""
_ONE = np.float32(1.0)


@fast_kernel
def change_sides(state: F32, edges: I32, table: F32, data: F32, sigma: F32, sigmas: float) -> int:
    """Move vertices that left their data to a neighbour's surface that agrees with it; how many.

    At a step the majority of neighbours may be on the wrong side.
    """
    M = len(state)
    sums = np.zeros((M, 4), np.float32)
    for e in range(len(edges)):
        i, j = edges[e, 0], edges[e, 1]
        du, dv = np.float32(2.0) * table[e, HALF_U], np.float32(2.0) * table[e, HALF_V]
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
def choose_sides(
    u: F32, v: F32, state: F32, data: F32, sigma: F32, starts: I64, neighbours: I32, sigmas: float
) -> int:
    """Move vertices whose data say nothing to the side of a step where they lie; how many.

    An outlier has a place, though no inverse depth.  Where neighbours and theirs are on two
    surfaces, the line that separates the two best (least squares of +-1, nearer ones heavier)
    says on which side the vertex is.    starts, neighbours: of ``rings``.
    sigmas: data farther off the surface say nothing.
    """
    seen, far = np.empty((_MOST, 4), np.float32), np.zeros(len(state), np.bool_)
    for i in range(len(state)):
        far[i] = not (sigma[i] < np.inf and abs(state[i, 0] - data[i]) <= sigmas * sigma[i])
    before, moved = state.copy(), 0
    for i in range(len(state)):
        if not far[i]:
            continue
        own = before[i, 0]
        count = _look_around(u, v, before, sigma, far, starts, neighbours, i, seen)
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
def _look_around(
    u: F32, v: F32, state: F32, sigma: F32, far: BoolArray, starts: I64, neighbours: I32, i: int,
    seen: F32,
) -> int:  # fmt: skip
    """Rows of ``seen``: place from i, inverse depth at i by the plane there, tolerance; how many.

    Neighbours, and theirs.  Those of several neighbours come several times, and so count more.
    """
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
    ww, wu, wv, uu, uv, vv = 0.0, 0.0, 0.0, _RIDGE, 0.0, _RIDGE
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

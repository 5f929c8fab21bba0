"""Which surface continues in the holes of a keyframe's own surface.

Most holes lie at depth discontinuities, between two surfaces that end some pixels short of each
other, and windows that straddle them match the nearer one.  So the depths to choose from are those
of the surfaces around: along each of eight directions r, from the nearest pixel y = x - n r with a
surface, whose inverse depth is w and whose slopes are g,

    w_r(x) = w(y) + <g(y), x - y>,    e_r(x) = sum_k |I(y + k r) - I(y + (k - 1) r)|,

and the depth that keyframes agree on.  The pixel takes the one with the least

    1 - ZNCC(w_r) + PRIOR e_r / (e_r + EDGE),                                               (3)

where e_r, the change of grey along the path, tells whether an edge lies between.  ZNCC is that of
equation (2) with weights exp(-|I(q) - I(x)| / LIKE) for the pixels q of a small window along the
surface (Yoon and Kweon 2006), so that what lies across the edge hardly counts.  It is the mean of
the better half of the sources: in the others the pixel may be hidden.

Where sources show the pixel and yet nothing was agreed on, something else may be there, such as a
thin rail: the hole stays.  Where none shows it, (3) is the change of grey alone.
"""

from collections.abc import Sequence
from typing import Annotated, NamedTuple

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, U8, Shape
from pliant.algorithms.stereo.matching import NOISE_VARIANCE
from pliant.algorithms.stereo.sweep import poses_of
from pliant.algorithms.stereo.views import NOT_SHOWN, DenseDepth, StereoView, motion
from pliant.compiler.kernel import kernel

_REACH_PX = 8
"""How far surfaces are continued, pixels of the swept view: twice the window of its last sweep."""
_RADIUS = 2
"""Of windows, pixels."""
_LIKE = 6.0
"""Difference of grey at which a pixel of a window counts 1 / e."""
_PRIOR, _EDGE = 0.3, 60.0
"""What an edge on the path costs at most, and the change of grey at which it costs half of that."""
_AGREED_PRIOR = 0.1
"""Of the depth that keyframes agree on: near discontinuities their windows err alike."""
_MIN_SUPPORT = 1.5
"""As many confident views agree."""
_OUTSIDE = 3.0
"""Cost of what no source shows: above all others."""
_SAME = 0.003
"""Share of the inverse depth by which two differ at least to be compared with the images both."""
_MOST_BEND = 0.05
"""Share of the inverse depth over _SPAN pixels above which a slope is a discontinuity."""
_SPAN = 2
_DIRECTIONS = np.array(
    [(1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (1, -1), (-1, 1), (-1, -1)], np.int32
)


class _Planes(NamedTuple):
    """Inverse depths of the surface, 0: none, and their slopes along u and v."""

    w: Annotated[F32, Shape("H", "W")]
    across: Annotated[F32, Shape("H", "W")]
    down: Annotated[F32, Shape("H", "W")]


class _Paths(NamedTuple):
    """From each pixel back to the surface in eight directions.  steps: 0: none.  changes: of grey
    along them."""

    steps: Annotated[U8, Shape(8, "H", "W")]
    changes: Annotated[I32, Shape(8, "H", "W")]


def extended(
    surface: F32, agreed: DenseDepth, view: StereoView, sources: Sequence[StereoView]
) -> F32:
    """Inverse depths (h, w) of the holes of a surface; 0 elsewhere, and where nothing is near.

    surface: (h, w) inverse depths in the view, 0 in holes.    agreed: as of ``consensus``.
    sources: of the same camera.  Without any, only what was agreed on remains.
    """
    w = np.where(agreed.confidences > _MIN_SUPPORT, agreed.inverse_depths, np.float32(0.0))
    result = np.where((surface > 0.0) | (view.grey == NOT_SHOWN), np.float32(0.0), w)
    if len(sources):
        planes = _Planes(surface, np.zeros_like(surface), np.zeros_like(surface))
        _slopes(planes)
        moved = motion(view.camera, view.T_world_camera, poses_of(sources))
        shape = (len(_DIRECTIONS), *surface.shape)
        paths = _Paths(np.zeros(shape, np.uint8), np.zeros(shape, np.int32))
        _walk(surface, view.grey, _DIRECTIONS, paths)
        _choose(
            planes, paths, view.grey, np.stack([source.grey for source in sources]),
            moved.homographies, moved.translations, _DIRECTIONS, _likeness(), result,
        )  # fmt: skip
    return result


def reduced(depths: F32, times: int) -> F32:
    """Inverse depths of a depth map (H, W), ``times`` smaller; 0 where a pixel has none."""
    height, width = (size // times for size in depths.shape)
    blocks = depths[: height * times, : width * times].reshape(height, times, width, times)
    known = blocks > 0.0
    inverse = np.float32(1.0) / np.where(known, blocks, np.float32(1.0))
    means = inverse.mean(axis=(1, 3), dtype=np.float32)
    return np.where(known.all(axis=(1, 3)), means, np.float32(0.0))


def _likeness() -> F32:
    """(256,) weights by the difference of grey, whole numbers: the same on every machine."""
    return np.rint(1024.0 * np.exp(-np.arange(256.0) / _LIKE)).astype(np.float32)


@kernel
def _slopes(planes: _Planes) -> None:
    """Of the slopes to either side the lesser one; 0 where both lead over a discontinuity."""
    w = planes.w
    height, width = w.shape
    for v in range(height):
        for u in range(width):
            here = w[v, u]
            if not here > np.float32(0.0):
                continue
            most = np.float32(_MOST_BEND) * here
            across, down = most, most
            for side in (-_SPAN, _SPAN):
                if 0 <= u + side < width and w[v, u + side] > np.float32(0.0):
                    rise = w[v, u + side] - here
                    if abs(rise) < abs(across):
                        across = rise if side > 0 else -rise
                if 0 <= v + side < height and w[v + side, u] > np.float32(0.0):
                    rise = w[v + side, u] - here
                    if abs(rise) < abs(down):
                        down = rise if side > 0 else -rise
            span = np.float32(_SPAN)
            planes.across[v, u] = across / span if across != most else np.float32(0.0)
            planes.down[v, u] = down / span if down != most else np.float32(0.0)


@kernel
def _walk(surface: F32, grey: U8, directions: I32, paths: _Paths) -> None:
    """Along each direction, what lies behind is done before what lies ahead."""
    height, width = surface.shape
    for r in range(len(directions)):
        du, dv = directions[r, 0], directions[r, 1]
        for i in range(height):
            v = i if dv >= 0 else height - 1 - i
            for k in range(width):
                u = k if du >= 0 else width - 1 - k
                a, b = u - du, v - dv
                if surface[v, u] > np.float32(0.0) or grey[v, u] == NOT_SHOWN:
                    continue
                if a < 0 or b < 0 or a >= width or b >= height:
                    continue
                change = abs(np.int32(grey[v, u]) - np.int32(grey[b, a]))
                if surface[b, a] > np.float32(0.0):
                    paths.steps[r, v, u], paths.changes[r, v, u] = 1, change
                elif 0 < paths.steps[r, b, a] < _REACH_PX:
                    paths.steps[r, v, u] = paths.steps[r, b, a] + 1
                    paths.changes[r, v, u] = paths.changes[r, b, a] + change


@kernel
def _choose(
    planes: _Planes, paths: _Paths, grey: U8, sources: U8, homographies: F64, translations: F64,
    directions: I32, likeness: F32, result: F32,
) -> None:  # fmt: skip
    """result: (h, w) what was agreed on, replaced by the depth with the least (3)."""
    height, width = grey.shape
    weights = np.empty((2 * _RADIUS + 1, 2 * _RADIUS + 1))
    costs = np.empty(len(sources))
    tried, results = np.empty(len(directions) + 1), np.empty(len(directions) + 1)
    for v in range(height):
        for u in range(width):
            if planes.w[v, u] > np.float32(0.0) or grey[v, u] == NOT_SHOWN:
                continue
            agreed, least, chosen, count = result[v, u], np.inf, 0.0, 0
            for r in range(-1, len(directions)):
                across, down = 0.0, 0.0
                if r < 0:
                    w, prior = float(agreed), _AGREED_PRIOR
                else:
                    n = int(paths.steps[r, v, u])
                    if n == 0:
                        continue
                    a, b = u - n * directions[r, 0], v - n * directions[r, 1]
                    across, down = float(planes.across[b, a]), float(planes.down[b, a])
                    w = planes.w[b, a] + across * (u - a) + down * (v - b)
                    change = float(paths.changes[r, v, u])
                    prior = _PRIOR * change / (change + _EDGE)
                if not w > 0.0 or prior >= least:
                    continue
                if count == 0:
                    _weigh(grey, u, v, likeness, weights, agreed > np.float32(0.0))
                like = 0
                while like < count and abs(tried[like] - w) >= _SAME * w:
                    like += 1
                if like == count:
                    tried[count] = w
                    results[count] = _mismatch(
                        grey, sources, homographies, translations, u, v, (w, across, down),
                        weights, costs,
                    )  # fmt: skip
                    count += 1
                if prior + results[like] < least:
                    least, chosen = prior + results[like], w
            if agreed > np.float32(0.0) or least >= _OUTSIDE:
                result[v, u] = np.float32(chosen)


@kernel
def _weigh(grey: U8, u: int, v: int, likeness: F32, weights: F64, whole: bool) -> None:
    """Of the window about a pixel; 0: outside the image, or not shown.  not whole: of it alone."""
    height, width = grey.shape
    here = np.int32(grey[v, u])
    for j in range(len(weights)):
        for i in range(len(weights)):
            x, y = u + i - _RADIUS, v + j - _RADIUS
            weights[j, i] = 0.0
            if not whole and (i != _RADIUS or j != _RADIUS):
                continue
            if 0 <= x < width and 0 <= y < height and grey[y, x] != NOT_SHOWN:
                weights[j, i] = likeness[abs(np.int32(grey[y, x]) - here)]


@kernel
def _mismatch(
    grey: U8, sources: U8, homographies: F64, translations: F64, u: int, v: int,
    plane: tuple[float, float, float], weights: F64, costs: F64,
) -> float:  # fmt: skip
    """1 - ZNCC, the mean of the better half of the sources that show the window.

    plane: inverse depth at the pixel, and its slopes.
    """
    height, width = grey.shape
    w, across, down = plane
    shown = 0
    for s in range(len(sources)):
        A, b, image = homographies[s], translations[s], sources[s]
        # Equation (1) is linear in the place within the window, as inverse depth is.
        begin, right, low = np.empty(3), np.empty(3), np.empty(3)
        for c in range(3):
            begin[c] = A[c, 0] * u + A[c, 1] * v + A[c, 2] + b[c] * w
            right[c], low[c] = A[c, 0] + b[c] * across, A[c, 1] + b[c] * down
        total, of_r, of_s, of_rr, of_ss, of_rs = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        inside = True
        for j in range(len(weights)):
            for i in range(len(weights)):
                weight = weights[j, i]
                if weight == 0.0:
                    continue
                du, dv = i - _RADIUS, j - _RADIUS
                z = begin[2] + right[2] * du + low[2] * dv
                if not z > 0.0:
                    inside = False
                    break
                p = (begin[0] + right[0] * du + low[0] * dv) / z
                q = (begin[1] + right[1] * du + low[1] * dv) / z
                if not (0.0 <= p < width - 1 and 0.0 <= q < height - 1):
                    inside = False
                    break
                k, m = int(p), int(q)
                g00, g01 = float(image[m, k]), float(image[m, k + 1])
                g10, g11 = float(image[m + 1, k]), float(image[m + 1, k + 1])
                if min(min(g00, g01), min(g10, g11)) == NOT_SHOWN:
                    inside = False
                    break
                above, below = g00 + (p - k) * (g01 - g00), g10 + (p - k) * (g11 - g10)
                there, here = above + (q - m) * (below - above), float(grey[v + dv, u + du])
                total += weight
                of_r += weight * here
                of_s += weight * there
                of_rr += weight * here * here
                of_ss += weight * there * there
                of_rs += weight * here * there
            if not inside:
                break
        if not inside:
            continue
        mean_r, mean_s = of_r / total, of_s / total
        spread_r = of_rr / total - mean_r * mean_r + NOISE_VARIANCE
        spread_s = of_ss / total - mean_s * mean_s + NOISE_VARIANCE
        cost = 1.0 - (of_rs / total - mean_r * mean_s) / np.sqrt(spread_r * spread_s)
        k = shown
        while k > 0 and costs[k - 1] > cost:
            costs[k] = costs[k - 1]
            k -= 1
        costs[k] = cost
        shown += 1
    if shown == 0:
        return _OUTSIDE
    used = (shown + 1) // 2
    mean = 0.0
    for k in range(used):
        mean += costs[k]
    return mean / used

"""Depth maps for surfels: their tangents at creation, and the consistency of the map with them.

A plane has an inverse depth that is affine in the image.  It is fitted robustly to the pixels
around a point, so that noise is averaged, holes are left out, and surfaces beyond a depth
discontinuity do not bend the tangent (DSDT, Eq. 3 and 4).

A map of a rigid scene is wrong where the scene deforms: surfels show where, and determine its
scale.
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np

from pliant.algorithms.arrays import F64, I64, BoolArray
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import inverse, transform
from pliant.algorithms.surfels.surfel_frame import SurfelFrame, SurfelState
from pliant.compiler.kernel import fast_kernel

_REWEIGHTINGS = 4
_TUKEY = 4.685  # 95 % efficiency for Gaussian noise
_MAD = 1.4826
_CELL_PX = 16
"""Side of the squares in which the agreement is tested once."""
_MIN_SURFELS = 30
"""Minimum agreeing surfels, besides half of those in the map."""
_MAX_DISAGREEMENT = 0.02
"""Maximum relative difference between a surfel's depth and the map's, after the median."""
_AROUND_PX = 2
"""The measured depth of a surfel is the median over a square that extends this far from it."""
_REACH = 2.0
"""Surfels within this many patch sides decide whether a depth is right."""


_BLUR_CELLS = 2.0
"""Standard deviation, in cells, with which surfels determine the depth around them."""
_FAR_WEIGHT = 1e-4
"""Weight of the mean depth, which decides far from all surfels."""


def depth_between(points_px: F64, z: F64, camera: PinholeCamera) -> F64:
    """(H, W) smooth depth through surfels: a Gaussian mean of their inverse depths.

    For births where depth has no meaning but that of the surfels around.  points_px: (N, 2) pixels
    of tracked surfels.  z: (N,) their depths.
    """
    rows, columns = (-(-side // _CELL_PX) for side in (camera.height, camera.width))
    at = np.floor((points_px + 0.5) / _CELL_PX).astype(np.int64)
    inside = ((at >= 0) & (at < (columns, rows))).all(axis=1) & (z > 0.0)
    cells, inverse_z = at[inside, 1] * columns + at[inside, 0], 1.0 / z[inside]
    sums = np.stack([np.bincount(cells, w, rows * columns) for w in (None, inverse_z)])
    weights, sums = (
        cv2.GaussianBlur(grid.reshape(rows, columns).astype(np.float64), (0, 0), _BLUR_CELLS)
        for grid in sums
    )
    mean = inverse_z.mean() if len(inverse_z) else 1.0
    smooth = (sums + _FAR_WEIGHT * mean) / (weights + _FAR_WEIGHT)
    size = columns * _CELL_PX, rows * _CELL_PX
    full = cv2.resize(smooth, size, interpolation=cv2.INTER_LINEAR)
    return 1.0 / np.asarray(full[: camera.height, : camera.width], np.float64)


@dataclass(frozen=True)
class Agreement:
    """Comparison of a depth map with surfels.

    ratio: units of the surfels per unit of the map.    depth: (H, W) in units of the surfels, 0
    where unknown or contradicted; None if undecided, because of the ``problem``.
    """

    ratio: float
    depth: F64 | None
    problem: str = ""


def agree(depth: F64, surfels: SurfelFrame, patch_px: int) -> Agreement:
    """Compare a depth map with the surfels tracked in its frame.

    depth: (H, W) along the optical axis in any unit, 0 where unknown.
    """
    pixels, ratios = _ratios(depth, surfels)
    if len(ratios) < _MIN_SURFELS:
        return Agreement(0.0, None, f"{len(ratios)} surfels lie on it, {_MIN_SURFELS} needed")
    ratio = float(np.median(ratios))
    agrees = np.abs(ratios - ratio) < _MAX_DISAGREEMENT * ratio
    count = int(agrees.sum())
    if count < max(_MIN_SURFELS, 0.5 * len(ratios)):
        return Agreement(ratio, None, f"{count} of the {len(ratios)} surfels on it agree with it")
    reach = _REACH * patch_px
    return Agreement(ratio, np.where(_doubted(depth, pixels, agrees, reach), 0.0, ratio * depth))


def contradicted_by_depth(depth: F64, points_px: F64, z: F64) -> tuple[BoolArray, BoolArray]:
    """(N,) whether a depth map contradicts the depths of surfels, and whether it has one there.

    depth: (H, W) in units of the surfels, 0 where unknown.  points_px: (N, 2).  z: (N,).
    """
    height, width = depth.shape
    steps = np.arange(-_AROUND_PX, _AROUND_PX + 1)
    at = np.rint(points_px).astype(np.int64)
    columns = at[:, 0, None] + np.tile(steps, len(steps))
    rows = at[:, 1, None] + steps.repeat(len(steps))
    inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    there = depth[np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)]
    valid = inside & (there > 0.0)
    known = (valid.sum(axis=1) > 0.5 * valid.shape[1]) & (z > 0.0)
    middle = np.full(len(z), np.inf)
    middle[known] = np.nanmedian(np.where(valid, there, np.nan)[known], axis=1)
    return known & (np.abs(z - middle) > _MAX_DISAGREEMENT * middle), known


def contradiction(depth: F64, surfels: SurfelFrame) -> str:
    """Why a measured depth map shows that most surfels are wrong; "" if it does not."""
    tracked = surfels.state == SurfelState.TRACKED
    z = transform(inverse(surfels.T_world_camera), surfels.positions[tracked])[:, 2]
    off, known = contradicted_by_depth(depth, surfels.points_px[tracked].astype(np.float64), z)
    if 2 * off.sum() <= known.sum() or known.sum() < _MIN_SURFELS:
        return ""
    return f"{off.sum()} of the {known.sum()} surfels on it have another depth"


def _ratios(depth: F64, surfels: SurfelFrame) -> tuple[I64, F64]:
    """(N, 2) pixels of tracked surfels that the map shows, and (N,) their depths by the map's."""
    tracked = surfels.state == SurfelState.TRACKED
    z = transform(inverse(surfels.T_world_camera), surfels.positions[tracked])[:, 2]
    pixels = np.rint(surfels.points_px[tracked]).astype(np.int64)
    size = np.array([depth.shape[1], depth.shape[0]])
    inside = ((pixels >= 0) & (pixels < size)).all(axis=1) & (z > 0.0)
    pixels, z = pixels[inside], z[inside]
    there = depth[pixels[:, 1], pixels[:, 0]]
    known = there > 0.0
    return pixels[known], z[known] / there[known]


def _doubted(depth: F64, pixels: I64, agrees: np.ndarray, reach_px: float) -> np.ndarray:
    """(H, W) whether fewer than half of the surfels around a pixel agree; false without surfels."""
    height, width = depth.shape
    rows, columns = np.arange(0, height, _CELL_PX), np.arange(0, width, _CELL_PX)
    middle = 0.5 * (_CELL_PX - 1)
    dv = (rows[:, None] + middle - pixels[:, 1]) ** 2
    du = (columns[:, None] + middle - pixels[:, 0]) ** 2
    near = dv[:, None] + du[None] < reach_px**2
    doubted = 2 * (near & agrees).sum(axis=2) < near.sum(axis=2)
    return np.repeat(np.repeat(doubted, _CELL_PX, axis=0), _CELL_PX, axis=1)[:height, :width]


@fast_kernel
def fit_inverse_depth(
    depth: F64, column: float, row: float, radius: int, jump: float, noise: float, out: F64
) -> float:
    """Fit 1/z = q + p (column' - column) + r (row' - row) around one point.

    depth: (H, W) metres, 0 or NaN for holes.  radius: of the square window, px.  jump: depths that
    differ by more than this share from the nearest valid one are another surface.  noise: relative
    depth noise that no fit is expected to get below.  out: (4,) receives q, p, r and the rms of the
    fit relative to q.  Returns the share of the window that supports the fit, 0 when there is none.
    """
    height, width = depth.shape
    c0, r0 = math.floor(column + 0.5), math.floor(row + 0.5)
    start = _nearest_depth(depth, c0, r0, min(radius, 3))
    if start <= 0.0:
        return 0.0
    size = 2 * radius + 1
    xs, ys, qs = np.empty(size * size), np.empty(size * size), np.empty(size * size)
    count = 0
    for y in range(max(r0 - radius, 0), min(r0 + radius + 1, height)):
        for x in range(max(c0 - radius, 0), min(c0 + radius + 1, width)):
            z = depth[y, x]
            if z > 0.0 and abs(z - start) < jump * start:
                xs[count], ys[count], qs[count] = x - column, y - row, 1.0 / z
                count += 1
    if count < max(6, size):
        return 0.0
    xs, ys, qs = xs[:count], ys[:count], qs[:count]
    q0 = 1.0 / start
    scale = 1e9
    residuals = np.empty(count)
    a, b, c = q0, 0.0, 0.0
    inliers, squares = 0, 0.0
    for _ in range(_REWEIGHTINGS):
        solved, a, b, c = _weighted_plane(xs, ys, qs, a, b, c, scale)
        if not solved:
            return 0.0
        for k in range(count):
            residuals[k] = abs(qs[k] - a - b * xs[k] - c * ys[k])
        middle = _smallest(residuals, count // 2)
        scale = _TUKEY * max(_MAD * middle, noise * q0)
        inliers, squares = 0, 0.0
        for k in range(count):
            if residuals[k] < scale:
                inliers += 1
                squares += residuals[k] * residuals[k]
    if not a > 0.0 or inliers == 0:
        return 0.0
    out[0], out[1], out[2] = a, b, c
    out[3] = math.sqrt(squares / inliers) / a
    return inliers / float(size * size)


@fast_kernel
def _smallest(values: F64, k: int) -> float:
    """The k-th smallest, from 0, of values that are reordered (Hoare's selection)."""
    first, last = 0, len(values) - 1
    while first < last:
        pivot, i, j = values[(first + last) // 2], first, last
        while i <= j:
            while values[i] < pivot:
                i += 1
            while values[j] > pivot:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i, j = i + 1, j - 1
        if k <= j:
            last = j
        elif k >= i:
            first = i
        else:
            break
    return float(values[k])


@fast_kernel
def _nearest_depth(depth: F64, column: int, row: int, radius: int) -> float:
    """The valid depth nearest to a pixel, 0 if there is none within ``radius``."""
    height, width = depth.shape
    best, found = 1 << 30, 0.0
    for y in range(max(row - radius, 0), min(row + radius + 1, height)):
        for x in range(max(column - radius, 0), min(column + radius + 1, width)):
            distance = (x - column) ** 2 + (y - row) ** 2
            if depth[y, x] > 0.0 and depth[y, x] < 1e6 and distance < best:
                best, found = distance, depth[y, x]
    return found


@fast_kernel
def _weighted_plane(
    xs: F64, ys: F64, qs: F64, a: float, b: float, c: float, scale: float
) -> tuple[bool, float, float, float]:
    """Least squares plane with Tukey weights about the plane (a, b, c)."""
    n = sx = sy = sxx = sxy = syy = sq = sxq = syq = 0.0
    for k in range(len(xs)):
        x, y, q = xs[k], ys[k], qs[k]
        t = (q - a - b * x - c * y) / scale
        if abs(t) >= 1.0:
            continue
        w = (1.0 - t * t) ** 2
        n += w
        sx += w * x
        sy += w * y
        sxx += w * x * x
        sxy += w * x * y
        syy += w * y * y
        sq += w * q
        sxq += w * x * q
        syq += w * y * q
    if n <= 0.0:
        return False, a, b, c
    mx, my, mq = sx / n, sy / n, sq / n
    cxx, cxy, cyy = sxx / n - mx * mx, sxy / n - mx * my, syy / n - my * my
    cxq, cyq = sxq / n - mx * mq, syq / n - my * mq
    det = cxx * cyy - cxy * cxy
    if not det > 1e-3 * cxx * cyy or cxx <= 0.0 or cyy <= 0.0:
        return False, a, b, c
    slope_x = (cxq * cyy - cyq * cxy) / det
    slope_y = (cyq * cxx - cxq * cxy) / det
    return True, mq - slope_x * mx - slope_y * my, slope_x, slope_y


def tangent_jacobian(x: F64, y: F64, z: F64, dz_dx: F64, dz_dy: F64) -> F64:
    """Eq. 4: (N, 3, 2) tangents of surfaces z(x, y) over normalised coordinates.

    x, y: (N,) normalised coordinates.  z: (N,) metres.  dz_dx, dz_dy: (N,) its derivatives.
    """
    rows = [
        [z + x * dz_dx, x * dz_dy],
        [y * dz_dx, z + y * dz_dy],
        [dz_dx, dz_dy],
    ]
    return np.moveaxis(np.array(rows, np.float64), -1, 0)

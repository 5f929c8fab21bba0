"""Landmarks that lost their track are reacquired at the maxima of a frame.

A landmark is projected with the pose of the frame, and matched to the nearby maximum whose patch
fits best.  Only the sign of the curvature counts: its size grows with the cube of the exposure.
The patch then refines the position, because an extremum alone is accurate to half a pixel.  Not in
the paper; docs/results.md has its value.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, U8, BoolArray
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import inverse
from pliant.algorithms.image.patch_alignment import (
    Template,
    align_patch,
    make_template,
    patch_strength,
    patch_tensor,
)
from pliant.algorithms.image.patch_sums import PATCH_PIXELS, PATCH_SIZE, TEMPLATE_FLOATS, UNIFORM
from pliant.algorithms.image.pixels import Pixels, pixels_of
from pliant.algorithms.slam.map.landmarks import PATCH_SIDE, Landmarks
from pliant.algorithms.slam.parameters import ReacquisitionParameters
from pliant.compiler.kernel import fast_kernel, kernel

_MIN_CELL_PX = 8

_MARGIN_PX = 8.0
_ALIGN_REACH_PX = np.float32(1.5)
_ITERATIONS = 4

FLAT = np.float32(1.0)
"""Standard deviation, in grey levels, below which a patch is not used."""


class MaximaGrid(NamedTuple):
    """Maxima (M, 3) as (u, v, kappa); those of cell c are ``order[starts[c] : starts[c + 1]]``.

    Those without kappa, (M, 2), only have a nearest one.
    cell_px: side of a cell, no less than any search radius, so that nine cells suffice.
    """

    maxima: F32
    starts: I32
    order: I32
    columns: int
    lines: int
    cell_px: int

    @staticmethod
    def build(maxima: F32, width: int, height: int, radius_px: float) -> "MaximaGrid":
        """Sort the maxima of an image of the given size.  radius_px: of the widest search."""
        cell_px = max(_MIN_CELL_PX, math.ceil(radius_px))
        columns, lines = width // cell_px + 1, height // cell_px + 1
        starts = np.zeros(columns * lines + 1, np.int32)
        order = np.empty(len(maxima), np.int32)
        grid = MaximaGrid(maxima, starts, order, columns, lines, cell_px)
        _sort_into_cells(grid)
        return grid

    def nearest(self, points_px: F32, radius_px: float) -> I32:
        """(N,) index of the maximum nearest to each point (N, 2) within the radius, else -1."""
        found = np.full(len(points_px), -1, np.int32)
        _nearest(points_px, self, radius_px, found)
        return found


@kernel
def _sort_into_cells(grid: MaximaGrid) -> None:
    maxima, starts, order = grid.maxima, grid.starts, grid.order
    columns, lines, cell_px = grid.columns, grid.lines, grid.cell_px
    cells = np.empty(maxima.shape[0], np.int32)
    for i in range(maxima.shape[0]):
        column = min(max(int(maxima[i, 0]) // cell_px, 0), columns - 1)
        line = min(max(int(maxima[i, 1]) // cell_px, 0), lines - 1)
        cells[i] = line * columns + column
        starts[cells[i] + 1] += 1
    for c in range(columns * lines):
        starts[c + 1] += starts[c]
    filled = starts[:-1].copy()
    for i in range(maxima.shape[0]):
        order[filled[cells[i]]] = i
        filled[cells[i]] += 1


@kernel
def _nearest(points_px: F32, grid: MaximaGrid, radius_px: float, found: I32) -> None:
    maxima, columns = grid.maxima, grid.columns
    for i in range(points_px.shape[0]):
        u, v = points_px[i, 0], points_px[i, 1]
        column, line = int(u) // grid.cell_px, int(v) // grid.cell_px
        best = radius_px * radius_px
        for y in range(max(line - 1, 0), min(line + 2, grid.lines)):
            for x in range(max(column - 1, 0), min(column + 2, columns)):
                cell = y * columns + x
                for k in range(grid.starts[cell], grid.starts[cell + 1]):
                    m = grid.order[k]
                    distance2 = (maxima[m, 0] - u) ** 2 + (maxima[m, 1] - v) ** 2
                    if distance2 < best:
                        best, found[i] = distance2, m


@dataclass(frozen=True, kw_only=True)
class Reacquired:
    """Reacquired landmarks, each at most once.

    rows: (R,) of the landmarks.   points_px: (R, 2) their positions.   maxima: (R,) index of
    theirs.
    visible: (V,) rows that should have been in the image.
    """

    rows: I32
    points_px: F32
    maxima: I32
    visible: I32


class _Wanted(NamedTuple):
    """Landmarks to search.

    projected: (W, 2) predicted position, px.     rows: (W,) of the landmarks.
    kappas: curvature of every row, of which the sign counts.
    patches: (..., PATCH_SIDE, PATCH_SIDE) grey levels around every row.
    """

    projected: F32
    rows: I32
    kappas: F32
    patches: U8


class _Limits(NamedTuple):
    """See the fields of ReacquisitionParameters."""

    radius_px: float
    min_zncc: float


def reacquire(
    T_world_camera: F64,
    rows: I32,
    points: Landmarks,
    maxima: F32,
    seen: F32,
    grey: U8 | None,
    camera: PinholeCamera,
    parameters: ReacquisitionParameters,
) -> Reacquired:
    """Match landmarks to the maxima of a frame with a known pose.

    rows: (R,) landmarks to search.  maxima: (M, 3) of the frame.  seen: (M, 3) the same in the
    pixels of grey (H, W), which may be an uncorrected image: the offset of a match from its maximum
    is the same in both.  grey None: only distance and the sign of the curvature decide.
    """
    projected, inside = _projected(T_world_camera, rows, points, camera)
    visible_rows = rows.compress(inside)
    wanted = _Wanted(projected.compress(inside, 0), visible_rows, points.kappas, points.patches)
    grid = MaximaGrid.build(maxima, camera.width, camera.height, parameters.radius_px)
    choice = np.full(len(visible_rows), -1, np.int32)
    points_px = np.zeros((len(visible_rows), 2), np.float32)
    image = np.zeros((0, 0), np.float32) if grey is None else grey.astype(np.float32)
    limits = _Limits(parameters.radius_px, parameters.min_zncc)
    _match(wanted, grid, seen, pixels_of(image), limits, choice, points_px)
    found = choice >= 0
    return Reacquired(
        rows=visible_rows.compress(found),
        points_px=points_px.compress(found, 0),
        maxima=choice[found],
        visible=visible_rows,
    )


def match_widely(
    T_world_camera: F64,
    rows: I32,
    points: Landmarks,
    grid: MaximaGrid,
    grey: U8,
    camera: PinholeCamera,
    radius_px: float,
    count: int,
    min_zncc: float,
) -> tuple[I32, F32]:
    """Match landmarks to the maxima of a frame with an uncertain pose, by their patches.

    rows, grey: as for ``reacquire``.   radius_px: around the projection by T_world_camera.
    count: maximum number of landmarks.   Returns rows (F,) and pixels (F, 2); some of them are
    wrong.
    """
    projected, inside = _projected(T_world_camera, rows, points, camera)
    visible = np.flatnonzero(inside)
    visible = visible[:: max(1, -(-len(visible) // count))]
    rows = rows[visible]
    wanted = _Wanted(projected[visible], rows, points.kappas, points.patches)
    points_px = np.zeros((len(rows), 2), np.float32)
    image = pixels_of(grey.astype(np.float32))
    found = _match_patches(wanted, grid, image, radius_px, min_zncc, points_px)
    return rows[found], points_px[found]


def _projected(
    T_world_camera: F64, rows: I32, points: Landmarks, camera: PinholeCamera
) -> tuple[F32, BoolArray]:
    """Projections of landmarks, px (R, 2), and whether they are in the image."""
    T_camera_world = np.ascontiguousarray(inverse(T_world_camera)[:3])
    K = np.array([*camera.intrinsics, camera.width, camera.height])
    projected = np.empty((len(rows), 2), np.float32)
    visible = _project(T_camera_world, rows, points.xyz, K, projected)
    return projected, visible


@fast_kernel
def cut_patches(grey: U8, points_px: F32, rows: I32, patches: U8) -> None:
    """Store the patch around each landmark (N, 2), with the margin for its gradients, in
    ``patches[rows[n]]``; zeros beyond the border of the image.
    """
    height, width = grey.shape
    for i in range(rows.size):
        patch = patches[rows[i]]
        left = points_px[i, 0] - np.float32(0.5 * (PATCH_SIDE - 1))
        top = points_px[i, 1] - np.float32(0.5 * (PATCH_SIDE - 1))
        x, y = int(np.floor(left)), int(np.floor(top))
        if x < 0 or y < 0 or x + PATCH_SIDE >= width or y + PATCH_SIDE >= height:
            patch[:] = 0
            continue
        a, b = left - np.float32(x), top - np.float32(y)
        one = np.float32(1.0)
        w00, w01, w10, w11 = (one - a) * (one - b), a * (one - b), (one - a) * b, a * b
        for r in range(PATCH_SIDE):
            upper, lower = grey[y + r, x:], grey[y + r + 1, x:]
            for c in range(PATCH_SIDE):
                above = w00 * upper[c] + w01 * upper[c + 1]
                below = w10 * lower[c] + w11 * lower[c + 1]
                patch[r, c] = np.uint8(above + below + np.float32(0.5))


@kernel
def _project(T: F64, rows: I32, xyz: F64, K: F64, projected: F32) -> BoolArray:
    visible = np.zeros(rows.size, np.bool_)
    for i in range(rows.size):
        X, Y, Z = xyz[rows[i], 0], xyz[rows[i], 1], xyz[rows[i], 2]
        z = T[2, 0] * X + T[2, 1] * Y + T[2, 2] * Z + T[2, 3]
        if z > 1e-6:
            u = K[0] * (T[0, 0] * X + T[0, 1] * Y + T[0, 2] * Z + T[0, 3]) / z + K[2]
            v = K[1] * (T[1, 0] * X + T[1, 1] * Y + T[1, 2] * Z + T[1, 3]) / z + K[3]
            projected[i, 0], projected[i, 1] = u, v
            visible[i] = _MARGIN_PX <= u < K[4] - _MARGIN_PX and _MARGIN_PX <= v < K[5] - _MARGIN_PX
    return visible


@fast_kernel
def _match(
    wanted: _Wanted,
    grid: MaximaGrid,
    seen: F32,
    image: Pixels,
    limits: _Limits,
    choice: I32,
    points_px: F32,
) -> None:
    """Assign each maximum to the landmark that fits it best; writes its choice, -1, and its
    position.
    """
    maxima = grid.maxima
    owner = np.full(maxima.shape[0], -1, np.int32)
    scores = np.zeros(maxima.shape[0])
    window = Pixels(np.empty(PATCH_SIDE * PATCH_SIDE, np.float32), PATCH_SIDE, PATCH_SIDE)
    values = np.empty(TEMPLATE_FLOATS, np.float32)
    to_origin = np.float32(0.5 * (PATCH_SIZE - 1))
    for i in range(wanted.rows.size):
        first, second, distance2 = _two_nearest(wanted, i, grid, limits)
        if first < 0:
            continue
        best, best_score = -1, -1.0
        best_u, best_v = np.float32(0.0), np.float32(0.0)
        if image.width == 0:
            best, best_score = first, 1.0 / (1.0 + distance2)
            best_u, best_v = maxima[best, 0], maxima[best, 1]
        else:
            energy = _template_of(wanted.patches[wanted.rows[i]], window, values)
            if energy < np.float32(PATCH_PIXELS) * FLAT * FLAT:
                continue
            template = Template(values, 0, energy, UNIFORM)
            for k in range(2):
                m = first if k == 0 else second
                if m < 0:
                    break
                u, v = seen[m, 0] - to_origin, seen[m, 1] - to_origin
                found = align_patch(image, u, v, template, _ITERATIONS, _ALIGN_REACH_PX)
                if found.zncc >= limits.min_zncc and found.zncc > best_score:
                    best, best_score = m, float(found.zncc)
                    best_u, best_v = maxima[m, 0] + (found.u - u), maxima[m, 1] + (found.v - v)
        if best < 0 or (owner[best] >= 0 and scores[best] >= best_score):
            continue
        if owner[best] >= 0:
            choice[owner[best]] = -1
        owner[best], scores[best] = i, best_score
        choice[i] = best
        points_px[i, 0], points_px[i, 1] = best_u, best_v


@fast_kernel
def _match_patches(
    wanted: _Wanted,
    grid: MaximaGrid,
    image: Pixels,
    radius_px: float,
    min_zncc: float,
    points_px: F32,
) -> BoolArray:
    """Whether each landmark has a maximum with a similar patch; writes the best one's position."""
    found = np.zeros(wanted.rows.size, np.bool_)
    window = Pixels(np.empty(PATCH_SIDE * PATCH_SIDE, np.float32), PATCH_SIDE, PATCH_SIDE)
    values = np.empty(TEMPLATE_FLOATS, np.float32)
    to_origin = np.float32(0.5 * (PATCH_SIZE - 1))
    for i in range(wanted.rows.size):
        energy = _template_of(wanted.patches[wanted.rows[i]], window, values)
        if energy < np.float32(PATCH_PIXELS) * FLAT * FLAT:
            continue
        template = Template(values, 0, energy, UNIFORM)
        u, v = wanted.projected[i, 0], wanted.projected[i, 1]
        known = wanted.kappas[wanted.rows[i]]
        column, line = int(u) // grid.cell_px, int(v) // grid.cell_px
        best, best_zncc = -1, np.float32(0.0)
        for y in range(max(line - 1, 0), min(line + 2, grid.lines)):
            begin = y * grid.columns + max(column - 1, 0)
            end = y * grid.columns + min(column + 1, grid.columns - 1)
            for k in range(grid.starts[begin], grid.starts[end + 1]):
                m = int(grid.order[k])
                distance2 = (grid.maxima[m, 0] - u) ** 2 + (grid.maxima[m, 1] - v) ** 2
                if distance2 >= radius_px * radius_px or grid.maxima[m, 2] * known <= 0.0:
                    continue
                left, top = grid.maxima[m, 0] - to_origin, grid.maxima[m, 1] - to_origin
                zncc = align_patch(image, left, top, template, 1, _ALIGN_REACH_PX).zncc
                if zncc > best_zncc:
                    best, best_zncc = m, zncc
        if best < 0:
            continue
        left, top = grid.maxima[best, 0] - to_origin, grid.maxima[best, 1] - to_origin
        aligned = align_patch(image, left, top, template, _ITERATIONS, _ALIGN_REACH_PX)
        if aligned.zncc >= min_zncc:
            found[i] = True
            points_px[i, 0], points_px[i, 1] = aligned.u + to_origin, aligned.v + to_origin
    return found


@fast_kernel
def _two_nearest(
    wanted: _Wanted, i: int, grid: MaximaGrid, limits: _Limits
) -> tuple[int, int, float]:
    """The nearest two maxima whose curvature has the landmark's sign, -1 without one, and the
    squared distance of the first.
    """
    u, v, known = wanted.projected[i, 0], wanted.projected[i, 1], wanted.kappas[wanted.rows[i]]
    column, line = int(u) // grid.cell_px, int(v) // grid.cell_px
    first, second = -1, -1
    nearest = next_nearest = limits.radius_px * limits.radius_px
    for y in range(max(line - 1, 0), min(line + 2, grid.lines)):
        # The cells of a line are contiguous.
        begin = y * grid.columns + max(column - 1, 0)
        end = y * grid.columns + min(column + 1, grid.columns - 1)
        for k in range(grid.starts[begin], grid.starts[end + 1]):
            m = int(grid.order[k])
            kappa = grid.maxima[m, 2]
            distance2 = (grid.maxima[m, 0] - u) ** 2 + (grid.maxima[m, 1] - v) ** 2
            # Signed: a dark feature (kappa > 0) is never taken for a bright one.
            if distance2 >= next_nearest or kappa * known <= 0.0:
                continue
            if distance2 < nearest:
                second, next_nearest = first, nearest
                first, nearest = m, distance2
            else:
                second, next_nearest = m, distance2
    return first, second, nearest


@fast_kernel
def _template_of(patch: U8, window: Pixels, values: F32) -> np.float32:
    """Make the template of a stored patch; returns its energy, 0 if it cannot be aligned."""
    for r in range(PATCH_SIDE):
        for c in range(PATCH_SIDE):
            window.values[r * PATCH_SIDE + c] = np.float32(patch[r, c])
    tensor = patch_tensor(window, 1, 1, UNIFORM)
    if patch_strength(tensor)[0] <= np.float32(0.0):
        return np.float32(0.0)
    make_template(window, 1, 1, tensor, UNIFORM, values, 0)
    return tensor.energy

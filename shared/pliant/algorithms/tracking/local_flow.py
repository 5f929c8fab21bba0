"""A coarse-to-fine grid of local flow, as a correction of the dominant flow.

An affine model cannot follow parallax.  One patch per cell is aligned at an eighth, a quarter and
half of the size.  After each level a plane through each cell and its neighbours moves the flow from
the patch to the centre of the cell, and repairs cells that failed or are isolated.
"""

from typing import NamedTuple

import numpy as np

from pliant.algorithms.arrays import F32, BoolArray
from pliant.algorithms.image.patch_alignment import (
    Template,
    align_patch,
    make_template,
    patch_strength,
    patch_tensor,
)
from pliant.algorithms.image.patch_sums import GAUSSIAN, PATCH_SIZE, TEMPLATE_FLOATS
from pliant.algorithms.image.pixels import Pixels, pixels_of
from pliant.compiler.kernel import fast_kernel

CELL_PX = 20
"""Side of a cell of the grid in full-size pixels: 32 x 24 cells at 640x480."""
COARSEST = 3
"""Octave of the first level: an eighth of the size."""
MIN_ZNCC = np.float32(0.7)
"""Correlation below which the patch of a cell counts as lost."""
MIN_STRENGTH = np.float32(0.5)
"""Minimum smaller eigenvalue of a cell's patch, DN^2 per pixel."""
AGREEMENT_PX = np.float32(1.5)
"""Pixels of the level by which a cell may differ from the median around it."""


def grid_shape(width: int, height: int) -> tuple[int, int]:
    """Rows and columns of the grid for an image."""
    return -(-height // CELL_PX), -(-width // CELL_PX)


class Flow(NamedTuple):
    """The dominant flow and the local flow relative to it.

    grid: (rows, columns, 2) full-size pixels, at cell centres.  affine: six numbers of [A | b].
    """

    grid: F32
    affine: F32


class _Cells(NamedTuple):
    """points: (rows, columns, 3) (u, v, |kappa|) of each cell's strongest extremum, 0 where there
    is none.  hint: a second flow to begin with.  coarser: the flow of the level before.
    """

    points: F32
    hint: F32
    coarser: Flow


def local_flow(
    previous: list[F32], current: list[F32], maxima: F32, affine: F32, hint: F32
) -> Flow:
    """Estimate the local flow relative to the dominant flow.

    previous, current: images at 1/2, 1/4 and 1/8 of the size.  maxima: (M, 3) rows (u, v, kappa) of
    the previous frame: the strongest of each cell is followed.
    affine: six numbers of the dominant flow.  hint: (rows, columns, 2) a second initial value (the
    flow of the frame before).
    """
    rows, columns = hint.shape[:2]
    points = np.zeros((rows, columns, 3), np.float32)
    _strongest_of_cells(maxima, points)
    grid = np.zeros_like(hint)
    slopes = np.zeros((rows, columns, 4), np.float32)
    template = np.empty(TEMPLATE_FLOATS, np.float32)
    for octave in range(COARSEST, 0, -1):
        found = np.zeros((rows, columns), np.bool_)
        cells = _Cells(points, hint, Flow(grid.copy(), affine))
        before, now = pixels_of(previous[octave - 1]), pixels_of(current[octave - 1])
        _align_cells(before, now, octave, cells, grid, found, template)
        grid = fit_planes(grid, found, points, AGREEMENT_PX * np.float32(1 << octave), slopes)
    return Flow(grid, affine)


@fast_kernel
def flow_at(flow: Flow, u: np.float32, v: np.float32) -> tuple[np.float32, np.float32]:
    """Displacement of a pixel: the dominant flow plus the grid's bilinear correction."""
    grid, affine = flow.grid, flow.affine
    rows, columns = grid.shape[0], grid.shape[1]
    cell = np.float32(1.0 / CELL_PX)
    half = np.float32(0.5)
    x = min(max(u * cell - half, np.float32(0.0)), np.float32(columns - 1))
    y = min(max(v * cell - half, np.float32(0.0)), np.float32(rows - 1))
    c, r = min(int(x), max(columns - 2, 0)), min(int(y), max(rows - 2, 0))
    c1, r1 = min(c + 1, columns - 1), min(r + 1, rows - 1)
    fx, fy = x - np.float32(c), y - np.float32(r)
    gx, gy = np.float32(1.0) - fx, np.float32(1.0) - fy
    w00, w01, w10, w11 = gx * gy, fx * gy, gx * fy, fx * fy
    du = w00 * grid[r, c, 0] + w01 * grid[r, c1, 0] + w10 * grid[r1, c, 0] + w11 * grid[r1, c1, 0]
    dv = w00 * grid[r, c, 1] + w01 * grid[r, c1, 1] + w10 * grid[r1, c, 1] + w11 * grid[r1, c1, 1]
    du += affine[0] * u + affine[1] * v + affine[2] - u
    dv += affine[3] * u + affine[4] * v + affine[5] - v
    return du, dv


@fast_kernel
def _strongest_of_cells(maxima: F32, points: F32) -> None:
    for i in range(len(maxima)):
        u, v, kappa = maxima[i, 0], maxima[i, 1], abs(maxima[i, 2])
        row, column = int(v) // CELL_PX, int(u) // CELL_PX
        if kappa > points[row, column, 2]:
            points[row, column, 0] = u
            points[row, column, 1] = v
            points[row, column, 2] = kappa


@fast_kernel
def _align_cells(
    previous: Pixels,
    current: Pixels,
    octave: int,
    cells: _Cells,
    grid: F32,
    found: BoolArray,
    template: F32,
) -> None:
    """Write the flow of every cell whose patch is found.  template: scratch."""
    affine, points = cells.coarser.affine, cells.points
    scale = np.float32(1.0) / np.float32(1 << octave)
    half = np.float32(0.5)
    centre = np.float32(0.5 * (PATCH_SIZE - 1))
    for row in range(grid.shape[0]):
        for column in range(grid.shape[1]):
            if points[row, column, 2] == np.float32(0.0):
                continue
            u, v = points[row, column, 0], points[row, column, 1]
            left = int(np.floor((u + half) * scale - half - centre + half))
            top = int(np.floor((v + half) * scale - half - centre + half))
            if left < 1 or top < 1 or left > previous.width - PATCH_SIZE - 1:
                continue
            if top > previous.height - PATCH_SIZE - 1:
                continue
            tensor = patch_tensor(previous, left, top, GAUSSIAN)
            if patch_strength(tensor)[0] < MIN_STRENGTH:
                continue
            make_template(previous, left, top, tensor, GAUSSIAN, template, 0)
            base_u = affine[0] * u + affine[1] * v + affine[2] - u
            base_v = affine[3] * u + affine[4] * v + affine[5] - v
            best = MIN_ZNCC
            best_u, best_v = np.float32(0.0), np.float32(0.0)
            for attempt in range(4):
                # Start from this cell's flow, then its neighbours', then the second hint.
                if attempt == 0:
                    guess_u, guess_v = flow_at(cells.coarser, u, v)
                    guess_u -= base_u
                    guess_v -= base_v
                elif attempt == 1 and column > 0 and found[row, column - 1]:
                    guess_u, guess_v = grid[row, column - 1, 0], grid[row, column - 1, 1]
                elif attempt == 2 and row > 0 and found[row - 1, column]:
                    guess_u, guess_v = grid[row - 1, column, 0], grid[row - 1, column, 1]
                elif attempt == 3:
                    guess_u, guess_v = cells.hint[row, column, 0], cells.hint[row, column, 1]
                else:
                    continue
                to = align_patch(
                    current,
                    np.float32(left) + (base_u + guess_u) * scale,
                    np.float32(top) + (base_v + guess_v) * scale,
                    Template(template, 0, tensor.energy, GAUSSIAN),
                    8,
                    np.float32(4.0),
                )
                if to.zncc > best and to.step < half:
                    best = to.zncc
                    best_u = (to.u - np.float32(left)) / scale - base_u
                    best_v = (to.v - np.float32(top)) / scale - base_v
                    found[row, column] = True
                if best > np.float32(0.9):
                    break
            if found[row, column]:
                grid[row, column, 0] = best_u
                grid[row, column, 1] = best_v


def fit_planes(flow: F32, found: BoolArray, points: F32, tolerance: np.float32, slopes: F32) -> F32:
    """Move the flow of each cell from its patch to its centre, in agreement with its neighbours.

    A plane is fitted to the flow of the surrounding 3x3 cells.  The Geman-McClure weights are of
    the distance from the cell's own flow, or from the median if the cell failed or is isolated: so
    a zoom is interpolated, and a step in depth is not.  slopes: (rows, columns, 4) go there,
    [du/dx, du/dy, dv/dx, dv/dy] of the planes; 0 where there is none.
    """
    agreed = flow.copy()
    _fit_planes(flow, found, points, tolerance, slopes, agreed, np.empty((2, 9), np.float32))
    return agreed


@fast_kernel
def _fit_planes(
    flow: F32,
    found: BoolArray,
    points: F32,
    tolerance: np.float32,
    slopes: F32,
    agreed: F32,
    sorted_flow: F32,
) -> None:
    """sorted_flow: scratch for u and v of nine cells."""
    rows, columns = flow.shape[0], flow.shape[1]
    us, vs = sorted_flow[0], sorted_flow[1]
    cell = np.float32(CELL_PX)
    half = np.float32(0.5)
    square = tolerance * tolerance
    for row in range(rows):
        for column in range(columns):
            count = 0
            support = 0
            for r in range(max(row - 1, 0), min(row + 2, rows)):
                for c in range(max(column - 1, 0), min(column + 2, columns)):
                    if found[r, c]:
                        _insert_sorted(us, count, flow[r, c, 0])
                        _insert_sorted(vs, count, flow[r, c, 1])
                        count += 1
                        du = flow[r, c, 0] - flow[row, column, 0]
                        dv = flow[r, c, 1] - flow[row, column, 1]
                        support += 1 if du * du + dv * dv < square else 0
            if count < 2:
                continue
            u, v = us[count // 2], vs[count // 2]
            if found[row, column] and support >= 3:
                u, v = flow[row, column, 0], flow[row, column, 1]
            sw = sx = sy = sxx = sxy = syy = np.float32(0.0)
            su = sv = sxu = syu = sxv = syv = np.float32(0.0)
            for r in range(max(row - 1, 0), min(row + 2, rows)):
                for c in range(max(column - 1, 0), min(column + 2, columns)):
                    if not found[r, c]:
                        continue
                    du, dv = flow[r, c, 0] - u, flow[r, c, 1] - v
                    x = points[r, c, 0] / cell - half - np.float32(column)
                    y = points[r, c, 1] / cell - half - np.float32(row)
                    weight = square / (du * du + dv * dv + square)
                    weight *= weight / (np.float32(0.5) + x * x + y * y)
                    sw += weight
                    sx += weight * x
                    sy += weight * y
                    sxx += weight * x * x
                    sxy += weight * x * y
                    syy += weight * y * y
                    su += weight * du
                    sv += weight * dv
                    sxu += weight * x * du
                    syu += weight * y * du
                    sxv += weight * x * dv
                    syv += weight * y * dv
            # Damped slopes: collinear neighbours give their mean.
            damping = np.float32(0.02) * sw
            a, b, c2 = (
                sxx - sx * sx / sw + damping,
                sxy - sx * sy / sw,
                syy - sy * sy / sw + damping,
            )
            determinant = a * c2 - b * b
            ru, rv = sxu - sx * su / sw, syu - sy * su / sw
            slope_x, slope_y = (c2 * ru - b * rv) / determinant, (a * rv - b * ru) / determinant
            slopes[row, column, 0], slopes[row, column, 1] = slope_x / cell, slope_y / cell
            agreed[row, column, 0] = u + (su - slope_x * sx - slope_y * sy) / sw
            ru, rv = sxv - sx * sv / sw, syv - sy * sv / sw
            slope_x, slope_y = (c2 * ru - b * rv) / determinant, (a * rv - b * ru) / determinant
            slopes[row, column, 2], slopes[row, column, 3] = slope_x / cell, slope_y / cell
            agreed[row, column, 1] = v + (sv - slope_x * sx - slope_y * sy) / sw


@fast_kernel
def _insert_sorted(values: F32, count: int, value: np.float32) -> None:
    # Each step keeps the smaller value and passes the larger on: without branches.
    for i in range(count):
        smaller, value = min(values[i], value), max(values[i], value)
        values[i] = smaller
    values[count] = value

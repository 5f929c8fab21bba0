"""Mapped points that lost their track are found again among the maxima of a frame.

A point is projected with the pose of the frame; the maximum near it whose curvature and patch fit
best takes it.  Its patch then refines the position, since an extremum alone is known to half a
pixel only.  Not in the paper; docs/results.md says what it is worth."""

from dataclasses import dataclass

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, U8, BoolArray
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import inverse
from pliant.algorithms.kernel import fast_kernel, kernel
from pliant.algorithms.mapping.parameters import ReacquisitionParameters
from pliant.algorithms.mapping.patches import PATCH, align_patch, normalise_patch

CELL_PX = 8
"""Side of a cell: larger than any search radius, so that nine cells suffice."""


@dataclass(frozen=True, kw_only=True)
class MaximaGrid:
    """Maxima (M, 3) as (u, v, kappa); those of cell c are ``order[starts[c] : starts[c + 1]]``."""

    maxima: F32
    starts: I32
    order: I32
    columns: int
    lines: int

    @staticmethod
    def build(maxima: F32, width: int, height: int) -> "MaximaGrid":
        """Sort the maxima of an image of the given size."""
        columns, lines = width // CELL_PX + 1, height // CELL_PX + 1
        starts = np.zeros(columns * lines + 1, np.int32)
        order = np.empty(len(maxima), np.int32)
        _sort_into_cells(maxima, columns, lines, starts, order)
        return MaximaGrid(maxima=maxima, starts=starts, order=order, columns=columns, lines=lines)

    def nearest(self, points_px: F32, radius_px: float) -> I32:
        """(N,) index of the maximum nearest to each point (N, 2) within the radius, else -1."""
        found = np.full(len(points_px), -1, np.int32)
        _nearest(
            points_px, self.maxima, self.starts, self.order, self.columns, self.lines, radius_px,
            found,
        )  # fmt: skip
        return found


@kernel
def _sort_into_cells(maxima: F32, columns: int, lines: int, starts: I32, order: I32) -> None:
    cells = np.empty(maxima.shape[0], np.int32)
    for i in range(maxima.shape[0]):
        column = min(max(int(maxima[i, 0]) // CELL_PX, 0), columns - 1)
        line = min(max(int(maxima[i, 1]) // CELL_PX, 0), lines - 1)
        cells[i] = line * columns + column
        starts[cells[i] + 1] += 1
    for c in range(columns * lines):
        starts[c + 1] += starts[c]
    filled = starts[:-1].copy()
    for i in range(maxima.shape[0]):
        order[filled[cells[i]]] = i
        filled[cells[i]] += 1


@kernel
def _nearest(
    points_px: F32,
    maxima: F32,
    starts: I32,
    order: I32,
    columns: int,
    lines: int,
    radius_px: float,
    found: I32,
) -> None:
    for i in range(points_px.shape[0]):
        u, v = points_px[i, 0], points_px[i, 1]
        column, line = int(u) // CELL_PX, int(v) // CELL_PX
        best = radius_px * radius_px
        for y in range(max(line - 1, 0), min(line + 2, lines)):
            for x in range(max(column - 1, 0), min(column + 2, columns)):
                cell = y * columns + x
                for k in range(starts[cell], starts[cell + 1]):
                    m = order[k]
                    distance2 = (maxima[m, 0] - u) ** 2 + (maxima[m, 1] - v) ** 2
                    if distance2 < best:
                        best, found[i] = distance2, m


_MARGIN_PX = 8.0
_ALIGN_REACH_PX = 1.5


@dataclass(frozen=True, kw_only=True)
class Reacquired:
    """Points found again, each at most once.

    rows: (R,) of the points.   points_px: (R, 2) where they are.   maxima: (R,) index of theirs.
    visible: (V,) rows that should have been in the image.
    """

    rows: I32
    points_px: F32
    maxima: I32
    visible: I32


def reacquire(
    T_world_camera: F64,
    rows: I32,
    xyz: F64,
    kappas: F32,
    patches: U8,
    grid: MaximaGrid,
    grey: U8 | None,
    camera: PinholeCamera,
    parameters: ReacquisitionParameters,
) -> Reacquired:
    """Match points to the maxima of a frame whose pose is known.

    rows: (R,) points looked for; xyz, kappas and patches are indexed by row.  grey: (H, W), or
    None: then curvature and distance alone decide.
    """
    T_camera_world = np.ascontiguousarray(inverse(T_world_camera)[:3])
    K = np.array([camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height])
    projected = np.empty((len(rows), 2), np.float32)
    visible = _project(T_camera_world, rows, xyz, K, projected)
    wanted = rows[visible]
    choice = np.full(len(wanted), -1, np.int32)
    points_px = np.zeros((len(wanted), 2), np.float32)
    image = grey if grey is not None else np.zeros((0, 0), np.uint8)
    _match(
        wanted, projected[visible], kappas, patches, grid.maxima, grid.starts, grid.order,
        grid.columns, grid.lines, image, parameters.radius_px, parameters.kappa_ratio,
        parameters.min_zncc, choice, points_px,
    )  # fmt: skip
    found = choice >= 0
    return Reacquired(
        rows=wanted[found], points_px=points_px[found], maxima=choice[found], visible=wanted
    )


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
    rows: I32,
    projected: F32,
    kappas: F32,
    patches: U8,
    maxima: F32,
    starts: I32,
    order: I32,
    columns: int,
    lines: int,
    grey: U8,
    radius_px: float,
    kappa_ratio: float,
    min_zncc: float,
    choice: I32,
    points_px: F32,
) -> None:
    owner = np.full(maxima.shape[0], -1, np.int32)
    scores = np.zeros(maxima.shape[0])
    template = np.empty((PATCH, PATCH), np.float32)
    work = np.empty((PATCH, PATCH), np.float32)
    position, best_position = np.empty(2), np.empty(2)
    near, nearest = np.empty(2, np.int64), np.empty(2)
    reach2 = radius_px * radius_px
    with_patch = grey.size > 0
    for i in range(rows.size):
        row = rows[i]
        u, v = projected[i, 0], projected[i, 1]
        known = kappas[row]
        column, line = int(u) // CELL_PX, int(v) // CELL_PX
        near[0], near[1], nearest[0], nearest[1] = -1, -1, reach2, reach2
        for y in range(max(line - 1, 0), min(line + 2, lines)):
            # The cells of a line lie one after the other.
            first = y * columns + max(column - 1, 0)
            last = y * columns + min(column + 1, columns - 1)
            for k in range(starts[first], starts[last + 1]):
                m = order[k]
                mu, mv, kappa = maxima[m, 0], maxima[m, 1], maxima[m, 2]
                distance2 = (mu - u) ** 2 + (mv - v) ** 2
                # Signed: a dark feature (kappa > 0) is never taken for a bright one.
                if (
                    distance2 >= nearest[1]
                    or kappa * known <= 0.0
                    or abs(kappa) > kappa_ratio * abs(known)
                    or abs(known) > kappa_ratio * abs(kappa)
                ):
                    continue
                if distance2 < nearest[0]:
                    near[1], nearest[1] = near[0], nearest[0]
                    near[0], nearest[0] = m, distance2
                else:
                    near[1], nearest[1] = m, distance2
        if near[0] < 0:
            continue
        best, best_score = -1, -1.0
        if not with_patch:
            best, best_score = near[0], 1.0 / (1.0 + nearest[0])
            best_position[0], best_position[1] = maxima[best, 0], maxima[best, 1]
        else:
            for r in range(PATCH):
                for c in range(PATCH):
                    template[r, c] = patches[row, r, c]
            if not normalise_patch(template):
                continue
            for k in range(2):
                m = near[k]
                if m < 0:
                    break
                score = align_patch(
                    grey, template, maxima[m, 0], maxima[m, 1], work, _ALIGN_REACH_PX, position
                )
                if score >= min_zncc and score > best_score:
                    best, best_score = m, score
                    best_position[0], best_position[1] = position[0], position[1]
        if best < 0 or (owner[best] >= 0 and scores[best] >= best_score):
            continue
        if owner[best] >= 0:
            choice[owner[best]] = -1
        owner[best], scores[best] = i, best_score
        choice[i] = best
        points_px[i, 0], points_px[i, 1] = best_position[0], best_position[1]

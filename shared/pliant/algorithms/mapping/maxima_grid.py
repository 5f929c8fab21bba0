"""The maxima of one frame, sorted into cells so that those near a pixel are found at once."""

from dataclasses import dataclass

import numpy as np

from pliant.algorithms.arrays import F32, I32
from pliant.algorithms.kernel import kernel

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

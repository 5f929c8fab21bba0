"""The motion of a real sheet of paper: a smooth surface through its measured points.

Every 8th frame is measured.  In between each point goes along a cubic (Catmull and Rom); at each
time a thin plate near all points, over the plane of the first frame, where the paper is nearly
flat, is a first guess.  Paper does not stretch, but noise and cubics make it so by 1 to 3 % over
2 cm: so the edges of the grid are then given the lengths back that they have in the first frame.
Where the paper snaps over within 8 frames (106-110, 122-126, 130-135) no way between is known, and
up to 5 % of strain remain.
"""

import math

import numpy as np

from pliant.algorithms.arrays import F64
from pliant.compiler.kernel import kernel
from pliant.rendering.sheets import Shape

KEY_EVERY_S = 8.0 / 30.0
_CELL_M = 0.007
_SWEEPS = 300
_SHAPES_PER_S = 60.0  # the surface is found this often; in between it goes straight
_RIM = 0.03  # of the extent: beyond the outermost points the plate would have to guess
_SMOOTHING = 1e-3  # m^2: leaves 0.2 mm rms, the accuracy of the measured points


def paper_shape(tracks_m: F64) -> tuple[float, float, Shape]:
    """Width and height of the paper's rectangle in metres, and its shape over time.

    tracks_m: (K, N, 3) points in the camera's frame, one set every ``KEY_EVERY_S``.
    """
    middle = tracks_m[0].mean(axis=0)
    normal = np.linalg.svd(tracks_m[0] - middle, full_matrices=False)[2][2]
    # As upright as the camera, and not mirrored.
    down = np.cross(np.sign(normal[2]) * normal, [1.0, 0.0, 0.0])
    down /= np.linalg.norm(down)
    axes = np.stack([np.cross(down, np.sign(normal[2]) * normal), down])
    flat = (tracks_m[0] - middle) @ axes.T
    low, high = flat.min(axis=0), flat.max(axis=0)
    low, high = low + _RIM * (high - low), high - _RIM * (high - low)
    columns, rows = (round(float(size) / _CELL_M) + 1 for size in high - low)
    x, y = np.meshgrid(np.linspace(low[0], high[0], columns), np.linspace(low[1], high[1], rows))
    weights = plate_weights(flat, np.stack([x.ravel(), y.ravel()], axis=1))

    def guess(time_s: float) -> F64:
        return (weights @ points_at(tracks_m, time_s)).reshape(rows, columns, 3)

    rest = _edge_lengths(guess(0.0))
    found: dict[int, F64] = {}

    def solved(number: int) -> F64:
        if number not in found:
            vertices = guess(number / _SHAPES_PER_S)
            _restore(vertices, rest, _SWEEPS)
            found[number] = vertices
        return found[number]

    def shape(time_s: float) -> F64:
        number = int(np.floor(time_s * _SHAPES_PER_S))
        part = time_s * _SHAPES_PER_S - number
        return (1.0 - part) * solved(number) + part * solved(number + 1)

    return float(high[0] - low[0]), float(high[1] - low[1]), shape


def points_at(tracks_m: F64, time_s: float) -> F64:
    """(N, 3) the points at a time; outside of what is measured the ends are held."""
    last = len(tracks_m) - 1
    s = float(np.clip(time_s / KEY_EVERY_S, 0.0, last))
    i = min(int(s), last - 1)
    t = s - i
    before, first, second, after = (tracks_m[min(max(i + k, 0), last)] for k in (-1, 0, 1, 2))
    leave, arrive = 0.5 * (second - before), 0.5 * (after - first)
    return (
        (2 * t**3 - 3 * t**2 + 1) * first + (t**3 - 2 * t**2 + t) * leave
        + (3 * t**2 - 2 * t**3) * second + (t**3 - t**2) * arrive
    )  # fmt: skip


def plate_weights(nodes: F64, places: F64) -> F64:
    """(M, N) weights of the N nodes' values in the thin plate at M places.

    nodes: (N, 2).  places: (M, 2).  A plane is reproduced exactly.
    """
    n = len(nodes)
    system = np.zeros((n + 3, n + 3))
    system[:n, :n] = _kernel(nodes, nodes) + _SMOOTHING * np.eye(n)
    system[:n, n], system[:n, n + 1 :] = 1.0, nodes
    system[n:, :n] = system[:n, n:].T
    rows = np.concatenate([_kernel(places, nodes), np.ones((len(places), 1)), places], axis=1)
    return np.asarray(np.linalg.solve(system, rows.T)[:n].T, np.float64)


def _kernel(a: F64, b: F64) -> F64:
    square = ((a[:, None] - b[None]) ** 2).sum(axis=2)
    out: F64 = np.where(square > 0.0, 0.5 * square * np.log(np.maximum(square, 1e-30)), 0.0)
    return out


_STEPS = np.array([[0, 1], [1, 0], [1, 1], [1, -1]])  # rows and columns from an edge's first end


def _edge_lengths(vertices: F64) -> F64:
    """(4, R, C) lengths of the edges that start at each vertex, in the order of ``_STEPS``."""
    rows, columns = vertices.shape[:2]
    lengths = np.zeros((4, rows, columns))
    for k, (down, right) in enumerate(_STEPS):
        first = vertices[: rows - down, max(0, -right) : columns - max(0, right)]
        second = vertices[down:, max(0, right) : columns + min(0, right)]
        place = lengths[k, : rows - down, max(0, -right) : columns - max(0, right)]
        place[:] = np.linalg.norm(second - first, axis=2)
    return lengths


@kernel
def _restore(vertices: F64, rest: F64, sweeps: int) -> None:
    """Move both ends of every edge until all have their rest lengths, again and again; in place."""
    rows, columns = vertices.shape[:2]
    for sweep in range(sweeps):
        for n in range(rows * columns):
            # Back and forth, or the sheet would creep into one direction.
            at = n if sweep % 2 == 0 else rows * columns - 1 - n
            i, j = at // columns, at % columns
            for k in range(4):
                down = 0 if k == 0 else 1
                right = 0 if k == 1 else (-1 if k == 3 else 1)
                if i + down >= rows or j + right >= columns or j + right < 0:
                    continue
                a, b = vertices[i, j], vertices[i + down, j + right]
                x, y, z = b[0] - a[0], b[1] - a[1], b[2] - a[2]
                half = 0.5 * (1.0 - rest[k, i, j] / math.sqrt(x * x + y * y + z * z))
                a[0] += half * x
                a[1] += half * y
                a[2] += half * z
                b[0] -= half * x
                b[1] -= half * y
                b[2] -= half * z

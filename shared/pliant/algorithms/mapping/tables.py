"""Kernels over the dense camera x point table of a window."""

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, I64, U8, BoolArray
from pliant.algorithms.kernel import kernel


@kernel
def observe(
    rows: I32,
    points_px: F32,
    column_of: I32,
    slot: int,
    lens: F32,
    u: F32,
    v: F32,
    w: F32,
    seen: BoolArray,
) -> None:
    """Write the observations of one camera, rows (n,) at points_px (n, 2), into its slot.

    column_of: (capacity,) column of each row, negative where it is not in the table.
    lens: (5,) fx, fy, cx, cy and the lens radius.  No calibration is perfect, and what it misses
    grows with the distance from the axis: an observation at the lens radius counts half.
    """
    scale = np.float32(1.0) / (lens[4] * lens[4])
    for i in range(rows.size):
        column = column_of[rows[i]]
        if column >= 0:
            u[slot, column], v[slot, column] = points_px[i, 0], points_px[i, 1]
            x, y = (points_px[i, 0] - lens[2]) / lens[0], (points_px[i, 1] - lens[3]) / lens[1]
            share = (x * x + y * y) * scale
            w[slot, column] = np.float32(1.0) / (np.float32(1.0) + share * share)
            seen[slot, column] = True


@kernel
def gather(
    columns: I32, u: F32, v: F32, w: F32, seen: BoolArray, out_u: F32, out_v: F32, out_w: F32
) -> None:
    """Copy some columns of the table; the weight is 0 where nothing is seen."""
    for m in range(u.shape[0]):
        for i in range(columns.size):
            n = columns[i]
            if seen[m, n]:
                out_u[m, i], out_v[m, i], out_w[m, i] = u[m, n], v[m, n], w[m, n]


@kernel
def count_cameras(columns: I32, seen: BoolArray, first: int, last: int) -> I32:
    """(C,) how many of the cameras first, ..., last - 1 see each of the columns."""
    counts = np.zeros(columns.size, np.int32)
    for m in range(first, last):
        for i in range(columns.size):
            counts[i] += seen[m, columns[i]]
    return counts


@kernel
def columns_in_state(rows: I32, state: U8, wanted: int) -> I32:
    """Columns of the rows (N,) whose state is the wanted one, ascending."""
    columns = np.empty(rows.size, np.int32)
    count = 0
    for n in range(rows.size):
        columns[count] = n
        count += state[rows[n]] == wanted
    return columns[:count].copy()


@kernel
def seen_in_state(rows: I32, state: U8, wanted: int, seen: BoolArray, slot: int, least: int) -> I32:
    """Columns in the wanted state that the slot and at least ``least`` cameras see."""
    columns = np.empty(rows.size, np.int32)
    count = 0
    for n in range(rows.size):
        if seen[slot, n] and state[rows[n]] == wanted:
            cameras = 0
            if least > 1:
                for m in range(seen.shape[0]):
                    cameras += seen[m, n]
            if least <= 1 or cameras >= least:
                columns[count] = n
                count += 1
    return columns[:count].copy()


@kernel
def flows(rows: I32, state: U8, wanted: int, u: F32, v: F32, seen: BoolArray) -> tuple[int, F32]:
    """Points in the wanted state that the last but one slot sees, and how far those moved, px,
    that the last one sees too."""
    moved = np.empty(rows.size, np.float32)
    before, both = 0, 0
    last = seen.shape[0] - 1
    for n in range(rows.size):
        if seen[last - 1, n] and state[rows[n]] == wanted:
            before += 1
            if seen[last, n]:
                du, dv = u[last, n] - u[last - 1, n], v[last, n] - v[last - 1, n]
                moved[both] = np.sqrt(du * du + dv * dv)
                both += 1
    return before, moved[:both].copy()


@kernel
def has_parallax(
    columns: I32,
    slot: int,
    R_world_camera: F64,
    u: F32,
    v: F32,
    seen: BoolArray,
    lens: F32,
    cosine: float,
) -> I64:
    """Those columns whose ray of the slot and some other one differ by more than an angle.

    R_world_camera: (M, 3, 3).   cosine: of the angle.
    """
    kept = np.empty(columns.size, np.int64)
    count = 0
    for i in range(columns.size):
        n = columns[i]
        x, y = (u[slot, n] - lens[2]) / lens[0], (v[slot, n] - lens[3]) / lens[1]
        A = R_world_camera[slot]
        ax = A[0, 0] * x + A[0, 1] * y + A[0, 2]
        ay = A[1, 0] * x + A[1, 1] * y + A[1, 2]
        az = A[2, 0] * x + A[2, 1] * y + A[2, 2]
        length = ax * ax + ay * ay + az * az
        for m in range(seen.shape[0]):
            if seen[m, n] and m != slot:
                x, y = (u[m, n] - lens[2]) / lens[0], (v[m, n] - lens[3]) / lens[1]
                B = R_world_camera[m]
                bx = B[0, 0] * x + B[0, 1] * y + B[0, 2]
                by = B[1, 0] * x + B[1, 1] * y + B[1, 2]
                bz = B[2, 0] * x + B[2, 1] * y + B[2, 2]
                dot = ax * bx + ay * by + az * bz
                other = bx * bx + by * by + bz * bz
                if dot < 0.0 or dot * dot < cosine * cosine * length * other:
                    kept[count] = n
                    count += 1
                    break
    return kept[:count].copy()


@kernel
def choose(order: I64, columns: I32, seen: BoolArray, wanted: int, chosen: BoolArray) -> None:
    """Let a camera, seen (N,), have ``wanted`` of its columns chosen, the first in the order."""
    missing = wanted
    for i in range(columns.size):
        if chosen[i] and seen[columns[i]]:
            missing -= 1
    for k in range(order.size):
        if missing <= 0:
            break
        i = order[k]
        if not chosen[i] and seen[columns[i]]:
            chosen[i] = True
            missing -= 1

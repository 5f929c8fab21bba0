"""The dense, padded camera x point layout of the subspace method.

Points are padded to blocks of ``BLOCK`` columns, so that inner loops have a constant length and
become SIMD code.  A table states which camera observes any point of which block.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, I64, U8, BoolArray
from pliant.algorithms.geometry import inverse
from pliant.algorithms.slam.estimate.problem import AnyProblem, BundleWindow
from pliant.algorithms.slam.estimate.projection import Cameras
from pliant.compiler.kernel import kernel

BLOCK = 128
"""Points in a block: W of ten cameras and one block (184 kB) stays in the L2 cache."""


@dataclass(frozen=True, kw_only=True)
class Unknowns:
    """Cameras and points of one problem, ready for the kernels.  P is the number of columns.

    column: (N,) of each point.
    cameras: M of them.      free: (M,) 1 for a free camera.
    origin: (3,) subtracted from the world, so that float32 handles small numbers.
    points: (3, P) in the shifted world.
    """

    column: I64
    cameras: Cameras
    free: BoolArray
    origin: F64
    points: F64


class Table(NamedTuple):
    """Dense observations of M cameras.  P is padded to whole blocks.

    u, v, w: (M, P) float32, w = 0 where nothing is seen.
    seen: (M, P / BLOCK) 1 where the camera sees a point of the block.
    """

    u: F32
    v: F32
    w: F32
    seen: U8


@dataclass(frozen=True, kw_only=True)
class Layout(Unknowns):
    """The dense layout."""

    table: Table


def build_layout(problem: BundleWindow) -> Layout:
    """Convert a problem to the dense layout, without changing it."""
    M, N = len(problem.T_world_camera), len(problem.points_world)
    P = max(1, -(-N // BLOCK)) * BLOCK
    usable = finite_points(problem.points_world)
    u, v, w = np.zeros((3, M, P), np.float32)
    seen = np.zeros((M, P // BLOCK), np.uint8)
    _select(problem.columns, usable, problem.u, problem.v, problem.weights, problem.seen, u, v, w)
    _mark_blocks(w, seen)
    unknowns = unknowns_of(problem, np.arange(N), usable, P)
    return Layout(**vars(unknowns), table=Table(u, v, w, seen))


@kernel
def finite_points(points_world: F64) -> BoolArray:
    """(N,) whether each point is finite."""
    finite = np.empty(points_world.shape[0], np.bool_)
    for n in range(points_world.shape[0]):
        x, y, z = points_world[n, 0], points_world[n, 1], points_world[n, 2]
        finite[n] = np.isfinite(x) and np.isfinite(y) and np.isfinite(z)
    return finite


def unknowns_of(problem: AnyProblem, column: I64, usable: BoolArray, P: int) -> Unknowns:
    """Cameras and points of a problem, with the points in the given ones of P columns."""
    M = len(problem.T_world_camera)
    origin = problem.T_world_camera[:, :3, 3].mean(axis=0) if M else np.zeros(3)
    points = np.zeros((3, P))
    _shift(problem.points_world, usable, column, origin, points)
    T_camera_world = inverse(problem.T_world_camera)
    motion = np.empty((M, 12))
    motion[:, :9] = T_camera_world[:, :3, :3].reshape(M, 9)
    motion[:, 9:] = T_camera_world[:, :3, 3] + T_camera_world[:, :3, :3] @ origin
    lens = np.ascontiguousarray(problem.intrinsics[:, 4:])
    cameras = Cameras(
        motion=motion,
        pinhole=np.ascontiguousarray(problem.intrinsics[:, :4]),
        lens=lens if lens.any() else np.zeros(0),
    )
    free = ~problem.fixed_cameras
    return Unknowns(column=column, cameras=cameras, free=free, origin=origin, points=points)


def poses_of(layout: Unknowns, problem: AnyProblem, motion: F64) -> F64:
    """(M, 4, 4) T_world_camera of (M, 12) motions; fixed ones exactly as they were."""
    T_camera_world = np.zeros_like(problem.T_world_camera)
    T_camera_world[:, :3, :3] = motion[:, :9].reshape(-1, 3, 3)
    T_camera_world[:, :3, 3] = motion[:, 9:]
    T_camera_world[:, 3, 3] = 1.0
    T_world_camera = inverse(T_camera_world)
    T_world_camera[:, :3, 3] += layout.origin
    return np.where(problem.fixed_cameras[:, None, None], problem.T_world_camera, T_world_camera)


def points_of(layout: Unknowns, problem: AnyProblem, points: F64) -> F64:
    """(N, 3) points in the world frame; those that did not move exactly as they were."""
    out = problem.points_world.copy()
    _shift_back(points, layout.points, layout.column, layout.origin, out)
    return out


@kernel
def _select(
    columns: I32,
    usable: BoolArray,
    all_u: F32,
    all_v: F32,
    all_w: F32,
    seen: BoolArray,
    u: F32,
    v: F32,
    w: F32,
) -> None:
    """Copy the columns of a table, 0 where there is no observation."""
    zero, most = np.float32(0.0), np.float32(np.inf)
    for m in range(u.shape[0]):
        for n in range(columns.size):
            # Selected, not branched: whether a camera sees a point is nearly random.
            c = columns[n]
            a, b, weight = all_u[m, c], all_v[m, c], all_w[m, c]
            good = seen[m, c] & usable[n] & (abs(a) < most) & (abs(b) < most) & (weight > zero)
            u[m, n] = a if good else zero
            v[m, n] = b if good else zero
            w[m, n] = weight if good else zero


@kernel
def _mark_blocks(w: F32, seen: U8) -> None:
    for m in range(w.shape[0]):
        for b in range(seen.shape[1]):
            for n in range(b * BLOCK, (b + 1) * BLOCK):
                if w[m, n] > 0.0:
                    seen[m, b] = 1
                    break


@kernel
def _shift(points_world: F64, usable: BoolArray, column: I64, origin: F64, points: F64) -> None:
    for n in range(column.size):
        if usable[n]:
            for k in range(3):
                points[k, column[n]] = points_world[n, k] - origin[k]


@kernel
def _shift_back(moved: F64, before: F64, column: I64, origin: F64, points_world: F64) -> None:
    for n in range(column.size):
        c = column[n]
        if (
            moved[0, c] != before[0, c]
            or moved[1, c] != before[1, c]
            or moved[2, c] != before[2, c]
        ):
            for k in range(3):
                points_world[n, k] = moved[k, c] + origin[k]

"""The deformation graph: edges between surfels that were created side by side on one surface.

Not in the paper, whose surfels are independent; see ``graph_alignment`` for their use.
"""

import math
from typing import NamedTuple

import numpy as np

from pliant.algorithms.arrays import F64, I64, BoolArray
from pliant.algorithms.surfels.patch_sampling import A, B, F, X
from pliant.compiler.kernel import fast_kernel

_OFF_PLANE = 0.3
"""Maximum distance of neighbours from each other's plane, as a share of their distance."""

_TEAR = 0.3
"""Strain at which an edge has a quarter of its weight: for tears and slides."""
_FEW = 3
_HELD_SHARE = 0.25


class Edges(NamedTuple):
    """E pairs of neighbours, d metres apart when the younger was created."""

    ends: I64  # (E, 2) rows of the two surfels
    first: F64  # (E, 3) d in A, B, A x B of the first
    second: F64  # (E, 3) d in A, B, A x B of the second
    lengths: F64  # (E,) |d|, metres


def no_edges() -> Edges:
    """No pairs."""
    return Edges(np.zeros((0, 2), np.int64), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))


@fast_kernel
def own_coordinates(pose: F64, d: F64, out: F64) -> None:
    """Coefficients of a vector in A, B and A x B of a surfel."""
    a0, a1, a2 = pose[A], pose[A + 1], pose[A + 2]
    b0, b1, b2 = pose[B], pose[B + 1], pose[B + 2]
    n0, n1, n2 = a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0
    dn = (d[0] * n0 + d[1] * n1 + d[2] * n2) / (n0 * n0 + n1 * n1 + n2 * n2)
    aa, ab, bb = (
        a0 * a0 + a1 * a1 + a2 * a2,
        a0 * b0 + a1 * b1 + a2 * b2,
        b0 * b0 + b1 * b1 + b2 * b2,
    )
    da, db = a0 * d[0] + a1 * d[1] + a2 * d[2], b0 * d[0] + b1 * d[1] + b2 * d[2]
    det = aa * bb - ab * ab
    out[0], out[1], out[2] = (da * bb - db * ab) / det, (db * aa - da * ab) / det, dn


@fast_kernel
def own_vector(pose: F64, c: F64, out: F64) -> None:
    """The vector of such coefficients, stretched by the surfel's own F: the identity at birth."""
    f11, f12, f22 = pose[F], pose[F + 1], pose[F + 2]
    i, j = f11 * c[0] + f12 * c[1], f12 * c[0] + f22 * c[1]
    a0, a1, a2 = pose[A], pose[A + 1], pose[A + 2]
    b0, b1, b2 = pose[B], pose[B + 1], pose[B + 2]
    out[0] = i * a0 + j * b0 + c[2] * (a1 * b2 - a2 * b1)
    out[1] = i * a1 + j * b1 + c[2] * (a2 * b0 - a0 * b2)
    out[2] = i * a2 + j * b2 + c[2] * (a0 * b1 - a1 * b0)


@fast_kernel
def _nearest(points: F64, normals: F64, rows: I64, first: int, off_plane: float, out: I64) -> None:
    """Fill ``out`` (N, K) with the nearest rows on the same surface, -1 where there are none.

    rows: (N,) 1 where a surfel may be a neighbour.  Of each pair one is at least ``first``.
    """
    n, wanted = len(points), out.shape[1]
    best = np.empty(wanted)
    for i in range(n):
        out[i] = -1
        best[:] = np.inf
        for j in range(n):
            if j == i or not rows[i] or not rows[j] or (i < first and j < first):
                continue
            squares = off_i = off_j = 0.0
            for k in range(3):
                d = points[j, k] - points[i, k]
                squares += d * d
                off_i += d * normals[i, k]
                off_j += d * normals[j, k]
            bound = off_plane * off_plane * squares
            if squares >= best[wanted - 1] or off_i * off_i > bound or off_j * off_j > bound:
                continue
            at = wanted - 1
            while at > 0 and best[at - 1] > squares:
                best[at], out[i, at] = best[at - 1], out[i, at - 1]
                at -= 1
            best[at], out[i, at] = squares, j


def find_edges(
    poses: F64, known: I64, first_new: int, count: int, *, widely: bool = False
) -> Edges:
    """Connect each surfel with its ``count`` nearest neighbours on the same surface.

    Only edges to new surfels are returned.  An earlier surfel gets one if a new surfel is among its
    nearest neighbours of all, old and new.

    poses: (N, POSE_FLOATS).  known: (N,) 1 where the pose is reliable.  first_new: row of the first
    new surfel.  widely: each earlier surfel is connected with its nearest new ones, however far.
    """
    n = len(poses)
    if n < 2 or count == 0:
        return no_edges()
    points = np.ascontiguousarray(poses[:, X : X + 3])
    normals = np.cross(poses[:, A : A + 3], poses[:, B : B + 3])
    normals /= np.maximum(np.linalg.norm(normals, axis=1), 1e-300)[:, None]
    nearest = np.empty((n, count), np.int64)
    _nearest(points, normals, known, first_new if widely else 0, _OFF_PLANE, nearest)
    rows, columns = np.repeat(np.arange(n), count), nearest.ravel()
    wanted = (columns >= 0) & (np.maximum(rows, columns) >= first_new)
    pairs = np.stack([rows, columns], axis=1)[wanted]
    ends = np.unique(np.sort(pairs, axis=1), axis=0).astype(np.int64).reshape(-1, 2)
    d = points[ends[:, 1]] - points[ends[:, 0]]
    first, second = np.zeros((len(ends), 3)), np.zeros((len(ends), 3))
    for e, (i, j) in enumerate(ends):
        own_coordinates(poses[i], d[e], first[e])
        own_coordinates(poses[j], d[e], second[e])
    return Edges(ends, first, second, np.maximum(np.linalg.norm(d, axis=1), 1e-9))


def keep_rows(edges: Edges, rows: I64, count: int) -> Edges:
    """The pairs whose surfels are both kept.  rows: those kept, of ``count``."""
    new = np.full(count, -1, np.int64)
    new[rows] = np.arange(len(rows))
    ends = new[edges.ends]
    kept = (ends >= 0).all(axis=1)
    return Edges(ends[kept], edges.first[kept], edges.second[kept], edges.lengths[kept])


def join_edges(a: Edges, b: Edges) -> Edges:
    """All pairs of both."""
    return Edges(
        np.concatenate([a.ends, b.ends]),
        np.concatenate([a.first, b.first]),
        np.concatenate([a.second, b.second]),
        np.concatenate([a.lengths, b.lengths]),
    )


def edge_rows(poses: F64, edges: Edges) -> tuple[F64, F64, F64]:
    """Robust weights (E,), residuals (E, 2, 3), and arms (E, 2, 3) R_i d and R_j d of all pairs.

    The weights are those of Geman and McClure.  poses: (N, POSE_FLOATS).
    """
    e = len(edges.ends)
    weights, residuals, arms = np.zeros(e), np.zeros((e, 2, 3)), np.zeros((e, 2, 3))
    _edge_rows(poses, edges, _TEAR, weights, residuals, arms)
    return weights, residuals, arms


@fast_kernel
def _edge_rows(
    poses: F64, edges: Edges, tear: float, weights: F64, residuals: F64, arms: F64
) -> None:
    for e in range(len(edges.ends)):
        i, j = edges.ends[e, 0], edges.ends[e, 1]
        own_vector(poses[i], edges.first[e], arms[e, 0])
        own_vector(poses[j], edges.second[e], arms[e, 1])
        squares = 0.0
        for k in range(3):
            p, q = arms[e, 0, k], arms[e, 1, k]
            r = poses[j, X + k] - poses[i, X + k] - 0.5 * (p + q)
            residuals[e, 0, k], residuals[e, 1, k] = r, q - p
            squares += r * r
        ratio = squares / (tear * edges.lengths[e]) ** 2
        weights[e] = 1.0 / (1.0 + ratio) ** 2


@fast_kernel
def _by_surfel(ends: I64, count: int) -> tuple[I64, I64]:
    """Starts (count + 1,) and pairs (2 E,): those of each surfel one after another."""
    starts = np.zeros(count + 1, np.int64)
    for e in range(len(ends)):
        starts[ends[e, 0] + 1] += 1
        starts[ends[e, 1] + 1] += 1
    for s in range(count):
        starts[s + 1] += starts[s]
    filled, pairs = starts[:-1].copy(), np.empty(2 * len(ends), np.int64)
    for e in range(len(ends)):
        for side in range(2):
            s = ends[e, side]
            pairs[filled[s]] = e
            filled[s] += 1
    return starts, pairs


@fast_kernel
def _median_strains(edges: Edges, residuals: F64, out: F64) -> None:
    starts, pairs = _by_surfel(edges.ends, len(out))
    values = np.empty(len(pairs))
    for k in range(len(pairs)):
        e = pairs[k]
        r = residuals[e, 0]
        values[k] = math.sqrt(r[0] * r[0] + r[1] * r[1] + r[2] * r[2]) / edges.lengths[e]
    for s in range(len(out)):
        if starts[s + 1] > starts[s]:
            out[s] = np.median(values[starts[s] : starts[s + 1]])


def median_strains(poses: F64, edges: Edges, known: BoolArray) -> F64:
    """(N,) median of |X_j - X_i - (R_i + R_j) d / 2| / |d| over each surfel's edges.

    known: (N,) surfels that are compared.  Half of its neighbours agree with a surfel to within
    this share of their distance.  NaN without edges between known ones.
    """
    out = np.full(len(poses), np.nan)
    used = _between(edges, known)
    if len(used.ends):
        _median_strains(used, edge_rows(poses, used)[1], out)
    return out


def _between(edges: Edges, known: BoolArray) -> Edges:
    """The pairs of known surfels."""
    rows = known[edges.ends].all(axis=1)
    return Edges(edges.ends[rows], edges.first[rows], edges.second[rows], edges.lengths[rows])


def share_of_neighbours(edges: Edges, some: BoolArray, of: BoolArray) -> F64:
    """(N,) share of each surfel's neighbours among ``of`` that are ``some``, (N,) each; 1 without
    any.
    """
    i, j = edges.ends.T
    counts = [
        np.bincount(i, rows[j], len(rows)) + np.bincount(j, rows[i], len(rows))
        for rows in (some & of, of)
    ]
    return np.where(counts[1] > 0, counts[0] / np.maximum(counts[1], 1.0), 1.0)


@fast_kernel
def _image_matrix(pose: F64, out: F64) -> None:
    """The four entries of a patch's distortion in the image since its birth, row by row."""
    f11, f12, f22, z = pose[F], pose[F + 1], pose[F + 2], pose[X + 2]
    c = f11 * pose[A + 2] + f12 * pose[B + 2], f12 * pose[A + 2] + f22 * pose[B + 2]
    for k in range(2):
        a, b, share = pose[A + k], pose[B + k], pose[X + k] / z
        out[2 * k] = (f11 * a + f12 * b - share * c[0]) / z
        out[2 * k + 1] = (f12 * a + f22 * b - share * c[1]) / z


@fast_kernel
def _patch_distortions(poses: F64, ends: I64, out: F64) -> None:
    starts, pairs = _by_surfel(ends, len(out))
    matrices, others = np.empty((len(poses), 4)), np.empty(len(pairs))
    for s in range(len(poses)):
        _image_matrix(poses[s], matrices[s])
    for s in range(len(out)):
        count, squares = starts[s + 1] - starts[s], 0.0
        if count == 0:
            continue
        for entry in range(4):
            for k in range(count):
                e = pairs[starts[s] + k]
                other = ends[e, 1] if ends[e, 0] == s else ends[e, 0]
                others[k] = matrices[other, entry]
            difference = matrices[s, entry] - np.median(others[:count])
            squares += difference * difference
        out[s] = math.sqrt(squares)


def patch_distortions(poses: F64, edges: Edges, known: BoolArray) -> F64:
    """(N,) how differently from its neighbours' a surfel's patch is distorted in the image.

    The Frobenius norm of the difference of its 2 x 2 matrix since birth, which is then the
    identity, from the median of its neighbours', entry by entry.  poses: (N, POSE_FLOATS) in the
    camera's frame, of surfels that were born in one frame.  known: (N,) surfels that are compared.
    NaN without edges between known ones.
    """
    out = np.full(len(poses), np.nan)
    _patch_distortions(poses, _between(edges, known).ends, out)
    return out


def torn_off(edges: Edges, weights: F64, count: int) -> BoolArray:
    """(count,) which surfels keep only a few of their neighbours.

    weights: (E,) of ``edge_rows``.  If two surfaces slide along each other, each surfel still has
    neighbours; one that has left them all has drifted along its ray.
    """
    ends = edges.ends.ravel()
    degree = np.bincount(ends, minlength=count)
    held = np.bincount(ends, weights=np.repeat(weights, 2), minlength=count)
    return (degree >= _FEW) & (held < _HELD_SHARE * degree)


def pull_of_edges(edges: Edges, count: int, weight: float, strain: float) -> F64:
    """(count,) DN^2 / m^2 with which its edges hold each surfel in place.

    weight: of a pair that is strained by ``strain``, DN^2.
    """
    pulls = np.repeat(weight / (strain * edges.lengths) ** 2, 2)
    total = np.bincount(edges.ends.ravel(), weights=pulls, minlength=count)
    return total.astype(np.float64)

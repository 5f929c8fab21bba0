"""Whether a map that deforms may be trusted: how it predicts tracks that it was not made from.

The rest place of such a track is triangulated from every second keyframe that has it, carried by
the nodes, and projected into the others.  The same without displacements, by the cameras of a rigid
adjustment, is the rigid map's prediction of the same pixels.

A map that deforms has enough unknowns to fit much that is wrong: a scene before a camera that
stands still, for one.  Such a fit predicts badly, or hardly any of its surface is at rest.
"""

from dataclasses import dataclass

import numpy as np

from pliant.algorithms.arrays import F64, I64
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.deformable.moving_landmarks import DeformingMap, TrackedPoints
from pliant.algorithms.deformable.node_graph import carriers_of

KERNEL_PX = 1.5
"""Error of a pixel that counts as large: of the Cauchy kernel."""
_STIFF = 0.006
"""Displacement that hardly counts, as a share of the median depth."""
_NEAREST_Z = 1e-6


@dataclass(frozen=True)
class Evidence:
    """predicted, by_rigid: shares of the tracks that each map predicts to KERNEL_PX.

    gain: mean decrease of a track's cost by displacements, as a share of its standard deviation.
    stiff: share of the landmarks that hardly move.
    """

    predicted: float
    by_rigid: float
    gain: float
    stiff: float


def weigh(found: DeformingMap, held_out: TrackedPoints, camera: PinholeCamera) -> Evidence:
    """Judge a map by tracks that it does not have."""
    costs = _costs(held_out, found.T_world_camera, found, camera)
    rigid = _costs(held_out, found.T_rigid, None, camera)
    less = rigid - costs
    moved = np.einsum("lj,kljc->klc", found.weights, found.displacements[:, found.carriers])
    size = np.sqrt((moved**2).sum(axis=2).mean(axis=0)) / found.depth
    return Evidence(
        predicted=float((costs < np.log(2.0)).mean()),
        by_rigid=float((rigid < np.log(2.0)).mean()),
        gain=float(less.mean() / (less.std() + 1e-12)),
        stiff=float((size < _STIFF).mean()),
    )


def _costs(
    tracks: TrackedPoints, T: F64, moving: DeformingMap | None, camera: PinholeCamera
) -> F64:
    """(L,) mean Cauchy cost of the pixels of each track, one half predicted by the other."""
    k, i, count = tracks.keyframes, tracks.landmarks, int(tracks.landmarks.max()) + 1
    rays = np.concatenate([camera.normalise(tracks.points_px), np.ones((len(k), 1))], axis=1)
    rays = np.einsum("mij,mj->mi", T[k, :3, :3], rays)
    order, centres = _order(i), T[k, :3, 3]
    total = np.zeros(count)
    for half in range(2):
        known, tested = order % 2 == half, order % 2 != half
        rest = triangulate(i[known], rays[known], centres[known], count)
        moved = np.zeros((len(k), 3))
        if moving is not None:
            carriers, weights = carriers_of(rest, moving.nodes, moving.spacing)
            d = moving.displacements[k[:, None], carriers[i]]
            moved = np.einsum("mj,mjc->mc", weights[i], d)
            rest = triangulate(i[known], rays[known], (centres - moved)[known], count)
        points = np.einsum("mji,mj->mi", T[k, :3, :3], rest[i] + moved - centres)
        front = points[:, 2] > _NEAREST_Z
        points[~front] = (0.0, 0.0, 1.0)
        squares = ((camera.project(points) - tracks.points_px) ** 2).sum(axis=1)
        squares[~front] = np.inf
        cost = np.log1p(np.minimum(squares / KERNEL_PX**2, 1e6))
        total += np.bincount(i[tested], cost[tested], count)
    return total / np.bincount(i, minlength=count)


def _order(landmarks: I64) -> I64:
    """(M,) number of each observation among those of its landmark."""
    by_landmark = np.argsort(landmarks, kind="stable")
    first = np.searchsorted(landmarks[by_landmark], landmarks)
    out = np.empty(len(landmarks), np.int64)
    out[by_landmark] = np.arange(len(landmarks))
    return out - first


def triangulate(landmarks: I64, rays: F64, centres: F64, count: int) -> F64:
    """(count, 3) points nearest to the rays (M, 3) of each landmark from centres (M, 3)."""
    across = np.eye(3) - rays[:, :, None] * rays[:, None] / (rays**2).sum(axis=1)[:, None, None]
    A, b = np.zeros((count, 3, 3)), np.zeros((count, 3))
    np.add.at(A, landmarks, across)
    np.add.at(b, landmarks, np.einsum("mij,mj->mi", across, centres))
    solved = np.linalg.solve(A + 1e-9 * np.eye(3), b[:, :, None])[:, :, 0]
    return np.asarray(solved, np.float64)

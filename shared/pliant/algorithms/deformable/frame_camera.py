"""The camera of each frame by the map of the last window, until there is another one.

The map stays as it is: rest places, nodes, and how stiff each node is.  Unknown are the camera and
the displacements of the nodes in one frame; the cost is that of ``adjustment.py``.  Where the
surface has moved since the window, its displacements say so, and what is stiff has the camera.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from pliant.algorithms.arrays import F64, I64, Shape
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.deformable.adjustment import NOISE_PX
from pliant.algorithms.deformable.held_out import KERNEL_PX
from pliant.algorithms.deformable.linearised import CAMERA, accumulate, linearise
from pliant.algorithms.deformable.moving_landmarks import NEAREST, DeformingMap
from pliant.algorithms.deformable.node_graph import NodeGraph, edges_of
from pliant.algorithms.deformable.priors import Prior
from pliant.algorithms.geometry import inverse, so3_exp, transform

_STEPS = 2
_FEWEST = 30
"""Landmarks that a frame must see."""
_FIT = 0.5
"""Least share of them that fit their pixels."""
_REGULAR = 1e-6
"""Damping of what nothing determines."""


@dataclass
class FrameCamera:
    """Certain landmarks of a window, in units of ``depth``, its median one.

    ids: ascending.    prior: of the displacements of a frame.    T_world_camera, displacements: of
    the last frame.
    """

    depth: float
    ids: Annotated[I64, Shape("L")]
    rest: Annotated[F64, Shape("L", 3)]
    carriers: Annotated[I64, Shape("L", NEAREST)]
    weights: Annotated[F64, Shape("L", NEAREST)]
    prior: Annotated[F64, Shape("B", "B")]
    T_world_camera: Annotated[F64, Shape(4, 4)]
    displacements: Annotated[F64, Shape(1, "N", 3)]

    def follow(self, ids: I64, points_px: F64, camera: PinholeCamera) -> F64 | None:
        """T_world_camera (4, 4) of the next frame, in the window's unit.

        ids, points_px: (N,) and (N, 2) its tracks, rectified.  None where too few landmarks are
        among them, or fit.
        """
        rows, pixels = self._seen(ids, points_px)
        if len(rows) < _FEWEST:
            return None
        now = self.T_world_camera, self.displacements, np.zeros(0)
        for _ in range(_STEPS):
            now = self._stepped(*now[:2], rows, pixels, camera)
        if not np.isfinite(now[0]).all() or np.mean(now[2] < KERNEL_PX**2) < _FIT:
            return None
        self.T_world_camera, self.displacements = now[:2]
        out = self.T_world_camera.copy()
        out[:3, 3] *= self.depth
        return out

    def landmarks(self, ids: I64, points_px: F64) -> tuple[F64, F64]:
        """(M, 3) landmarks among the tracks of the last frame, in its camera's frame and in the
        window's unit, and their pixels (M, 2)."""
        rows, pixels = self._seen(ids, points_px)
        moved = self.displacements[0][self.carriers[rows]]
        points = self.rest[rows] + np.einsum("lj,ljc->lc", self.weights[rows], moved)
        return self.depth * transform(inverse(self.T_world_camera), points), pixels

    def _seen(self, ids: I64, points_px: F64) -> tuple[I64, F64]:
        """Rows (M,) of the landmarks among tracks, and their pixels (M, 2)."""
        _, rows, seen = np.intersect1d(self.ids, ids, assume_unique=True, return_indices=True)
        return rows, np.ascontiguousarray(points_px[seen], np.float64)

    def _stepped(
        self, T: F64, d: F64, rows: I64, pixels: F64, camera: PinholeCamera
    ) -> tuple[F64, F64, F64]:
        """Camera and displacements after a Gauss-Newton step, and errors before, px squared."""
        count, size = len(rows), CAMERA + len(self.prior)
        J_camera, J_point = np.empty((count, 2, CAMERA)), np.empty((count, 2, 3))
        r, squares = np.empty((count, 2)), np.empty(count)
        only, each = np.zeros(count, np.int64), np.arange(count)
        carriers, weights = self.carriers[rows], self.weights[rows]
        linearise(
            *(only, each, pixels, camera.intrinsics, T[None], self.rest[rows], d),
            *(carriers, weights, NOISE_PX, KERNEL_PX, J_camera, J_point, r, squares),
        )
        H, g = np.zeros((1, size, size)), np.zeros((1, size))
        unused = np.zeros((count, 3, 3)), np.zeros((count, 3))
        accumulate(only, each, carriers, weights, J_camera, J_point, r, H, g, *unused)
        H[0, CAMERA:, CAMERA:] += self.prior
        g[0, CAMERA:] += self.prior @ d.ravel()
        x = np.linalg.solve(H[0] + _REGULAR * np.eye(size), -g[0])
        moved = T.copy()
        moved[:3, :3] = T[:3, :3] @ so3_exp(x[:3])
        moved[:3, 3] += x[3:CAMERA]
        return moved, d + x[CAMERA:].reshape(d.shape), squares


def frame_camera(found: DeformingMap, ids: I64, keyframe: int = -1) -> FrameCamera:
    """Follow a window from a keyframe on.  ids: (L,) the track of each landmark."""
    rows = np.flatnonzero(found.reliable)
    rows = rows[np.argsort(ids[rows], kind="stable")]
    nodes, spacing = found.nodes / found.depth, found.spacing / found.depth
    carriers, weights = found.carriers[rows], found.weights[rows]
    prior = Prior(NodeGraph(nodes, edges_of(nodes, spacing), carriers, weights, spacing))
    displacements = found.displacements / found.depth
    prior.update_rigidity(displacements)
    T_world_camera = found.T_world_camera[keyframe].copy()
    T_world_camera[:3, 3] /= found.depth
    return FrameCamera(
        depth=found.depth,
        ids=ids[rows],
        rest=found.rest[rows] / found.depth,
        carriers=carriers,
        weights=weights,
        prior=prior.matrix,
        T_world_camera=T_world_camera,
        displacements=displacements[keyframe][None],
    )

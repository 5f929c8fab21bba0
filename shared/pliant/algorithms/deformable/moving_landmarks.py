"""What the deformable adjustment takes and gives."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from pliant.algorithms.arrays import F64, I64, BoolArray, Shape

NEAREST = 4
"""Nodes that carry a landmark."""


@dataclass(frozen=True, kw_only=True)
class TrackedPoints:
    """Pixels of landmarks in keyframes, each landmark in several.

    keyframes, landmarks: index of each observation.    points_px: (u, v), rectified image.
    """

    keyframes: Annotated[I64, Shape("M")]
    landmarks: Annotated[I64, Shape("M")]
    points_px: Annotated[F64, Shape("M", 2)]


@dataclass(frozen=True, kw_only=True)
class DeformingMap:
    """A map whose landmarks move with the nodes of a graph.

    T_world_camera: of K keyframes.    T_rigid: of a rigid adjustment of the same tracks.
    depth: the median one.    rest: landmarks at rest, world.
    nodes: N nodes at rest, ``spacing`` apart.    displacements: of each node in each keyframe.
    carriers, weights: nodes of each landmark, and how much it follows each; they sum to 1.
    reliable: whether a landmark fits its pixels, and its rest place is certain.
    """

    T_world_camera: Annotated[F64, Shape("K", 4, 4)]
    T_rigid: Annotated[F64, Shape("K", 4, 4)]
    depth: float
    spacing: float
    rest: Annotated[F64, Shape("L", 3)]
    nodes: Annotated[F64, Shape("N", 3)]
    displacements: Annotated[F64, Shape("K", "N", 3)]
    carriers: Annotated[I64, Shape("L", NEAREST)]
    weights: Annotated[F64, Shape("L", NEAREST)]
    reliable: Annotated[BoolArray, Shape("L")]

    def positions(self, keyframe: int) -> F64:
        """(L, 3) landmarks in a keyframe, world."""
        moved = self.displacements[keyframe][self.carriers]
        return self.rest + np.einsum("lj,ljc->lc", self.weights, moved)

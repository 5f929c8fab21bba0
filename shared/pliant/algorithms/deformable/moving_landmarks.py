"""What the deformable adjustment takes and gives."""

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from pliant.algorithms.arrays import F32, F64, I64, BoolArray, Shape

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


def _none(*shape: int) -> F64:
    return np.zeros((0, *shape))


def _no_rows(*shape: int) -> I64:
    return np.zeros((0, *shape), np.int64)


@dataclass(frozen=True, kw_only=True)
class WindowMap:
    """Certain landmarks of a window; fields as of ``DeformingMap``.

    frames: of the keyframes, the newest last; none where nothing was adjusted, or for a problem.
    T_world_camera: theirs; the world is nearly that of the rigid map, the unit that of the first.
    ids, points_px: of the landmarks, where the newest keyframe tracks them, NaN where it does not.
    problem: why the adjustment is not to be trusted, "" where it is.
    between, T_between: keyframes of the rigid map between those of a window that continues none,
    and their T_world_camera.
    T_frame: T_world_camera of this frame by the window before, in the world of that one; none where
    none is trusted.
    """

    frames: Annotated[I64, Shape("K")] = field(default_factory=lambda: _no_rows())
    T_world_camera: Annotated[F64, Shape("K", 4, 4)] = field(default_factory=lambda: _none(4, 4))
    ids: Annotated[I64, Shape("L")] = field(default_factory=lambda: _no_rows())
    points_px: Annotated[F32, Shape("L", 2)] = field(
        default_factory=lambda: np.zeros((0, 2), np.float32)
    )
    rest: Annotated[F64, Shape("L", 3)] = field(default_factory=lambda: _none(3))
    displacements: Annotated[F64, Shape("K", "N", 3)] = field(default_factory=lambda: _none(0, 3))
    carriers: Annotated[I64, Shape("L", NEAREST)] = field(default_factory=lambda: _no_rows(NEAREST))
    weights: Annotated[F64, Shape("L", NEAREST)] = field(default_factory=lambda: _none(NEAREST))
    problem: str = ""
    between: Annotated[I64, Shape("B")] = field(default_factory=lambda: _no_rows())
    T_between: Annotated[F64, Shape("B", 4, 4)] = field(default_factory=lambda: _none(4, 4))
    T_frame: Annotated[F64, Shape("F", 4, 4)] = field(default_factory=lambda: _none(4, 4))

    @property
    def in_view(self) -> I64:
        """Rows of the landmarks that the newest keyframe tracks."""
        return np.flatnonzero(np.isfinite(self.points_px[:, 0]))

    def moved(self) -> F64:
        """(K, L, 3) displacements of the landmarks in each keyframe, world."""
        return np.einsum("lj,kljc->klc", self.weights, self.displacements[:, self.carriers])

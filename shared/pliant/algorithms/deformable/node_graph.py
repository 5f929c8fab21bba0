"""The nodes that carry the landmarks, and what joins them in space."""

from dataclasses import dataclass

import numpy as np

from pliant.algorithms.arrays import F64, I64
from pliant.algorithms.deformable.moving_landmarks import NEAREST

_REACH = 0.7
"""Standard deviation of a node's influence, in node spacings."""
_JOINED = 6
"""Nearest nodes that a node is joined to."""
_LONGEST = 2.5
"""Longest edge, in node spacings."""
_FAR = 1e-6
"""Weight of a node that is far away: a landmark always has carriers."""


@dataclass(frozen=True)
class NodeGraph:
    """N nodes at rest, E edges, and the carriers of L landmarks with their weights."""

    nodes: F64  # (N, 3)
    edges: I64  # (E, 2)
    carriers: I64  # (L, NEAREST)
    weights: F64  # (L, NEAREST)
    spacing: float


_MOST = 100
"""Nodes; a larger scene has them farther apart."""


def no_nodes(count: int) -> NodeGraph:
    """The graph of a rigid scene with this many landmarks."""
    none = np.zeros((count, 0))
    return NodeGraph(np.zeros((0, 3)), np.zeros((0, 2), np.int64), none.astype(np.int64), none, 0.0)


def node_graph(rest: F64, spacing: float) -> NodeGraph:
    """Cover landmarks (L, 3) with nodes that are at least ``spacing`` apart.

    Raises ValueError for fewer than NEAREST nodes.
    """
    while len(chosen := _apart(rest, spacing)) > _MOST:
        spacing *= 1.2
    nodes = rest[chosen]
    if len(nodes) < NEAREST:
        raise ValueError(f"{len(nodes)} nodes: the landmarks are too close together")
    carriers, weights = carriers_of(rest, nodes, spacing)
    return NodeGraph(nodes, edges_of(nodes, spacing), carriers, weights, spacing)


def edges_of(nodes: F64, spacing: float) -> I64:
    """(E, 2) nodes that are joined."""
    near, apart = _nearest(nodes, nodes, min(_JOINED + 1, len(nodes)))
    pairs = np.stack([np.repeat(near[:, 0], near.shape[1] - 1), near[:, 1:].ravel()], axis=1)
    pairs = np.sort(pairs[apart[:, 1:].ravel() < _LONGEST * spacing], axis=1)
    return np.unique(pairs, axis=0).reshape(-1, 2)


def carriers_of(points: F64, nodes: F64, spacing: float) -> tuple[I64, F64]:
    """(P, NEAREST) nodes that carry points, and their weights."""
    carriers, apart = _nearest(nodes, points, NEAREST)
    weights = np.exp(-0.5 * (apart / (_REACH * spacing)) ** 2) + _FAR
    return carriers, weights / weights.sum(axis=1, keepdims=True)


def _apart(points: F64, spacing: float) -> I64:
    """Indices of points of which no two are nearer than ``spacing``, and which cover the rest."""
    free = np.ones(len(points), np.bool_)
    chosen: list[int] = []
    for index in range(len(points)):
        if free[index]:
            chosen.append(index)
            free &= ((points - points[index]) ** 2).sum(axis=1) > spacing**2
    return np.array(chosen, np.int64)


def _nearest(nodes: F64, points: F64, count: int) -> tuple[I64, F64]:
    """(P, count) nearest nodes of each point, nearest first, and their distances."""
    square = ((points[:, None] - nodes[None]) ** 2).sum(axis=2)
    near = np.argsort(square, axis=1, kind="stable")[:, :count]
    return near, np.sqrt(np.take_along_axis(square, near, axis=1))

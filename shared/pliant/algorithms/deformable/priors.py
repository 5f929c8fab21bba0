"""The prior of the displacements of one keyframe: smooth, isometric, and mostly none."""

import numpy as np

from pliant.algorithms.arrays import F64
from pliant.algorithms.deformable.node_graph import NodeGraph

_GRADIENT = 0.3
"""Standard deviation of the difference of two joined displacements, by the nodes' distance."""
_STRAIN = 0.02
"""The same, of the change of their distance."""
STIFF = 0.003
"""Displacement that a stiff node may have, as a share of the median depth."""


class Prior:
    """The quadratic form d_k^T P d_k, the same for all keyframes: (3N, 3N) ``matrix``.

    Lengths are shares of the median depth.
    """

    def __init__(self, graph: NodeGraph) -> None:
        self._edges = _of_edges(graph)
        self.matrix: F64 = self._edges
        self.update_rigidity(np.zeros((1, len(graph.nodes), 3)))

    def update_rigidity(self, d: F64) -> None:
        """Weights of the Geman-McClure cost of each node's displacements (K, N, 3) as they are."""
        share = (d**2).sum(axis=2).mean(axis=0) / STIFF**2
        rigidity = (1.0 + share) ** -2.0
        self.matrix = self._edges + np.diag(np.repeat(rigidity / STIFF**2, 3))

    def gradient(self, d: F64) -> F64:
        """P d for (K, N, 3) displacements."""
        return (d.reshape(len(d), -1) @ self.matrix).reshape(d.shape)


def _of_edges(graph: NodeGraph) -> F64:
    """(3N, 3N) of gradients and strains of all edges."""
    count = len(graph.nodes)
    out = np.zeros((count, 3, count, 3))
    for a, b in graph.edges.tolist():
        arm = graph.nodes[b] - graph.nodes[a]
        square = float(arm @ arm)
        along = np.outer(arm, arm) / square
        weight = (np.eye(3) / _GRADIENT**2 + along / _STRAIN**2) / square
        out[a, :, a] += weight
        out[b, :, b] += weight
        out[a, :, b] -= weight
        out[b, :, a] -= weight
    return out.reshape(3 * count, 3 * count)

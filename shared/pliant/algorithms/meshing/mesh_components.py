"""Connected components: of a graph, and a mesh without those that are small."""

import numpy as np

from pliant.algorithms.arrays import I64
from pliant.algorithms.meshing.mesh_blocks import TriangleMesh
from pliant.compiler.kernel import kernel

CRUMB = 0.01
"""Share of the largest component's area below which one is left out."""


def cleaned(mesh: TriangleMesh) -> TriangleMesh:
    """Without components whose area is small beside that of the largest.

    Triangles are connected where they share a vertex.
    """
    if not len(mesh.triangles):
        return mesh
    triangles = mesh.triangles.astype(np.int64)
    label = components(len(mesh.positions), triangles[:, :2].ravel(), triangles[:, 1:].ravel())[
        triangles[:, 0]
    ]
    corners = mesh.positions[triangles].astype(np.float64)
    turned = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.bincount(label, np.linalg.norm(turned, axis=1))
    return mesh.of_triangles((areas >= CRUMB * areas.max())[label])


def components(count: int, here: I64, there: I64) -> I64:
    """(count,) the connected component of each node of a graph, numbered by their first nodes."""
    _, component = np.unique(_roots(count, here, there), return_inverse=True)
    return component.astype(np.int64)


@kernel
def _roots(count: int, here: I64, there: I64) -> I64:
    """The least node that each is joined to, by halving the paths of a disjoint set."""
    parent = np.arange(count)
    for edge in range(len(here)):
        one, other = here[edge], there[edge]
        while parent[one] != one:
            parent[one] = parent[parent[one]]
            one = parent[one]
        while parent[other] != other:
            parent[other] = parent[parent[other]]
            other = parent[other]
        if one < other:
            parent[other] = one
        else:
            parent[one] = other
    for node in range(count):
        parent[node] = parent[parent[node]]
    return parent

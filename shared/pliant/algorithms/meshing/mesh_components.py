"""Connected components: of a graph, and a mesh without those that are small."""

import math
from typing import Any

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, I64
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
    piece = pieces_of(len(mesh.positions), mesh.triangles)
    areas = np.bincount(piece, areas_of(mesh.positions, mesh.triangles))
    return mesh.of_triangles((areas >= CRUMB * areas.max())[piece])


@kernel
def areas_of(positions: F32, triangles: I32) -> F64:
    """(T,) areas of triangles.  A kernel, because numpy takes 200 bytes a triangle."""
    areas = np.empty(len(triangles))
    one, other = np.empty(3), np.empty(3)
    for t in range(len(triangles)):
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        for k in range(3):
            here = np.float64(positions[a, k])
            one[k], other[k] = positions[b, k] - here, positions[c, k] - here
        e0, e1, e2 = one
        f0, f1, f2 = other
        n0, n1, n2 = e1 * f2 - e2 * f1, e2 * f0 - e0 * f2, e0 * f1 - e1 * f0
        areas[t] = 0.5 * math.sqrt(n0 * n0 + n1 * n1 + n2 * n2)
    return areas


@kernel
def pieces_of(count: int, triangles: I32) -> I32:
    """(T,) the connected component of each triangle, named by one of its ``count`` vertices.

    A kernel, because numpy takes 80 bytes a triangle.
    """
    parent = np.arange(count).astype(np.int32)
    for t in range(len(triangles)):
        _join(parent, triangles[t, 0], triangles[t, 1])
        _join(parent, triangles[t, 1], triangles[t, 2])
    _flatten(parent)
    pieces = np.empty(len(triangles), np.int32)
    for t in range(len(triangles)):
        pieces[t] = parent[triangles[t, 0]]
    return pieces


def components(count: int, here: I64, there: I64) -> I64:
    """(count,) the connected component of each node of a graph, numbered by their first nodes."""
    _, component = np.unique(_roots(count, here, there), return_inverse=True)
    return component.astype(np.int64)


@kernel
def _roots(count: int, here: I64, there: I64) -> I64:
    """The least node that each is joined to, by halving the paths of a disjoint set."""
    parent = np.arange(count)
    for edge in range(len(here)):
        _join(parent, here[edge], there[edge])
    _flatten(parent)
    return parent


@kernel
def _join(parent: Any, one: Any, other: Any) -> None:
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


@kernel
def _flatten(parent: Any) -> None:
    """Parents are never greater: those before a node are done."""
    for node in range(len(parent)):
        parent[node] = parent[parent[node]]

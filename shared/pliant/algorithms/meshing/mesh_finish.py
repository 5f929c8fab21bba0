"""Finishing of the mesh: small holes closed, crumbs and shreds removed, borders smoothed.

Surface from unobserved voxels, or from inconsistent observations, is a guess.  It is kept where
observed surface encloses it, and closes a hole.  Along the border it is removed, so that the mesh
ends where the observations do.  Components of little area and weight are removed.  Lengths are in
voxels, a share of the scene's median depth.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, I64, BoolArray
from pliant.algorithms.meshing.mesh_blocks import TriangleMesh
from pliant.algorithms.meshing.mesh_borders import smoothed_borders, without_teeth, zipped
from pliant.algorithms.meshing.mesh_components import areas_of, pieces_of
from pliant.algorithms.meshing.mesh_topology import NONE, corner_before, split_fans, stars_of
from pliant.algorithms.meshing.tsdf_closing import CARRIED, Evidence, is_guessed
from pliant.compiler.kernel import kernel

MOST_STEPS = 7.0
"""As of ``Tsdf``: maximum for a guess.  The two truncations are 8 steps apart."""
_SURE_STEPS = 5.0
"""Above it a vertex is a guess.  MAX_STEPS of the live mesh is lower, against curtains behind depth
discontinuities; here they are cut off as teeth, and a lower limit would leave slits.
"""
_RINGS = 2 * CARRIED
"""Rings of triangles from the border in which guesses are removed.  Twice the extrapolated voxels,
because extrapolation is diagonal as well.
"""
_CRUMB = 30.0
"""Minimum area of a component in square voxels, times its weight: one frontal observation with
certain depth has weight 1.
"""
_MAX_EDGE = 2.5
"""Maximum edge, in voxels, of a triangle that closes a notch."""


@dataclass(frozen=True)
class _Judged:
    """support: (V,) weights.    guessed: (V,)."""

    mesh: TriangleMesh
    support: F32
    guessed: BoolArray

    def kept(self, alive: BoolArray) -> "_Judged":
        """Select triangles (T,)."""
        mesh = self.mesh
        used, triangles = _of_used_vertices(len(mesh.positions), mesh.triangles, alive)
        mesh = TriangleMesh(
            positions=mesh.positions[used],
            normals=mesh.normals[used],
            colours=mesh.colours[used],
            triangles=triangles,
        )
        return _Judged(mesh, self.support[used], self.guessed[used])

    def zipped(self, max_edge: float) -> "_Judged":
        """Close sharp notches.  At most one border then passes each vertex."""
        mesh = self.mesh
        triangles, was = split_fans(len(mesh.positions), mesh.triangles)
        positions, normals = mesh.positions[was], mesh.normals[was]
        more = zipped(positions, normals, triangles, max_edge)
        mesh = TriangleMesh(
            positions=positions,
            normals=normals,
            colours=mesh.colours[was],
            triangles=np.concatenate([triangles, more]),
        )
        return _Judged(mesh, self.support[was], self.guessed[was])


def finished(
    mesh: TriangleMesh, evidence_of: Callable[[F32], Evidence], voxel: float
) -> TriangleMesh:
    """Return the finished mesh of a volume with extrapolated distances, with its guesses marked.

    evidence_of: for vertices (V, 3).    voxel: its side, in the unit of the mesh.
    """
    evidence = evidence_of(mesh.positions)
    judged = _Judged(mesh, evidence.support, is_guessed(evidence, _SURE_STEPS))
    del mesh, evidence  # each step takes the place of the one before
    judged = judged.kept(peeled(judged.mesh.triangles, judged.guessed, _RINGS))
    judged = judged.zipped(_MAX_EDGE * voxel)
    judged = judged.kept(without_teeth(judged.mesh.positions, judged.mesh.triangles))
    judged = judged.kept(_large_enough(judged, voxel))
    judged = judged.zipped(_MAX_EDGE * voxel)
    mesh = judged.mesh
    return replace(
        mesh,
        positions=smoothed_borders(mesh.positions, mesh.normals, mesh.triangles),
        closed=np.flatnonzero(judged.guessed).astype(np.int32),
    )


def _large_enough(judged: _Judged, voxel: float) -> BoolArray:
    """(T,) triangles of components with sufficient area times weight, which is at most 1."""
    mesh = judged.mesh
    piece = pieces_of(len(mesh.positions), mesh.triangles)
    areas = areas_of(mesh.positions, mesh.triangles)
    sizes = _certain_areas(piece, areas, mesh.triangles, judged.support)
    return (sizes >= _CRUMB * voxel * voxel)[piece]


@kernel
def _of_used_vertices(count: int, triangles: I32, alive: BoolArray) -> tuple[I64, I32]:
    """The vertices that kept triangles use, and these.  A kernel, because numpy takes 120 bytes a
    triangle."""
    place, kept = np.full(count, NONE, np.int32), 0
    for t in range(len(triangles)):
        if alive[t]:
            kept += 1
            for k in range(3):
                place[triangles[t, k]] = 0
    used = np.flatnonzero(place != NONE)
    for row in range(len(used)):
        place[used[row]] = row
    some = np.empty((kept, 3), np.int32)
    row = 0
    for t in range(len(triangles)):
        if alive[t]:
            for k in range(3):
                some[row, k] = place[triangles[t, k]]
            row += 1
    return used, some


@kernel
def _certain_areas(piece: I32, areas: F64, triangles: I32, support: F32) -> F64:
    """(V,) area times weight of the component that a vertex names."""
    sizes = np.zeros(len(support))
    for t in range(len(triangles)):
        total = 0.0
        for k in range(3):
            total += support[triangles[t, k]]
        sizes[piece[t]] += areas[t] * min(total / 3.0, 1.0)
    return sizes


@kernel
def peeled(triangles: I32, guessed: BoolArray, rings: int) -> BoolArray:
    """(T,) triangles that are kept: those with a guessed vertex are removed at the border.

    guessed: (V,).   rings: how often.
    """
    stars = stars_of(len(guessed), triangles)
    alive = np.ones(len(triangles), np.bool_)
    ends = np.zeros(len(guessed), np.bool_)
    for t in range(len(triangles)):
        for k in range(3):
            a, b = triangles[t, k], triangles[t, (k + 1) % 3]
            if corner_before(b, a, triangles, stars, alive) == NONE:
                ends[a], ends[b] = True, True
    for _ in range(rings):
        gone = np.zeros(len(triangles), np.bool_)
        for t in range(len(triangles)):
            a, b, c = triangles[t]
            is_guess = guessed[a] or guessed[b] or guessed[c]
            gone[t] = alive[t] and is_guess and (ends[a] or ends[b] or ends[c])
        for t in range(len(triangles)):
            if gone[t]:
                alive[t] = False
                for k in range(3):
                    ends[triangles[t, k]] = True
    return alive

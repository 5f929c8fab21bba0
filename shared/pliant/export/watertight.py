"""A mesh closed to a solid: Open3D's screened Poisson reconstruction.

Kazhdan and Hoppe 2013.  A filmed surface has a border, where the view ended, and its reconstruction
continues from there without end.  So the solid is bounded by a box a little larger than the mesh.
If a first, coarse reconstruction contains parts of the box, those parts are points of the surface,
too; on the side of the cameras the box stays open.
"""

import math
from dataclasses import replace
from typing import Any

import numpy as np

from pliant.algorithms.arrays import F32, F64, I64, BoolArray
from pliant.algorithms.meshing.mesh_blocks import TriangleMesh
from pliant.algorithms.meshing.mesh_components import cleaned
from pliant.algorithms.meshing.touching import taken_apart
from pliant.errors import ResultError
from pliant.export.kinds import KINDS
from pliant.open3d_geometry import from_mesh, to_cloud, to_mesh
from pliant.open3d_library import load_open3d

WATERTIGHT_NAME = KINDS["watertight"]
_COARSE_DEPTH, _LEAST_DEPTH, _MOST_DEPTH = 7, 6, 9
"""Levels of the octree: cells have a share of 2^-depth of the cube."""
_COARSE_CUBE, _CUBE = 1.5, 1.2
"""Side of the cube of a reconstruction, of what is in it: the box lies within both."""
_MARGIN = 0.03
"""How far the box is from the mesh, as a share of its diagonal: as thick a wall is at least."""
_BOX_SAMPLES = 96
"""Along the longest side of the box."""
_RAYS = 7
"""From each sample of the box to places of the mesh; most of them tell on which side it is."""
_BOX_COLOUR = (178, 178, 178)


def watertight(mesh: TriangleMesh) -> TriangleMesh:
    """The solid whose surface a mesh shows: each edge has two triangles, which turn alike.

    normals of the mesh: to where the cameras were, so that the solid is what they did not see.
    The same mesh gives the same bytes: with more threads Open3D's Poisson would not.

    Raises Open3dError, ResultError for a mesh without triangles.
    """
    mesh = cleaned(mesh)
    if not len(mesh.triangles):
        raise ResultError("an empty mesh has no inside")
    coarse = _poisson(mesh, min(_COARSE_DEPTH, _depth(mesh)), _COARSE_CUBE)
    places, normals = _box(mesh.positions)
    within = _is_within(coarse, places, mesh.positions)
    if within.all():  # all walls were seen: the surface closes by itself
        within[:] = False
    count = int(within.sum())
    grey = np.tile(np.array(_BOX_COLOUR, np.uint8), (count, 1))
    surface = replace(
        mesh,
        positions=np.concatenate([mesh.positions, places[within]]).astype(np.float32),
        normals=np.concatenate([mesh.normals, normals[within]]).astype(np.float32),
        colours=np.concatenate([mesh.colours, grey]),
    )
    closed = cleaned(from_mesh(_poisson(surface, _depth(mesh), _CUBE)))
    try:
        positions, triangles = taken_apart(closed.positions, closed.triangles)
    except ValueError:
        raise ResultError("Poisson's surface of this mesh does not close") from None
    nearest = _nearest(surface.positions, positions)
    coloured = TriangleMesh(
        positions=positions,
        normals=surface.normals[nearest],
        colours=surface.colours[nearest],
        triangles=triangles,
    )
    return from_mesh(to_mesh(coloured))


def _depth(mesh: TriangleMesh) -> int:
    """Cells of the reconstruction as large as the triangles, within bounds."""
    a, b = (mesh.positions[mesh.triangles[:, k]] for k in range(2))
    edge = max(float(np.median(np.linalg.norm(b - a, axis=1))), 1e-12)
    side = _CUBE * float(np.ptp(mesh.positions, axis=0).max())
    return min(max(math.ceil(math.log2(max(side / edge, 1.0))), _LEAST_DEPTH), _MOST_DEPTH)


def _poisson(mesh: TriangleMesh, depth: int, cube: float) -> Any:
    open3d = load_open3d()
    cloud = to_cloud(mesh.positions, mesh.colours, mesh.normals)
    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        made, _ = open3d.geometry.TriangleMesh.create_from_point_cloud_poisson(
            cloud, depth=depth, scale=cube, n_threads=1
        )
    return made


def _nearest(known: F32, places: F32) -> I64:
    """(N,) the nearest known point of each place.  Poisson's own colours have spots."""
    open3d = load_open3d()
    search = open3d.core.nns.NearestNeighborSearch(open3d.core.Tensor(known))
    search.knn_index()
    rows, _ = search.knn_search(open3d.core.Tensor(places), 1)
    return np.asarray(rows.numpy().ravel(), np.int64)


def _box(positions: F32) -> tuple[F64, F64]:
    """Samples (N, 3) of the faces of the box about a mesh, and their normals, outwards."""
    low, high = positions.min(axis=0).astype(np.float64), positions.max(axis=0).astype(np.float64)
    margin = _MARGIN * float(np.linalg.norm(high - low))
    low, high = low - margin, high + margin
    step = float((high - low).max()) / _BOX_SAMPLES
    axes = [np.arange(low[k] + 0.5 * step, high[k], step) for k in range(3)]
    places: list[F64] = []
    normals: list[F64] = []
    for axis in range(3):
        for end, sign in ((low, -1.0), (high, 1.0)):
            sides = [np.array([end[k]]) if k == axis else axes[k] for k in range(3)]
            face = np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, 3)
            places.append(face)
            normals.append(np.tile(sign * np.eye(3)[axis], (len(face), 1)))
    return np.concatenate(places), np.concatenate(normals)


def _is_within(surface: Any, places: F64, targets: F32) -> BoolArray:
    """(N,) whether places are in the solid: most rays from there first meet the back of it."""
    open3d = load_open3d()
    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(open3d.t.geometry.TriangleMesh.from_legacy(surface))
    votes = np.zeros(len(places))
    chosen = np.random.default_rng(0).integers(0, len(targets), _RAYS)
    for target in targets[chosen].astype(np.float64):
        ways = target - places
        rays = np.concatenate([places, ways], axis=1).astype(np.float32)
        met = scene.cast_rays(open3d.core.Tensor(rays))
        facing = (met["primitive_normals"].numpy() * ways).sum(axis=1)
        votes += np.where(np.isfinite(met["t_hit"].numpy()), np.sign(facing), 0.0)
    return votes > 0.0

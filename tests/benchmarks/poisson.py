"""Poisson reconstruction by Open3D, for comparison with our own meshes."""

from typing import Any

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32
from pliant.open3d_geometry import to_cloud
from pliant.open3d_library import load_open3d

NEIGHBOURS = 16
DEPTH = 8
CUT = 0.05
"""Share of the vertices, those with the fewest points about them, that Poisson made up."""


def poisson_mesh(points_world: F64, p_world_camera: F64) -> tuple[F32, F32, I32]:
    """Vertices, normals and triangles through points, normals towards the cameras that saw them.

    points_world, p_world_camera: (N, 3).
    """
    open3d: Any = load_open3d()
    cloud = to_cloud(points_world, None)
    cloud.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(NEIGHBOURS))
    normals = np.asarray(cloud.normals)
    away = (normals * (points_world - p_world_camera)).sum(axis=1) > 0.0
    normals[away] *= -1.0
    cloud.normals = open3d.utility.Vector3dVector(normals)
    mesh, density = open3d.geometry.TriangleMesh.create_from_point_cloud_poisson(
        cloud, depth=DEPTH, n_threads=1
    )
    mesh.remove_vertices_by_mask(np.asarray(density) < np.quantile(density, CUT))
    mesh.compute_vertex_normals()
    return (
        np.asarray(mesh.vertices, np.float32),
        np.asarray(mesh.vertex_normals, np.float32),
        np.asarray(mesh.triangles, np.int32),
    )

"""Poisson reconstruction by Open3D, for comparison with our own meshes."""

from importlib import import_module
from typing import Any

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32

NEIGHBOURS = 16
DEPTH = 8
CUT = 0.05
"""Share of the vertices, those with the fewest points about them, that Poisson made up."""


def poisson_mesh(points_world: F64, p_world_camera: F64) -> tuple[F32, F32, I32]:
    """Vertices, normals and triangles through points, normals towards the cameras that saw them.

    points_world, p_world_camera: (N, 3).  On Debian and Ubuntu Open3D needs libegl1, libgl1,
    libx11-6 and libusb-1.0-0.
    """
    open3d: Any = import_module("open3d")  # it takes 1-3 s
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points_world))
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

"""Our arrays as Open3D's clouds and meshes, and back."""

from typing import Any

import numpy as np

from pliant.algorithms.arrays import F32, F64, U8
from pliant.algorithms.meshing.mesh_blocks import TriangleMesh
from pliant.open3d_library import load_open3d


def to_cloud(positions: F64 | F32, colours: U8 | None, normals: F64 | F32 | None = None) -> Any:
    """``open3d.geometry.PointCloud`` of (N, 3) points, RGB colours and normals."""
    open3d = load_open3d()
    cloud = open3d.geometry.PointCloud(_rows(open3d, positions))
    if colours is not None:
        cloud.colors = _rows(open3d, colours / 255.0)
    if normals is not None:
        cloud.normals = _rows(open3d, normals)
    return cloud


def to_mesh(mesh: TriangleMesh) -> Any:
    """``open3d.geometry.TriangleMesh`` with colours and normals of the vertices."""
    open3d = load_open3d()
    made = open3d.geometry.TriangleMesh(
        _rows(open3d, mesh.positions),
        open3d.utility.Vector3iVector(np.ascontiguousarray(mesh.triangles)),
    )
    made.vertex_colors = _rows(open3d, mesh.colours / 255.0)
    made.vertex_normals = _rows(open3d, mesh.normals)
    return made


def from_mesh(mesh: Any) -> TriangleMesh:
    """Convert Open3D's mesh; its normals are computed from its triangles."""
    mesh.compute_vertex_normals()
    colours = 255.0 * np.asarray(mesh.vertex_colors, np.float64).reshape(-1, 3)
    return TriangleMesh(
        positions=np.asarray(mesh.vertices, np.float32),
        normals=np.asarray(mesh.vertex_normals, np.float32),
        colours=np.rint(np.clip(colours, 0.0, 255.0)).astype(np.uint8),
        triangles=np.asarray(mesh.triangles, np.int32),
    )


def _rows(open3d: Any, values: F64 | F32) -> Any:
    return open3d.utility.Vector3dVector(np.ascontiguousarray(values, np.float64))

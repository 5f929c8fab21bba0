"""From the points of a keyframe to a smooth mesh and its depth map (VITAMIN-E, section 4)."""

from pliant.algorithms.meshing.delaunay import Triangulation, triangulate
from pliant.algorithms.meshing.depth_rendering import DepthMap, render_depth
from pliant.algorithms.meshing.keyframe_surface import (
    KeyframeSurfaces,
    SeenPoints,
    Surface,
    SurfaceParameters,
)
from pliant.algorithms.meshing.mesh_blocks import BlockMesh, MeshBlocks, TriangleMesh
from pliant.algorithms.meshing.mesh_rendering import MeshView, view_mesh
from pliant.algorithms.meshing.nltgv import (
    NltgvParameters,
    NltgvResult,
    NltgvStart,
    carry_duals,
    smooth,
)
from pliant.algorithms.meshing.parameters import MeshingParameters
from pliant.algorithms.meshing.triangle_filter import TriangleFilterParameters, filter_triangles
from pliant.algorithms.meshing.tsdf_parameters import TsdfParameters
from pliant.algorithms.meshing.warm_up import warm_up

__all__ = [
    "BlockMesh",
    "DepthMap",
    "KeyframeSurfaces",
    "MeshBlocks",
    "MeshView",
    "MeshingParameters",
    "NltgvParameters",
    "NltgvResult",
    "NltgvStart",
    "SeenPoints",
    "Surface",
    "SurfaceParameters",
    "TriangleFilterParameters",
    "TriangleMesh",
    "Triangulation",
    "TsdfParameters",
    "carry_duals",
    "filter_triangles",
    "render_depth",
    "smooth",
    "triangulate",
    "view_mesh",
    "warm_up",
]

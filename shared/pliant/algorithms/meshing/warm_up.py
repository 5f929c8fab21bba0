"""Compiles every kernel of meshing by meshing a small synthetic keyframe."""

import numpy as np

from pliant.algorithms.arrays import F32
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.meshing.delaunay import triangulate
from pliant.algorithms.meshing.depth_rendering import render_depth
from pliant.algorithms.meshing.mesh_blocks import weld
from pliant.algorithms.meshing.nltgv import NltgvParameters, smooth
from pliant.algorithms.meshing.triangle_filter import TriangleFilterParameters, filter_triangles
from pliant.algorithms.meshing.tsdf_blocks import (
    SIDE,
    blocks_in_band,
    find_rows,
    make_table,
    with_neighbours,
)
from pliant.algorithms.meshing.tsdf_extract import TsdfArrays, extract_blocks
from pliant.algorithms.meshing.tsdf_integrate import add_sight, blocks_in_view
from pliant.algorithms.meshing.tsdf_pixels import intrinsics_of, pixel_planes

_POINTS, _VOXEL = 100, 0.1


def warm_up() -> None:
    """Run every kernel once, with the types of the real work."""
    camera = PinholeCamera(width=64, height=48, fx=60.0, fy=60.0, cx=31.5, cy=23.5)
    generator = np.random.default_rng(0)
    points = generator.uniform((0.0, 0.0), (64.0, 48.0), (_POINTS, 2)).astype(np.float32)
    mesh = triangulate(points)
    points = points[mesh.vertices]
    inverse_depths = generator.uniform(0.4, 0.5, len(points)).astype(np.float32)
    sigmas = np.full(len(points), 0.01, np.float32)
    result = smooth(points, inverse_depths, sigmas, mesh.edges, NltgvParameters(max_iterations=2))
    smoothed = result.inverse_depths
    kept = filter_triangles(
        mesh.triangles, points, smoothed, sigmas, np.full(len(points), 9, np.int32),
        camera, TriangleFilterParameters(),
    )  # fmt: skip
    depth = render_depth(mesh.triangles[kept], points, smoothed, sigmas, camera)
    _fuse(depth.depths, depth.weights, camera)


def _fuse(depth: F32, weight: F32, camera: PinholeCamera) -> None:
    pixels, K, pose = pixel_planes(depth, weight, camera), intrinsics_of(camera), np.eye(4)
    keys = blocks_in_band(pixels.planes, pixels.depths, K, pose, _VOXEL, 4 * _VOXEL)
    seen = blocks_in_view(
        keys, pose, K, pixels.furthest, camera.width, camera.height, _VOXEL, 4 * _VOXEL
    )
    keys = with_neighbours(keys[seen])
    shape, slots = (len(keys), SIDE, SIDE, SIDE), np.arange(len(keys), dtype=np.int32)
    distances, weights = np.zeros(shape, np.int32), np.zeros(shape, np.int32)
    colours = np.zeros((*shape, 4), np.int32)
    add_sight(
        keys, slots, pose, K, pixels.planes, pixels.weights,
        np.zeros((*depth.shape, 3), np.uint8), _VOXEL, 4 * _VOXEL, True, 1,
        distances, weights, colours,
    )  # fmt: skip
    table = make_table(keys)
    find_rows(table, keys)
    tsdf = TsdfArrays(table, slots, distances, weights, colours, _VOXEL, 4 * _VOXEL, 1)
    weld(extract_blocks(keys, tsdf))

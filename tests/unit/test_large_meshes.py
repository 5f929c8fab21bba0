"""What meshes of many triangles take in memory, beside themselves, to be drawn and decimated."""

import tracemalloc
from collections.abc import Callable

import numpy as np
import pytest
from wavy_meshes import grey, grid, waves

from pliant.algorithms.meshing.decimation import clustered, decimated
from pliant.algorithms.meshing.mesh_blocks import LATTICE, SIDE, MeshBlocks, TriangleMesh, weld
from pliant.algorithms.meshing.mesh_finish import finished
from pliant.algorithms.meshing.tsdf_closing import Evidence
from pliant.pictures.mesh import draw_mesh, mesh_view


def large() -> TriangleMesh:
    positions, triangles = waves(550)
    normals = np.tile(np.array([0.0, 0.0, 1.0], np.float32), (len(positions), 1))
    return TriangleMesh(
        positions=positions, normals=normals, colours=grey(positions).astype(np.uint8),
        triangles=triangles,
    )  # fmt: skip


def drawn(mesh: TriangleMesh) -> None:
    above = np.eye(4)[None].repeat(2, axis=0)
    above[:, 2, 3] = 2.0
    draw_mesh(mesh, mesh_view(mesh, above), size=(64, 48))


def made_few(mesh: TriangleMesh) -> None:
    clustered(mesh.positions, mesh.colours, mesh.triangles, 100_000)


def made_fewer(mesh: TriangleMesh) -> None:
    decimated(mesh.positions, mesh.colours, mesh.triangles, 550_000)


@pytest.mark.parametrize(("work", "most"), [(drawn, 130), (made_few, 150), (made_fewer, 400)])
def test_bytes_for_each_triangle_are_few(work: Callable[[TriangleMesh], None], most: int) -> None:
    mesh = large()
    tracemalloc.start()
    try:
        work(mesh)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak / len(mesh.triangles) < most


def test_finishing_takes_few_bytes_for_each_triangle() -> None:
    mesh = large()
    count = len(mesh.positions)
    evidence = Evidence(np.ones(count, np.float32), np.ones(count, np.float32))
    finished(mesh, lambda _: evidence, 0.01)
    tracemalloc.start()
    try:
        finished(mesh, lambda _: evidence, 0.01)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak / len(mesh.triangles) < 100


def many_blocks(side: int = 40) -> MeshBlocks:
    """Of a plane: each block has 81 vertices, those on its rim as its neighbours have them."""
    count, n = side * side, LATTICE
    keys = np.stack(np.meshgrid(np.arange(side), np.arange(side), [0], indexing="ij"), axis=-1)
    x, y = np.divmod(np.arange(n * n, dtype=np.int32), n)
    plane, triangles = grid(n)
    local = (plane[:, :2] * SIDE)[None] + keys.reshape(-1, 1, 3)[..., :2] * SIDE
    positions = np.concatenate([local, np.zeros((*local.shape[:2], 1))], axis=2)
    positions = positions.reshape(-1, 3).astype(np.float32)
    return MeshBlocks(
        keys=keys.reshape(-1, 3).astype(np.int32),
        vertex_counts=np.full(count, n * n, np.int32),
        triangle_counts=np.full(count, len(triangles), np.int32),
        edges=np.tile((y * n + x) * 3 + 2, count),
        positions=positions,
        normals=np.zeros_like(positions),
        colours=np.zeros(positions.shape, np.uint8),
        triangles=np.tile(triangles, (count, 1)),
    )


def test_blocks_are_welded_with_few_bytes_for_each_triangle() -> None:
    side = 40
    blocks = many_blocks(side)
    tracemalloc.start()
    try:
        mesh = weld(blocks)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert len(mesh.positions) == (side * SIDE + 1) ** 2
    assert len(mesh.triangles) == 2 * (side * SIDE) ** 2
    corners = mesh.positions[mesh.triangles]
    assert np.ptp(corners, axis=1).max() <= 1.0 + 1e-5  # each is where it was
    assert peak / len(mesh.triangles) < 70

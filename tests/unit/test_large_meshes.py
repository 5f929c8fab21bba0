"""What meshes of many triangles take in memory, beside themselves, to be drawn and decimated."""

import tracemalloc
from collections.abc import Callable

import numpy as np
import pytest
from test_decimation import grey, waves

from pliant.algorithms.meshing.decimation import clustered, decimated
from pliant.algorithms.meshing.mesh_blocks import TriangleMesh
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

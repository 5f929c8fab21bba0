"""Points that are an array and a cloud of Open3D's, and meshes likewise."""

import pickle
from typing import Any

import numpy as np
import pytest

from pliant.algorithms.meshing.mesh_blocks import TriangleMesh
from pliant.api.open3d_types import Mesh, PointArray
from pliant.compiler.kernel import kernel
from pliant.open3d_geometry import from_mesh
from pliant.open3d_library import Open3dError, load_open3d

POSITIONS = np.arange(12, dtype=np.float64).reshape(4, 3)
COLOURS = np.arange(12, dtype=np.uint8).reshape(4, 3) * 20


@pytest.fixture(scope="module")
def open3d() -> Any:
    try:
        return load_open3d()
    except Open3dError as error:
        pytest.skip(f"open3d is installed but cannot be loaded ({error})")


@kernel
def total(values: np.ndarray) -> float:
    return float(values[0, 0] + values[1, 1])


def test_points_are_an_array_as_before() -> None:
    points = PointArray.of(POSITIONS, COLOURS)
    assert isinstance(points, np.ndarray)
    np.testing.assert_array_equal(points, POSITIONS)
    np.testing.assert_array_equal(2.0 * points[1:] - 1.0, 2.0 * POSITIONS[1:] - 1.0)
    np.testing.assert_array_equal(np.linalg.norm(points, axis=1), np.linalg.norm(POSITIONS, axis=1))
    assert type(points.min()) is type(points.sum()) is np.float64
    assert type(points.mean(axis=0)) is type(points + 1.0) is type(points @ np.eye(3)) is np.ndarray
    assert np.asarray(points).base is not None  # nothing was copied
    assert total(points) == 4.0
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(points)), POSITIONS)
    assert points.tobytes() == POSITIONS.tobytes()


@pytest.mark.usefixtures("open3d")
def test_open3d_has_the_points_and_their_colours() -> None:
    points = PointArray.of(POSITIONS, COLOURS)
    cloud = points.to_open3d()
    np.testing.assert_array_equal(np.asarray(cloud.points), POSITIONS)
    np.testing.assert_array_equal(np.rint(255 * np.asarray(cloud.colors)), COLOURS)
    some = points[points[:, 0] > 4.0].to_open3d()
    assert (len(some.points), some.has_colors()) == (2, False)
    assert len(PointArray.of(POSITIONS[:0], COLOURS[:0]).to_open3d().points) == 0


@pytest.mark.usefixtures("open3d")
def test_a_mesh_goes_to_open3d_and_comes_back() -> None:
    positions = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], np.float32)
    mesh = Mesh(
        positions=positions,
        normals=np.tile(np.array([0, 0, 1], np.float32), (4, 1)),
        colours=COLOURS,
        triangles=np.array([[0, 1, 2], [1, 3, 2]], np.int32),
    )
    assert isinstance(mesh, TriangleMesh)
    made = mesh.to_open3d()
    assert made.has_vertex_normals()
    back = from_mesh(made)
    for name in ("positions", "normals", "colours", "triangles"):
        np.testing.assert_array_equal(getattr(back, name), getattr(mesh, name))
        assert getattr(back, name).dtype == getattr(mesh, name).dtype

"""Solids from surfaces with a border, pieces that are left out, sheets that touch."""

from dataclasses import replace

import numpy as np
import pytest

from pliant.algorithms.arrays import F32, F64, I32
from pliant.algorithms.meshing.mesh_blocks import TriangleMesh
from pliant.algorithms.meshing.mesh_components import areas_of, cleaned, components
from pliant.algorithms.meshing.touching import taken_apart
from pliant.errors import ResultError
from pliant.export.watertight import watertight
from pliant.open3d_library import Open3dError, load_open3d

CUBE = np.array(
    [
        *([0, 2, 1], [1, 2, 3], [4, 5, 6], [5, 7, 6], [0, 1, 4], [1, 5, 4]),
        *([2, 6, 3], [3, 6, 7], [0, 4, 2], [2, 4, 6], [1, 3, 5], [3, 7, 5]),
    ],
    np.int32,
)

CORNERS = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)], np.float32)


@pytest.fixture(scope="module")
def open3d() -> None:
    try:
        load_open3d()
    except Open3dError as error:
        pytest.skip(f"open3d is installed but cannot be loaded ({error})")


def uses(triangles: I32) -> np.ndarray:
    """(E,) how many triangles have each edge, in each of its two directions."""
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    assert len(np.unique(edges, axis=0)) == len(edges)  # no two triangles turn alike along one
    return np.unique(np.sort(edges, axis=1), axis=0, return_counts=True)[1]


def volume(positions: F32, triangles: I32) -> float:
    a, b, c = positions[triangles].astype(np.float64).transpose(1, 0, 2)
    return float((a * np.cross(b, c)).sum() / 6.0)


def sheet(heights: F64, colour: int = 90) -> TriangleMesh:
    """A relief over the unit square, seen from above."""
    side = len(heights)
    x, y = np.meshgrid(np.linspace(0, 1, side), np.linspace(0, 1, side), indexing="ij")
    positions = np.stack([x, y, heights], axis=-1).reshape(-1, 3).astype(np.float32)
    a = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).ravel()
    lower = np.stack([a, a + side, a + 1], axis=1)
    upper = np.stack([a + 1, a + side, a + side + 1], axis=1)
    step = 1.0 / (side - 1)
    slopes = [np.gradient(heights, step, axis=axis) for axis in (0, 1)]
    normals = np.stack([-slopes[0], -slopes[1], np.ones_like(heights)], axis=-1).reshape(-1, 3)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return TriangleMesh(
        positions=positions,
        normals=normals.astype(np.float32),
        colours=np.full((side * side, 3), colour, np.uint8),
        triangles=np.concatenate([lower, upper]).astype(np.int32),
    )


def relief(side: int = 60) -> TriangleMesh:
    x, y = np.meshgrid(np.linspace(0, 1, side), np.linspace(0, 1, side), indexing="ij")
    return sheet(0.1 * np.sin(6.0 * x) * np.cos(5.0 * y))


def test_cubes_that_touch_in_an_edge_are_two_afterwards() -> None:
    places = np.concatenate([CORNERS, CORNERS + np.array([0, 1, 1], np.float32)])
    second = np.array([6, 7, 10, 11, 12, 13, 14, 15], np.int32)[CUBE]
    both = np.concatenate([CUBE, second])
    edges = np.concatenate([both[:, [0, 1]], both[:, [1, 2]], both[:, [2, 0]]])
    assert np.unique(np.sort(edges, axis=1), axis=0, return_counts=True)[1].max() == 4
    positions, triangles = taken_apart(places, both)
    assert len(positions) == 16
    np.testing.assert_array_equal(positions[triangles], places[both])
    assert (uses(triangles) == 2).all()


def test_cubes_that_touch_in_a_corner_share_it_no_longer() -> None:
    places = np.concatenate([CORNERS, CORNERS[1:] + np.float32(1.0)])
    both = np.concatenate([CUBE, np.array([7, 8, 9, 10, 11, 12, 13, 14], np.int32)[CUBE]])
    positions, triangles = taken_apart(places, both)
    assert len(positions) == 16
    assert (uses(triangles) == 2).all()
    np.testing.assert_array_equal(positions[triangles], places[both])


def test_a_closed_surface_stays_as_it_is() -> None:
    positions, triangles = taken_apart(CORNERS, CUBE)
    np.testing.assert_array_equal(positions[triangles], CORNERS[CUBE])
    assert len(positions) == 8


def test_vertices_that_two_edges_join_get_one_between_them() -> None:
    """A ring of cubes about a hole whose sides touch: in space one edge, on the surface two."""
    cells = [(0, 0, 0), (1, 0, 0), (2, 0, 0), (2, 1, 0), (1, 1, 1), (0, 1, 0), (1, 1, -1)]
    cells += [(0, 1, 1), (2, 1, 1), (0, 1, -1), (2, 1, -1), (0, 0, 1), (2, 0, -1)]
    positions, triangles = taken_apart(*solid_of(cells))
    assert (uses(triangles) == 2).all()
    assert volume(positions, triangles) == pytest.approx(len(cells))


@pytest.mark.parametrize("seed", range(20))
def test_touching_parts_are_separated(seed: int) -> None:
    filled = np.argwhere(np.random.default_rng(seed).random((4, 4, 4)) < 0.5)
    places, both = solid_of([tuple(cell) for cell in filled.tolist()])
    positions, triangles = taken_apart(places, both)
    assert (uses(triangles) == 2).all()
    assert volume(positions, triangles) == pytest.approx(len(filled))


def solid_of(cells: list[tuple[int, ...]]) -> tuple[F32, I32]:
    """The surface of unit cubes, with one vertex in one place."""
    inside = set(cells)
    names: dict[tuple[int, ...], int] = {}
    triangles: list[list[int]] = []
    for cell in cells:
        for axis in range(3):
            for end in (0, 1):
                beyond = [*cell]
                beyond[axis] += 2 * end - 1
                if tuple(beyond) in inside:
                    continue
                u, v = (axis + 1) % 3, (axis + 2) % 3
                square: list[int] = []
                for a, b in ((0, 0), (1, 0), (1, 1), (0, 1)):
                    corner = [*cell]
                    corner[axis] += end
                    corner[u] += a
                    corner[v] += b
                    square.append(names.setdefault(tuple(corner), len(names)))
                square = square if end else square[::-1]
                triangles += [[square[0], *square[1:3]], [square[0], *square[2:4]]]
    return np.array(list(names), np.float32), np.array(triangles, np.int32)


@pytest.mark.parametrize("broken", [CUBE[1:], np.concatenate([CUBE[1:], CUBE[:1, ::-1]])])
def test_a_border_is_refused_and_so_is_a_triangle_turned_over(broken: I32) -> None:
    with pytest.raises(ValueError, match="not closed"):
        taken_apart(CORNERS, broken)


@pytest.mark.usefixtures("open3d")
def test_a_relief_becomes_a_solid_that_keeps_its_front() -> None:
    mesh = relief()
    solid = watertight(mesh)
    assert (uses(solid.triangles) == 2).all()
    assert volume(solid.positions, solid.triangles) > 0.05
    inside = mesh.positions[(np.abs(mesh.positions[:, :2] - 0.5) < 0.4).all(axis=1)]
    for place in inside[::97]:
        assert np.linalg.norm(solid.positions - place, axis=1).min() < 0.02
    front = (np.abs(solid.positions[:, :2] - 0.5) < 0.4).all(axis=1) & (solid.normals[:, 2] > 0.5)
    assert np.abs(solid.colours[front].astype(int) - 90).max() <= 2


@pytest.mark.usefixtures("open3d")
def test_the_same_mesh_gives_the_same_bytes() -> None:
    first, second = watertight(relief(40)), watertight(relief(40))
    for name in ("positions", "normals", "colours", "triangles"):
        assert getattr(first, name).tobytes() == getattr(second, name).tobytes()


@pytest.mark.usefixtures("open3d")
def test_a_sphere_observed_from_within_closes_by_itself() -> None:
    """A room of which nothing is missing: no box about it."""
    v, u = np.meshgrid(np.linspace(0, np.pi, 40)[1:-1], np.linspace(0, 2 * np.pi, 80)[:-1])
    ways = np.stack([np.sin(v) * np.cos(u), np.sin(v) * np.sin(u), np.cos(v)], -1).reshape(-1, 3)
    rows = np.arange(79 * 38).reshape(79, 38)
    a, b = rows[:, :-1].ravel(), rows[:, 1:].ravel()
    c, d = np.roll(rows, -1, axis=0)[:, :-1].ravel(), np.roll(rows, -1, axis=0)[:, 1:].ravel()
    triangles = np.concatenate([np.stack([a, b, c], 1), np.stack([b, d, c], 1)])
    room = TriangleMesh(
        positions=ways.astype(np.float32), normals=-ways.astype(np.float32),
        colours=np.full((len(ways), 3), 60, np.uint8), triangles=triangles.astype(np.int32),
    )  # fmt: skip
    solid = watertight(room)
    assert (uses(solid.triangles) == 2).all()
    np.testing.assert_allclose(np.linalg.norm(solid.positions, axis=1), 1.0, atol=0.03)


def test_pieces_that_are_small_beside_the_largest_are_left_out() -> None:
    large, small = relief(40), relief(40)
    crumb = (small.positions * np.float32(0.05) + np.float32(2.0)).astype(np.float32)
    both = TriangleMesh(
        positions=np.concatenate([crumb, large.positions]),
        normals=np.concatenate([small.normals, large.normals]),
        colours=np.concatenate([small.colours, large.colours]),
        triangles=np.concatenate([small.triangles, large.triangles + len(crumb)]),
    )
    kept = cleaned(both)
    for name in ("positions", "normals", "colours", "triangles"):
        np.testing.assert_array_equal(getattr(kept, name), getattr(large, name))
    none = replace(both, triangles=np.zeros((0, 3), np.int32))
    assert cleaned(none) is none


def test_areas_are_half_of_the_cross_product() -> None:
    generator = np.random.default_rng(0)
    positions = generator.normal(size=(30, 3)).astype(np.float32)
    triangles = generator.integers(0, 30, (50, 3)).astype(np.int32)
    a, b, c = (positions.astype(np.float64)[triangles[:, k]] for k in range(3))
    expected = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    np.testing.assert_allclose(areas_of(positions, triangles), expected, atol=1e-12)


def test_components_are_those_of_a_search_from_node_to_node() -> None:
    edges = np.random.default_rng(0).integers(0, 300, (180, 2))
    label = np.full(300, -1)
    for start in range(300):
        found, label[start] = [start], start if label[start] < 0 else label[start]
        while found:
            node = found.pop()
            near = np.concatenate([edges[edges[:, 0] == node, 1], edges[edges[:, 1] == node, 0]])
            found += near[label[near] < 0].tolist()
            label[near] = np.where(label[near] < 0, label[start], label[near])
    expected = np.unique(label, return_inverse=True)[1]
    np.testing.assert_array_equal(components(300, *edges.T.copy()), expected)


@pytest.mark.usefixtures("open3d")
def test_nothing_has_no_inside() -> None:
    none = np.zeros((0, 3), np.float32)
    empty = TriangleMesh(
        positions=none, normals=none, colours=none.astype(np.uint8), triangles=none.astype(np.int32)
    )
    with pytest.raises(ResultError):
        watertight(empty)

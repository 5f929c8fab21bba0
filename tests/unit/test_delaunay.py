"""Delaunay triangulation against scipy, by its definition, and on points that admit none."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import ConvexHull, Delaunay

from pliant.algorithms.arrays import F64, I32
from pliant.algorithms.meshing.delaunay import Triangulation, triangulate


def edges_of(triangles: I32) -> I32:
    pairs = np.vstack([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    return np.unique(np.sort(pairs, axis=1), axis=0)


def areas(points: F64, triangles: I32) -> F64:
    a, b, c = (points[triangles[:, k]] for k in range(3))
    return ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]) / 2.0


def check_structure(points: F64, result: Triangulation) -> None:
    """Canonical order, edges of the triangles, and the convex hull is covered exactly once."""
    kept = points[result.vertices]
    raster = np.lexsort((kept[:, 0], kept[:, 1]))
    np.testing.assert_array_equal(raster, np.arange(len(kept)))
    triangles = result.triangles
    assert np.all(triangles[:, :1] < triangles[:, 1:])
    np.testing.assert_array_equal(triangles, triangles[np.lexsort(triangles.T[::-1])])
    assert np.all(areas(kept, triangles) > 0.0)
    if len(triangles):
        np.testing.assert_array_equal(result.edges, edges_of(triangles))
        assert set(range(len(kept))) == set(np.unique(triangles).tolist())
        # Euler: M - E + (T + 1) = 2.
        assert len(kept) - len(result.edges) + len(triangles) == 1


def circumcircle_excess(points: F64, triangle: I32) -> float:
    """How far the nearest other point is outside the circumcircle, over the radius."""
    a, b, c = (complex(*points[k]) for k in triangle)
    w = (c - a) / (b - a)
    centre = a + (b - a) * (w - abs(w) ** 2) / (2j * w.imag)
    distance = np.abs(points @ np.array([1.0, 1.0j]) - centre)
    radius = abs(a - centre)
    distance[triangle] = np.inf
    return float((distance.min() - radius) / radius)


@pytest.mark.parametrize("count", [3, 4, 5, 6, 9, 40, 500, 3000])
def test_equals_scipy_on_random_points(count: int) -> None:
    for seed in range(3):
        generator = np.random.default_rng(seed)
        # On the grid of the predicates, so that both triangulate the same points.
        points = np.unique(generator.integers(0, 1 << 19, (count, 2)), axis=0) / 1024.0
        points = generator.permutation(np.vstack([points, [[0.0, 0.0], [639.0, 600.0]]]))
        result = triangulate(points)
        check_structure(points, result)
        reference = Delaunay(points[result.vertices]).simplices.astype(np.int32)
        np.testing.assert_array_equal(result.edges, edges_of(reference))


@given(
    st.lists(st.tuples(st.integers(0, 12), st.integers(0, 12)), min_size=3, max_size=60),
    st.randoms(use_true_random=False),
)
def test_circles_are_empty_and_the_order_of_points_does_not_matter(
    cells: list[tuple[int, int]], shuffle: object
) -> None:
    points = np.array(cells, dtype=np.float64)
    result = triangulate(points)
    check_structure(points, result)
    kept = points[result.vertices]
    assert len(kept) == len(set(cells))
    for triangle in result.triangles:
        assert len(kept) == 3 or circumcircle_excess(kept, triangle) > -1e-9
    hull = areas(kept, result.triangles).sum()
    if len(result.triangles):
        assert hull == pytest.approx(ConvexHull(kept).volume)
    shuffle.shuffle(cells)  # type: ignore[attr-defined]
    again = np.array(cells, dtype=np.float64)
    other = triangulate(again)
    np.testing.assert_array_equal(again[other.vertices], kept)
    np.testing.assert_array_equal(other.triangles, result.triangles)
    np.testing.assert_array_equal(other.edges, result.edges)


def test_order_of_many_points_does_not_matter() -> None:
    generator = np.random.default_rng(3)
    points = generator.uniform((0, 0), (640, 480), (2000, 2)).astype(np.float32)
    order = generator.permutation(2000)
    first, second = triangulate(points), triangulate(points[order])
    assert first.triangles.tobytes() == second.triangles.tobytes()
    assert first.edges.tobytes() == second.edges.tobytes()
    np.testing.assert_array_equal(first.vertices, order[second.vertices])


def test_grid_of_cocircular_points() -> None:
    u, v = np.meshgrid(np.arange(40.0), np.arange(30.0))
    points = np.column_stack([u.ravel(), v.ravel()])
    result = triangulate(points)
    check_structure(points, result)
    assert len(result.triangles) == 2 * 39 * 29


def test_points_on_one_circle() -> None:
    angle = np.linspace(0.0, 2.0 * np.pi, 200, endpoint=False)
    points = np.column_stack([300.0 + 200.0 * np.cos(angle), 300.0 + 200.0 * np.sin(angle)])
    points = np.round(points * 1024.0) / 1024.0
    result = triangulate(points)
    check_structure(points, result)
    assert len(result.triangles) == 198


@pytest.mark.parametrize("direction", [(1.0, 0.0), (0.0, 1.0), (1.0, 1.0), (2.0, -3.0)])
def test_collinear_points_have_edges_but_no_triangles(direction: tuple[float, float]) -> None:
    for count in (3, 4, 5, 33, 100):
        points = np.arange(float(count))[:, None] * np.array(direction) + (0.0, 300.0)
        result = triangulate(np.random.default_rng(0).permutation(points))
        assert len(result.vertices) == count
        assert len(result.triangles) == 0
        assert len(result.edges) == count - 1


@pytest.mark.parametrize("count", [0, 1, 2])
def test_too_few_points(count: int) -> None:
    result = triangulate(np.array([[1.0, 2.0], [3.0, 4.0]])[:count])
    assert len(result.vertices) == count
    assert len(result.triangles) == 0
    assert len(result.edges) == max(0, count - 1)


def test_points_that_are_not_finite_or_double_are_left_out() -> None:
    nan, inf = float("nan"), float("inf")
    points = np.array([[nan, 1], [5, 5], [9, 0], [5, 5], [0, 0], [inf, 3], [5, 5], [3, -inf]])
    result = triangulate(points)
    assert result.vertices.tolist() == [4, 2, 1]
    assert result.triangles.tolist() == [[0, 1, 2]]
    assert len(triangulate(np.full((5, 2), nan)).vertices) == 0
    assert triangulate(np.full((5, 2), 7.0)).vertices.tolist() == [0]


@pytest.mark.parametrize("scale", [1e-300, 1e-30, 1e30, 1e307])
def test_any_extent_is_triangulated(scale: float) -> None:
    points = np.array([[-5.0, 0.0], [5.0, 1.0], [0.0, 7.0], [1.0, 2.0]]) * scale
    assert len(triangulate(points).triangles) == 3


def test_wrong_shape_is_refused() -> None:
    with pytest.raises(ValueError, match="points_px"):
        triangulate(np.zeros((4, 3)))

"""Depth maps of meshes against planes known exactly, and which triangles are kept."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pliant.algorithms.arrays import F32, F64, I32
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.meshing.delaunay import triangulate
from pliant.algorithms.meshing.keyframe_surface import filter_triangles
from pliant.algorithms.meshing.parameters import TriangleFilterParameters
from pliant.algorithms.meshing.rendering import normals_of, render_depth

CAMERA = PinholeCamera(width=80, height=60, fx=70.0, fy=75.0, cx=38.5, cy=31.0)
LOOSE = TriangleFilterParameters(
    max_edge_px=1e4, max_depth_ratio=1e4, max_slant_deg=90.0, min_observations=1
)


def rays() -> F64:
    u, v = np.meshgrid(np.arange(80.0), np.arange(60.0))
    return np.stack([(u - 38.5) / 70.0, (v - 31.0) / 75.0, np.ones_like(u)], axis=-1)


def random_mesh(count: int, seed: int) -> tuple[F32, I32]:
    """Vertices beyond the image on all sides, so that it is covered."""
    generator = np.random.default_rng(seed)
    points = generator.uniform((-40, -40), (120, 100), (count, 2)).astype(np.float32)
    corners = np.array([[-50, -50], [130, -50], [-50, 110], [130, 110]], np.float32)
    points = np.vstack([points, corners])
    mesh = triangulate(points)
    return points[mesh.vertices], mesh.triangles


@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (0.3, -0.2, 1.0), (-0.6, 0.1, 0.9)])
def test_a_plane_has_its_exact_depth_and_slant_everywhere(
    normal: tuple[float, float, float],
) -> None:
    points, triangles = random_mesh(150, 0)
    n = np.array(normal) / np.linalg.norm(normal)
    distance = 2.5
    at = np.column_stack([(points - (38.5, 31.0)) / (70.0, 75.0), np.ones(len(points))])
    inverse = (at @ n / distance).astype(np.float32)
    result = render_depth(triangles, points, inverse, np.zeros_like(inverse), CAMERA)
    expected = rays() @ n / distance
    np.testing.assert_allclose(1.0 / result.depths[expected > 0.02], expected[expected > 0.02],
                               rtol=1e-5)  # fmt: skip
    cosine = expected * distance / np.linalg.norm(rays(), axis=-1)
    np.testing.assert_allclose(result.weights, cosine, atol=1e-4)


def test_the_nearer_surface_wins_in_any_order() -> None:
    square = np.array([[10, 10], [50, 10], [50, 40], [10, 40]], np.float32)
    points = np.vstack([square, square + np.float32(15)])
    inverse = np.repeat(np.array([0.25, 0.5], np.float32), 4)
    quads = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], np.int32)
    sigmas = np.zeros(8, np.float32)
    first = render_depth(quads, points, inverse, sigmas, CAMERA)
    second = render_depth(quads[::-1].copy(), points, inverse, sigmas, CAMERA)
    np.testing.assert_array_equal(first.depths, second.depths)
    assert first.depths[30, 30] == 2.0
    assert first.depths[12, 12] == 4.0
    assert first.depths[5, 5] == 0.0
    assert first.weights[5, 5] == 0.0
    # Half open: 40 x 30 pixel centres, those on the lower and right borders are outside.
    assert np.count_nonzero(render_depth(quads[:2], points, inverse, sigmas, CAMERA).depths) == 1200


@given(st.integers(0, 10_000), st.booleans())
def test_neighbours_leave_no_gap_and_no_overlap(seed: int, on_grid: bool) -> None:
    generator = np.random.default_rng(seed)
    points = generator.uniform((5, 5), (75, 55), (12, 2)).astype(np.float32)
    if on_grid:
        points = np.round(points)
    mesh = triangulate(points)
    points = points[mesh.vertices]
    inverse, sigmas = np.ones(len(points), np.float32), np.zeros(len(points), np.float32)
    covered = np.zeros((60, 80), np.int64)
    for triangle in mesh.triangles:
        # Corners in any turn.
        order = generator.permutation(3)
        covered += render_depth(triangle[None, order], points, inverse, sigmas, CAMERA).depths > 0
    whole = render_depth(mesh.triangles, points, inverse, sigmas, CAMERA).depths > 0
    assert covered.max(initial=0) <= 1
    np.testing.assert_array_equal(covered > 0, whole)
    # The hull is convex, so every row is one run.
    runs = np.abs(np.diff(np.pad(whole, ((0, 0), (1, 1))).astype(np.int64), axis=1)).sum(axis=1)
    assert runs.max(initial=0) <= 2


def test_uncertain_depth_weighs_less() -> None:
    points, triangles = random_mesh(20, 1)
    inverse = np.full(len(points), 0.5, np.float32)
    sure = render_depth(triangles, points, inverse, np.zeros_like(inverse), CAMERA)
    unsure = render_depth(triangles, points, inverse, np.float32(0.01) * inverse, CAMERA)
    np.testing.assert_allclose(unsure.weights, sure.weights / 2.0, rtol=1e-5)


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -1.0, 0.0])
def test_corners_that_are_no_depth_are_left_out(bad: float) -> None:
    points = np.array([[5, 5], [60, 5], [5, 50], [60, 50]], np.float32)
    triangles = np.array([[0, 1, 2], [1, 3, 2]], np.int32)
    inverse = np.array([1, 1, 1, bad], np.float32)
    sigmas = np.zeros(4, np.float32)
    alone = render_depth(triangles[:1], points, inverse, sigmas, CAMERA)
    both = render_depth(triangles, points, inverse, sigmas, CAMERA)
    np.testing.assert_array_equal(alone.depths, both.depths)
    points[3] = bad if not bad <= 0.0 else np.nan
    inverse[3] = 1.0
    both = render_depth(triangles, points, inverse, sigmas, CAMERA)
    np.testing.assert_array_equal(alone.depths, both.depths)
    none = render_depth(np.zeros((0, 3), np.int32), points, inverse, sigmas, CAMERA)
    assert not none.depths.any()


def test_triangles_far_outside_cost_and_cover_nothing() -> None:
    points = np.array([[-1e9, -1e9], [-1e9, -9e8], [-9e8, -1e9], [5, 1e8], [5, 2e8], [7, 1e8]])
    triangles = np.array([[0, 1, 2], [3, 4, 5]], np.int32)
    ones = np.ones(6, np.float32)
    assert not render_depth(triangles, points.astype(np.float32), ones, ones, CAMERA).depths.any()


def kept(
    depths: list[float], parameters: TriangleFilterParameters, *,
    points: list[tuple[float, float]] | None = None, sigma: float = 0.0, observations: int = 5,
) -> bool:  # fmt: skip
    px = np.array(points or [(30.0, 30.0), (40.0, 30.0), (30.0, 40.0)], np.float32)
    inverse = np.float32(1.0) / np.array(depths, np.float32)
    result = filter_triangles(
        np.array([[0, 1, 2]], np.int32), px, inverse, np.float32(sigma) * inverse,
        np.full(3, observations, np.int32), CAMERA, parameters,
    )  # fmt: skip
    return bool(result[0])


def test_what_is_not_surface_is_dropped() -> None:
    assert kept([2.0, 2.0, 2.0], TriangleFilterParameters())
    jump = LOOSE.model_copy(update={"max_depth_ratio": 1.2})
    assert kept([2.0, 2.3, 2.0], jump)
    assert not kept([2.0, 2.5, 2.0], jump)
    long = LOOSE.model_copy(update={"max_edge_px": 14.0})
    assert not kept([2.0, 2.0, 2.0], long)
    assert kept([2.0, 2.0, 2.0], LOOSE.model_copy(update={"max_edge_px": 14.2}))
    assert not kept([2.0, 2.0, 2.0], LOOSE, sigma=0.2)
    assert not kept([2.0, 2.0, 2.0], LOOSE.model_copy(update={"min_observations": 6}))
    assert not kept([2.0, float("nan"), 2.0], LOOSE)
    assert not kept([2.0, -2.0, 2.0], LOOSE)
    assert not kept([2.0, 2.0, 2.0], LOOSE, points=[(30, 30), (40, 30), (float("nan"), 40)])


@pytest.mark.parametrize("slant_deg", [0.0, 30.0, 60.0, 75.0])
def test_slant_is_the_angle_between_normal_and_ray(slant_deg: float) -> None:
    # A small triangle around the principal point, turned about the vertical.
    tangent = np.tan(np.radians(slant_deg))
    points = [(38.0, 30.5), (39.0, 30.5), (38.5, 31.9)]
    depths = [2.0 / (1.0 - tangent * (u - 38.5) / 70.0) for u, _ in points]
    above = LOOSE.model_copy(update={"max_slant_deg": slant_deg + 1.0})
    assert kept(depths, above, points=points)
    if slant_deg:
        below = LOOSE.model_copy(update={"max_slant_deg": slant_deg - 1.0})
        assert not kept(depths, below, points=points)


def test_normals_are_those_of_the_planes_up_to_the_edge_between_them():
    u, v = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, 0.0 * u + 1.0], -1)
    near, far = np.array([0.3, -0.2, 0.8]), np.array([-0.1, 0.1, 0.3])
    left = u < 40
    planes = np.where(left[..., None], near, far)
    depths = (1.0 / (planes * rays).sum(axis=-1)).astype(np.float32)
    depths[10:12, 20:22] = 0.0
    normals = normals_of(depths, CAMERA)
    expected = -planes / np.linalg.norm(planes, axis=-1, keepdims=True)
    expected[10:12, 20:22] = 0.0
    np.testing.assert_allclose(normals, expected, atol=1e-3)
    alone = np.zeros_like(depths)
    alone[30, 30] = 1.0
    assert not normals_of(alone, CAMERA).any()

"""What a camera sees of a mesh, against planes known exactly; surfaces within a distance."""

import numpy as np
import pytest

from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import so3_exp
from pliant.algorithms.meshing.mesh_blocks import TriangleMesh
from pliant.algorithms.meshing.rendering import view_mesh
from pliant.evaluation.criteria import Similarity
from pliant.evaluation.mesh_truth import MeshEvaluation, format_mesh
from pliant.evaluation.surface_distance import sample_surface, share_within, thin_out

CAMERA = PinholeCamera(width=80, height=60, fx=70.0, fy=75.0, cx=38.5, cy=31.0)
NONE = np.zeros((0, 3))


def wall(z: float = 3.0, cells: int = 20) -> tuple[np.ndarray, np.ndarray]:
    """A grid of triangles in the plane z, larger than what the camera sees."""
    side = np.linspace(-4.0, 4.0, cells + 1)
    x, y = np.meshgrid(side, side)
    points = np.stack([x, y, np.full_like(x, z)], axis=-1).reshape(-1, 3).astype(np.float32)
    a = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).ravel()
    b, c, d = a + 1, a + cells + 1, a + cells + 2
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([b, d, c], 1)]).astype(np.int32)
    return points, faces


def test_a_slanted_wall_has_its_exact_depth_and_place_at_every_pixel() -> None:
    points, faces = wall()
    T = np.eye(4)
    T[:3, :3] = so3_exp(np.array([[0.1, -0.3, 0.05]]))[0]
    T[:3, 3] = (0.2, -0.1, 0.3)
    view = view_mesh(points, faces, CAMERA, T)
    assert (view.depths > 0.0).all()
    u, v = np.meshgrid(np.arange(80.0), np.arange(60.0))
    rays = np.stack([(u - 38.5) / 70.0, (v - 31.0) / 75.0, np.ones_like(u)], axis=-1)
    true = (3.0 - T[2, 3]) / (rays @ T[2, :3])
    np.testing.assert_allclose(view.depths, true, rtol=1e-5)
    seen = view.interpolate(faces, points)
    np.testing.assert_allclose(seen, rays * true[..., None] @ T[:3, :3].T + T[:3, 3], atol=1e-4)


def test_the_nearest_of_two_walls_is_seen_and_what_lies_behind_is_not_drawn() -> None:
    near, faces = wall(2.0)
    far, _ = wall(3.0)
    behind, _ = wall(-1.0)
    points = np.concatenate([far, near, behind])
    everything = np.concatenate([faces, faces + len(near), faces + 2 * len(near)])
    view = view_mesh(points, everything, CAMERA, np.eye(4))
    np.testing.assert_allclose(view.depths, 2.0, rtol=1e-6)
    empty = view_mesh(behind, faces, CAMERA, np.eye(4))
    assert not empty.depths.any()
    assert (empty.triangles == -1).all()


def test_samples_of_a_wall_and_what_is_within_a_distance() -> None:
    points, faces = wall()
    samples = sample_surface(points.astype(np.float64), faces, 0.1)
    assert abs(len(samples) - 6400) < 80
    np.testing.assert_allclose(samples[:, 2], 3.0)
    thin = thin_out(samples, 0.2)
    assert 1500 < len(thin) <= 1681
    generator = np.random.default_rng(0)
    others = np.array([0.0, 0.0, 3.0]) + generator.uniform(-4.0, 4.0, (500, 3))
    near = np.linalg.norm(others[:, None] - samples, axis=-1).min(axis=1) <= 0.15
    assert share_within(others, samples, 0.15) == near.mean()
    assert share_within(others, NONE, 1.0) == share_within(NONE, others, 1.0) == 0.0


STILL = Similarity(scale=1.0, R=np.eye(3), t=np.zeros(3))


def evaluate(points: np.ndarray, faces: np.ndarray, scale: float = 1.0) -> MeshEvaluation:
    normals = np.tile(np.array([0.0, 0.0, -1.0], np.float32), (len(points), 1))
    no_colours = np.zeros((0, 3), np.uint8)
    mesh = TriangleMesh(positions=points, normals=normals, colours=no_colours, triangles=faces)
    alignment = Similarity(scale=scale, R=np.eye(3), t=np.zeros(3))
    evaluation = MeshEvaluation(mesh, alignment, CAMERA)
    evaluation.add(np.full((60, 80), 3.0), np.eye(4), np.eye(4))
    return evaluation


def test_the_true_wall_at_another_scale_is_perfect_but_for_what_the_view_does_not_see() -> None:
    points, faces = wall()
    found = evaluate(points / np.float32(2.0), faces, scale=2.0).result()
    assert found.covered == 1.0
    assert found.median_error < 1e-6
    assert found.within == found.recall == 1.0
    assert found.normal_deg < 0.1
    seen = (80 / 70.0 * 3.0) * (60 / 75.0 * 3.0) / 64.0
    assert abs(found.precision - seen) < 0.05
    assert "100.0 % of the true depth" in format_mesh(found)


def test_a_wall_ten_percent_too_far_is_so_until_its_scale_is_fitted() -> None:
    points, faces = wall(3.3)
    found = evaluate(points, faces).result()
    assert abs(found.median_error - 0.1) < 1e-3
    assert found.within == found.f_score == 0.0
    assert abs(found.fitted_scale - 1.0 / 1.1) < 1e-3
    assert found.fitted_median_error < 1e-3


def test_normals_of_ground_truth_with_the_noise_of_a_depth_camera() -> None:
    """Slopes between pixels magnify it; planes of windows average it out."""
    normal = np.array([0.3, -0.2, -1.0])
    normal /= np.linalg.norm(normal)
    generator = np.random.default_rng(0)
    u, v = np.meshgrid(np.arange(80.0), np.arange(60.0))
    rays = np.dstack([CAMERA.normalise(np.dstack([u, v]).reshape(-1, 2)).reshape(60, 80, 2),
                      np.ones_like(u)])  # fmt: skip
    exact = -3.0 / (rays @ normal)
    noisy = exact * (1.0 + 0.001 * generator.standard_normal(exact.shape))
    points = (rays * exact[..., None])[::59, ::79].reshape(-1, 3).astype(np.float32)
    faces = np.array([[0, 1, 2], [1, 3, 2]], np.int32)
    for depth, noise in ((exact, 0.0), (noisy, 2.0)):
        mesh = TriangleMesh(
            positions=points, normals=np.tile(normal.astype(np.float32), (4, 1)),
            colours=np.zeros((4, 3), np.uint8), triangles=faces,
        )  # fmt: skip
        evaluation = MeshEvaluation(mesh, STILL, CAMERA)
        evaluation.add(depth, np.eye(4), np.eye(4))
        found = evaluation.result()
        assert found.plane_normal_deg < 0.05 + 0.5 * noise
        for magnified in (found.normal_deg, found.truth_noise_deg):
            assert noise <= magnified < 0.05 + 4.0 * noise


def test_no_mesh_covers_nothing() -> None:
    found = evaluate(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32)).result()
    assert found.covered == found.f_score == 0.0
    assert np.isnan(found.median_error)


def test_a_displaced_wall_shows_in_its_columns_and_vertices() -> None:
    """ICP moves it back; true depth at our own poses has no error where those are true."""
    points, faces = wall(3.1)
    measured = evaluate(points, faces)
    columns = measured.columns()
    assert columns["trajectory"].completion_m == pytest.approx(0.1, rel=0.02)
    assert columns["icp"].completion_m < 0.02
    assert columns["floor"].chamfer_m == 0.0
    distances, diameter = measured.distances(0.05)
    assert diameter == pytest.approx(np.hypot(79 / 70.0 * 3.0, 59 / 75.0 * 3.0), rel=1e-6)
    near = (np.abs(points[:, 0]) < 1.0) & (np.abs(points[:, 1]) < 0.7)
    np.testing.assert_allclose(distances[near], 0.1, atol=0.01)
    assert np.isinf(distances[np.abs(points[:, 0]) > 3.0]).all()


def test_no_mesh_has_no_columns() -> None:
    nothing = evaluate(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32))
    assert nothing.columns() == {}
    assert nothing.distances(0.01)[0].shape == (0,)

"""The renderer's geometry against closed forms: depth, normals, faces, tiles."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pliant.algorithms.arrays import F64
from pliant.algorithms.camera import PinholeCamera
from pliant.rendering.face_textures import face_frame
from pliant.rendering.intersect import face_point, hit_solid
from pliant.rendering.lens import NO_DISTORTION, pixel_rays
from pliant.rendering.paths import look_at
from pliant.rendering.render import SceneGeometry
from pliant.rendering.scenes import SCENES
from pliant.rendering.solids import KINDS, Kind, Scene, Solid, Vector

CAMERA = PinholeCamera(width=70, height=50, fx=60.0, fy=60.0, cx=34.5, cy=24.5)
RAYS = pixel_rays(CAMERA, NO_DISTORTION)
UP = np.array([0.0, 0.0, 1.0])


def scene_of(
    kind: Kind, centre: Vector, size: Vector, rotation: Vector = (0, 0, 0)
) -> SceneGeometry:
    solid = Solid(name="it", kind=kind, centre=centre, size=size, rotation=rotation)
    return SceneGeometry(Scene(name="one", solids=(solid,), lights=()))


def world_rays(T_world_camera: F64) -> F64:
    rays = np.concatenate([RAYS, np.ones((*RAYS.shape[:2], 1))], axis=2)
    return rays @ T_world_camera[:3, :3].T


def test_a_wall_ahead_has_one_depth():
    geometry = scene_of("box", (0.0, 0.0, 2.5), (50.0, 50.0, 1.0))
    surface = geometry.surface(np.eye(4), RAYS)
    np.testing.assert_allclose(surface.depth_m, 2.0, rtol=1e-14)
    assert (surface.faces == 4).all()
    np.testing.assert_array_equal(surface.normals, np.broadcast_to([0.0, 0.0, -1.0], (50, 70, 3)))


def test_a_slanted_plane_has_the_depth_of_its_equation():
    angle = 0.4
    geometry = scene_of("box", (0.0, 0.0, 3.0), (90.0, 90.0, 0.5), (0.0, angle, 0.0))
    normal = np.array([np.sin(angle), 0.0, np.cos(angle)])
    on_plane = np.array([0.0, 0.0, 3.0]) - 0.25 * normal
    expected = (normal @ on_plane) / (world_rays(np.eye(4)) @ normal)
    np.testing.assert_allclose(geometry.depth(np.eye(4), RAYS), expected, rtol=1e-12)


def test_a_sphere_has_the_depth_of_its_quadratic_and_radial_normals():
    centre = np.array([0.1, -0.05, 2.0])
    geometry = scene_of("sphere", (0.1, -0.05, 2.0), (1.0, 1.0, 1.0))
    surface = geometry.surface(np.eye(4), RAYS)
    rays = world_rays(np.eye(4))
    a, b = (rays**2).sum(axis=2), rays @ centre
    root = b**2 - a * (centre @ centre - 0.25)
    expected = np.where(root > 0.0, (b - np.sqrt(np.maximum(root, 0.0))) / a, 0.0)
    np.testing.assert_allclose(surface.depth_m, expected, rtol=1e-12)
    hit = surface.faces >= 0
    points = rays[hit] * surface.depth_m[hit][:, None]
    np.testing.assert_allclose(surface.normals[hit], (points - centre) / 0.5, atol=1e-12)


def test_a_cylinder_shows_its_side_and_its_top():
    geometry = scene_of("cylinder", (0.0, 0.0, 0.0), (0.6, 0.6, 0.8))
    T = look_at(np.array([1.2, 0.9, 1.1]), np.zeros(3), up=UP)
    surface = geometry.surface(T, RAYS)
    hit = surface.faces >= 0
    points = world_rays(T)[hit] * surface.depth_m[hit][:, None] + T[:3, 3]
    faces, radius = surface.faces[hit], np.hypot(points[:, 0], points[:, 1])
    assert set(faces.tolist()) == {0, 1}
    np.testing.assert_allclose(radius[faces == 0], 0.3, atol=1e-12)
    np.testing.assert_allclose(points[faces == 1, 2], 0.4, atol=1e-12)
    assert (radius[faces == 1] <= 0.3).all()


def test_from_inside_a_room_every_ray_ends_on_its_walls():
    size = (4.0, 3.0, 2.5)
    geometry = scene_of("room", (0.0, 0.0, 0.0), size)
    T = look_at(np.array([-1.0, 0.4, 0.2]), np.array([2.0, 1.0, -0.5]), up=UP)
    surface = geometry.surface(T, RAYS)
    points = world_rays(T) * surface.depth_m[:, :, None] + T[:3, 3]
    part = np.abs(points) / (np.array(size) / 2.0)
    np.testing.assert_allclose(part.max(axis=2), 1.0, rtol=1e-12)
    # Normals look at the camera.
    assert ((T[:3, 3] - points) * surface.normals).sum(axis=2).min() > 0.0


def test_the_nearer_solid_hides_the_farther_one_in_any_order():
    near = Solid(name="near", kind="box", centre=(0.0, 0.0, 2.0), size=(0.5, 0.5, 0.2))
    far = Solid(name="far", kind="sphere", centre=(0.0, 0.0, 4.0), size=(2.0, 2.0, 2.0))
    depths = [
        SceneGeometry(Scene(name="s", solids=solids, lights=())).depth(np.eye(4), RAYS)
        for solids in ((near, far), (far, near))
    ]
    np.testing.assert_array_equal(depths[0], depths[1])
    assert depths[0][24, 34] == pytest.approx(1.9)


@pytest.mark.parametrize("name", sorted(SCENES))
def test_tiles_list_every_visible_solid(name: str):
    """The culled kernel against a plain search over all solids, at random pixels."""
    builtin = SCENES[name]()
    geometry = SceneGeometry(builtin.scene)
    solids, rng = geometry.solids, np.random.default_rng(0)
    for time_s in np.linspace(0.0, builtin.path.duration_s, 4):
        T = builtin.path.T_world_camera(float(time_s))
        depth = geometry.depth(T, RAYS)
        rays = world_rays(T)
        for row, col in zip(rng.integers(0, 50, 60), rng.integers(0, 70, 60), strict=True):
            best = np.inf
            for s in range(len(solids.kind)):
                R = solids.rotation[s]
                o, d = R.T @ (T[:3, 3] - solids.centre[s]), R.T @ rays[row, col]
                t = hit_solid(int(solids.kind[s]), *o, *d, *solids.half[s])
                best = t if 0.02 < t < best else best
            assert depth[row, col] == pytest.approx(best, rel=1e-9)


@settings(max_examples=60)
@given(
    kind=st.sampled_from(range(len(KINDS))),
    face=st.integers(0, 5),
    u=st.floats(0.02, 0.98),
    v=st.floats(0.02, 0.98),
)
def test_texture_coordinates_lead_to_the_point_and_back(kind: int, face: int, u: float, v: float):
    half = np.array([0.7, 0.7, 1.1]) if kind == 3 else np.array([0.7, 0.5, 1.1])
    if kind == 2:
        half = np.array([0.7, 0.7, 0.7])
    face = face % 3 if kind == 3 else face
    hx, hy, hz = half
    if kind == 3:
        sizes = [(2 * np.pi * hx, 2 * hz), (2 * hx, 2 * hx), (2 * hx, 2 * hx)][face]
        if face > 0:  # stay on the round end
            u, v = 0.5 + 0.6 * (u - 0.5), 0.5 + 0.6 * (v - 0.5)
    elif kind == 2:
        sizes = (np.pi / 2 * hx, np.pi / 2 * hx)
    else:
        sizes = [(2 * hy, 2 * hz), (2 * hx, 2 * hz), (2 * hx, 2 * hy)][face // 2]
    u, v = u * sizes[0], v * sizes[1]
    points, normals = face_frame(kind, face, half, np.array([u]), np.array([v]))
    found = face_point(kind, *points[0], *half)
    assert found[0] == face
    np.testing.assert_allclose(found[1:3], (u, v), atol=1e-9)
    np.testing.assert_allclose(found[3:], normals[0], atol=1e-9)

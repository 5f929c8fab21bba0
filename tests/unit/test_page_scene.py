"""What report.html shows at first."""

import base64
import json

import numpy as np
import pytest

from pliant.algorithms.arrays import F64
from pliant.algorithms.meshing.mesh_blocks import TriangleMesh
from pliant.results.page.scene import make_scene

ASPECT = 4.0 / 3.0
FOCAL = 2.4  # of viewer.js: to the upper border, half a height


def shown_at(header: str, points: F64) -> F64:
    """(N, 2) shares of half a canvas, right and up, as viewer.js draws points at first."""
    view = json.loads(header)
    right, up, level = np.array(view["axes"])
    height = view["height"]
    forward = np.cos(height) * level - np.sin(height) * up
    above = np.cross(right, forward)
    eye = np.array(view["target"]) - view["distance"] * forward
    local = (points - eye) @ np.stack([right, above, forward], axis=1)
    return local[:, :2] / local[:, 2:] * FOCAL / np.array([ASPECT, 1.0])


@pytest.mark.parametrize("distance", [0.5, 2.0, 8.0])
def test_a_surface_fills_the_canvas_wherever_the_camera_is(distance: float) -> None:
    x, y = np.meshgrid(np.linspace(-0.3, 0.3, 20), np.linspace(-0.2, 0.2, 20))
    surface = np.stack([x, y, distance + 0.05 * np.sin(9.0 * x)], axis=-1).reshape(-1, 3)
    colours = np.full(surface.shape, 200, np.uint8)
    scene = make_scene(surface, colours, np.eye(4)[None], None, frame_path=False)
    places = shown_at(scene.header, surface)
    assert np.abs(places).max() < 1.05
    middle = 0.5 * (places.min(axis=0) + places.max(axis=0))
    assert np.abs(middle).max() < 0.1
    assert np.ptp(places, axis=0).max() > 1.6


def test_a_surface_beyond_the_points_stays_where_it_is() -> None:
    points = np.random.default_rng(0).uniform((-0.5, -0.5, 1.0), (0.5, 0.5, 2.0), (500, 3))
    corners = np.array([[-1.0, -0.4, 1.5], [1.0, -0.4, 1.5], [0.0, 0.4, 1.5], [30.0, 0.0, 1.5]])
    mesh = TriangleMesh(
        positions=corners.astype(np.float32),
        normals=np.tile(np.float32([0.0, 0.0, -1.0]), (4, 1)),
        colours=np.full((4, 3), 90, np.uint8),
        triangles=np.array([[0, 1, 2], [1, 2, 3]], np.int32),
    )
    scene = make_scene(points, np.full(points.shape, 200, np.uint8), np.eye(4)[None], mesh)
    header, data = json.loads(scene.header), base64.b64decode(scene.bytes)
    (layer,) = (each for each in header["layers"] if each["name"] == "mesh")
    shares = np.frombuffer(data, "<u2", 3 * layer["count"], layer["places"]).reshape(-1, 3) / 65535
    drawn = np.frombuffer(data, "<u4", 3 * layer["triangles"], layer["indices"])
    places = np.array(header["low"]) + shares[drawn] * np.array(header["size"])
    np.testing.assert_allclose(places[places[:, 0].argsort()], corners[[0, 2, 1]], atol=1e-3)

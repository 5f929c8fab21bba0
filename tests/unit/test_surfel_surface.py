"""The mesh between surfels."""

from dataclasses import replace

import numpy as np

from pliant.algorithms.surfels.surface import surface_of
from pliant.algorithms.surfels.surfel_frame import SurfelFrame, SurfelState

FOCAL = 500.0


def surfels_at(points: np.ndarray) -> SurfelFrame:
    """Surfels at (N, 3) points that face the camera at the origin."""
    n = len(points)
    floats = np.ones(n, np.float32)
    return replace(
        SurfelFrame.empty(),
        ids=np.arange(n),
        positions=points,
        tangents=np.broadcast_to(np.eye(3)[:, :2], (n, 3, 2)).copy(),
        deformations=np.tile([1.0, 0.0, 1.0], (n, 1)),
        points_px=(FOCAL * points[:, :2] / points[:, 2:] + 300.0).astype(np.float32),
        zncc=floats, visible=floats, sigma=floats, gains=floats, biases=floats,
        state=np.zeros(n, np.uint8),
        age=np.zeros(n, np.int32),
        born=np.zeros(n, np.int32),
    )  # fmt: skip


def grid(depth: float, left: float = -0.5) -> np.ndarray:
    x, y = np.meshgrid(np.linspace(left, left + 1.0, 11), np.linspace(-0.5, 0.5, 11))
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, depth)], axis=1)


def test_a_plane_is_one_sheet_that_faces_the_camera() -> None:
    rows, normals, triangles = surface_of(surfels_at(grid(2.0)))
    assert rows.tolist() == list(range(121))
    assert len(triangles) == 2 * 10 * 10
    np.testing.assert_allclose(normals, np.tile([0.0, 0.0, -1.0], (121, 1)))


def test_two_sheets_are_not_joined() -> None:
    near, far = grid(1.0, left=-1.02), grid(1.5, left=0.02)
    _, _, triangles = surface_of(surfels_at(np.concatenate([near, far])))
    assert len(triangles) >= 2 * 2 * 10 * 10 - 4
    sides = triangles < len(near)
    assert (sides.all(axis=1) | ~sides.any(axis=1)).all()


def test_only_what_is_tracked_is_surface() -> None:
    surfels = surfels_at(grid(2.0))
    surfels.state[:5] = SurfelState.OUTLIER
    rows, _, triangles = surface_of(surfels)
    assert rows.tolist() == list(range(5, 121))
    assert triangles.max() < len(rows)
    rows, normals, triangles = surface_of(replace(surfels, state=np.full(121, 4, np.uint8)))
    assert (len(rows), len(normals), len(triangles)) == (0, 0, 0)

"""The mesh between surfels."""

from dataclasses import replace

import numpy as np

from pliant.algorithms.surfels.surface import surface_of
from pliant.algorithms.surfels.surface_over_time import surface_over_time
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


def test_a_gap_is_closed_only_where_both_ends_lie_in_one_plane() -> None:
    """Two pieces of 11 x 11 surfels, 0.1 apart, with a gap of 0.4 between them."""
    left, right = grid(2.0, left=-1.2), grid(2.0, left=0.2)
    surfels = surfels_at(np.concatenate([left, right]))
    _, _, triangles = surface_of(surfels)
    assert len(triangles) == 2 * 21 * 10
    turned = surfels.tangents.copy()
    turned[121:, :, 0] = (0.8, 0.0, 0.6)
    _, _, triangles = surface_of(replace(surfels, tangents=turned))
    assert len(triangles) == 2 * 2 * 10 * 10


def test_only_what_is_tracked_is_surface() -> None:
    surfels = surfels_at(grid(2.0))
    surfels.state[:5] = SurfelState.OUTLIER
    rows, _, triangles = surface_of(surfels)
    assert rows.tolist() == list(range(5, 121))
    assert triangles.max() < len(rows)
    rows, normals, triangles = surface_of(replace(surfels, state=np.full(121, 4, np.uint8)))
    assert (len(rows), len(normals), len(triangles)) == (0, 0, 0)


def corners_of(ids: np.ndarray, triangles: np.ndarray) -> set[frozenset[int]]:
    return {frozenset(corners) for corners in ids[triangles].tolist()}


def test_the_surface_over_time_is_that_of_each_frame() -> None:
    """A surfel in the middle is lost and found, and another row is born."""
    early, without = surfels_at(grid(2.0)[:110]), surfels_at(grid(2.1)[:110])
    without.state[60] = SurfelState.OCCLUDED
    frames = [early, without, surfels_at(grid(2.2))]
    found = surface_over_time(frames)
    assert found.ids.tolist() == list(range(121))
    assert len(found.triangles) == len(corners_of(found.ids, found.triangles))
    for frame, positions, shown in zip(frames, found.positions, found.shown, strict=True):
        rows, _, triangles = surface_of(frame)
        expected = corners_of(frame.ids[rows], triangles)
        assert corners_of(found.ids, found.triangles[shown]) == expected
        np.testing.assert_array_equal(positions[rows], frame.positions[rows])
        assert np.isnan(np.delete(positions, rows, axis=0)).all()
    assert found.shown.all(axis=0).sum() > 150
    assert found.shown.sum(axis=1).tolist() == [180, 178, 200]


def test_a_triangle_turned_over_is_another_one() -> None:
    points = np.array([(0.0, 0.0, 2.0), (0.1, 0.0, 2.0), (0.0, 0.1, 2.0)])
    found = surface_over_time([surfels_at(points), surfels_at(points * (-1.0, 1.0, 1.0))])
    assert found.shown.tolist() in ([[True, False], [False, True]], [[False, True], [True, False]])

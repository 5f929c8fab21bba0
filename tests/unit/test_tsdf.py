"""The kernels of the volume against plain numpy, and marching cubes on fields known exactly."""

import numpy as np
import pytest
from fusion_scene import CAMERA, PLANES, edge_uses, make_view, pose, rays, true_depth

from pliant.algorithms.arrays import F32, F64, I32
from pliant.algorithms.geometry import inverse, transform
from pliant.algorithms.meshing.marching_cubes import Tsdf, cube_table, extract_blocks
from pliant.algorithms.meshing.mesh_blocks import (
    SIDE,
    TriangleMesh,
    pack,
    sorted_keys,
    unpack,
    weld,
)
from pliant.algorithms.meshing.tsdf_blocks import (
    Scale,
    VoxelSums,
    find_rows,
    make_table,
    with_neighbours,
)
from pliant.algorithms.meshing.tsdf_integrate import (
    DISTANCE_UNITS,
    WEIGHT_UNITS,
    add_sight,
    blocks_in_band,
    blocks_in_view,
    pixel_planes,
)

VOXEL, TRUNCATION = 0.05, 0.2
SCALE = Scale(VOXEL, TRUNCATION)


def lattice(keys: I32) -> F64:
    """(N, 8, 8, 8, 3) voxel positions indexed (block, z, y, x)."""
    z, y, x = np.meshgrid(*[np.arange(SIDE)] * 3, indexing="ij")
    return (keys[:, None, None, None] * SIDE + np.stack([x, y, z], axis=-1)) * VOXEL


def meshed(field: F64, weights: I32 | None = None) -> TriangleMesh:
    """Marching cubes of a (8 n, 8 n, 8 n) field (z, y, x) in truncations of 4 voxels."""
    side = len(field) // SIDE
    z, y, x = np.meshgrid(*[np.arange(side)] * 3, indexing="ij")
    keys = np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1).astype(np.int32)
    order = np.argsort(pack(keys))

    def blocks(array: I32) -> I32:
        split = array.reshape(side, SIDE, side, SIDE, side, SIDE).transpose(0, 2, 4, 1, 3, 5)
        return np.ascontiguousarray(split.reshape(-1, SIDE, SIDE, SIDE))

    sums = np.rint(np.clip(field, -1.0, 1.0) * DISTANCE_UNITS * 1000).astype(np.int32)
    given = np.full(field.shape, 1000, np.int32) if weights is None else weights * 1000
    colours = np.ones((len(keys), SIDE, SIDE, SIDE, 4), np.int32)
    held = VoxelSums(blocks(sums), blocks(given.astype(np.int32)), colours)
    tsdf = Tsdf(make_table(keys), held, Scale(1.0, 4.0), min_weight=1)
    return weld(extract_blocks(keys[order], tsdf))


def grid(size: int) -> F64:
    """(size, size, size, 3) positions x, y, z indexed (z, y, x)."""
    z, y, x = np.meshgrid(*[np.arange(float(size))] * 3, indexing="ij")
    return np.stack([x, y, z], axis=-1)


def test_keys_and_their_table() -> None:
    keys = np.random.default_rng(0).integers(-(2**19), 2**19, (500, 3)).astype(np.int32)
    np.testing.assert_array_equal(unpack(pack(keys)), keys)
    keys = sorted_keys(keys)
    assert all(tuple(a) < tuple(b) for a, b in zip(keys[:-1].tolist(), keys[1:].tolist()))
    shuffled = np.random.default_rng(1).permutation(len(keys))
    np.testing.assert_array_equal(find_rows(make_table(keys[shuffled]), keys[shuffled]),
                                  np.arange(len(keys)))  # fmt: skip
    assert (find_rows(make_table(keys), keys + 1) == -1).mean() > 0.99
    around = with_neighbours(keys[:2])
    expected = {
        (int(k[0]) + a, int(k[1]) + b, int(k[2]) + c)
        for k in keys[:2] for a in (-1, 0, 1) for b in (-1, 0, 1) for c in (-1, 0, 1)
    }  # fmt: skip
    assert [tuple(k) for k in around.tolist()] == sorted(expected)


def test_each_pixel_is_the_plane_that_it_shows() -> None:
    depth = true_depth(pose(0), ball=False)
    pixels = pixel_planes(depth, np.ones_like(depth), CAMERA)
    found, normals = pixels.planes.astype(np.float64), PLANES[:, :3]
    # Away from the camera; a pose at the origin sees n . X = d as it is.
    best = np.abs(found[..., :3] @ -normals.T - 1.0).min(axis=-1)
    assert np.mean(best < 1e-4) > 0.98  # not where it is bent
    on_plane = np.sum(found[..., :3] * rays(CAMERA), axis=-1) * depth
    np.testing.assert_allclose(on_plane, found[..., 3], rtol=1e-4)


@pytest.mark.parametrize("free_space", [True, False])
def test_sums_are_those_of_plain_numpy(free_space: bool) -> None:
    view = make_view(3)
    pixels = pixel_planes(view.depth, view.weight, CAMERA)
    T = view.T_world_camera
    keys = with_neighbours(blocks_in_band(pixels, T, SCALE))
    N = len(keys)
    sums = np.zeros((N, 8, 8, 8), np.int32), np.zeros((N, 8, 8, 8), np.int32)
    colours = np.zeros((N, 8, 8, 8, 4), np.int32)
    rows = np.random.default_rng(0).permutation(N)

    def add(sign: int) -> None:
        add_sight(sign, keys, rows, pixels, view.colour, inverse(T), SCALE, free_space,
                  VoxelSums(*sums, colours))  # fmt: skip

    add(1)
    points = transform(inverse(T), lattice(keys).reshape(-1, 3))
    front = points[:, 2] > 1e-3
    px = CAMERA.project(np.where(front[:, None], points, 1.0))
    u, v = np.floor(px + 0.5).astype(np.int64).T
    inside = front & (u >= 0) & (v >= 0) & (u < CAMERA.width) & (v < CAMERA.height)
    u, v = np.where(inside, u, 0), np.where(inside, v, 0)
    weight = np.where(inside, np.maximum(np.floor(view.weight * WEIGHT_UNITS + 0.5), 1)[v, u], 0)
    planes = pixels.planes.astype(np.float64)[v, u]
    along = np.sum(planes[:, :3] * points, axis=1)
    distance = planes[:, 3] - along
    behind = np.divide(-points[:, 2] * distance, along, out=np.full(len(u), np.inf),
                       where=along > 0.0)  # fmt: skip
    weight = np.where((distance >= -TRUNCATION) & (behind <= 2 * TRUNCATION), weight, 0)
    if not free_space:
        weight = np.where(distance < TRUNCATION, weight, 0)
    level = np.floor(np.minimum(distance / TRUNCATION, 1.0) * DISTANCE_UNITS + 0.5)
    # In float32 a voxel may fall on another pixel, level or side of the truncation: if it is near.
    share = np.abs(px % 1.0 - 0.5).min(axis=1)
    close = (share < 1e-3) | (np.abs(np.abs(distance) - TRUNCATION) < 1e-4)
    close |= np.abs(behind - 2 * TRUNCATION) < 1e-3
    weight_of = sums[1][rows].reshape(-1)
    np.testing.assert_array_equal(weight_of[~close], weight[~close])
    off = np.abs(sums[0][rows].reshape(-1) - weight * level)
    assert np.all(off[~close] <= weight[~close])
    assert np.mean(off[~close] > 0) < 0.01
    near = np.where(distance < TRUNCATION, weight, 0)
    expected = near[:, None] * np.column_stack([view.colour[v, u], np.ones(len(u))])
    np.testing.assert_array_equal(colours[rows].reshape(-1, 4)[~close], expected[~close])
    assert close.mean() < 0.05
    assert np.count_nonzero(weight) > 10_000
    add(-1)
    assert not sums[0].any()
    assert not sums[1].any()
    assert not colours.any()


def test_the_band_and_the_view_leave_out_no_voxel_near_the_surface() -> None:
    view = make_view(2)
    pixels = pixel_planes(view.depth, view.weight, CAMERA)
    T = view.T_world_camera
    band = blocks_in_band(pixels, T, SCALE)
    # The points of the surface, and those half a truncation in front and behind.
    for share in (-0.5, 0.0, 0.5):
        depth = view.depth + share * TRUNCATION * 0.7
        points = transform(T, (rays(CAMERA) * depth[..., None]).reshape(-1, 3))
        keys = sorted_keys(np.floor(points / VOXEL / SIDE + 0.5 / SIDE).astype(np.int32))
        assert np.mean(find_rows(make_table(band), keys) < 0) < 0.02
    seen = blocks_in_view(band, pixels, inverse(T), SCALE)
    assert seen.all()
    turned = T @ np.diag([-1.0, 1.0, -1.0, 1.0])
    behind = blocks_in_view(band, pixels, inverse(turned), SCALE)
    assert behind.mean() < 0.05


def test_every_case_of_the_cube_joins_the_edges_that_it_cuts() -> None:
    counts, triangles, corners = cube_table()
    for case in range(256):
        cut = {e for e in range(12) if (case >> corners[e, 0] ^ case >> corners[e, 1]) & 1}
        used = triangles[case, : counts[case]]
        assert set(used.ravel().tolist()) == cut
        assert edge_uses(used).max() <= 2 if len(used) else case in (0, 255)


def test_any_field_gives_a_closed_manifold() -> None:
    # Noise reaches every case and every ambiguous face.
    field = np.random.default_rng(0).uniform(-0.3, 0.3, (16, 16, 16))
    field[[0, -1]] = field[:, [0, -1]] = field[:, :, [0, -1]] = 0.3
    mesh = meshed(field)
    assert len(mesh.triangles) > 3000
    np.testing.assert_array_equal(np.unique(edge_uses(mesh.triangles)), [2])
    sides = np.concatenate([mesh.triangles[:, [0, 1]], mesh.triangles[:, [1, 2]],
                            mesh.triangles[:, [2, 0]]]).astype(np.int64)  # fmt: skip
    # Each side is run through once in each direction: all triangles turn the same way.
    assert len(np.unique(sides[:, 0] << 32 | sides[:, 1])) == len(sides)


def test_a_ball_is_watertight_round_and_turned_outwards() -> None:
    centre, radius = np.array([11.3, 12.1, 11.8]), 7.2
    mesh = meshed((np.linalg.norm(grid(24) - centre, axis=-1) - radius) / 4.0)
    np.testing.assert_array_equal(np.unique(edge_uses(mesh.triangles)), [2])
    vertices, faces = len(mesh.positions), len(mesh.triangles)
    assert vertices - 3 * faces // 2 + faces == 2  # Euler: one closed surface without a hole
    out = mesh.positions - centre
    distance = np.linalg.norm(out, axis=1)
    np.testing.assert_allclose(distance, radius, atol=0.06)
    assert np.sum(out / distance[:, None] * mesh.normals, axis=1).min() > np.cos(np.radians(4))
    corners = mesh.positions[mesh.triangles].astype(np.float64)
    volume = np.linalg.det(corners - centre).sum() / 6.0
    assert volume == pytest.approx(4 / 3 * np.pi * radius**3, rel=0.02)


def test_a_plane_is_exact() -> None:
    normal = np.array([0.36, -0.48, 0.8])
    offset = float(normal @ [7.7, 8.2, 7.9])
    mesh = meshed((grid(16) @ normal - offset) / 4.0)
    np.testing.assert_allclose(mesh.positions @ normal, offset, atol=0.011)
    np.testing.assert_allclose(mesh.normals @ normal, 1.0, atol=1e-4)


def test_there_is_no_surface_without_observations_or_where_two_meet() -> None:
    points = grid(16)
    field: F64 = (points[..., 2] - 7.4) / 4.0
    weights = (points[..., 0] < 8).astype(np.int32)
    mesh = meshed(field, weights)
    assert mesh.positions[:, 0].max() == 7.0
    # What is far behind one surface, beside what is far in front of another.
    mesh = meshed(np.where(points[..., 2] < 7.5, -0.9, 0.9))
    assert len(mesh.triangles) == 0


def test_welding_is_one_vertex_for_one_edge() -> None:
    mesh = meshed((np.linalg.norm(grid(16) - 7.6, axis=-1) - 4.3) / 4.0)
    positions: F32 = np.unique(mesh.positions, axis=0)
    assert len(positions) == len(mesh.positions)

"""Fewer triangles: the surface stays where it was, whole, and turned as it was."""

import numpy as np
import pytest
from wavy_meshes import grey, grid, height, waves

from pliant.algorithms.arrays import F32, F64, I32
from pliant.algorithms.meshing import decimation
from pliant.algorithms.meshing.decimation import clustered, decimated


def turned(positions: F32, triangles: I32) -> F64:
    """(T, 3) normals, as long as the area."""
    a, b, c = positions[triangles].astype(np.float64).transpose(1, 0, 2)
    return 0.5 * np.cross(b - a, c - a)


def test_a_flat_square_needs_few_triangles_and_keeps_its_outline() -> None:
    positions, triangles = grid(40)
    found, _, fewer = decimated(positions, grey(positions), triangles, 40)
    assert 10 < len(fewer) <= 40
    areas = turned(found, fewer)
    assert (areas[:, 2] > 0.0).all()  # none is turned over
    assert areas[:, 2].sum() == pytest.approx(1.0, abs=1e-3)
    assert np.abs(found[:, 2]).max() < 1e-6
    for corner in ((0, 0), (0, 1), (1, 0), (1, 1)):
        assert np.linalg.norm(found[:, :2] - corner, axis=1).min() < 0.01


def test_triangles_are_spent_where_the_surface_bends() -> None:
    """Half of it flat, half of it waves of twelve vertices each."""
    positions, triangles = grid(100)
    x = positions[:, 0]
    positions[:, 2] = np.where(x > 0.5, 0.02 * np.sin(2.0 * np.pi * (x - 0.5) / 0.125), 0.0)
    found, _, fewer = decimated(positions, grey(positions), triangles, 1500)
    assert 1400 < len(fewer) <= 1500
    bent = found[fewer].mean(axis=1)[:, 0] > 0.5
    assert bent.mean() > 0.65
    x = found[:, 0]
    expected = np.where(x > 0.5, 0.02 * np.sin(2.0 * np.pi * (x - 0.5) / 0.125), 0.0)
    assert np.abs(found[:, 2] - expected).max() < 0.002
    assert (turned(found, fewer)[:, 2] > 0.0).all()


def test_a_cube_is_its_twelve_triangles() -> None:
    """Six faces that meet: vertices end up at its corners, and it stays closed."""
    side = 12
    plane, triangles = grid(side)
    u, v = plane[:, 0], plane[:, 1]
    faces: list[F32] = []
    for axis in range(3):
        for at in (0.0, 1.0):
            face = np.zeros((len(plane), 3), np.float32)
            face[:, axis] = at
            face[:, (axis + 1) % 3], face[:, (axis + 2) % 3] = (u, v) if at else (v, u)
            faces.append(face)
    rows = np.concatenate([triangles + n * len(plane) for n in range(6)])
    key = np.rint(np.concatenate(faces) * (side - 1)).astype(np.int64)
    unique, where = np.unique(key, axis=0, return_inverse=True)
    positions = (unique / (side - 1)).astype(np.float32)
    found, _, fewer = decimated(
        positions, grey(positions), where.reshape(-1)[rows].astype(np.int32), 12
    )
    assert len(fewer) == 12
    assert len(found) == 8
    np.testing.assert_allclose(found, np.rint(found), atol=0.01)
    centres, normals = found[fewer].mean(axis=1) - 0.5, turned(found, fewer)
    assert ((centres * normals).sum(axis=1) > 0.0).all()
    assert (centres * normals).sum() / 3.0 == pytest.approx(1.0, abs=0.01)  # its volume


def test_colours_are_the_means_of_what_they_stand_for() -> None:
    positions, triangles = grid(60)
    colours = np.zeros((len(positions), 3), np.uint8)
    colours[:, 0] = np.rint(255 * positions[:, 0])
    found, tints, _ = decimated(positions, colours, triangles, 1000)
    assert np.abs(tints[:, 0] / 255 - found[:, 0]).max() < 0.1
    assert not tints[:, 1:].any()


def test_a_mesh_that_is_small_enough_stays_but_for_what_is_none_of_it() -> None:
    positions, triangles = grid(5)
    stray = np.concatenate([positions, [[9.0, 9.0, 9.0]]]).astype(np.float32)
    nothing = np.array([[3, 3, 4]], np.int32)
    found, tints, same = decimated(
        stray, grey(stray), np.concatenate([triangles, nothing]), len(triangles)
    )
    np.testing.assert_array_equal(found, positions)
    np.testing.assert_array_equal(same, triangles)
    assert len(tints) == len(found)


def test_degenerate_meshes_end() -> None:
    nowhere = np.zeros((30, 3), np.float32)
    rows = np.random.default_rng(0).integers(0, 30, (60, 3)).astype(np.int32)
    found, _, fewer = decimated(nowhere, grey(nowhere), rows, 4)
    assert np.isfinite(found).all()
    assert len(fewer) <= 60
    anywhere = np.random.default_rng(1).normal(size=(30, 3)).astype(np.float32)
    found, _, fewer = decimated(anywhere, grey(anywhere), rows, 4)  # no surface at all
    assert np.isfinite(found).all()
    none = decimated(nowhere, grey(nowhere), rows[:0], 4)
    assert [len(each) for each in none] == [0, 0, 0]


def test_the_same_mesh_gives_the_same_bytes() -> None:
    positions, triangles = grid(50)
    positions[:, 2] = np.random.default_rng(0).normal(0.0, 0.01, len(positions))
    first = decimated(positions, grey(positions), triangles, 500)
    second = decimated(positions, grey(positions), triangles, 500)
    for one, other in zip(first, second, strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_very_large_mesh_is_clustered_first_and_ends_as_near(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    positions, triangles = waves(200)
    found: list[float] = []
    for workable in (10**6, 10**4):
        monkeypatch.setattr(decimation, "_WORKABLE", workable)
        kept, _, fewer = decimated(positions, grey(positions), triangles, 600)
        assert 500 < len(fewer) <= 600
        assert (turned(kept, fewer)[:, 2] > 0.0).all()
        assert turned(kept, fewer)[:, 2].sum() == pytest.approx(1.0, abs=0.05)
        found.append(float(np.sqrt(np.mean((kept[:, 2] - height(kept)) ** 2))))
    assert found[1] < 1.5 * found[0]


def test_clusters_are_at_most_so_many_and_cover_the_same() -> None:
    positions, triangles = waves(200)
    tints = np.stack([255.0 * positions[:, 0]] * 3, axis=1).astype(np.uint8)
    kept, colours, fewer = clustered(positions, tints, triangles, 9000)
    assert 2000 < len(fewer) <= 9000
    assert len(np.unique(np.sort(fewer, axis=1), axis=0)) == len(fewer)
    assert np.abs(kept[:, 2] - height(kept)).max() < 0.005
    assert turned(kept, fewer)[:, 2].sum() == pytest.approx(1.0, abs=0.05)
    assert np.abs(colours[:, 0] - 255.0 * kept[:, 0]).max() < 2.0

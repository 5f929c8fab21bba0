"""Small holes closed, crumbs left out, borders smoothed: on walls and grids with known answers."""

from pathlib import Path

import numpy as np
import pytest

from pliant.algorithms.arrays import F32, F64, I32, U8, BoolArray
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.meshing import tsdf_volume
from pliant.algorithms.meshing.marching_cubes import Tsdf
from pliant.algorithms.meshing.mesh_blocks import TriangleMesh
from pliant.algorithms.meshing.mesh_borders import smoothed_borders, without_teeth, zipped
from pliant.algorithms.meshing.mesh_finish import peeled
from pliant.algorithms.meshing.mesh_topology import NONE, border_of, split_fans
from pliant.algorithms.meshing.parameters import TsdfParameters
from pliant.algorithms.meshing.tsdf_blocks import InMemory
from pliant.algorithms.meshing.tsdf_closing import Evidence, evidence_of
from pliant.algorithms.meshing.tsdf_volume import TsdfVolume
from pliant.formats.ply import read_ply, write_ply
from pliant.messages.mesh_pieces import joined, split
from pliant.messages.types import Header

CAMERA = PinholeCamera(width=96, height=72, fx=90.0, fy=90.0, cx=47.5, cy=35.5)
VOXEL, DEPTH = 0.02, 1.0


def sheet(cells: BoolArray) -> tuple[F32, F32, I32]:
    """Positions, normals and triangles of the unit squares (rows, columns) that are True."""
    rows, columns = cells.shape
    y, x = np.mgrid[: rows + 1, : columns + 1]
    positions = np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3).astype(np.float32)
    v, u = np.nonzero(cells)
    first = v * (columns + 1) + u
    corners = np.stack([first, first + 1, first + columns + 2, first + columns + 1], axis=1)
    triangles = np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]]).astype(np.int32)
    return positions, np.tile(np.array([0, 0, 1], np.float32), (len(positions), 1)), triangles


def area(positions: F32, triangles: I32) -> float:
    """Signed, along z."""
    p = positions.astype(np.float64)[triangles]
    return float(0.5 * np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])[:, 2].sum())


def test_observed_surface_is_without_the_triangles_of_closed_vertices() -> None:
    positions, normals, triangles = sheet(np.ones((1, 3), np.bool_))
    colours = np.arange(24, dtype=np.uint8).reshape(8, 3)
    mesh = TriangleMesh(
        positions=positions, normals=normals, colours=colours, triangles=triangles,
        closed=np.array([3], np.int32),
    )  # fmt: skip
    observed = mesh.observed()
    left = positions[triangles][~(triangles == 3).any(axis=1)]
    assert 0 < len(left) < len(triangles)
    np.testing.assert_array_equal(observed.positions[observed.triangles], left)
    assert len(observed.closed) == 0
    assert not (observed.colours == colours[3]).all(axis=1).any()
    np.testing.assert_array_equal(observed.observed().triangles, observed.triangles)


def test_the_border_runs_anticlockwise_and_a_holes_clockwise() -> None:
    cells = np.ones((3, 3), np.bool_)
    cells[1, 1] = False
    positions, _, triangles = sheet(cells)
    border = border_of(len(positions), triangles)
    after = border.after
    assert after[0] == 1  # along the lower side, x grows
    assert after[5] == 9  # of the square from (1, 1) to (2, 2): up first
    on = np.flatnonzero(after != NONE)
    np.testing.assert_array_equal(border.before[after[on]], on)


def test_fans_that_meet_in_a_vertex_are_parted() -> None:
    positions, _, triangles = sheet(np.eye(2, dtype=np.bool_))
    parted, was = split_fans(len(positions), triangles)
    assert len(was) == len(positions) + 1
    assert was[-1] == 4
    np.testing.assert_array_equal(was[parted], triangles)
    after = border_of(len(was), parted).after
    on = np.flatnonzero(after != NONE)
    assert len(np.unique(after[on])) == len(on) == 8


def test_teeth_and_shreds_are_cut_off_and_a_straight_border_stays() -> None:
    cells = np.ones((12, 20), np.bool_)
    positions, _, triangles = sheet(cells)
    assert without_teeth(positions, triangles).all()
    cells[6:] = False
    cells[6, ::3] = True  # teeth, of which the lower triangle is left
    positions, _, triangles = sheet(cells)
    at = positions[triangles].mean(axis=1)
    triangles = triangles[(at[:, 1] < 6.0) | (at[:, 1] % 1.0 < 0.5)]
    assert positions[triangles][:, :, 1].max() == 7.0
    left = triangles[without_teeth(positions, triangles)]
    assert positions[left][:, :, 1].max() == 6.0
    assert area(positions, left) == pytest.approx(6 * 20)
    # A strip of equilateral triangles.
    k = np.arange(12)
    strip = np.stack([0.5 * k, (k % 2) * np.sqrt(0.75), 0.0 * k], axis=1).astype(np.float32)
    shred = np.stack([k[:-2], k[1:-1], k[2:]], axis=1).astype(np.int32)
    assert not without_teeth(strip, shred).any()


def test_notches_and_slits_are_closed_and_straight_borders_do_not_grow() -> None:
    positions, normals, triangles = sheet(np.ones((8, 12), np.bool_))
    assert len(zipped(positions, normals, triangles, 2.5)) == 0
    # The row of squares between y = 4 and 5 is squeezed to a slit, which opens to the right.
    cells = np.ones((8, 12), np.bool_)
    cells[4, 3:] = False
    slit, normals, triangles = sheet(cells)
    slit[:, 1] -= np.where(slit[:, 1] > 4, 0.9, 0.0)
    more = zipped(slit, normals, triangles, 2.5)
    assert area(slit, more) == pytest.approx(0.1 * 9, rel=1e-3)
    assert (zipped(slit, -normals, triangles, 2.5).size) == 0  # not against the normals


def test_a_smoothed_border_keeps_the_area_and_the_surface_and_turns_nothing_over() -> None:
    y, x = np.mgrid[:40, :40]
    positions, normals, triangles = sheet((x - 19.5) ** 2 + (y - 19.5) ** 2 < 15.0**2)
    smooth = smoothed_borders(positions, normals, triangles)
    on = np.flatnonzero(border_of(len(positions), triangles).after != NONE)
    inner = np.setdiff1d(np.arange(len(positions)), on)
    np.testing.assert_array_equal(smooth[inner], positions[inner])
    assert np.all(smooth[:, 2] == 0.0)
    assert area(smooth, triangles) == pytest.approx(area(positions, triangles), rel=0.01)
    p = smooth.astype(np.float64)[triangles]
    assert np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])[:, 2].min() > 0.0
    radii = [np.linalg.norm(each[on, :2] - 20.0, axis=1) for each in (positions, smooth)]
    assert radii[1].std() < 0.5 * radii[0].std()


def test_guesses_go_from_the_border_and_stay_where_they_are_enclosed() -> None:
    positions, _, triangles = sheet(np.ones((10, 20), np.bool_))
    guessed = positions[:, 0] >= 18.0  # at the border, of three columns of vertices
    guessed |= (np.abs(positions[:, 0] - 6) < 2) & (np.abs(positions[:, 1] - 5) < 2)
    alive = peeled(triangles, guessed, 4)
    left = positions[triangles[alive]]
    assert left[:, :, 0].max() == 17.0
    assert area(positions, triangles[alive]) == pytest.approx(17 * 10)


def wall(hole: BoolArray, crumb: bool = False) -> TsdfVolume:
    """A slanted wall seen five times, but for a hole (H, W); beside it a crumb nearer by."""
    x = np.tile(np.arange(CAMERA.width), (CAMERA.height, 1))
    ray = (x - CAMERA.cx) / CAMERA.fx
    depths = (DEPTH / (1.0 - 0.3 * ray)).astype(np.float32)  # z = DEPTH + 0.3 x
    depths[hole] = 0.0
    if crumb:
        depths[10:18, 10:18] = 0.6 * DEPTH
    colour = np.full((CAMERA.height, CAMERA.width, 3), (200, 100, 50), np.uint8)
    volume = TsdfVolume(VOXEL, TsdfParameters())
    for _ in range(5):
        weights = (depths > 0.0).astype(np.float32)
        volume.integrate(depths, weights, colour, CAMERA, np.eye(4))
    return volume


def holes(mesh: TriangleMesh) -> int:
    """Borders but for the outer one."""
    after = border_of(len(mesh.positions), mesh.triangles).after
    left, count = set(np.flatnonzero(after != NONE).tolist()), 0
    while left:
        at = min(left)
        while at in left:
            left.remove(at)
            at = int(after[at])
        count += 1
    return count - 1


def patch(size: int) -> BoolArray:
    hole = np.zeros((CAMERA.height, CAMERA.width), np.bool_)
    hole[36 - size // 2 : 36 + size // 2, 48 - size // 2 : 48 + size // 2] = True
    return hole


def test_a_small_hole_is_closed_on_the_surface_and_marked_and_nothing_grows() -> None:
    whole, small = wall(patch(0)).extract_finished(), wall(patch(6))
    raw = small.extract_all()
    mesh = small.extract_finished()
    assert holes(mesh) == 0
    assert len(whole.closed) == 0
    closed = mesh.positions[mesh.closed].astype(np.float64)
    assert len(closed) > 4
    assert np.abs(closed[:, :2]).max() < 6 * DEPTH / CAMERA.fx
    off: F64 = (closed[:, 2] - DEPTH - 0.3 * closed[:, 0]) / np.sqrt(1.09)
    assert np.abs(off).max() < 0.1 * VOXEL
    np.testing.assert_array_equal(mesh.colours[mesh.closed], [(200, 100, 50)] * len(closed))
    for side in (np.min, np.max):
        grown = side(mesh.positions, axis=0) - side(raw.positions, axis=0)
        assert np.abs(grown).max() <= VOXEL


def test_a_large_hole_stays_as_large_and_free_space_stays_open() -> None:
    assert holes(wall(patch(30)).extract_finished()) == 1
    through = wall(patch(6))
    depths = np.where(patch(6), np.float32(3.0 * DEPTH), np.float32(0.0))
    colour = np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)
    weights = (depths > 0.0).astype(np.float32)
    for _ in range(5):
        through.integrate(depths, weights, colour, CAMERA, np.eye(4))
    mesh = through.extract_finished()
    near = mesh.positions[:, 2] < 2.0 * DEPTH
    middle = near & (np.abs(mesh.positions[:, :2]).max(axis=1) < 1.0 * DEPTH / CAMERA.fx)
    assert near.any()
    assert not middle.any()


def test_a_crumb_goes() -> None:
    hole = patch(0)
    hole[4:24, 4:24] = True
    volume = wall(hole, crumb=True)
    assert volume.extract_all().positions[:, 2].min() < 0.62 * DEPTH
    assert volume.extract_finished().positions[:, 2].min() > 0.7 * DEPTH


def test_what_vertices_read_of_the_voxels_on_disk_is_let_go_part_by_part(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    whole = wall(patch(6)).extract_finished()
    done: list[int] = []

    def watched(positions: F32, tsdf: Tsdf, filled: U8) -> Evidence:
        done.append(len(positions))
        return evidence_of(positions, tsdf, filled)

    monkeypatch.setattr(tsdf_volume, "_VERTICES_AT_ONCE", 300)
    monkeypatch.setattr(tsdf_volume, "evidence_of", watched)

    def let_go(_: InMemory) -> None:
        done.append(0)

    monkeypatch.setattr(InMemory, "let_go", let_go)
    again = wall(patch(6)).extract_finished()
    first = next(at for at, count in enumerate(done) if count)
    assert len(done[first:]) > 6
    assert max(done) == 300
    assert not any(done[first + 1 :: 2])  # after each part
    for name in ("positions", "normals", "colours", "triangles", "closed"):
        np.testing.assert_array_equal(getattr(again, name), getattr(whole, name))


def test_an_empty_volume_gives_an_empty_mesh() -> None:
    mesh = TsdfVolume(VOXEL, TsdfParameters()).extract_finished()
    assert len(mesh.triangles) == len(mesh.positions) == len(mesh.closed) == 0


def test_the_marks_come_through_messages_and_files(tmp_path: Path) -> None:
    count = 70_000
    positions = np.random.default_rng(0).uniform(size=(count, 3)).astype(np.float32)
    closed = np.array([0, 5, 65_535, 65_536, 69_999], np.int32)
    mesh = TriangleMesh(
        positions=positions, normals=positions, colours=np.zeros((count, 3), np.uint8),
        triangles=np.arange(count - 1, dtype=np.int32).reshape(-1, 3)[:20_000], closed=closed,
    )  # fmt: skip
    header = Header(frame=0, stamp_ns=0, frame_id="world")
    pieces = list(split(header, mesh, segment=0, level="fine", voxel_size=1.0, keyframes=1))
    assert [len(piece.closed) for piece in pieces] == [3, 2]
    np.testing.assert_array_equal(joined(pieces).closed, closed)
    some = mesh.of_triangles(np.arange(len(mesh.triangles)) < 2)
    np.testing.assert_array_equal(some.closed, [0, 5])
    path = tmp_path / "mesh.ply"
    write_ply(path, positions, faces=mesh.triangles, closed=closed)
    np.testing.assert_array_equal(read_ply(path).closed, closed)
    write_ply(path, positions, faces=mesh.triangles)
    assert read_ply(path).closed.size == 0

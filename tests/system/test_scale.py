"""``pliant scale``: a result in metres, by what is known of the scene."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from running import NO_MESH, TINY, assert_one_line, in_this_process

import pliant
from pliant.algorithms.arrays import F64, U8
from pliant.datasets.builtin import builtin_folder
from pliant.errors import PliantError
from pliant.evaluation.run_evaluation import evaluate_result
from pliant.export.export import export_result
from pliant.formats.ply import read_ply
from pliant.formats.tum import read_tum
from pliant.messages import topics
from pliant.messages.types import MapUpdate
from pliant.results.folder import prepare
from pliant.results.known_scale import MetricRecording
from pliant.results.mesh_files import mesh_of
from pliant.results.run import read_run
from pliant.scale.command import Known, scale_result
from pliant.scale.lengths import from_points

pytestmark = pytest.mark.system


@pytest.fixture(scope="module")
def doubled(tiny_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A result whose unit is two metres."""
    folder = Path(shutil.copytree(tiny_run, tmp_path_factory.mktemp("scale") / "tiny"))
    done = in_this_process("scale", folder, "--points", "-0.5,0,1", "0.5,0,1", 2)
    assert done.returncode == 0, done.stderr
    assert "a unit of the map is 2 m" in done.stdout
    return folder


def test_every_file_is_in_metres(tiny_run: Path, doubled: Path) -> None:
    for name in ("trajectory.txt", "trajectory_online.txt", "keyframes.txt"):
        before, after = read_tum(tiny_run / name), read_tum(doubled / name)
        np.testing.assert_allclose(after.positions, 2.0 * before.positions, atol=2e-6)
        turned = after.T_world_camera[:, :3, :3] - before.T_world_camera[:, :3, :3]
        np.testing.assert_allclose(turned, 0.0, atol=1e-6)
    for name in ("points.ply", "mesh.ply", "mesh_coarse.ply"):
        np.testing.assert_allclose(
            read_ply(doubled / name).points, 2.0 * read_ply(tiny_run / name).points, rtol=1e-6
        )
    report = json.loads((doubled / "report.json").read_text())
    assert report["scale_is_metric"]
    assert not json.loads((tiny_run / "report.json").read_text())["scale_is_metric"]
    assert "<th>scale</th><td>metres</td>" in (doubled / "report.html").read_text()
    assert (doubled / "recording.mcap").read_bytes() == (tiny_run / "recording.mcap").read_bytes()


def test_exports_and_python_are_in_metres(tiny_run: Path, doubled: Path, tmp_path: Path) -> None:
    for to in ("tum", "euroc"):
        one = export_result(tiny_run, to, tmp_path / f"{to}-units").read_text()
        assert one != export_result(doubled, to, tmp_path / f"{to}-metres").read_text()
    units, metres = pliant.open(tiny_run), pliant.open(doubled)
    np.testing.assert_allclose(metres.points, 2.0 * units.points)
    assert metres.mesh is not None
    assert units.mesh is not None
    np.testing.assert_allclose(metres.mesh.positions, 2.0 * units.mesh.positions)
    drawn = [
        list(MetricRecording(folder / "recording.mcap").decoded(topics.MAP_UPDATE))
        for folder in (tiny_run, doubled)
    ]
    for a, b in zip(*drawn, strict=True):
        assert isinstance(a, MapUpdate)
        assert isinstance(b, MapUpdate)
        np.testing.assert_array_equal(b.points_world, 2.0 * a.points_world)


def test_a_mesh_that_is_made_again_is_in_metres(doubled: Path, tmp_path: Path) -> None:
    done = in_this_process("mesh", doubled, "--output", tmp_path / "mesh")
    assert done.returncode == 0, done.stderr
    again, before = (read_ply(folder / "mesh.ply") for folder in (tmp_path / "mesh", doubled))
    np.testing.assert_allclose(again.points.min(axis=0), before.points.min(axis=0), rtol=0.02)


def test_the_scale_is_saved_with_the_map_and_the_result(doubled: Path, tmp_path: Path) -> None:
    assert "scale: metres" in in_this_process("map", "info", doubled).stdout
    today = tmp_path / "today"
    arguments = ("--map", doubled, "--end", "0.7", *NO_MESH)
    done = in_this_process("run", TINY, *arguments, "--output", today)
    assert done.returncode == 0, done.stderr
    assert json.loads((today / "report.json").read_text())["scale_is_metric"]
    there, then = read_tum(today / "trajectory.txt"), read_tum(doubled / "trajectory.txt")
    np.testing.assert_allclose(there.positions, then.positions[: len(there)], atol=0.02)
    again = shutil.copytree(doubled, tmp_path / "again")
    prepare(again, "")
    assert not (again / "scale.yaml").exists()


def test_the_last_given_scale_counts(doubled: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(doubled, tmp_path / "tiny"))
    done = in_this_process("scale", folder, "--depth", TINY)
    assert done.returncode == 0, done.stderr
    assert "a metre so far is" in done.stdout
    found = evaluate_result(folder, groundtruth=builtin_folder(TINY)).final.alignment
    assert found is not None
    assert abs(found.scale - 1.0) < 0.005


def test_a_marker_determines_the_scale(tmp_path: Path) -> None:
    source, result = tmp_path / "with-marker", tmp_path / "result"
    shutil.copytree(builtin_folder(TINY), source)
    put_marker_into(source, side_m=0.25)
    assert in_this_process("run", source, *NO_MESH, "--output", result).returncode == 0
    done = in_this_process("scale", result, "--marker", 0.25)
    assert done.returncode == 0, done.stderr
    assert "1 marker of 0.25 m" in done.stdout
    found = evaluate_result(result, groundtruth=source / "groundtruth.txt").final.alignment
    assert found is not None
    assert abs(found.scale - 1.0) < 0.015


def test_exports_made_before_are_named(tiny_run: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(tiny_run, tmp_path / "tiny"))
    poses = export_result(folder, "tum", None)
    before = poses.read_bytes()
    for name in ("nerfstudio", "images", "picture.png"):
        (folder / name).mkdir()
    _, told = scale_result(folder, Known(points=((-0.5, 0.0, 1.0), (0.5, 0.0, 1.0), 2.0)))
    assert told.startswith("exports in the old unit: trajectory_tum.txt, nerfstudio: ")
    assert poses.read_bytes() == before
    assert export_result(folder, "tum", None, force=True).read_bytes() != before


def test_a_vertex_of_the_mesh_is_of_the_map_too(tiny_run: Path) -> None:
    run = read_run(tiny_run / "recording.mcap")
    longest = run.history.longest_segment()
    points, mesh = run.history.points_in(longest).positions, mesh_of(run.mesh, longest)
    assert mesh is not None
    some = mesh.positions[::20].tolist()
    vertex = max(some, key=lambda place: np.linalg.norm(points - place, axis=1).min())
    assert from_points(run, vertex, points[0], 1.0).metres_per_unit > 0.0
    with pytest.raises(PliantError, match="outside of the map"):
        from_points(replace(run, mesh=[]), vertex, points[0], 1.0)


def put_marker_into(sequence: Path, side_m: float) -> None:
    """Draw a board with a marker that stands still in the world into every image."""
    calibration = yaml.safe_load((sequence / "calib.yaml").read_text())
    fx, fy, cx, cy = (calibration[name] for name in ("fx", "fy", "cx", "cy"))
    poses: F64 = read_tum(sequence / "groundtruth.txt").T_world_camera
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_250)
    marker = cv2.aruco.generateImageMarker(dictionary, 7, 140)
    board = np.pad(marker, 30, constant_values=255)
    half = 0.5 * side_m * len(board) / len(marker)
    turn = cv2.Rodrigues(np.array([0.3, 0.4, 0.0]))[0]
    corners = half * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) @ turn.T
    T = poses[0]
    world = (corners + np.array([0.1, -0.1, 1.3])) @ T[:3, :3].T + T[:3, 3]
    edge = len(board) - 0.5
    flat = np.array([[-0.5, -0.5], [edge, -0.5], [edge, edge], [-0.5, edge]], np.float32)
    listed = (sequence / "rgb.txt").read_text().splitlines()
    names = [line.split()[1] for line in listed if not line.startswith("#")]
    for name, T_world_camera in zip(names, poses, strict=True):
        x, y, z = ((world - T_world_camera[:3, 3]) @ T_world_camera[:3, :3]).T
        seen = np.column_stack([fx * x / z + cx, fy * y / z + cy]).astype(np.float32)
        image = np.asarray(cv2.imread(str(sequence / name)))
        H = cv2.getPerspectiveTransform(flat, seen)
        size = image.shape[1], image.shape[0]
        covered = cv2.warpPerspective(np.full_like(board, 255), H, size) > 128
        shown: U8 = np.asarray(cv2.warpPerspective(board, H, size), np.uint8)
        image[covered] = shown[covered][:, None]
        cv2.imwrite(str(sequence / name), image)


@pytest.mark.parametrize(
    ("known", "says"),
    [
        (Known(), "one of --points, --marker, --depth"),
        (Known(marker=0.1, depth=TINY), "one of --points, --marker, --depth"),
        (Known(marker=0.1), "keyframes see none"),
        (Known(marker=-1.0), "expected a positive length"),
        (Known(points=((1.0, 2.0, 3.0), (1.0, 2.0, 3.0), 1.0)), "the two points are identical"),
        (Known(points=((1.0, 2.0, 3.0), (1.0, 2.0, 4.0), np.nan)), "expected a positive length"),
        (Known(points=((-0.5, 0.0, 1.0), (900.0, 1.0, 1.0), 1.0)), "900,1,1 is outside of the map"),
        (Known(points=((0.0, 0.0, -9.0), (0.5, 0.0, 1.0), 1.0)), "0,0,-9 is outside of the map"),
        (Known(depth="nowhere"), "nowhere"),
    ],
)
def test_lengths_without_information_change_nothing(
    tiny_run: Path, known: Known, says: str
) -> None:
    before = {path: path.stat().st_mtime_ns for path in tiny_run.iterdir()}
    with pytest.raises(PliantError, match=says):
        list(scale_result(tiny_run, known))
    assert {path: path.stat().st_mtime_ns for path in tiny_run.iterdir()} == before


def test_a_scale_that_is_none_is_one_line(doubled: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(doubled, tmp_path / "tiny"))
    (folder / "scale.yaml").write_text("metres_per_unit: -1\nsigma: 0\nsource: nobody\n")
    assert_one_line(in_this_process("export", folder, "--to", "tum"), "scale.yaml: no valid scale")
    told = in_this_process("scale", folder, "--points", "1,2", "1,2,4", 1)
    assert_one_line(told, "expected X,Y,Z", code=2)

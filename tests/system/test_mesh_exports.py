"""Exports of the mesh: with a texture, closed to a solid, without small pieces."""

import shutil
from importlib import import_module
from pathlib import Path

import cv2
import numpy as np
import pytest
from running import assert_one_line, in_this_process

from pliant import open3d_library
from pliant.algorithms.geometry import pose_to_matrix
from pliant.algorithms.meshing.rendering import view_mesh
from pliant.errors import ResultError
from pliant.export.crop import Box
from pliant.export.export import export_result
from pliant.export.textured import textured_mesh
from pliant.formats.ply import read_ply
from pliant.formats.textured import write_glb
from pliant.recording.reader import Recording
from pliant.results.run import read_run
from pliant.results.textured_mesh import keyframe_images

pytestmark = pytest.mark.system


@pytest.fixture(scope="module")
def result(tiny_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run's result, to which exports may be added."""
    return Path(shutil.copytree(tiny_run, tmp_path_factory.mktemp("result") / "tiny"))


def test_a_textured_mesh_has_the_colours_that_its_keyframes_show(
    result: Path, tmp_path: Path
) -> None:
    path = export_result(result, "glb", tmp_path / "mesh.glb", triangles=8000)
    assert path.read_bytes()[:4] == b"glTF"
    obj = export_result(result, "obj", tmp_path / "obj", triangles=800)
    assert {each.name for each in obj.iterdir()} == {"mesh.obj", "mesh.mtl", "mesh.png"}
    recording = Recording(result / "recording.mcap")
    mesh = textured_mesh(recording, 8000)
    write_glb(tmp_path / "again.glb", mesh)
    assert path.read_bytes() == (tmp_path / "again.glb").read_bytes()
    assert 4000 < len(mesh.triangles) <= 8000
    assert mesh.uvs.min() >= 0.0
    assert mesh.uvs.max() <= 1.0
    assert (np.linalg.norm(mesh.normals, axis=1) > 0.99).mean() > 0.99
    run = read_run(recording.path)
    assert run.stream is not None
    images = list(keyframe_images(recording, run, run.history.longest_segment()))
    assert len(images) > 4
    for number, image, _ in images[:: len(images) // 3]:
        T_world_camera = pose_to_matrix(run.history.keyframes[number].pose_world_camera)
        seen = view_mesh(mesh.positions, mesh.triangles, run.stream.camera, T_world_camera)
        at = seen.interpolate(mesh.triangles, mesh.uvs) * np.float32(len(mesh.texture)) - 0.5
        drawn = cv2.remap(mesh.texture, at[..., 0], at[..., 1], cv2.INTER_LINEAR)
        inside = seen.triangles >= 0
        assert inside.mean() > 0.5
        off = np.abs(drawn.astype(float) - image)[inside]
        contrast = np.abs(image - np.median(image)).mean()
        assert np.median(off) < 0.3 * contrast


def test_small_pieces_are_left_out(result: Path, tmp_path: Path) -> None:
    whole, clean = (
        textured_mesh(Recording(result / "recording.mcap"), 8000, clean=clean)
        for clean in (False, True)
    )
    assert 0.5 * len(whole.triangles) < len(clean.triangles) <= 8000
    with pytest.raises(ResultError, match="--clean: not available for tum"):
        export_result(result, "tum", tmp_path / "poses.txt", clean=True)


def test_closed_holes_are_left_out(result: Path) -> None:
    recording = Recording(result / "recording.mcap")
    whole, observed = (textured_mesh(recording, 10**7, observed=each) for each in (False, True))
    assert len(read_ply(result / "mesh.ply").closed)
    assert 0.5 * len(whole.triangles) < len(observed.triangles) < len(whole.triangles)


def test_a_solid_is_closed(result: Path, tmp_path: Path) -> None:
    try:
        import_module("open3d")
    except (ImportError, OSError) as error:
        pytest.skip(f"open3d is installed but cannot be loaded ({error})")
    solid = read_ply(export_result(result, "watertight", tmp_path / "solid.ply"))
    assert solid.faces is not None
    edges = np.concatenate([solid.faces[:, k] for k in ([0, 1], [1, 2], [2, 0])])
    _, counts = np.unique(np.sort(edges, axis=1), axis=0, return_counts=True)
    assert (counts == 2).all()


@pytest.mark.parametrize(
    "command", [("export", "--to", "watertight"), ("mesh", "--watertight")]
)  # fmt: skip
def test_without_open3d_s_libraries_one_line_names_the_packages(
    result: Path, command: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(name: str) -> None:
        raise ImportError("libGL.so.1: cannot open shared object file")

    monkeypatch.setattr(open3d_library, "import_module", refuse)
    name, *options = command
    done = in_this_process(name, result, *options, "--output", tmp_path / "out.glb"
        if "glb" in options else tmp_path / ("out.ply" if name == "export" else "out"))  # fmt: skip
    assert_one_line(done, "libGL.so.1")
    assert "apt install libegl1" in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_triangles_are_for_textured_meshes(result: Path, tmp_path: Path) -> None:
    with pytest.raises(
        ResultError, match="--triangles: not available for tum, only for glb and obj"
    ):
        export_result(result, "tum", tmp_path / "poses.txt", triangles=500)


def test_a_box_crops_meshes_and_points(result: Path, tmp_path: Path) -> None:
    points = read_ply(result / "points.ply").points
    low, high = np.quantile(points, (0.3, 0.7), axis=0)
    box = Box(low=tuple(low.tolist()), high=tuple(high.tolist()))
    cropped = read_ply(export_result(result, "ply", tmp_path / "points.ply", crop=box)).points
    inside = ((points >= low) & (points <= high)).all(axis=1)
    np.testing.assert_array_equal(np.sort(cropped, axis=0), np.sort(points[inside], axis=0))
    recording = Recording(result / "recording.mcap")
    low, high = np.quantile(read_ply(result / "mesh.ply").points, (0.2, 0.8), axis=0)
    box = Box(low=tuple(low.tolist()), high=tuple(high.tolist()))
    mesh = textured_mesh(recording, 8000, crop=box)
    assert len(mesh.triangles) > 1000
    slack = 0.02 * (high - low)  # decimation moves vertices
    assert (mesh.positions >= low - slack).all()
    assert (mesh.positions <= high + slack).all()
    folder = export_result(result, "splat", tmp_path / "splat", crop=box)
    dense = read_ply(folder / "sparse" / "0" / "points3D.ply").points
    assert len(dense) > 1000
    assert box.holds(dense).all()


def test_an_empty_box_is_one_line_with_the_place_of_the_mesh(result: Path, tmp_path: Path) -> None:
    box = Box(low=(1e3, 1e3, 1e3), high=(2e3, 2e3, 2e3))
    for kind, what in (("glb", "triangle of the mesh"), ("ply", "point"), ("splat", "point")):
        path = tmp_path / {"splat": "splat"}.get(kind, f"out.{kind}")
        with pytest.raises(ResultError, match=rf"--crop 1000,.*: no {what} is inside; the extent"):
            export_result(result, kind, path, crop=box)
        assert not path.exists()
    with pytest.raises(ResultError, match="only for glb, obj, watertight, ply, splat and las"):
        export_result(result, "tum", tmp_path / "poses.txt", crop=box)


@pytest.mark.parametrize("crop", ["1,2,3", "a,0,0,1,1,1", "1,0,0,0,1,1", "nan,0,0,1,1,1"])
def test_a_box_that_is_none_is_wrong_usage(result: Path, crop: str, tmp_path: Path) -> None:
    output = tmp_path / "points.ply"
    done = in_this_process("export", result, "--to", "ply", "--crop", crop, "--output", output)
    assert done.returncode == 2
    assert "--crop" in done.stderr
    assert not output.exists()
    box = "-1,-1,-9,1,1,9"  # begins like an option
    done = in_this_process("export", result, "--to", "ply", "--crop", box, "--output", output)
    assert done.returncode == 0

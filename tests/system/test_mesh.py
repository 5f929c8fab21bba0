"""A run with a mesh, the mesh made again, and runs that have none and say why."""

import json
import os
import shutil
import signal
from pathlib import Path

import numpy as np
import pytest
from running import (
    COARSE_MESH,
    TINY,
    assert_one_line,
    children,
    digests,
    in_this_process,
    pliant,
    running,
)

from pliant.export.export import export_result
from pliant.formats.ply import read_ply
from pliant.open3d_library import Open3dError, load_open3d

pytestmark = pytest.mark.system


@pytest.fixture
def result(tiny_run: Path) -> Path:
    assert "fine mesh:" in (tiny_run / "logs" / "stdout").read_text()
    return tiny_run


def test_a_run_leaves_meshes_pictures_and_figures(result: Path) -> None:
    report = json.loads((result / "report.json").read_text())
    assert [mesh["level"] for mesh in report["mesh"]] == ["coarse", "fine"]
    for mesh, name in zip(report["mesh"], ("mesh_coarse.ply", "mesh.ply"), strict=True):
        data = read_ply(result / name)
        assert data.faces is not None
        assert data.normals is not None
        assert data.colours is not None
        assert len(data.faces) == mesh["triangles"] > 100
        np.testing.assert_allclose(np.linalg.norm(data.normals, axis=1), 1.0, atol=1e-3)
    for name in ("mesh.png", "mesh_shaded.png", "mesh_normals.png"):
        assert (result / name).stat().st_size > 1000
    stages = report["milliseconds_per_frame"]["meshing"]
    assert {"smoothing", "coarse fusion", "final fine fusion"} <= stages.keys()
    assert report["counters"]["meshing"]["fused"] > 0


def test_the_mesh_against_the_truth(result: Path, tmp_path: Path) -> None:
    figures = tmp_path / "figures.json"
    folder = shutil.copytree(result, tmp_path / "result")
    done = in_this_process("eval", folder, "--groundtruth", TINY, "--mesh", "--json", figures)
    assert done.returncode == 0, done.stderr
    found = json.loads(figures.read_text())["mesh"]
    assert found["median_error"] < 0.01
    assert found["within"] > 0.9
    assert found["covered"] > 0.5
    assert found["normal_deg"] < 8.0
    surface = json.loads(figures.read_text())["surface"]
    assert surface.keys() == {"trajectory", "icp", "icp_scale", "floor"}
    assert surface["floor"]["chamfer_m"] < surface["trajectory"]["chamfer_m"]
    assert "+ ICP, scale" in done.stdout
    assert (folder / "mesh_error.png").stat().st_size > 1000


def test_a_mesher_that_is_killed_fuses_again_and_the_mesh_is_that_of_an_ordinary_run(
    result: Path, tmp_path: Path
) -> None:
    output = tmp_path / "restartable"
    with running(TINY, *COARSE_MESH, "--on-crash", "restart", "--output", output) as run:
        run.wait_for("meshing the recording")
        while not (meshers := children(run.process.pid, "mesh.afterwards")):
            assert run.process.poll() is None
        os.kill(meshers[0], signal.SIGKILL)
        code, written, errors = run.finish()
    assert code == 0, errors
    parts = len(list((output / "recording").iterdir()))
    assert f", recording/ ({parts} parts)\n" in written
    assert digests(output) == digests(result)
    for name in ("mesh.ply", "mesh_coarse.ply", "mesh.png"):
        assert (output / name).read_bytes() == (result / name).read_bytes(), name
    assert in_this_process("info", output).returncode == 0
    meshes = [json.loads((of / "report.json").read_text())["mesh"] for of in (output, result)]
    assert meshes[0] == meshes[1]
    # A power cut after the end, before the state was cleared away.
    (output / "state").mkdir()
    again = in_this_process("run", TINY, "--resume", "--output", output)
    assert again.returncode == 0, again.stderr
    assert "was already complete" in again.stderr
    assert digests(output) == digests(result)
    assert not (output / "state").exists()


def test_the_mesh_is_made_again_closed(result: Path, tmp_path: Path) -> None:
    try:
        load_open3d()
    except Open3dError as error:
        pytest.skip(f"open3d is installed but cannot be loaded ({error})")
    output = tmp_path / "solid"
    done = in_this_process("mesh", result, "--output", output, "--watertight")
    assert done.returncode == 0, done.stderr
    assert "mesh_watertight.ply: " in done.stdout
    exported = export_result(result, "watertight", tmp_path / "exported.ply")
    assert (output / "mesh_watertight.ply").read_bytes() == exported.read_bytes()


def test_the_mesh_is_made_again_without_small_pieces(result: Path, tmp_path: Path) -> None:
    whole, clean = tmp_path / "whole", tmp_path / "clean"
    for output, options in ((whole, ()), (clean, ("--clean",))):
        # Meshes of landmarks alone are not finished, and have small pieces.
        sets = ("--set", "meshing.depth=points")
        done = in_this_process("mesh", result, "--output", output, *options, *sets)
        assert done.returncode == 0, done.stderr
    before, after = (read_ply(folder / "mesh.ply").faces for folder in (whole, clean))
    assert before is not None
    assert after is not None
    assert 0.5 * len(before) < len(after) < len(before)
    report = json.loads((clean / "mesh.json").read_text())["mesh"]
    assert {"fine": len(after)}.items() <= {m["level"]: m["triangles"] for m in report}.items()


def test_the_mesh_is_made_again_with_other_parameters(result: Path, tmp_path: Path) -> None:
    done = in_this_process("mesh", result, "--output", tmp_path / "same")
    assert done.returncode == 0, done.stderr
    for name in ("mesh.ply", "mesh_coarse.ply"):
        assert (tmp_path / "same" / name).read_bytes() == (result / name).read_bytes()
    sets = ("--set", "meshing.tsdf.fine_voxel=0.08")
    done = in_this_process("mesh", result, "--output", tmp_path / "rough", *sets)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "rough" / "mesh.ply").stat().st_size < (
        0.3 * (result / "mesh.ply").stat().st_size
    )
    assert_one_line(in_this_process("mesh", result, "--output", result), "is read from there")


def test_a_mesh_made_again_is_evaluated_with_the_poses_of_its_run(
    result: Path, tmp_path: Path
) -> None:
    (tmp_path / "made").mkdir()
    run = shutil.copytree(result, tmp_path / "made" / "run")
    done = in_this_process("mesh", run, "--set", "meshing.depth=points", *COARSE_MESH)
    assert done.returncode == 0, done.stderr
    moved = (tmp_path / "made").rename(tmp_path / "moved")
    meshed = moved / "run_mesh"
    # What the user had to do before: the mesh in a folder of the run.
    by_hand = shutil.copytree(result, tmp_path / "by_hand")
    for mesh in meshed.glob("mesh*.ply"):
        shutil.copy(mesh, by_hand)
    found: list[object] = []
    for folder in (meshed, by_hand):
        figures = tmp_path / "figures.json"
        done = in_this_process("eval", folder, "-g", TINY, "--mesh", "--json", figures, "--force")
        assert done.returncode == 0, done.stderr
        content = json.loads(figures.read_text())
        found.append((content["final"], content["mesh"], content["mesh_coarse"]))
        assert (folder / "mesh_error.png").exists()
    assert found[0] == found[1]
    assert not (moved / "run" / "mesh_error.png").exists()
    (moved / "run").rename(moved / "elsewhere")
    gone = in_this_process("eval", meshed, "-g", TINY, "--mesh")
    assert_one_line(gone, "recording.mcap is gone")


def test_a_voxel_too_small_for_the_memory_is_refused_before_the_work(
    result: Path, tmp_path: Path
) -> None:
    sets = ("--output", tmp_path / "small", "--set", "meshing.tsdf.fine_voxel=0.0001")
    for command in (("run", TINY), ("mesh", result)):
        done = in_this_process(*command, *sets)
        assert_one_line(done, "fine_voxel=0.0001 needs")
        assert "would fit" in done.stderr
        assert not (tmp_path / "small").exists()


def test_the_service_replays_to_the_same_bytes(result: Path, tmp_path: Path) -> None:
    arguments = ("--services", "meshing", "--check", "--output", tmp_path / "again")
    done = in_this_process("replay", result, *arguments)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "the same bytes as recorded: mesh/blocks, mesh/final" in done.stdout


def test_a_run_needs_neither_open3d_nor_a_viewer(tmp_path: Path) -> None:
    hidden = tmp_path / "hidden" / "open3d"
    hidden.mkdir(parents=True)
    (hidden / "__init__.py").write_text("raise SystemExit('open3d was imported')")
    (hidden.parent / "sitecustomize.py").write_text("import sys\nsys.modules['rerun'] = None\n")
    environment = {"PYTHONPATH": str(hidden.parent)}
    arguments = ("--output", tmp_path / "result", *COARSE_MESH)
    done = pliant("run", f"{TINY}?frames=12", *arguments, env=environment)
    assert done.returncode == 0, done.stderr
    assert "fine mesh: " in done.stdout
    assert "pliant view" not in done.stderr
    assert (tmp_path / "result" / "mesh.ply").exists()

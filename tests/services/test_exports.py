"""What `pliant export` writes, read by programs that are not ours."""

import shutil
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader

from pliant.bus.replay_bus import ReplayBus
from pliant.config import Config
from pliant.datasets import open_source
from pliant.errors import ResultError
from pliant.export.export import export_result
from pliant.formats.ply import read_ply
from pliant.formats.tum import read_tum
from pliant.messages import topics
from pliant.messages.types import CameraStream
from pliant.viewers.point_blocks import BLOCK_POINTS, PointBlocks
from pliant_services.nodes import recorder

FRAMES = 40


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The result of a run on the smallest built-in sequence."""
    folder = tmp_path_factory.mktemp("result")
    done = subprocess.run(
        [
            *(sys.executable, "-m", "pliant_services.cli", "run", "built-in:tiny"),
            *("--output", folder, "--force"),
        ],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture(scope="module")
def model(result: Path) -> Path:
    return export_result(result, "colmap", None)


def test_foxglove_messages_are_read_with_their_own_definitions(result: Path) -> None:
    pytest.importorskip("foxglove_schemas_protobuf")
    decoder: Any = pytest.importorskip("mcap_protobuf.decoder")
    path = export_result(result, "foxglove", None)
    counts: dict[str, int] = {}
    clouds: dict[str, Any] = {}
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[decoder.DecoderFactory()])
        for schema, channel, _, message in reader.iter_decoded_messages():
            counts[channel.topic] = counts.get(channel.topic, 0) + 1
            if schema.name == "foxglove.PointCloud":
                clouds[channel.topic] = message
    for topic in ("/camera/image", "/camera/calibration", "/camera/tracks"):
        assert counts[topic] == FRAMES
    assert FRAMES // 2 < counts["/tf"] <= FRAMES
    whole = np.frombuffer(clouds["/map/all_points"].data, "<f4").reshape(-1, 4)[:, :3]
    points = read_ply(result / "points.ply").points
    assert sorted(map(tuple, whole.tolist())) == sorted(map(tuple, points.tolist()))


def test_foxglove_gives_the_same_bytes_again(result: Path, tmp_path: Path) -> None:
    pytest.importorskip("foxglove_schemas_protobuf")
    a = export_result(result, "foxglove", tmp_path / "a.mcap")
    b = export_result(result, "foxglove", tmp_path / "b.mcap")
    assert a.read_bytes() == b.read_bytes()


def test_rerun_reads_both_its_file_and_foxgloves(result: Path, tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    pytest.importorskip("foxglove_schemas_protobuf")
    command = shutil.which("rerun", path=str(Path(sys.executable).parent))
    if command is None:
        pytest.skip("the command `rerun` is not here")
    recording = export_result(result, "rerun", tmp_path / "run.rrd")
    foxglove = export_result(result, "foxglove", tmp_path / "run.mcap")
    converted = tmp_path / "converted.rrd"
    for arguments in (
        ["rrd", "verify", recording],
        ["mcap", "check", foxglove],
        ["mcap", "convert", foxglove, "-o", converted],
        ["rrd", "verify", converted],
    ):
        done = subprocess.run([command, *arguments], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
    done = subprocess.run([command, "rrd", "print", recording], capture_output=True, text=True)
    for entity in (
        "camera/image",
        "camera/image/tracks",
        "world/points/0",
        "world/path",
        "world/mesh/final/0",
    ):
        assert f"/map/{entity}" in done.stdout


def test_colmap_reads_a_model_whose_points_are_where_its_images_see_them(model: Path) -> None:
    pycolmap: Any = import_module("pycolmap")
    read = pycolmap.Reconstruction(str(model / "sparse" / "0"))
    assert read.num_images() >= 4
    assert read.num_points3D() > 1000
    said = read.compute_mean_reprojection_error()
    read.update_point_3d_errors()
    assert read.compute_mean_reprojection_error() == pytest.approx(said, abs=1e-3)
    assert said < 0.5
    assert read.compute_mean_track_length() > 3.0
    for image in read.images.values():
        assert (model / "images" / image.name).is_file()


def test_images_are_a_source_with_the_pixels_of_the_run(result: Path, tmp_path: Path) -> None:
    folder = export_result(result, "images", tmp_path / "images")
    source, built_in = open_source(str(folder)), open_source("built-in:tiny")
    assert source.frame_count == FRAMES
    assert not source.calibration.lens.distorts
    theirs = list(built_in)
    assert [f.stamp_ns for f in source] == [f.stamp_ns for f in theirs]


def test_a_recording_is_a_source_of_the_same_frames(result: Path) -> None:
    again = list(open_source(str(result / "recording.mcap")))
    assert again == list(open_source("built-in:tiny"))
    assert [f.index for f in open_source(str(result))] == list(range(FRAMES))


@pytest.mark.parametrize("kind", ["tum", "kitti", "euroc"])
def test_poses_are_those_of_the_result(kind: str, result: Path, tmp_path: Path) -> None:
    path = export_result(result / "recording.mcap", kind, tmp_path / "poses.txt")
    lines = [line for line in path.read_text().splitlines() if not line.startswith("#")]
    assert len(lines) == len(read_tum(result / "trajectory.txt"))
    if kind == "tum":
        assert path.read_text() == (result / "trajectory.txt").read_text()


def test_open3d_reads_the_points(result: Path, tmp_path: Path) -> None:
    open3d: Any = pytest.importorskip("open3d")
    path = export_result(result, "ply", tmp_path / "points.ply")
    cloud = open3d.io.read_point_cloud(str(path))
    assert len(cloud.points) == len(read_ply(result / "points.ply").points)
    assert cloud.has_colors()


def test_evo_reads_the_trajectory(result: Path, tmp_path: Path) -> None:
    path = export_result(result, "tum", tmp_path / "poses.txt")
    done = subprocess.run(
        [Path(sys.executable).parent / "evo_traj", "tum", path],
        capture_output=True,
        text=True,
        env={"HOME": str(tmp_path), "PATH": "/usr/bin:/bin"},
    )
    assert done.returncode == 0, done.stderr
    assert "poses" in done.stdout


def test_wrong_requests_are_one_line(result: Path, tmp_path: Path) -> None:
    with pytest.raises(ResultError, match=r"--to obj: choose foxglove, rerun"):
        export_result(result, "obj", None)
    with pytest.raises(ResultError, match="no such result folder or recording"):
        export_result(tmp_path / "nothing", "tum", None)
    there = tmp_path / "there.txt"
    there.write_text("mine")
    with pytest.raises(ResultError, match="--force"):
        export_result(result, "tum", there)
    assert there.read_text() == "mine"
    with pytest.raises(ResultError, match="is the recording itself"):
        export_result(result, "foxglove", result / "recording.mcap", force=True)
    for kind in ("foxglove", "rerun", "colmap", "images"):
        with pytest.raises(ResultError, match="cannot be"):
            export_result(result, kind, there / "below")
    parts = tmp_path / "recording"
    parts.mkdir()
    (parts / "part_00000.mcap").symlink_to(result / "recording.mcap")
    assert export_result(parts, "tum", None) == tmp_path / "recording_trajectory_tum.txt"


@pytest.mark.parametrize("kind", ["tum", "kitti", "euroc", "ply", "colmap", "images"])
def test_what_is_not_there_is_one_line_and_no_file(kind: str, tmp_path: Path) -> None:
    camera = "model: pinhole\nwidth: 4\nheight: 2\nfx: 1\nfy: 1\ncx: 0\ncy: 0\n"
    stream = CameraStream(
        frame=0, stamp_ns=0, frame_id="", source="", mode="lossless", frames=0,
        calibration=camera, width=4, height=2, fx=1.0, fy=1.0, cx=0.0, cy=0.0,
    )  # fmt: skip
    recorder.run(ReplayBus({topics.STREAM: [stream]}), Config(), tmp_path / "recording.mcap", {})
    with pytest.raises(ResultError, match=r"has no|to export"):
        export_result(tmp_path, kind, tmp_path / "made")
    assert not (tmp_path / "made").exists()


def test_points_that_were_missed_are_right_after_the_next_snapshot() -> None:
    """A viewer that loses updates shows no point that is gone, and in the end those that are."""
    generator = np.random.default_rng(0)
    full, holey = PointBlocks(), PointBlocks()
    alive: dict[int, np.ndarray[Any, Any]] = {}
    window: set[int] = set()
    born = 0
    for step in range(400):
        new = np.arange(born, born + 30)
        born += 30
        for i in new.tolist():
            alive[i] = generator.normal(size=3)
        window |= set(new.tolist())
        removed = generator.choice(sorted(window), 5, replace=False)
        window -= set(removed.tolist())
        for i in removed.tolist():
            del alive[i]
        window -= set(sorted(window)[: max(0, len(window) - 200)])  # they settled
        snapshot = step % 20 == 19
        told = np.array(sorted(window if snapshot else window & set(new.tolist())), np.int64)
        xyz = np.array([alive[i] for i in told.tolist()], np.float32).reshape(-1, 3)
        rgb = np.zeros((len(told), 3), np.uint8)
        full.tell(told, xyz, rgb, np.sort(removed), snapshot=snapshot)
        if step % 60 in (7, 8, 9):
            holey.miss()
        else:
            holey.tell(told, xyz, rgb, np.sort(removed), snapshot=snapshot)
        if snapshot:
            theirs = {tuple(row) for row in holey.everything()[0].tolist()}
            true = {tuple(row) for row in full.everything()[0].tolist()}
            assert theirs <= true
            assert len(theirs) > 0.5 * len(true)
    assert len(full) == len(alive)
    assert full.take_changed()[-1] == (born - 1) // BLOCK_POINTS


def test_every_is_for_surfaces(result: Path, tmp_path: Path) -> None:
    with pytest.raises(ResultError, match="--every: tum has no such option"):
        export_result(result, "tum", tmp_path / "poses.txt", every=2)
    with pytest.raises(ResultError, match="has no surfels"):
        export_result(result, "surface", tmp_path / "surface")

"""What `pliant export` writes, read by programs that are not ours."""

import json
import shutil
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader

from pliant.algorithms.arrays import F64
from pliant.bus.replay_bus import ReplayBus
from pliant.config import Config
from pliant.datasets import open_source
from pliant.datasets.depth import DepthRectifier
from pliant.datasets.source_spec import SourceSpec
from pliant.errors import ResultError
from pliant.export import overview
from pliant.export.export import export_result
from pliant.formats.ply import read_ply
from pliant.formats.tum import read_tum
from pliant.messages import topics
from pliant.messages.types import CameraStream
from pliant.recording.reader import Recording
from pliant.viewers.point_blocks import BLOCK_POINTS, PointBlocks
from pliant_services.nodes import recorder

pytestmark = pytest.mark.system
FRAMES = 40


@pytest.fixture(scope="module")
def result(tiny_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run's result, to which exports may be added."""
    return Path(shutil.copytree(tiny_run, tmp_path_factory.mktemp("result") / "tiny"))


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
    for topic in ("/camera/image", "/camera/tracks"):
        assert counts[topic] == FRAMES
    assert counts["/camera/calibration"] == FRAMES + 1  # and the one that was found in the end
    assert FRAMES // 2 < counts["/tf"] <= FRAMES
    whole = np.frombuffer(clouds["/map/all_points"].data, "<f4").reshape(-1, 4)[:, :3]
    points = read_ply(result / "points.ply").points
    assert sorted(map(tuple, whole.tolist())) == sorted(map(tuple, points.tolist()))


@pytest.mark.parametrize(
    ("to", "name", "says"),
    [
        ("glb", "x.txt", "x.txt: --to glb writes a .glb file"),
        ("glb", "x", "x: --to glb writes a .glb file"),
        ("ply", "x.pcd", "writes a .ply file"),
        ("foxglove", "x.bag", "writes a .mcap file"),
        ("rerun", "x.mcap", "writes a .rrd file"),
        ("obj", "x.obj", "x.obj: --to obj writes a folder: leave out the ending .obj"),
        ("colmap", "x.txt", "writes a folder: leave out the ending .txt"),
        ("picture", "x.txt", "x.txt"),
        ("overlay", "x.txt", "x.txt"),
        ("overview", "x.txt", "x.txt"),
    ],
)
def test_an_ending_that_contradicts_the_format_is_one_line(
    result: Path, tmp_path: Path, to: str, name: str, says: str
) -> None:
    with pytest.raises(ResultError) as refused:
        export_result(result, to, tmp_path / name)
    assert says in str(refused.value)
    assert "\n" not in str(refused.value)
    assert not list(tmp_path.iterdir())


def test_a_name_in_capitals_a_folder_with_a_dot_and_text_under_any_ending_are_taken(
    result: Path, tmp_path: Path
) -> None:
    for to, name in (("ply", "X.PLY"), ("colmap", "model.v2"), ("tum", "poses.tum")):
        assert export_result(result, to, tmp_path / name).exists()


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
        pytest.skip("the command of rerun is not here")
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


def reprojection_errors(reconstruction: Any) -> F64:
    """(N,) px of every observation of a pycolmap.Reconstruction, both ways consistent."""
    errors = list[float]()
    for image in reconstruction.images.values():
        for row, seen in enumerate(image.points2D):
            assert seen.has_point3D()
            point = reconstruction.points3D[seen.point3D_id]
            assert any(
                (each.image_id, each.point2D_idx) == (image.image_id, row)
                for each in point.track.elements
            )
            errors.append(float(np.linalg.norm(image.project_point(point.xyz) - seen.xy)))
    return np.array(errors)


def test_colmap_reads_a_model_whose_points_are_where_its_images_see_them(model: Path) -> None:
    pycolmap: Any = import_module("pycolmap")
    read = pycolmap.Reconstruction(str(model / "sparse" / "0"))
    assert read.num_images() >= 4
    assert read.num_points3D() > 1000
    errors = reprojection_errors(read)
    assert len(errors) == sum(len(p.track.elements) for p in read.points3D.values())
    assert np.median(errors) < 0.3
    said = read.compute_mean_reprojection_error()
    read.update_point_3d_errors()
    assert read.compute_mean_reprojection_error() == pytest.approx(said, abs=1e-3)
    assert read.compute_mean_track_length() > 3.0
    camera = read.cameras[1]
    for image in read.images.values():
        pixels = cv2.imread(str(model / "images" / image.name))
        assert pixels.shape[:2] == (camera.height, camera.width)


def test_nerfstudio_gets_the_images_points_and_poses_of_the_colmap_model(
    result: Path, model: Path, tmp_path: Path
) -> None:
    pycolmap: Any = import_module("pycolmap")
    read = pycolmap.Reconstruction(str(model / "sparse" / "0"))
    by_name = {image.name: image for image in read.images.values()}
    folder = export_result(result, "nerfstudio", tmp_path / "nerfstudio")
    said = json.loads((folder / "transforms.json").read_text())
    fx, fy, cx, cy = (said[key] for key in ("fl_x", "fl_y", "cx", "cy"))
    assert (said["camera_model"], fx, fy, cx, cy) == ("OPENCV", *read.cameras[1].params)
    assert [said[key] for key in ("k1", "k2", "p1", "p2")] == [0.0] * 4
    points = read_ply(folder / said["ply_file_path"])
    assert points.colours is not None
    homogeneous = np.concatenate([points.points, np.ones((len(points.points), 1))], axis=1)
    assert len(said["frames"]) == len(by_name)
    for frame in said["frames"]:
        image = folder / frame["file_path"]
        assert image.read_bytes() == (model / frame["file_path"]).read_bytes()
        assert cv2.imread(str(image)).shape[:2] == (said["h"], said["w"])
        T_world_camera = np.array(frame["transform_matrix"])
        np.testing.assert_allclose(T_world_camera[3], (0.0, 0.0, 0.0, 1.0))
        np.testing.assert_allclose(np.linalg.det(T_world_camera[:3, :3]), 1.0)
        x, y, z, _ = np.linalg.inv(T_world_camera) @ homogeneous.T  # right, up, back
        ahead = z < 0.0
        pixels = np.stack([fx * x / -z + cx, fy * -y / -z + cy], axis=1)
        theirs = by_name[image.name]
        for row in np.flatnonzero(ahead)[::500]:
            seen = theirs.project_point(points.points[row].astype(np.float64))
            np.testing.assert_allclose(pixels[row], seen, atol=1e-3)


def test_a_splat_has_dense_points_for_every_trainer(
    result: Path, model: Path, tmp_path: Path
) -> None:
    pycolmap: Any = import_module("pycolmap")
    folder = export_result(result, "splat", tmp_path / "splat")
    dense = read_ply(folder / "sparse" / "0" / "points3D.ply")
    mesh = read_ply(result / "mesh.ply")
    assert dense.normals is not None
    lengths = np.linalg.norm(dense.normals, axis=1)
    on_mesh = lengths > 0.5
    np.testing.assert_allclose(lengths[on_mesh], 1.0, atol=1e-3)
    assert set(map(tuple, dense.points[on_mesh].tolist())) <= set(map(tuple, mesh.points.tolist()))
    assert 0.4 * len(mesh.points) < on_mesh.sum() <= 200_000
    read, theirs = (pycolmap.Reconstruction(str(each / "sparse" / "0")) for each in (folder, model))
    sparse = theirs.num_points3D()
    assert read.num_points3D() == sparse + on_mesh.sum()
    assert sum(len(p.track.elements) > 0 for p in read.points3D.values()) == sparse
    said = json.loads((folder / "transforms.json").read_text())
    assert (folder / said["ply_file_path"]).exists()
    names = {Path(frame["file_path"]).name for frame in said["frames"]}
    assert names == {each.name for each in (folder / "images").iterdir()}
    assert names == {image.name for image in read.images.values()}
    assert len(names) >= 4


def test_depth_is_that_of_the_map_in_the_unit_that_is_said(
    result: Path, model: Path, tmp_path: Path
) -> None:
    pycolmap: Any = import_module("pycolmap")
    read = pycolmap.Reconstruction(str(model / "sparse" / "0"))
    folder = export_result(result, "depth", tmp_path / "depth")
    source = open_source(SourceSpec(location=str(folder), depth="all"))
    rectifier, lens = DepthRectifier(source.calibration), source.calibration.lens
    assert source.frame_count is not None
    assert source.frame_count >= read.num_images() - 1
    frames = [frame for frame in source if frame.depth]
    names = [line.split()[1] for line in (folder / "depth.txt").read_text().splitlines()[1:]]
    depths = {Path(n).name: rectifier.rectify(f.index, f.depth) for n, f in zip(names, frames)}
    assert len(read_tum(folder / "groundtruth.txt")) == source.frame_count
    errors = list[float]()
    for image in read.images.values():
        for seen in image.points2D if image.name in depths else ():
            z = (image.cam_from_world() * read.points3D[seen.point3D_id].xyz)[2]
            column, row = np.floor(seen.xy).astype(int)
            if known := depths[image.name][row, column]:
                errors.append(abs(known / z - 1.0))
    assert len(errors) > 5000
    assert np.median(errors) < 1e-2  # the surface is smoothed
    for name, known in depths.items():
        coloured = cv2.imread(str(folder / "normals" / name))[..., ::-1]
        there = coloured.any(axis=2)
        assert there[known > 0.0].mean() > 0.99
        normals = coloured[there] / 127.5 - 1.0
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=0.02)
        v, u = np.nonzero(there)
        rays = np.stack([(u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy, np.ones(len(u))], axis=1)
        assert ((normals * rays).sum(axis=1) < 0.02).all()  # towards the camera


def test_images_are_a_source_with_the_pixels_of_the_run(result: Path, tmp_path: Path) -> None:
    told: list[tuple[int, int]] = []
    folder = export_result(
        result, "images", tmp_path / "images", progress=lambda *each: told.append(each)
    )
    assert told == [(done, FRAMES) for done in range(1, FRAMES + 1)]
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


def test_the_overview_goes_from_tracks_to_points_to_the_mesh(
    result: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(overview, "_SWING", 12)  # each costs as much as all that is looked at here
    path = export_result(result, "overview", tmp_path / "o.webp")
    good, animation = cv2.imreadanimation(str(path))
    assert good
    frames = [frame[:, :, :3].astype(int) for frame in animation.frames]
    assert frames[0].shape[1] == 960
    # At the end the mesh alone, where the image was: dark ground is seen.
    dark = [(frame.max(axis=2) < 40).mean() for frame in (frames[0][:360, :400], frames[-1])]
    assert dark[0] < 0.2 < dark[1]
    assert np.abs(frames[-1] - frames[-10]).max() > 100


def test_a_picture_needs_no_images(result: Path, tmp_path: Path) -> None:
    shapes: list[tuple[int, ...]] = []
    recording = Recording(result / "recording.mcap")
    for left_out in (None, topics.SOURCE):
        kept = [t for t in topics.TOPICS if t.logged and t != left_out]
        messages = {topic: list(recording.decoded(topic)) for topic in kept}
        path = tmp_path / f"{len(shapes)}.mcap"
        recorder.run(ReplayBus(messages), Config(), path, {})
        picture: Any = cv2.imread(str(export_result(path, "picture", None)))
        shapes.append(picture.shape)
    assert shapes[0][1] - shapes[1][1] == 644  # an image and the gap beside it


def test_open3d_reads_the_points(result: Path, tmp_path: Path) -> None:
    try:
        open3d: Any = import_module("open3d")
    except (ImportError, OSError) as error:
        pytest.skip(f"open3d is installed but cannot be loaded ({error})")
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
    with pytest.raises(ResultError, match=r"--to stl: choose foxglove, rerun"):
        export_result(result, "stl", None)
    with pytest.raises(ResultError, match="no such result folder or recording"):
        export_result(tmp_path / "nothing", "tum", None)
    there = tmp_path / "there.txt"
    there.write_text("mine")
    with pytest.raises(ResultError, match="--force"):
        export_result(result, "tum", there)
    assert there.read_text() == "mine"
    with pytest.raises(ResultError, match="is read from there"):
        export_result(result, "foxglove", result / "recording.mcap", force=True)
    for kind, below in (
        ("foxglove", "x.mcap"),
        ("rerun", "x.rrd"),
        ("colmap", "x"),
        ("images", "x"),
    ):
        with pytest.raises(ResultError, match="cannot be"):
            export_result(result, kind, there / below)
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
    made = tmp_path / ("made.ply" if kind == "ply" else "made")
    with pytest.raises(ResultError, match=r"has no|to export"):
        export_result(tmp_path, kind, made)
    assert not made.exists()


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
        full.update(told, xyz, rgb, 0 * told, np.sort(removed), snapshot=snapshot)
        if step % 60 in (7, 8, 9):
            holey.miss()
        else:
            holey.update(told, xyz, rgb, 0 * told, np.sort(removed), snapshot=snapshot)
        if snapshot:
            theirs = {tuple(row) for row in holey.everything()[0].tolist()}
            true = {tuple(row) for row in full.everything()[0].tolist()}
            assert theirs <= true
            assert len(theirs) > 0.5 * len(true)
    assert len(full) == len(alive)
    assert full.take_changed()[-1] == (born - 1) // BLOCK_POINTS


def test_every_is_for_surfaces(result: Path, tmp_path: Path) -> None:
    with pytest.raises(ResultError, match="--every: not available for tum"):
        export_result(result, "tum", tmp_path / "poses.txt", every=2)
    with pytest.raises(ResultError, match="has no surfels"):
        export_result(result, "surface", tmp_path / "surface")

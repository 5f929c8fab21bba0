"""``pliant run --profile deformable`` with real processes, and what follows from its recording."""

import importlib
import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from running import assert_one_line, in_this_process, undescribed

from pliant.export.export import export_result
from pliant.formats.ply import read_ply

pytestmark = pytest.mark.system

FRAMES = 4
TINY = f"built-in:tiny?frames={FRAMES}"
FEW = ("--set", "surfels.max_surfels=60", "--set", "bus.checkpoint_frames=1")


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("surfels") / "tiny"
    done = in_this_process("run", TINY, "--profile", "deformable", "--output", folder, *FEW)
    assert done.returncode == 0, done.stderr
    assert f"{FRAMES} frames" in done.stdout
    assert done.stdout.splitlines()[-1] == "good: all frames have a pose in one segment"
    return folder


def test_a_run_leaves_everything_a_user_opens(result: Path) -> None:
    report = json.loads((result / "report.json").read_text())
    assert report["complete"]
    assert report["frames"] == report["frames_with_pose"] == FRAMES
    assert report["births"] == 60
    assert len(report["alive_per_frame"]) == FRAMES
    assert report["alive_per_frame"][0] == 60
    assert (report["verdict"], report["doubtful_frames"]) == ("good", [])
    assert undescribed(report) == set()
    assert len(np.loadtxt(result / "trajectory.txt")) == FRAMES
    with np.load(result / "surfels.npz") as surfels:
        counts = surfels["counts"]
        assert counts.sum() == len(surfels["ids"]) == len(surfels["positions"])
        alive = np.split(surfels["state"] == 0, np.cumsum(counts)[:-1])
        assert [int(a.sum()) for a in alive] == report["alive_per_frame"]
        assert surfels["T_world_camera"].shape == (FRAMES, 4, 4)


def test_the_page_shows_the_surface(result: Path) -> None:
    page = (result / "report.html").read_text(encoding="utf-8")
    (told,) = re.findall(r'id="scene">(.*?)</script>', page, re.DOTALL)
    layers = {layer["name"]: layer for layer in json.loads(told)["layers"]}
    assert 0 < layers["points"]["count"] <= 60
    keys = layers["mesh"]["keys"]
    assert [key["name"] for key in keys] == [f"frame {n}" for n in range(FRAMES)]
    assert layers["mesh"]["count"] == keys[-1]["vertices"][1]
    assert keys[-1]["triangles"][1] - keys[-1]["triangles"][0] > layers["points"]["count"]
    assert layers["path"]["count"] == FRAMES
    assert f"{FRAMES}, {FRAMES} tracked" in page
    assert '<span class="verdict good">good</span>' in page
    assert "surfels.npz" in page
    assert "://" not in page


def test_surfels_are_drawn_in_both_viewers(result: Path, tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    pytest.importorskip("foxglove_schemas_protobuf")
    scene_update: Any = importlib.import_module("foxglove_schemas_protobuf.SceneUpdate_pb2")
    path = export_result(result, "rerun", tmp_path / "run.rrd")
    command = Path(sys.executable).with_name("rerun")
    if command.is_file():
        done = subprocess.run([command, "rrd", "print", path], capture_output=True, text=True)
        assert "/map/world/surfels" in done.stdout
        assert "/map/world/surface" in done.stdout
        assert "/map/camera/image/surfels" in done.stdout
    path = export_result(result, "foxglove", tmp_path / "run.mcap")
    counts: dict[str, int] = {}
    last = scene_update.SceneUpdate()
    with path.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages():
            counts[channel.topic] = counts.get(channel.topic, 0) + 1
            if channel.topic == "/surfels/quads":
                last = scene_update.SceneUpdate.FromString(message.data)
    for topic in (*(f"/surfels/{name}" for name in ("quads", "points", "image", "mesh")), "/tf"):
        assert counts[topic] == FRAMES
    with np.load(result / "surfels.npz") as surfels:
        centres = surfels["positions"][-surfels["counts"][-1] :]
    triangles = last.entities[0].triangles[0]
    corners = np.array([(p.x, p.y, p.z) for p in triangles.points]).reshape(-1, 4, 3)
    np.testing.assert_allclose(corners.mean(axis=1), centres, atol=1e-5)
    assert len(triangles.colors) == 4 * len(centres)
    assert max(triangles.indices) == 4 * len(centres) - 1


def test_a_replay_and_a_run_on_the_recording_give_the_same(result: Path, tmp_path: Path) -> None:
    again = in_this_process(
        "replay", result, "--services", "surfels", "--check", "--output", tmp_path / "replay"
    )
    assert again.returncode == 0, again.stdout + again.stderr
    assert "the same bytes as recorded: surfels/state" in again.stdout
    once_more = in_this_process(
        "run", result, "--profile", "deformable", "--output", tmp_path / "run",
        "--on-crash", "restart", *FEW,
    )  # fmt: skip
    assert once_more.returncode == 0, once_more.stderr
    expected = (result / "surfels.npz").read_bytes()
    for folder in ("replay", "run"):
        assert (tmp_path / folder / "surfels.npz").read_bytes() == expected, folder


def test_the_surface_is_a_mesh_for_every_other_frame(result: Path, tmp_path: Path) -> None:
    done = in_this_process(
        "export", result, "--to", "surface", "--every", "2", "--output", tmp_path / "surface"
    )
    assert done.returncode == 0, done.stderr
    files = sorted((tmp_path / "surface").iterdir())
    assert [file.name for file in files] == ["000000.ply", "000002.ply"]
    mesh = read_ply(files[1])
    assert mesh.faces is not None
    assert mesh.colours is not None
    assert len(mesh.faces) > 20
    assert np.ptp(mesh.colours) > 50  # of the image


def test_the_animation_has_the_colours_of_the_images(result: Path, tmp_path: Path) -> None:
    done = in_this_process(
        "export", result, "--to", "animation", "--output", tmp_path / "surface.glb"
    )
    assert done.returncode == 0, done.stderr
    data = (tmp_path / "surface.glb").read_bytes()
    size = int.from_bytes(data[12:16], "little")
    document, body = json.loads(data[20 : 20 + size]), data[28 + size :]
    (primitive,) = document["meshes"][0]["primitives"]
    assert len(primitive["targets"]) == FRAMES - 1
    accessor = document["accessors"][primitive["attributes"]["COLOR_0"]]
    assert (accessor["type"], accessor["normalized"]) == ("VEC4", True)
    view = document["bufferViews"][accessor["bufferView"]]
    rows = np.frombuffer(body, "<u2", 4 * accessor["count"], view["byteOffset"]).reshape(-1, 4)
    assert (rows[:, 3] == 65535).all()
    assert np.ptp(rows[:, :3]) > 10_000


def test_its_poses_are_exported(result: Path, tmp_path: Path) -> None:
    exported = export_result(result, "tum", tmp_path / "poses.txt")
    assert exported.read_bytes() == (result / "trajectory.txt").read_bytes()


def test_the_overlay_shows_how_each_surfel_fares(result: Path, tmp_path: Path) -> None:
    done = in_this_process(
        "export", result, "--to", "overlay", "--output", tmp_path / "surfels.avi"
    )
    assert done.returncode == 0, done.stderr
    video = cv2.VideoCapture(str(tmp_path / "surfels.avi"))
    pictures = [video.read()[1] for _ in range(FRAMES)]
    assert not video.read()[0]
    blue, green, red = np.moveaxis(pictures[-1].astype(int), 2, 0)
    assert ((green > red + 60) & (green > blue + 60)).sum() > 60 * 10  # alive


def test_wrong_use_is_one_line(tmp_path: Path) -> None:
    done = in_this_process("run", TINY, "--camera", "static", "--output", tmp_path / "x")
    assert done.returncode == 2
    assert "--profile deformable" in done.stderr
    images = tmp_path / "images"
    images.mkdir()
    (images / "0.pgm").write_bytes(b"P5 64 48 255 " + bytes(64 * 48))
    done = in_this_process("run", images, "--fov", "60", "--profile", "deformable")
    assert_one_line(done, "has no depth")

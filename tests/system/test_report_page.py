"""report.html: what a browser shows of it, and what it says of runs that went wrong."""

import base64
import json
import re
import shutil
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from browser import in_browser
from running import TINY, in_this_process, undescribed

import pliant
from pliant.algorithms.meshing.mesh_blocks import TriangleMesh
from pliant.messages import topics
from pliant.recording.reader import Recording
from pliant.recording.writer import RecordingWriter
from pliant.results.calibration import FOUND
from pliant.results.folder import RECORDING_NAME
from pliant.results.page.advice import advice
from pliant.results.page.scene import make_scene
from pliant.results.write import write_results

pytestmark = pytest.mark.system


@pytest.fixture(scope="module")
def result(tiny_run: Path) -> pliant.Result:
    return pliant.open(tiny_run)


@pytest.fixture(scope="module")
def page(result: pliant.Result) -> str:
    return (result.path / "report.html").read_text(encoding="utf-8")


def test_it_prints_the_report(result: pliant.Result, page: str) -> None:
    report = json.loads((result.path / "report.json").read_text())
    for said in ("built-in:tiny", report["verdict_reason"], f"{report['points']:,} points"):
        assert said in page
    (listed,) = re.findall(r"<h2>Files</h2><table>(.*?)</table>", page, re.DOTALL)
    for name in re.findall(r"<th>(.*?)</th>", listed):
        assert (result.path / name).exists(), name


def test_every_field_of_the_report_is_documented(result: pliant.Result) -> None:
    report = json.loads((result.path / "report.json").read_text())
    assert undescribed(report) == set()
    assert undescribed({**report, "new": 1, "known_map": {"newer": 2}}) == {"new", "newer"}


def test_nothing_in_it_points_elsewhere(page: str) -> None:
    assert not re.findall(r"(?:src|href)=[\"'](?!data:)", page)
    assert "://" not in page
    assert "default-src 'none'" in page


def test_the_clip_has_a_picture_for_each_keyframe(result: pliant.Result, page: str) -> None:
    (data,) = re.findall(r'src="data:image/webp;base64,([^"]+)"', page)
    read, clip = cv2.imdecodeanimation(np.frombuffer(base64.b64decode(data), np.uint8))
    assert read
    assert len(clip.frames) == min(24, len(result.keyframes))
    assert np.asarray(clip.frames[0]).std() > 10.0


def test_the_scene_has_the_points_the_path_and_the_mesh(result: pliant.Result, page: str) -> None:
    header, data = scene_of(page)
    mesh, points, path = (layer_of(header, data, name) for name in ("mesh", "points", "path"))
    step = np.array(header["size"]) / 65535
    assert np.abs(path - result.trajectory.positions).max() < step.max()
    assert result.mesh is not None
    own = mean_and_spread(result.mesh.positions, result.mesh.triangles)
    np.testing.assert_allclose(mean_and_spread(mesh, triangles_of(header, data)), own, atol=0.01)
    low, high = np.array(header["low"]), np.add(header["low"], header["size"])
    inside = ((result.points >= low) & (result.points <= high)).all(axis=1)
    assert inside.mean() > 0.95
    assert len(points) == inside.sum()
    assert np.abs(points - result.points[inside]).max() < step.max()


def test_the_mesh_has_a_texture_of_its_keyframes(result: pliant.Result, page: str) -> None:
    """Of many more texels than it has vertices, whose colours alone would be a blur."""
    header, data = scene_of(page)
    (layer,) = (each for each in header["layers"] if each["name"] == "mesh")
    encoded = base64.b64decode(header["texture"].removeprefix("data:image/webp;base64,"))
    read = cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_COLOR_RGB)
    assert read is not None
    texture = np.asarray(read, np.float64)
    assert texture.shape == (1024, 1024, 3)
    assert len(encoded) < 500_000
    uvs = np.frombuffer(data, "<u2", 2 * layer["count"], layer["uvs"]).reshape(-1, 2) / 65535
    columns, rows = np.clip((uvs * 1024).astype(int), 0, 1023).T
    assert result.mesh is not None
    places = layer_of(header, data, "mesh")[::50].astype(np.float32)
    away = np.linalg.norm(places[:, None] - result.mesh.positions[None, ::10], axis=2)
    own = result.mesh.colours[::10][away.argmin(axis=1)].astype(np.float64)
    assert np.median(np.abs(texture[rows, columns][::50] - own)) < 15.0


def test_a_browser_draws_it(result: pliant.Result, tmp_path: Path) -> None:
    picture = tmp_path / "page.png"
    done = in_browser(result.path / "report.html", tmp_path, f"--screenshot={picture}")
    assert picture.exists(), done.stderr
    shown = cv2.imread(str(picture))
    view = shown[120:740, 20:960].astype(int)
    ground = np.array([24, 19, 16])
    drawn = np.abs(view - ground).max(axis=2) > 8
    assert 0.03 < drawn.mean() < 0.99  # a map on its ground, not a blank canvas
    orange = (view[..., 2] > 180) & (view[..., 0] < 120)
    assert orange.sum() > 20  # the camera's path


def test_on_a_telephone_the_map_is_whole_too(result: pliant.Result, tmp_path: Path) -> None:
    picture = tmp_path / "page.png"
    what = f"--screenshot={picture}"
    done = in_browser(result.path / "report.html", tmp_path, what, "500,900")
    assert picture.exists(), done.stderr
    shown = cv2.imread(str(picture))
    assert shown is not None
    ground = np.array([24, 19, 16])
    drawn = np.abs(shown[120:700, 20:465].astype(int) - ground).max(axis=2) > 8
    assert drawn.mean() > 0.03
    assert drawn[:, [0, -1]].mean() < 0.1  # nothing of it is cut off at its sides


def test_the_truth_adds_the_error_over_time(result: pliant.Result, tmp_path: Path) -> None:
    folder = tmp_path / "result"
    shutil.copytree(result.path, folder)
    page = folder / "report.html"
    before = page.read_text(encoding="utf-8")
    said: list[str] = []
    for _ in range(2):  # the second instead of the first
        done = in_this_process("eval", folder, "--groundtruth", TINY)
        assert done.returncode == 0, done.stderr
        assert f"error over time: {page}" in done.stdout
        said.append(page.read_text(encoding="utf-8"))
    assert said[0] == said[1]
    head, section, rest = said[0].split("<!-- against the truth -->")
    assert before == f"{head}{'<!-- against the truth -->' * 2}{rest}"
    final, online = re.findall(r'<polyline [^>]*points="([^"]+)"', section)
    assert len(final.split()) == len(result.trajectory)
    assert len(online.split()) == len(result.online_trajectory)
    (rmse,) = re.findall(r"final \(blue\): RMSE ([^;]+);", section)
    assert re.search(rf"ATE RMSE +{re.escape(rmse)} ", done.stdout)


def test_two_picked_points_show_their_distance(result: pliant.Result, tmp_path: Path) -> None:
    clicks = """<script>setTimeout(() => {
      const canvas = document.getElementById("view"), box = canvas.getBoundingClientRect();
      for (let x = 20; x < box.width; x += 20) for (let y = 20; y < box.height; y += 20)
        if (!document.getElementById("picked").textContent.includes("apart"))
          canvas.dispatchEvent(new MouseEvent("dblclick", {clientX: box.left + x, clientY: box.top + y}));
    }, 1000)</script>"""  # noqa: E501
    page = tmp_path / "page.html"
    page.write_text((result.path / "report.html").read_text(encoding="utf-8") + clicks)
    shown = in_browser(page, tmp_path, "--dump-dom").stdout
    told = re.search(r'"picked">([\d.]+) apart; [^<]*--points (\S+) (\S+) METRES', shown)
    assert told is not None
    apart, a, b = told.groups()
    between = np.subtract(*(np.array(point.split(","), float) for point in (a, b)))
    assert abs(np.linalg.norm(between) / float(apart) - 1.0) < 0.01
    assert result.mesh is not None
    for point in (a, b):
        away = result.mesh.positions - np.array(point.split(","), float)
        assert np.linalg.norm(away, axis=1).min() < 0.05


def test_a_page_without_a_map_has_the_reason(tmp_path: Path) -> None:
    sequence = tmp_path / "still"
    (sequence / "images").mkdir(parents=True)
    squares = np.random.default_rng(0).integers(0, 255, (12, 16), dtype=np.uint8)
    image = cv2.imencode(".png", np.kron(squares, np.ones((10, 10), np.uint8)))[1].tobytes()
    for n in range(6):
        (sequence / "images" / f"{n}.png").write_bytes(image)
    listed = "".join(f"{0.1 * n:.1f} images/{n}.png\n" for n in range(6))
    (sequence / "rgb.txt").write_text(listed)
    (sequence / "calib.yaml").write_text(
        "width: 160\nheight: 120\nfx: 150\nfy: 150\ncx: 80\ncy: 60\n"
    )
    folder = pliant.run(sequence, output=tmp_path / "result", quiet=True).path
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert "No map could start" in page
    assert "canvas id" not in page


@pytest.mark.parametrize("updates", [0, 1, 5, 40])
@pytest.mark.parametrize("keyframes", [0, 1, 2, 40])
def test_a_run_that_was_cut_off_has_a_page_too(
    result: pliant.Result, tmp_path: Path, updates: int, keyframes: int
) -> None:
    """What keyframes saw reaches a disk before or after the map that they belong to."""
    whole = Recording(result.path / RECORDING_NAME)
    kept = {topics.STREAM: 1, topics.MAP_UPDATE: updates, topics.KEYFRAME: keyframes}
    with RecordingWriter(tmp_path / RECORDING_NAME, whole.metadata()) as part:
        for topic, count in kept.items():
            for message in islice(whole.messages(topic), count):
                part.write(topic, message.data, sequence=0, log_time_ns=0, publish_time_ns=0)
    write_results(tmp_path)
    poses = (tmp_path / "trajectory.txt").read_text(encoding="utf-8").strip()
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert ("canvas id" in page) == bool(poses)


def scene_of(page: str) -> tuple[dict[str, Any], bytes]:
    (header,) = re.findall(r'id="scene">(.*?)</script>', page, re.DOTALL)
    (data,) = re.findall(r'id="bytes">(.*?)</script>', page, re.DOTALL)
    return json.loads(header), base64.b64decode(data)


def mean_and_spread(places: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """(2, 3) over the area of a mesh, however many triangles are where."""
    a, b, c = places[triangles].astype(np.float64).transpose(1, 0, 2)
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    centres = (a + b + c) / 3.0
    mean = np.average(centres, axis=0, weights=areas)
    return np.array([mean, np.sqrt(np.average((centres - mean) ** 2, axis=0, weights=areas))])


def triangles_of(header: dict[str, Any], data: bytes) -> np.ndarray:
    (layer,) = (each for each in header["layers"] if each["name"] == "mesh")
    return np.frombuffer(data, "<u4", 3 * layer["triangles"], layer["indices"]).reshape(-1, 3)


def layer_of(header: dict[str, Any], data: bytes, name: str) -> np.ndarray:
    (layer,) = (each for each in header["layers"] if each["name"] == name)
    shares = np.frombuffer(data, "<u2", 3 * layer["count"], layer["places"]).reshape(-1, 3)
    return np.array(header["low"]) + shares / 65535 * np.array(header["size"])


def sheet(side: int) -> TriangleMesh:
    """A wavy sheet of 2 (side - 1)^2 triangles, normals up, every second triangle turned over."""
    x, y = np.meshgrid(np.arange(side), np.arange(side), indexing="ij")
    z = np.sin(x / 10.0)
    positions = np.stack([x, y, z], axis=-1).reshape(-1, 3).astype(np.float32)
    a = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).ravel()
    triangles = np.concatenate(
        [np.stack([a, a + side, a + 1], 1), np.stack([a + 1, a + side + 1, a + side], 1)]
    )
    return TriangleMesh(
        positions=positions,
        normals=np.tile(np.array([0, 0, 1], np.float32), (len(positions), 1)),
        colours=np.full((len(positions), 3), 100, np.uint8),
        triangles=triangles.astype(np.int32),
    )


def test_all_triangles_turn_outwards() -> None:
    mesh = sheet(20)
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, 0, 3] = 1.0
    scene = make_scene(mesh.positions.astype(np.float64), mesh.colours, poses, mesh)
    header, data = json.loads(scene.header), base64.b64decode(scene.bytes)
    (layer,) = (each for each in header["layers"] if each["name"] == "mesh")
    corners = layer_of(header, data, "mesh")[triangles_of(header, data)]
    out = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert layer["triangles"] > 500
    assert (out[:, 2] > 0.0).all()


def report(**changes: Any) -> dict[str, Any]:
    return {
        "segments": [{"id": 0, "first_frame": 0, "frames": 100}],
        "frames": 100,
        "frames_with_pose": 100,
        "frames_without_pixels": {},
        "frames_passed_over": [],
        "median_tracks_per_frame": 9000.0,
        "median_inliers_per_frame": 6000.0,
        "doubtful_frames": [],
        "verdict": "good",
        "verdict_reason": "all frames have a pose in one segment",
        "calibration_verdict": "",
        "last_reason": "",
        **changes,
    }


STAMPS = {frame: 10**9 + frame * 33_000_000 for frame in range(100)}


def test_a_good_run_has_no_advice() -> None:
    assert advice(report(), STAMPS) == []
    # A clip so short that all of its frames waited for the map to begin.
    assert advice(report(median_inliers_per_frame=0.0), STAMPS) == []
    assert advice(report(calibration_verdict=f"{FOUND} (60.0 degrees)"), STAMPS) == []


def test_advice_does_not_repeat_the_verdict() -> None:
    """And the frame in a hundred that is doubtful is not what makes the run so."""
    open_lens = "unknown focal length"
    doubtful = {"verdict": "doubtful", "verdict_reason": open_lens, "doubtful_frames": [7]}
    assert advice(report(calibration_verdict=open_lens, **doubtful), STAMPS) == []


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"segments": [], "frames_with_pose": 0, "last_reason": "too little parallax"}, "parallax"),
        (
            {
                "segments": [
                    {"id": 0, "first_frame": 0, "frames": 50},
                    {"id": 1, "first_frame": 60, "frames": 40},
                ]
            },
            "Before 2.0 s",
        ),
        ({"frames_with_pose": 80}, "No pose for 20 frames"),
        ({"median_tracks_per_frame": 100.0}, "100 tracks"),
        ({"median_inliers_per_frame": 100.0}, "rotated more than it moved"),
        ({"doubtful_frames": [*range(30)], "verdict": "doubtful"}, "30 poses rely on"),
        ({"calibration_verdict": "the focal length is wrong"}, "The focal length is wrong."),
        ({"frames_passed_over": [5]}, "was too slow"),
        ({"frames_without_pixels": {"5": "dropped"}}, "was too slow"),
        (
            {"frames_without_pixels": {str(n): "broken: cut off" for n in range(9)}},
            "9 broken images",
        ),
    ],
)
def test_advice_names_the_fault(changes: dict[str, Any], said: str) -> None:
    (line,) = advice(report(**changes), STAMPS)
    assert said in line

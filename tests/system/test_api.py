"""``import pliant``: the numbers of the processes, as arrays."""

import inspect
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import typer

import pliant
from pliant.algorithms.camera import PinholeCamera
from pliant.datasets import open_source
from pliant.datasets.calibration_files import read_calibration
from pliant.datasets.rectifier import decode
from pliant.errors import CalibrationError, ConfigError, DatasetError, RecordingError, ResultError
from pliant.formats.ply import read_ply
from pliant.formats.tum import read_tum
from pliant_services.cli.commands import app

TINY = "built-in:tiny"

pytestmark = pytest.mark.system


@pytest.fixture(scope="module")
def result(tiny_run: Path) -> pliant.Result:
    return pliant.open(tiny_run)


@pytest.fixture(scope="module")
def followed() -> list[pliant.Tracked]:
    return list(pliant.follow(TINY))


def test_a_result_is_what_its_files_hold(result: pliant.Result) -> None:
    kept = read_tum(result.path / "trajectory.txt")
    np.testing.assert_array_equal(result.trajectory.stamps_ns, kept.stamps_ns)
    np.testing.assert_allclose(result.trajectory.positions, kept.positions, atol=1e-6)
    online = read_tum(result.path / "trajectory_online.txt")
    np.testing.assert_allclose(result.online_trajectory.positions, online.positions, atol=1e-6)
    cloud = read_ply(result.path / "points.ply")
    np.testing.assert_allclose(result.points, cloud.points, atol=1e-5)
    np.testing.assert_array_equal(result.colours, cloud.colours)
    assert result.mesh is not None
    surface = read_ply(result.path / "mesh.ply")
    np.testing.assert_array_equal(result.mesh.triangles, surface.faces)
    np.testing.assert_array_equal(result.mesh.positions, surface.points)
    assert result.calibration == read_calibration(result.path / "calibration.yaml")
    assert result.report["verdict"] == "good"


def test_keyframes_see_the_points_where_they_project(result: pliant.Result) -> None:
    points = result.history.points()
    where = dict(zip(np.asarray(points.ids).tolist(), points.positions, strict=True))
    assert len(result.keyframes) > 3
    for keyframe in result.keyframes:
        known = [n for n, point in enumerate(keyframe.point_ids.tolist()) if point in where]
        assert len(known) > 50
        xyz = np.array([where[keyframe.point_ids[n]] for n in known])
        T_camera_world = np.linalg.inv(keyframe.T_world_camera)
        seen = result.camera.project(xyz @ T_camera_world[:3, :3].T + T_camera_world[:3, 3])
        error = np.linalg.norm(seen - keyframe.points_px[known], axis=1)
        assert np.median(error) < 1.0
        assert keyframe.image.shape == (result.camera.height, result.camera.width, 3)


def test_any_frame_can_be_looked_up(result: pliant.Result) -> None:
    dataset = list(open_source(TINY))
    for number in (0, 17, len(dataset) - 1):
        assert result.tracks(number).frame == number
        np.testing.assert_array_equal(result.image(number), decode(dataset[number]))
    assert len(result.tracks(17).ids) > 100
    for number in (-1, len(dataset)):
        with pytest.raises(ResultError, match=f"frame {number} was not recorded"):
            result.tracks(number)


def test_a_recording_alone_is_opened_too(result: pliant.Result) -> None:
    alone = pliant.open(result.path / "recording.mcap")
    np.testing.assert_array_equal(alone.points, result.points)
    assert alone.report == result.report


def test_a_notebook_shows_verdict_and_picture(result: pliant.Result) -> None:
    shown = result._repr_html_()
    assert "good" in shown
    assert "data:image/png;base64," in shown
    picture = result.picture(320, 240)
    assert picture.shape == (240, 320, 3)
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 100


def test_following_a_source_gives_the_numbers_of_the_processes(
    result: pliant.Result, followed: list[pliant.Tracked]
) -> None:
    slam = followed[-1].slam
    np.testing.assert_array_equal(slam.trajectory.T_world_camera, result.trajectory.T_world_camera)
    np.testing.assert_array_equal(slam.points, result.points)
    online = result.online_trajectory
    told = [frame for frame in followed if frame.T_world_camera is not None]
    assert [frame.stamp_ns for frame in told] == online.stamps_ns.tolist()
    poses = np.array([frame.T_world_camera for frame in told])
    np.testing.assert_allclose(poses, online.T_world_camera, atol=1e-12)


def test_a_run_takes_what_the_command_takes() -> None:
    """But for what is for a terminal, and for runs that are resumed or read their settings."""
    command = typer.main.get_command(app).commands["run"]  # type: ignore[attr-defined]
    left = {"view", "save", "poses", "config", "set", "on_crash", "resume", "port"}
    options = {option.opts[0].removeprefix("--").replace("-", "_") for option in command.params}
    given = inspect.signature(pliant.run).parameters.keys()
    assert options - given == left
    assert given - options == {"settings", "on_frame"}


def test_a_run_prints_each_pose_as_it_comes(tmp_path: Path) -> None:
    told: list[tuple[int, object]] = []
    part = pliant.run(
        TINY, output=tmp_path / "part", start=0.2, every=2, sharpest=True, max_size=280,
        settings={"meshing.enabled": False}, quiet=True,
        on_frame=lambda frame, T_world_camera: told.append((frame, T_world_camera)),
    )  # fmt: skip
    assert part.camera.width == 280
    assert [frame for frame, _ in told] == list(range(part.report["frames"]))
    assert part.report["frames"] < 20
    poses = [T for _, T in told if T is not None]
    np.testing.assert_allclose(np.array(poses), part.online_trajectory.T_world_camera, atol=1e-7)
    assert 0 < len(poses) < len(told)  # a map begins once the camera has moved
    found = list[object]()
    within = pliant.run(
        TINY, output=tmp_path / "within", end=0.3, map=part.path, localise=True,
        settings={"meshing.enabled": False}, quiet=True,
        on_frame=lambda frame, T_world_camera: found.append(T_world_camera),
    )  # fmt: skip
    located = np.array([T for T in found if T is not None])
    assert len(located) > 3
    np.testing.assert_allclose(located, within.online_trajectory.T_world_camera, atol=1e-7)


def test_a_callback_that_raises_ends_the_run(tmp_path: Path) -> None:
    def refuse(frame: int, T_world_camera: object) -> None:
        raise ValueError(f"frame {frame}")

    with pytest.raises(ValueError, match="frame 0"):
        pliant.run(
            TINY, output=tmp_path / "part", settings={"meshing.enabled": False}, quiet=True,
            on_frame=refuse,
        )  # fmt: skip


def test_images_one_by_one_give_the_same(followed: list[pliant.Tracked]) -> None:
    dataset = open_source(TINY)
    slam = pliant.Slam(dataset.calibration)
    assert len(slam.trajectory) == len(slam.points) == 0
    for frame, told in zip(dataset, followed, strict=True):
        T_world_camera = slam.track(decode(frame), 1e-9 * frame.stamp_ns)
        if told.T_world_camera is None:
            assert T_world_camera is None
        else:
            np.testing.assert_array_equal(T_world_camera, told.T_world_camera)
    np.testing.assert_array_equal(slam.finish().points, followed[-1].slam.points)
    with pytest.raises(DatasetError, match="finished"):
        slam.track(decode(next(iter(dataset))), 1e6)


def test_a_video_needs_no_other_input(tmp_path: Path) -> None:
    path = tmp_path / "clip.avi"
    images = [decode(frame) for frame in open_source(TINY)]
    height, width = images[0].shape[:2]
    video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 20.0, (width, height))
    for image in images:
        video.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
    video.release()
    frames = list(pliant.follow(path, settings={"tracking.max_tracks": 500}))
    assert len(frames) == len(images)
    assert max(len(frame.track_ids) for frame in frames) <= 500


@pytest.mark.parametrize(
    ("image", "stamp", "what"),
    [
        (np.zeros((48, 64)), 1.0, "uint8"),
        (np.zeros((48, 64, 4), np.uint8), 1.0, "(48, 64, 4)"),
        (np.zeros((0, 64), np.uint8), 1.0, "(0, 64)"),
        (np.zeros((48, 64), np.uint8), 0.0, "not after"),
        (np.zeros((48, 63), np.uint8), 1.0, "63x48 px, but the camera has 64x48"),
    ],
)
def test_an_image_that_cannot_be_is_one_line(image: np.ndarray, stamp: float, what: str) -> None:
    slam = pliant.Slam(fov=70)
    slam.track(np.zeros((48, 64), np.uint8), 0.0)
    with pytest.raises(DatasetError) as caught:
        slam.track(image, stamp)
    assert what in str(caught.value)
    assert slam.track(np.zeros((48, 64), np.uint8), 2.0) is None


def test_mistakes_are_one_line(tmp_path: Path, result: pliant.Result) -> None:
    camera = PinholeCamera(width=64, height=48, fx=50.0, fy=50.0, cx=32.0, cy=24.0)
    with pytest.raises(CalibrationError, match="exclude each other"):
        pliant.Slam(camera, fov=70)
    with pytest.raises(ConfigError, match="max_tracks"):
        pliant.Slam(settings={"tracking.max_trakcs": 5})
    with pytest.raises(RecordingError, match="no such recording"):
        pliant.open(tmp_path / "nothing")
    with pytest.raises(ResultError, match="no such file"):
        pliant.run(tmp_path / "nothing.mp4", output=tmp_path / "out", quiet=True)
    with pytest.raises(ResultError, match="--force"):
        pliant.run(TINY, output=result.path, quiet=True)
    with pytest.raises(AttributeError, match="juggle"):
        pliant.juggle  # noqa: B018


def test_a_frame_without_pixels_is_said(tmp_path: Path) -> None:
    sequence = tmp_path / "sequence"
    (sequence / "images").mkdir(parents=True)
    (sequence / "images" / "0.png").write_bytes(b"\x89PNG\r\n\x1a\n nothing")
    good = cv2.imencode(".png", np.zeros((48, 64), np.uint8))[1].tobytes()
    (sequence / "images" / "1.png").write_bytes(good)
    (sequence / "rgb.txt").write_text("0.0 images/0.png\n0.1 images/1.png\n")
    (sequence / "calib.yaml").write_text(
        "model: pinhole\nwidth: 64\nheight: 48\nfx: 50\nfy: 50\ncx: 32\ncy: 24\n"
    )
    frames = list(pliant.follow(sequence))
    assert [frame.image.size > 0 for frame in frames] == [False, True]
    assert "frame 0" in frames[0].reason


def test_importing_it_loads_no_kernels() -> None:
    code = "import pliant, sys; print('numba' in sys.modules, 'cv2' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "False"]

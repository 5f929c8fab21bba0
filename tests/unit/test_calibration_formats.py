"""Calibrations as other programs write them: each is read as it is meant, or refused in a line."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from pliant.datasets import open_source
from pliant.datasets.calibration import Calibration
from pliant.datasets.calibration_files import read_calibration
from pliant.datasets.source_spec import SourceSpec
from pliant.errors import CalibrationError

ORB_SLAM2 = """%YAML:1.0

#--------------------------------------------------------------------------------------------
# Camera Parameters. Adjust them!
#--------------------------------------------------------------------------------------------
Camera.fx: 517.306408
Camera.fy: 516.469215
Camera.cx: 318.643040
Camera.cy: 255.313989

Camera.k1: 0.262383
Camera.k2: -0.953104
Camera.p1: -0.005358
Camera.p2: 0.002628
Camera.k3: 1.163314

Camera.fps: 30.0
ORBextractor.nFeatures: 1000
"""
ORB_SLAM3 = """%YAML:1.0
File.version: "1.0"
Camera.type: "KannalaBrandt8"
Camera1.fx: 190.978477
Camera1.fy: 190.973307
Camera1.cx: 254.931706
Camera1.cy: 256.897442
Camera1.k1: 0.003482389402
Camera1.k2: 0.000715034845
Camera1.k3: -0.002053236141
Camera1.k4: 0.000202936736
Camera.width: 512
Camera.height: 512
Camera.fps: 20
"""
TRANSFORMS: dict[str, Any] = {
    "camera_model": "OPENCV",
    **dict(w=640, h=480, fl_x=500.0, fl_y=501.0, cx=320.5, cy=240.5),  # noqa: C408
    **dict(k1=-0.2, k2=0.05, p1=1e-3, p2=2e-3),  # noqa: C408
    "frames": [{"file_path": "images/0.png", "transform_matrix": np.eye(4).tolist()}],
}
RADTAN = (-0.2, 0.05, 1e-3, 2e-3, 0.0)


def written(folder: Path, content: str | dict[str, Any], name: str = "camera.yaml") -> Path:
    file = folder / name
    file.write_text(content if isinstance(content, str) else json.dumps(content))
    return file


def refused(file: Path, size: tuple[int, int] | None = (640, 480)) -> str:
    with pytest.raises(CalibrationError) as caught:
        read_calibration(file, size)
    line = str(caught.value)
    assert "\n" not in line
    assert line.startswith(f"{file}: ")
    return line


def intrinsics(calibration: Calibration) -> tuple[float, ...]:
    return (calibration.fx, calibration.fy, calibration.cx, calibration.cy)


@pytest.mark.parametrize("count", [4, 5, 8, 12, 14])
def test_what_opencv_writes_is_what_its_distortion_is(tmp_path: Path, count: int) -> None:
    """Written by OpenCV itself, and projected by it, with as many coefficients as it knows."""
    K = np.array([[500.0, 0.0, 321.0], [0.0, 501.0, 242.0], [0.0, 0.0, 1.0]])
    coefficients = np.array([-0.2, 0.05, 1e-3, 2e-3, 1e-3, 0.1, -0.02, 1e-3, *[0.0] * 6])[:count]
    file = tmp_path / "camera.yml"
    storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_WRITE)
    for key, value in (("image_width", 640), ("image_height", 480), ("camera_matrix", K)):
        storage.write(key, value)
    storage.write("distortion_coefficients", coefficients[:, None])
    storage.release()
    lens = read_calibration(file, (640, 480)).lens
    points = np.random.default_rng(1).uniform((-0.6, -0.4, 1.0), (0.6, 0.4, 1.0), (50, 3))
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, coefficients)
    np.testing.assert_allclose(lens.project(points[:, :2]), expected[:, 0], atol=1e-9)


@pytest.mark.parametrize("count", [12, 14])
def test_a_prism_or_a_tilt_is_refused(tmp_path: Path, count: int) -> None:
    content: dict[str, Any] = {"camera_matrix": [[500, 0, 321], [0, 501, 242], [0, 0, 1]]}
    content["distortion_coefficients"] = [[0.1] * count]
    line = refused(written(tmp_path, content))
    assert f"{count} distortion coefficients" in line
    assert "calibrate again with those" in line


def test_opencv_with_other_names_and_no_size(tmp_path: Path) -> None:
    """As scripts in Python write it, rows in a list; the images say how large they are."""
    content: dict[str, Any] = {"cameraMatrix": [[500, 0, 321], [0, 501, 242], [0, 0, 1]]}
    file = written(tmp_path, {**content, "distCoeffs": [list(RADTAN)]})
    assert read_calibration(file, (640, 480)).distortion == RADTAN
    assert "no width, height" in refused(file, None)
    fisheye = {**content, "fisheye_model": 1, "distortion_coefficients": [0.01, 0.0, 0.0, 0.0]}
    assert read_calibration(written(tmp_path, fisheye), (640, 480)).model == "fisheye"


def test_orb_slam(tmp_path: Path) -> None:
    old = read_calibration(written(tmp_path, ORB_SLAM2), (640, 480))
    assert intrinsics(old) == (517.306408, 516.469215, 318.64304, 255.313989)
    assert old.distortion == (0.262383, -0.953104, -0.005358, 0.002628, 1.163314)
    assert old.fps == 30.0
    new = read_calibration(written(tmp_path, ORB_SLAM3))
    assert (new.model, new.width, new.height) == ("fisheye", 512, 512)
    assert new.distortion == (0.003482389402, 0.000715034845, -0.002053236141, 0.000202936736)
    rectified = ORB_SLAM2.replace("Camera.fx", 'Camera.type: "Rectified"\nCamera.fx')
    assert read_calibration(written(tmp_path, rectified), (640, 480)).model == "pinhole"


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (ORB_SLAM3.replace("KannalaBrandt8", "Omni"), "Camera.type 'Omni'"),
        (ORB_SLAM2 + "LEFT.K: !!opencv-matrix\n   rows: 3\n", "stereo pair"),
        (ORB_SLAM2.replace("Camera.fy", "Camera.f"), "no fy"),
        (ORB_SLAM2 + "Camera.k4: 0.5\n", "no k4"),
        ("cam0:\n  camera_model: omni\n  intrinsics: [1, 2, 3, 4, 5]\n", "pinhole-equi"),
        ("cam0: 3\n", "cam0 is 3"),
        ("1 FOV 640 480 500 500 320 240 0.9\n", "camera model FOV is not supported"),
        ("1 OPENCV 640 480 500 500 320 240\n", "OPENCV has 4 parameters: expected 8"),
        ("1 PINHOLE 640 480 500 x 320 240\n", "fy is 'x'"),
        ("1 PINHOLE 640 480 5e2 5e2 320 240\n2 PINHOLE 640 480 6e2 6e2 320 240", "2 cameras"),
    ],
)
def test_what_is_no_lens_of_ours_is_refused(tmp_path: Path, text: str, says: str) -> None:
    assert says in refused(written(tmp_path, text))


def test_every_model_of_colmap_is_read_as_colmap_means_it(tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    points = np.random.default_rng(2).uniform((-0.6, -0.4, 1.0), (0.6, 0.4, 1.0), (50, 3))
    names = ("f", "fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    values = dict(zip(names, (505, 500, 501, 321, 242, -0.05, 0.02, 1e-3, 2e-3), strict=False))
    values |= {"k": -0.05, "k3": 1e-3, "k4": 2e-3, "k5": -1e-3, "k6": 1e-4}
    read = 0
    for name in pycolmap.CameraModelId.__members__:
        if name == "INVALID":
            continue
        camera = pycolmap.Camera.create_from_model_name(0, name, 500.0, 640, 480)
        own = [each.strip() for each in camera.params_info.split(",")]
        file = written(tmp_path, "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n", "cameras.txt")
        if not set(own) <= set(values) or "DIVISION" in name:  # by k, too, and another lens
            file.write_text(f"7 {name} 640 480 {' '.join('0.5' for _ in own)}\n")
            assert "is not supported" in refused(file)
            continue
        camera.params = [float(values[each]) for each in own]
        file.write_text(f"7 {name} 640 480 {' '.join(map(str, camera.params))}\n")
        lens = read_calibration(file, (640, 480)).lens
        expected = np.array([camera.img_from_cam(point) for point in points]) - 0.5
        np.testing.assert_allclose(lens.project(points[:, :2]), expected, atol=1e-9, err_msg=name)
        read += 1
    assert read >= 9  # newer versions have more of them


def test_the_size_selects_one_of_several_cameras(tmp_path: Path) -> None:
    lines = ["# Camera list", "1 PINHOLE 320 240 250 250 160 120", "2 PINHOLE 640 480 5e2 5e2 1 2"]
    file = written(tmp_path, "\n".join(lines), "cameras.txt")
    assert intrinsics(read_calibration(file, (640, 480))) == (500.0, 500.0, 0.5, 1.5)


def test_nerfstudio(tmp_path: Path) -> None:
    calibration = read_calibration(written(tmp_path, TRANSFORMS), (640, 480))
    assert intrinsics(calibration) == (500.0, 501.0, 320.0, 240.0)
    assert calibration.distortion == RADTAN
    each = {key: TRANSFORMS[key] for key in ("w", "h", "fl_x", "fl_y", "cx", "cy")}
    frames = [{**each, "file_path": "0.png"}, {**each, "file_path": "1.png"}]
    same = read_calibration(written(tmp_path, {"frames": frames}), (640, 480))
    assert intrinsics(same) == intrinsics(calibration)
    frames[1]["fl_x"] = 600.0
    assert "different cameras" in refused(written(tmp_path, {"frames": frames}))
    wide = {"camera_angle_x": np.pi / 2.0, "w": 640, "h": 480, "cx": 320, "cy": 240}
    assert read_calibration(written(tmp_path, wide)).fx == pytest.approx(320.0)
    assert "no k4" in refused(written(tmp_path, {**TRANSFORMS, "k4": 0.1}))
    assert "EQUIRECTANGULAR" in refused(
        written(tmp_path, {**TRANSFORMS, "camera_model": "EQUIRECTANGULAR"})
    )


def test_a_thousand_poses_are_not_too_large(tmp_path: Path) -> None:
    content = {**TRANSFORMS, "frames": TRANSFORMS["frames"] * 20000}
    file = written(tmp_path, content, "transforms.json")
    assert file.stat().st_size > 1 << 20
    assert read_calibration(file, (640, 480)).fx == 500.0


def test_a_source_is_opened_with_the_file_of_another_program(tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    cv2.imwrite(str(tmp_path / "images" / "0.png"), np.zeros((480, 640), np.uint8))
    file = written(tmp_path, TRANSFORMS, "transforms.json")
    source = open_source(SourceSpec(location=str(tmp_path / "images"), calibration=file))
    assert intrinsics(source.calibration) == (500.0, 501.0, 320.0, 240.0)

"""Calibrations: what is read, what is refused, and with which words."""

import dataclasses
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from pliant.datasets.calibration import (
    Calibration,
    calibration_from_fov,
    calibration_from_yaml,
    calibration_yaml,
)
from pliant.datasets.calibration_files import read_calibration
from pliant.datasets.tum_rgbd import tum_calibration
from pliant.errors import CalibrationError

PLAIN: dict[str, Any] = {
    "model": "pinhole",
    "width": 64,
    "height": 48,
    "fx": 60.0,
    "fy": 61.0,
    "cx": 31.0,
    "cy": 24.0,
}
RADTAN = {**PLAIN, "model": "pinhole-radtan", "k1": -0.1, "k2": 0.01, "p1": 1e-3, "p2": -1e-3}
FISHEYE = {**PLAIN, "model": "fisheye", "k1": 0.01, "k2": 0.0, "k3": 0.0, "k4": 0.0}

EUROC = """
# General sensor definitions.
sensor_type: camera
T_BS:
  cols: 4
  rows: 4
  data: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
rate_hz: 20
resolution: [752, 480]
camera_model: pinhole
intrinsics: [458.654, 457.296, 367.215, 248.375] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]
"""
KALIBR = """
cam0:
  camera_model: pinhole
  distortion_coeffs: [0.0034824, 0.00071503, -0.0020532, 0.00020294]
  distortion_model: equidistant
  intrinsics: [190.97847, 190.97330, 254.93170, 256.89744]
  resolution: [512, 512]
cam1:
  camera_model: pinhole
"""
ROS = """
image_width: 640
image_height: 480
camera_name: head
camera_matrix: {rows: 3, cols: 3, data: [500, 0, 321, 0, 501, 242, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [-0.2, 0.05, 0.001, 0.002, 0.0]}
"""
OPENCV = """%YAML:1.0
---
image_width: 640
image_height: 480
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 500., 0., 321., 0., 501., 242., 0., 0., 1. ]
distortion_model: radtan
distortion_coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ -2.0e-01, 5.0e-02, 1.0e-03, 2.0e-03, 0. ]
"""


def written(folder: Path, content: dict[str, Any] | str, name: str = "calib.yaml") -> Path:
    file = folder / name
    file.write_text(content if isinstance(content, str) else yaml.safe_dump(content))
    return file


def refused(folder: Path, content: dict[str, Any] | str, **more: Any) -> str:
    """The line that a user sees: one line, and it names the file."""
    file = written(folder, content)
    with pytest.raises(CalibrationError) as caught:
        read_calibration(file, **more)
    line = str(caught.value)
    assert "\n" not in line
    assert line.startswith(str(file))
    return line.removeprefix(f"{file}: ")


def test_own_format(tmp_path: Path) -> None:
    extra = {"camera": "of a phone", "colour": "grey", "fps": "stills"}
    calibration = read_calibration(written(tmp_path, {**RADTAN, **extra}), (64, 48))
    assert calibration == Calibration(
        model="pinhole-radtan",
        width=64,
        height=48,
        fx=60.0,
        fy=61.0,
        cx=31.0,
        cy=24.0,
        distortion=(-0.1, 0.01, 1e-3, -1e-3, 0.0),
    )
    assert read_calibration(written(tmp_path, {**PLAIN, "k1": 0, "fps": 20})).fps == 20.0
    assert read_calibration(written(tmp_path, FISHEYE)).distortion == (0.01, 0.0, 0.0, 0.0)


def test_model_is_inferred_from_the_coefficients(tmp_path: Path) -> None:
    for content, model in ((PLAIN, "pinhole"), (RADTAN, "pinhole-radtan")):
        without = {key: value for key, value in content.items() if key != "model"}
        assert read_calibration(written(tmp_path, without)).model == model


def test_numbers_that_yaml_takes_for_text_are_numbers(tmp_path: Path) -> None:
    text = yaml.safe_dump(RADTAN).replace("p1: 0.001", "p1: 1e-3")
    assert isinstance(yaml.safe_load(text)["p1"], str)
    assert read_calibration(written(tmp_path, text)).distortion[2] == 1e-3


def test_depth_images(tmp_path: Path) -> None:
    own = {"depth_scale": 0.001, "depth_fx": 70.0, "depth_invalid": [0, 65535]}
    depth = read_calibration(written(tmp_path, {**PLAIN, **own})).depth
    assert depth is not None
    assert (depth.scale_m, depth.invalid) == (0.001, (0, 65535))
    assert (depth.camera.fx, depth.camera.fy) == (70.0, 61.0)
    assert "depth_scale" in refused(tmp_path, {**PLAIN, "depth_scale": -1})


@pytest.mark.parametrize(
    ("text", "model", "size", "intrinsics", "distortion"),
    [
        (
            EUROC,
            "pinhole-radtan",
            (752, 480),
            (458.654, 457.296, 367.215, 248.375),
            (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05, 0.0),
        ),
        (
            KALIBR,
            "fisheye",
            (512, 512),
            (190.97847, 190.97330, 254.93170, 256.89744),
            (0.0034824, 0.00071503, -0.0020532, 0.00020294),
        ),
        (ROS, "pinhole-radtan", (640, 480), (500, 501, 321, 242), (-0.2, 0.05, 0.001, 0.002, 0.0)),
        (
            OPENCV,
            "pinhole-radtan",
            (640, 480),
            (500, 501, 321, 242),
            (-0.2, 0.05, 0.001, 0.002, 0.0),
        ),
    ],
    ids=["euroc", "kalibr", "ros", "opencv"],
)
def test_formats_of_others(
    tmp_path: Path,
    text: str,
    model: str,
    size: tuple[int, int],
    intrinsics: tuple[float, ...],
    distortion: tuple[float, ...],
) -> None:
    calibration = read_calibration(written(tmp_path, text), size)
    assert calibration.model == model
    assert (calibration.width, calibration.height) == size
    assert (calibration.fx, calibration.fy, calibration.cx, calibration.cy) == intrinsics
    assert calibration.distortion == distortion


def test_kitti(tmp_path: Path) -> None:
    rows = [f"P{i}: {700 + i} 0 600 {-i} 0 701 180 0 0 0 1 0" for i in range(4)]
    file = written(tmp_path, "\n".join([*rows, "Tr: 1 0 0 0 0 1 0 0 0 0 1 0"]), "calib.txt")
    calibration = read_calibration(file, (1226, 370), kitti_camera=2)
    assert (calibration.model, calibration.width, calibration.fx) == ("pinhole", 1226, 702.0)
    with pytest.raises(CalibrationError, match="no row P7"):
        read_calibration(file, (1226, 370), kitti_camera=7)
    assert "12" in refused(tmp_path, "P0: 1 2 3", image_size=(4, 4))
    assert "P0" not in refused(tmp_path, "P0: " + "nan " * 12, image_size=(4, 4))


@pytest.mark.parametrize("camera", ["1", "2", "3"])
def test_tum_cameras_are_usable(camera: str) -> None:
    calibration = tum_calibration(camera)
    assert calibration.lens.distorts == (camera != "3")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"fx": float("nan")}, "fx is nan: expected a finite number"),
        ({"k1": float("inf")}, "k1 is inf"),
        ({"fx": -60.0}, "fx is -60: a focal length is positive"),
        ({"fy": 0}, "fy is 0"),
        ({"fx": 0.0036}, "not plausible"),
        ({"cx": 900.0}, "cx is 900: far outside of the 64 px"),
        ({"cy": -500.0}, "cy is -500: far outside"),
        ({"width": 0}, "width is 0"),
        ({"height": 10.5}, "height is 10.5: expected a whole number"),
        ({"width": 70000}, "width is 70000"),
        ({"fx": "sixty"}, "fx is 'sixty': expected a number"),
        ({"fx": [1, 2]}, "fx is [1, 2]: expected a number"),
        ({"fx": True}, "fx is True"),
        ({"cx": None}, "no cx"),
        ({"k2": None}, "model pinhole-radtan, but no k2"),
        (
            {"model": "omni"},
            "use pinhole, pinhole-radtan, pinhole-rational, fisheye",
        ),
        ({"model": "pinhole"}, "model pinhole has no k1, k2, p1, p2"),
        ({"model": ["pinhole"]}, "is not supported"),
        ({"k1": -300.0}, "distortion (-300, 0.01, 0.001, -0.001, 0): the distortion"),
    ],
)
def test_impossible_values_are_refused(tmp_path: Path, change: dict[str, Any], says: str) -> None:
    assert says in refused(tmp_path, {**RADTAN, **change})


@pytest.mark.parametrize("key", ["fx", "fy", "cx", "cy", "width", "height"])
def test_missing_keys_are_named(tmp_path: Path, key: str) -> None:
    content = {name: value for name, value in PLAIN.items() if name != key}
    assert refused(tmp_path, content).startswith(f"no {key}: ")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("fx: [1, 2", "not YAML"),
        ("fx: 1\nfx\n", "not YAML"),
        ("", "no keys and values"),
        ("just text", "no keys and values"),
        ("- 1\n- 2\n", "no keys and values"),
        ("name: me\n", "contains no camera"),
        ("!!python/object/apply:os.system ['true']", "not YAML"),
        (EUROC.replace("pinhole", "omni"), "camera_model 'omni'"),
        (EUROC.replace("radial-tangential", "fov"), "distortion_model 'fov'"),
        (EUROC.replace("[458.654,", "["), "expected 4 numbers"),
        (EUROC.replace("distortion_coefficients", "nothing"), "no distortion_coefficients"),
        (ROS.replace("0.002, 0.0]", "0.002, 0.0, 0.1, 0.2, 0.3]"), "8 distortion coefficients"),
        (ROS.replace("[500,", "[a,"), "fx is 'a'"),
        (EUROC.replace("[752, 480]", "[752, x]"), "height is 'x'"),
        ("fx: 2020-99-99", "not YAML"),
        ("[" * 2000, "not YAML"),
        (f"fx: {10**400}\nfy: 1\ncx: 1\ncy: 1\nwidth: 2\nheight: 2", "expected a number"),
    ],
)
def test_broken_files_are_refused(tmp_path: Path, text: str, says: str) -> None:
    assert says in refused(tmp_path, text)


def test_wrong_size_is_refused(tmp_path: Path) -> None:
    line = refused(tmp_path, PLAIN, image_size=(128, 96))
    assert "64x48" in line
    assert "128x96" in line


def test_files_that_are_none(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match="no such calibration file"):
        read_calibration(tmp_path / "calib.yaml")
    with pytest.raises(CalibrationError, match="a folder without a calibration file"):
        read_calibration(tmp_path)
    (tmp_path / "binary").write_bytes(b"\x89\xfe\x00\x01" * 8)
    with pytest.raises(CalibrationError, match="not a text file"):
        read_calibration(tmp_path / "binary")
    (tmp_path / "large").write_bytes(b" " * (2 << 20))
    with pytest.raises(CalibrationError, match="too large"):
        read_calibration(tmp_path / "large")


def test_field_of_view() -> None:
    calibration = calibration_from_fov(640, 480, 90.0)
    assert calibration.fx == pytest.approx(320.0)
    assert calibration.fy == calibration.fx
    assert (calibration.cx, calibration.cy) == (319.5, 239.5)
    for impossible in (0.0, -10.0, 180.0, float("nan")):
        with pytest.raises(CalibrationError, match="--fov"):
            calibration_from_fov(640, 480, impossible)


def test_an_unknown_camera_has_the_same_field_of_view_upright() -> None:
    wide, upright = calibration_from_fov(1920, 1080), calibration_from_fov(1080, 1920)
    assert upright.fx == upright.fy == wide.fx == pytest.approx(960.0 * 3.0**0.5)
    assert upright.focal_sigma == wide.focal_sigma > calibration_from_fov(640, 480, 60).focal_sigma


finite = st.floats(-1e-2, 1e-2, allow_subnormal=False)


@settings(max_examples=50)
@given(st.floats(40.0, 90.0), st.floats(10.0, 50.0), finite, finite, finite, st.booleans())
def test_yaml_gives_back_the_same_numbers(
    focal: float, centre: float, k1: float, k2: float, p1: float, fisheye: bool
) -> None:
    calibration = dataclasses.replace(
        calibration_from_yaml(yaml.safe_dump({**RADTAN, "depth_scale": 0.001, "fps": 25})),
        model="fisheye" if fisheye else "pinhole-radtan",
        fx=focal,
        cx=centre,
        distortion=(k1, k2, p1, 1e-5) if fisheye else (k1, k2, p1, 1e-5, 1e-17),
    )
    assert calibration_from_yaml(calibration_yaml(calibration)) == calibration


@settings(max_examples=200)
@given(
    st.dictionaries(
        st.sampled_from(
            [
                *RADTAN,
                "k3",
                "k4",
                "intrinsics",
                "camera_matrix",
                "resolution",
                "cam0",
                "distortion_coefficients",
                "depth_scale",
                "depth_invalid",
            ]
        ),
        st.none()
        | st.booleans()
        | st.integers(-1000, 100000)
        | st.floats()
        | st.text(max_size=5)
        | st.lists(st.floats() | st.integers(), max_size=9),
    )
)
def test_any_content_is_a_calibration_or_a_calibration_error(
    tmp_path_factory: pytest.TempPathFactory, content: dict[str, Any]
) -> None:
    file = written(tmp_path_factory.getbasetemp(), {**RADTAN, **content}, "random.yaml")
    try:
        read_calibration(file)
    except CalibrationError as error:
        line = str(error)
    else:
        line = ""
    assert "\n" not in line

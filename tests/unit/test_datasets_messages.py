"""Bags of ROS 1 and 2, and MCAP files of others, as sources of frames."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import recorded_messages as bags
from recorded_messages import COUNT, HEIGHT, START_NS, STEP_NS, WIDTH, Ros

from pliant.datasets import notes_on, open_source
from pliant.datasets.calibration import UNSAID_SIGMA
from pliant.datasets.rectifier import decode
from pliant.datasets.source_spec import SourceSpec
from pliant.errors import CalibrationError, DatasetError

Write = Callable[[Path], None]


def ros1(path: Path) -> None:
    ros = Ros(1)
    bags.write_ros1_bag(path, ros, bags.usual(ros))


def ros2(path: Path) -> None:
    ros = Ros(2)
    bags.write_ros2_bag(path, ros, bags.usual(ros))


def ros2_mcap(path: Path) -> None:
    ros = Ros(2)
    bags.write_ros_mcap(path, ros, bags.usual(ros))


def ros1_mcap(path: Path) -> None:
    ros = Ros(1)
    bags.write_ros_mcap(path, ros, bags.usual(ros))


FILES: dict[str, tuple[str, Write]] = {
    "ros 1": ("drive.bag", ros1),
    "ros 2": ("drive", ros2),
    "ros 2 mcap": ("drive.mcap", ros2_mcap),
    "ros 1 mcap": ("drive.mcap", ros1_mcap),
    "foxglove protobuf": (
        "drive.mcap", lambda path: bags.write_foxglove_mcap(path, raw=True, encoding="protobuf")
    ),
    "foxglove json": (
        "drive.mcap", lambda path: bags.write_foxglove_mcap(path, raw=True, encoding="json")
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", FILES)
def test_every_kind_gives_the_same_frames_times_and_camera(kind: str, tmp_path: Path) -> None:
    name, write = FILES[kind]
    write(tmp_path / name)
    source = open_source(str(tmp_path / name))
    assert (source.name, source.frame_count, source.is_live) == ("drive", COUNT, False)
    for _ in range(2):  # each iteration begins anew
        frames = list(source)
        assert [f.stamp_ns for f in frames] == [START_NS + i * STEP_NS for i in range(COUNT)]
        assert [f.index for f in frames] == list(range(COUNT))
        for i, frame in enumerate(frames):
            assert np.array_equal(decode(frame), bags.picture(i))
    camera = source.calibration
    assert (camera.model, camera.width, camera.height) == ("pinhole-radtan", WIDTH, HEIGHT)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (40.0, 41.0, 23.5, 15.5)
    assert camera.distortion == tuple(bags.PLUMB_BOB[1])


def test_compressed_images_keep_their_bytes(tmp_path: Path) -> None:
    ros = Ros(2)
    messages = {"/camera/image_raw/compressed": [ros.compressed(i) for i in range(COUNT)]}
    bags.write_ros2_bag(tmp_path / "a", ros, messages)
    bags.write_foxglove_mcap(tmp_path / "b.mcap", raw=False, encoding="protobuf")
    for path in (tmp_path / "a", tmp_path / "b.mcap"):
        frames = list(open_source(SourceSpec(location=str(path), fov_deg=70.0)))
        assert [f.data for f in frames] == [bags.jpeg(i) for i in range(COUNT)]
        assert {f.encoding for f in frames} == {"jpeg"}


def _raw(encoding: str, rgb: Any) -> Any:
    alpha = np.full((HEIGHT, WIDTH, 1), 7, np.uint8)
    bayer = {"r": 0, "g": 1, "b": 2}
    if encoding.startswith("bayer_"):
        pattern = encoding[6:10]
        mosaic = np.zeros((HEIGHT, WIDTH), np.uint8)
        for i, colour in enumerate(pattern):
            mosaic[i // 2 :: 2, i % 2 :: 2] = rgb[i // 2 :: 2, i % 2 :: 2, bayer[colour]]
        return mosaic
    return {
        "rgb8": rgb,
        "bgr8": rgb[:, :, ::-1],
        "8UC3": rgb[:, :, ::-1],
        "rgba8": np.concatenate([rgb, alpha], axis=2),
        "bgra8": np.concatenate([rgb[:, :, ::-1], alpha], axis=2),
        "mono8": rgb[:, :, 0],
        "mono16": rgb[:, :, 0].astype("<u2") * 256 + 77,
    }[encoding]


@pytest.mark.parametrize(
    "encoding",
    ["rgb8", "bgr8", "8UC3", "rgba8", "bgra8", "mono8", "mono16", "big-endian mono16"]
    + [f"bayer_{p}8" for p in ("rggb", "bggr", "gbrg", "grbg")],
)
@pytest.mark.parametrize("padding", [0, 6])
def test_every_encoding_gives_its_colours(encoding: str, padding: int, tmp_path: Path) -> None:
    ros = Ros(2)
    # One colour, so that what Bayer's pattern interpolates is known.
    rgb = np.broadcast_to(np.array([200, 90, 10], np.uint8), (HEIGHT, WIDTH, 3))
    name = encoding.split()[-1]
    pixels = _raw(name, rgb)
    if name != encoding:
        pixels = pixels.astype(">u2")
    image = ros.image(
        0, encoding=name, padding=padding, pixels=pixels, is_bigendian=int(name != encoding)
    )
    bags.write_ros2_bag(tmp_path / "bag", ros, {"/image": [image]})
    (frame,) = open_source(SourceSpec(location=str(tmp_path / "bag"), fov_deg=70.0))
    decoded = decode(frame)
    expected = rgb[:, :, 0] if name.startswith("mono") else rgb
    assert decoded.shape == expected.shape
    assert np.array_equal(decoded[2:-2, 2:-2], expected[2:-2, 2:-2])


@pytest.mark.parametrize(
    ("said", "model", "coefficients"),
    [
        (("plumb_bob", [0.0] * 5), "pinhole-radtan", (0.0,) * 5),
        (
            ("rational_polynomial", [0.3, 0.1, 1e-3, -1e-3, 0.02, 0.5, 0.1, 0.03]),
            "pinhole-rational",
            (0.3, 0.1, 1e-3, -1e-3, 0.02, 0.5, 0.1, 0.03),
        ),
        (("equidistant", [0.01, 0.02, -0.01, 0.001]), "fisheye", (0.01, 0.02, -0.01, 0.001)),
    ],
)
def test_distortion_models(
    said: tuple[str, list[float]], model: str, coefficients: tuple[float, ...], tmp_path: Path
) -> None:
    ros = Ros(1)
    messages = {"/cam/image_raw": [ros.image(0)], "/cam/camera_info": [ros.camera_info(0, said)]}
    bags.write_ros1_bag(tmp_path / "x.bag", ros, messages)
    calibration = open_source(str(tmp_path / "x.bag")).calibration
    assert (calibration.model, calibration.distortion) == (model, coefficients)


def test_the_rational_model_is_opencvs() -> None:
    from pliant.algorithms.rectification import Lens, distort, undistort

    coefficients = (0.3, 0.1, 1e-3, -1e-3, 0.02, 0.5, 0.1, 0.03)
    lens = Lens(
        model="pinhole-rational", width=640, height=480, fx=400.0, fy=410.0, cx=320.0, cy=240.0,
        coefficients=coefficients,
    )  # fmt: skip
    points = np.random.default_rng(0).uniform(-0.7, 0.7, (100, 2))
    K = np.array([[400.0, 0.0, 320.0], [0.0, 410.0, 240.0], [0.0, 0.0, 1.0]])
    space = np.concatenate([points, np.ones((100, 1))], axis=1)
    theirs, _ = cv2.projectPoints(space, np.zeros(3), np.zeros(3), K, np.array(coefficients))
    np.testing.assert_allclose(lens.project(points), theirs[:, 0], atol=1e-9)
    np.testing.assert_allclose(undistort(distort(points, lens), lens), points, atol=1e-9)


def test_the_calibration_nearest_by_name_is_taken_and_rectified_images_use_p(
    tmp_path: Path,
) -> None:
    ros = Ros(2)
    left, right = ros.camera_info(0), ros.camera_info(0)
    right.k[0] = 50.0
    messages = {
        "/left/image_raw": [ros.image(0)],
        "/left/camera_info": [left],
        "/right/image_raw": [ros.image(0)],
        "/right/image_rect": [ros.image(0)],
        "/right/camera_info": [right],
    }
    bags.write_ros2_bag(tmp_path / "bag", ros, messages)
    bag = str(tmp_path / "bag")
    assert open_source(SourceSpec(location=bag, topic="/left/image_raw")).calibration.fx == 40.0
    assert open_source(SourceSpec(location=bag, topic="right/image_raw")).calibration.fx == 50.0
    rectified = open_source(SourceSpec(location=bag, topic="/right/image_rect")).calibration
    assert (rectified.model, rectified.fx, rectified.cx) == ("pinhole", 44.0, 22.0)


def test_an_own_calibration_wins(tmp_path: Path) -> None:
    ros2(tmp_path / "bag")
    assert open_source(
        SourceSpec(location=str(tmp_path / "bag"), fov_deg=90.0)
    ).calibration.fx == pytest.approx(24.0)


def refused(source: Path, topic: str = "", **more: Any) -> str:
    with pytest.raises((DatasetError, CalibrationError)) as caught:
        list(open_source(SourceSpec(location=str(source), topic=topic, **more)))
    text = str(caught.value)
    assert "\n" not in text
    assert source.name in text
    return text


def test_the_choice_of_a_topic(tmp_path: Path) -> None:
    ros = Ros(2)
    messages = {**bags.usual(ros), "/other": [ros.compressed(0)]}
    bags.write_ros2_bag(tmp_path / "two", ros, messages)
    text = refused(tmp_path / "two")
    assert "--topic" in text
    assert "/camera/image_raw (sensor_msgs/Image), /other (sensor_msgs/CompressedImage)" in text
    assert "no topic /nowhere; images are in /camera/image_raw" in refused(
        tmp_path / "two", "/nowhere"
    )
    assert "/chatter carries std_msgs/String, no images" in refused(tmp_path / "two", "/chatter")
    other = open_source(SourceSpec(location=str(tmp_path / "two"), topic="/other")).calibration
    assert other.focal_sigma == UNSAID_SIGMA
    bags.write_ros2_bag(tmp_path / "none", ros, {"/chatter": [ros.text()]})
    assert "no topic with images; its topics: std_msgs/String" in refused(tmp_path / "none")
    folder = tmp_path / "folder"
    folder.mkdir()
    cv2.imwrite(str(folder / "0.png"), bags.picture(0))
    assert "has no topics" in refused(folder, "/image", fov_deg=70.0)


def test_what_cannot_be_understood_is_said(tmp_path: Path) -> None:
    ros = Ros(2)
    odd = ros.image(0, encoding="8UC2", pixels=bags.picture(0)[:, :, :2])
    bags.write_ros2_bag(tmp_path / "odd", ros, {"/image": [odd]})
    assert "encoding '8UC2' are not supported" in refused(tmp_path / "odd", fov_deg=70.0)
    never = ros.camera_info(0)
    never.k[:] = 0.0
    never.p[:] = 0.0
    messages = {"/image": [ros.image(0)], "/camera_info": [never]}
    bags.write_ros2_bag(tmp_path / "never", ros, messages)
    assert "the camera is not calibrated" in refused(tmp_path / "never")


@pytest.mark.parametrize("kind", FILES)
def test_a_file_that_is_cut_off_is_one_line(kind: str, tmp_path: Path) -> None:
    name, write = FILES[kind]
    whole, cut = tmp_path / name, tmp_path / f"cut_{name}"
    write(whole)
    if whole.is_dir():
        cut.mkdir()
        for path in whole.iterdir():
            data = path.read_bytes()
            (cut / path.name).write_bytes(
                data if path.suffix == ".yaml" else data[: len(data) // 2]
            )
    else:
        data = whole.read_bytes()
        cut.write_bytes(data[: len(data) // 2])
    text = refused(cut, fov_deg=70.0)
    assert "truncated" in text
    assert "repair it with" in text


def test_any_bytes_are_one_line(tmp_path: Path) -> None:
    generator = np.random.default_rng(0)
    ros2_mcap(tmp_path / "whole.mcap")
    ros1(tmp_path / "whole.bag")
    for suffix in (".mcap", ".bag"):
        whole = bytearray((tmp_path / f"whole{suffix}").read_bytes())
        for i in range(30):
            data = whole.copy()
            for at in generator.integers(8, len(data), 20):
                data[at] = generator.integers(0, 256)
            path = tmp_path / f"broken_{i}{suffix}"
            path.write_bytes(data)
            said = ""
            try:
                list(open_source(SourceSpec(location=str(path), fov_deg=70.0)))
            except (DatasetError, CalibrationError) as error:
                said = str(error)
            assert "\n" not in said


def test_colour_is_used_instead_of_depth_with_a_note(tmp_path: Path) -> None:
    ros = Ros(2)
    deep = np.full((HEIGHT, WIDTH), 900, "<u2")
    messages = {
        "/camera/color/image_raw": [ros.image(0)],
        "/camera/color/image_raw/compressed": [ros.compressed(0)],
        "/camera/depth/image_rect_raw": [ros.image(0, encoding="16UC1", pixels=deep)],
    }
    bags.write_ros2_bag(tmp_path / "bag", ros, messages)
    source = open_source(SourceSpec(location=str(tmp_path / "bag"), fov_deg=70.0))
    assert np.array_equal(decode(next(iter(source))), bags.picture(0))
    assert notes_on(source) == [
        "using /camera/color/image_raw, not /camera/color/image_raw/compressed, "
        "/camera/depth/image_rect_raw (choose with --topic)"
    ]
    asked = open_source(
        SourceSpec(location=str(tmp_path / "bag"), topic="/camera/color/image_raw", fov_deg=70.0)
    )
    assert notes_on(asked) == []

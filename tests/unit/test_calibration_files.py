"""Calibration files as they lie about: other encodings, XML, binary, several cameras."""

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
import recorded_messages as bags
from recorded_messages import Ros

from pliant.datasets import open_source
from pliant.datasets.calibration_files import read_calibration
from pliant.datasets.source_spec import SourceSpec
from pliant.errors import CalibrationError

SIZE = (640, 480)
ORB_SLAM = (
    "%YAML:1.0\n# é Camera Parameters\nCamera.fx:\t517.3\nCamera.fy: 516.4\nCamera.cx: 318.6\n"
    "Camera.cy: 255.3\n\nCamera.k1: 0.26\n\tCamera.k2: -0.95\nCamera.p1: -0.005\nCamera.p2: 0.002\n"
)
CAMERA = (
    "  camera_model: pinhole\n  intrinsics: [{fx}, 501.0, 320.0, 240.0]\n"
    "  distortion_model: radtan\n  distortion_coeffs: [0.1, 0.0, 0.0, 0.0]\n"
    "  resolution: [{width}, 480]\n  rostopic: {topic}\n"
)
CHAIN = "".join(
    f"cam{n}:\n{CAMERA.format(fx=500.0 + 100 * n, width=640, topic=f'/cam{n}/image_raw')}"
    for n in range(2)
)


def refused(file: Path, size: tuple[int, int] | None = SIZE) -> str:
    with pytest.raises(CalibrationError) as caught:
        read_calibration(file, size)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "latin-1", "utf-16"])
def test_orb_slam_with_tabs_in_any_encoding(encoding: str, tmp_path: Path) -> None:
    file = tmp_path / "TUM1.yaml"
    file.write_bytes(ORB_SLAM.replace("\n\tC", "\nC").encode(encoding))
    found = read_calibration(file, SIZE)
    assert (found.fx, found.distortion) == (517.3, (0.26, -0.95, -0.005, 0.002, 0.0))


def test_bytes_are_no_calibration(tmp_path: Path) -> None:
    for data in (bytes(range(256)), b"fx: 1\0", b"\xff\xfe\x00"):
        (tmp_path / "x.yaml").write_bytes(data)
        assert "x.yaml" in refused(tmp_path / "x.yaml")


def test_opencv_as_xml(tmp_path: Path) -> None:
    K = np.array([[500.0, 0.0, 321.0], [0.0, 501.0, 242.0], [0.0, 0.0, 1.0]])
    file = tmp_path / "camera.xml"
    storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_WRITE)
    for key, value in (("image_width", 640), ("image_height", 480), ("camera_matrix", K)):
        storage.write(key, value)
    storage.write("calibration_time", "Mon 1 Jan 2024")
    storage.write("distortion_coefficients", np.array([[-0.2, 0.05, 1e-3, 2e-3, 0.0]]))
    storage.release()
    found = read_calibration(file)
    assert (found.width, found.fx, found.cy) == (640, 500.0, 242.0)
    assert found.distortion == (-0.2, 0.05, 1e-3, 2e-3, 0.0)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("<?xml version='1.0'?><calibration><f>500</f></calibration>", "XML of another program"),
        ("<?xml version='1.0'?><opencv_storage><a>", "not XML"),
        ("<?xml version='1.0'?><opencv_storage></opencv_storage>", "contains no camera"),
        (
            "<?xml version='1.0'?><!DOCTYPE x [<!ENTITY a 'aaaa'><!ENTITY b '&a;&a;'>]>"
            "<opencv_storage>&b;</opencv_storage>",
            "XML with declarations",
        ),
    ],
)
def test_other_xml_is_refused(text: str, says: str, tmp_path: Path) -> None:
    (tmp_path / "a.xml").write_text(text)
    assert says in refused(tmp_path / "a.xml")


def cameras_bin(*cameras: tuple[int, int, int, int, list[float]]) -> bytes:
    data = struct.pack("<Q", len(cameras))
    for number, model, width, height, values in cameras:
        data += struct.pack(f"<IiQQ{len(values)}d", number, model, width, height, *values)
    return data


def test_colmap_binary(tmp_path: Path) -> None:
    one = (1, 4, 640, 480, [500.0, 501.0, 320.5, 240.5, -0.2, 0.05, 1e-3, 2e-3])
    two = (7, 1, 640, 480, [600.0, 601.0, 320.5, 240.5])
    file = tmp_path / "cameras.bin"
    file.write_bytes(cameras_bin(one))
    for path in (file, tmp_path):
        found = read_calibration(path, SIZE)
        assert (found.fx, found.fy, found.cx) == (500.0, 501.0, 320.0)
        assert found.distortion == (-0.2, 0.05, 1e-3, 2e-3, 0.0)
    file.write_bytes(cameras_bin(one, two))
    assert "has 2 cameras: select the camera of the images, as in --calibration FILE:7" in refused(
        file
    )
    assert read_calibration(Path(f"{file}:7"), SIZE).fx == 600.0
    assert "no camera 3" in refused(Path(f"{file}:3"))
    for data in (cameras_bin(one)[:-1], b"", cameras_bin((1, 99, 640, 480, [1.0])), b"x" * 1000):
        file.write_bytes(data)
        assert "not a cameras.bin of COLMAP" in refused(file)


def test_pycolmap_writes_the_models_that_are_read(tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    for name in ("SIMPLE_RADIAL", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE", "RADIAL_FISHEYE"):
        model = pycolmap.Reconstruction()
        model.add_camera(pycolmap.Camera.create_from_model_name(1, name, 500.0, 640, 480))
        folders = [tmp_path / name / kind for kind in ("text", "binary")]
        for folder in folders:
            folder.mkdir(parents=True)
        model.write_text(str(folders[0]))
        model.write_binary(str(folders[1]))
        text, binary = (read_calibration(folder, SIZE) for folder in folders)
        assert text == binary


def test_user_topic_folder_or_size_selects_the_camera_of_a_chain(tmp_path: Path) -> None:
    file = tmp_path / "camchain.yaml"
    file.write_text(CHAIN)
    asked = refused(file)
    assert "has 2 cameras (cam0, cam1): select the camera of the images" in asked
    assert asked.endswith("--calibration FILE:cam1")
    assert read_calibration(Path(f"{file}:cam1"), SIZE).fx == 600.0
    assert read_calibration(Path(f"{file}:0"), SIZE).fx == 500.0
    assert "no 'cam4': it has cam0, cam1" in refused(Path(f"{file}:cam4"))
    assert read_calibration(file, SIZE, source="/cam1/image_raw").fx == 600.0
    assert read_calibration(file, SIZE, source="cam1").fx == 600.0
    file.write_text(CHAIN.replace("[640, 480]", "[320, 480]", 1))
    assert read_calibration(file, SIZE).fx == 600.0
    file.write_text(CHAIN[: CHAIN.index("cam1:")])
    assert read_calibration(file, SIZE).fx == 500.0
    file.write_text(CHAIN[CHAIN.index("cam1:") :])
    assert read_calibration(file, SIZE).fx == 600.0


def test_the_folder_or_topic_of_a_source_selects_the_camera_of_a_chain(tmp_path: Path) -> None:
    text = CHAIN.replace("640, 480", f"{bags.WIDTH}, {bags.HEIGHT}")
    for n in range(2):
        text = text.replace(f"[{500.0 + 100 * n}, 501.0", f"[{40.0 + n}, 40.0")
    text = text.replace("320.0, 240.0", "23.5, 15.5")
    chain = tmp_path / "camchain.yaml"
    chain.write_text(text)
    ros = Ros(2)
    topics = {f"/cam{n}/image_raw": [ros.image(0)] for n in range(2)}
    bags.write_ros2_bag(tmp_path / "bag", ros, topics)
    camera = tmp_path / "mav0" / "cam1"
    (camera / "data").mkdir(parents=True)
    cv2.imwrite(str(camera / "data" / "1.png"), np.zeros((bags.HEIGHT, bags.WIDTH), np.uint8))
    (camera / "data.csv").write_text("1403636579763555584,1.png\n")
    for n in range(2):
        opened = open_source(
            SourceSpec(
                location=str(tmp_path / "bag"), topic=f"/cam{n}/image_raw", calibration=chain
            )
        )
        assert opened.calibration.fx == 40.0 + n
    assert open_source(SourceSpec(location=str(camera), calibration=chain)).calibration.fx == 41.0


@pytest.mark.parametrize(
    ("text", "fx"),
    [
        ("535.4 539.2 320.1 247.6\n", 535.4),
        ("535.4,539.2,320.1,247.6", 535.4),
        ("# fx fy cx cy\n5.354e2 539.2 320.1 247.6\n", 535.4),
        ("5.35e2 0 320.1\n0 539.2 247.6\n0 0 1\n", 535.0),
        ("535.4 0 320.1 0\n0 539.2 247.6 0\n0 0 1 0\n0 0 0 1\n", 535.4),
    ],
)
def test_numbers_alone(text: str, fx: float, tmp_path: Path) -> None:
    (tmp_path / "calibration.txt").write_text(text)
    found = read_calibration(tmp_path / "calibration.txt", SIZE)
    assert (found.fx, found.fy, found.cx, found.cy) == (fx, 539.2, 320.1, 247.6)


def test_numbers_alone_that_are_no_camera(tmp_path: Path) -> None:
    file = tmp_path / "calibration.txt"
    for text in ("1 2 3 4 5", "9" * 10**6, "- 1\n- 2\n", "1 2 3 x"):
        file.write_text(text)
        assert len(refused(file)) < 600 + len(str(file))


def test_kitti_raw(tmp_path: Path) -> None:
    row = "7.215377e+02 0.0 6.095593e+02 0.0 0.0 7.3e+02 1.72854e+02 0.0 0.0 0.0 1.0 0.0"
    file = tmp_path / "calib_cam_to_cam.txt"
    file.write_text(f"calib_time: 09-Jan-2012\nK_00: 1\nP_rect_00: {row}\nP_rect_02: {row}\n")
    found = read_calibration(file, (1242, 375), kitti_camera=2)
    assert (found.fx, found.fy, found.cx) == (721.5377, 730.0, 609.5593)


def test_eth3d_and_scannet_are_opened(tmp_path: Path) -> None:
    for layout in ("eth3d", "scannet"):
        folder = tmp_path / layout
        images = folder / ("rgb" if layout == "eth3d" else "color")
        (folder / "depth").mkdir(parents=True)
        images.mkdir()
        for n in range(3):
            cv2.imwrite(str(images / f"{n}.png"), np.zeros((480, 640, 3), np.uint8))
            cv2.imwrite(str(folder / "depth" / f"{n}.png"), np.ones((480, 640), np.uint16))
    (tmp_path / "eth3d" / "calibration.txt").write_text("726.2 726.3 359.2 202.4")
    (tmp_path / "eth3d" / "rgb.txt").write_text(
        "".join(f"{0.1 * n} rgb/{n}.png\n" for n in range(3))
    )
    (tmp_path / "scannet" / "intrinsic").mkdir()
    (tmp_path / "scannet" / "intrinsic" / "intrinsic_color.txt").write_text(
        "726.2 0 359.2 0\n0 726.3 202.4 0\n0 0 1 0\n0 0 0 1\n"
    )
    for layout in ("eth3d", "scannet"):
        found = open_source(str(tmp_path / layout))
        assert found.frame_count == 3
        assert (found.calibration.fx, found.calibration.cy) == (726.2, 202.4)

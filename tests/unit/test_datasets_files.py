"""Sources made of files: every format is recognised, read in order, and refused in one line."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from pliant.datasets import FORMATS, open_source
from pliant.datasets.base import Dataset
from pliant.datasets.calibration import UNSAID_SIGMA
from pliant.datasets.images import image_files
from pliant.datasets.rectifier import Rectifier, decode
from pliant.datasets.source_spec import SourceSpec
from pliant.datasets.times import nanoseconds, number_of
from pliant.errors import CalibrationError, DatasetError, PliantError

WIDTH, HEIGHT = 64, 48
CALIBRATION = {
    "model": "pinhole",
    "width": WIDTH,
    "height": HEIGHT,
    "fx": 60.0,
    "fy": 60.0,
    "cx": 31.5,
    "cy": 23.5,
}
SENSOR = (
    "rate_hz: 20\nresolution: [64, 48]\ncamera_model: pinhole\nintrinsics: [60, 60, 31, 23]\n"
    "distortion_model: radial-tangential\ndistortion_coefficients: [-0.1, 0.01, 0, 0]\n"
)


def encoded(
    number: int = 0, suffix: str = ".png", width: int = WIDTH, height: int = HEIGHT
) -> bytes:
    image = np.full((height, width), 10 * number, np.uint8)
    image[:, : width // 2] += 5
    done, data = cv2.imencode(suffix, image)
    assert done
    return data.tobytes()


def write_images(folder: Path, names: list[str]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for number, name in enumerate(names):
        (folder / name).write_bytes(encoded(number, Path(name).suffix))


def write_calibration(folder: Path, **changes: object) -> None:
    (folder / "calib.yaml").write_text(yaml.safe_dump({**CALIBRATION, **changes}))


def listed_folder(folder: Path, count: int = 3) -> Path:
    names = [f"{i:03d}.png" for i in range(count)]
    write_images(folder / "images", names)
    write_calibration(folder)
    lines = [f"{0.5 + i / 30:.6f} images/{name}" for i, name in enumerate(names)]
    (folder / "rgb.txt").write_text("\n".join(["# timestamp filename", *lines]) + "\n")
    return folder


def tum(folder: Path) -> Path:
    folder /= "rgbd_dataset_freiburg2_desk"
    (folder / "rgb").mkdir(parents=True)
    (folder / "rgb" / "a.png").write_bytes(encoded(1, width=640, height=480))
    (folder / "rgb.txt").write_text(
        "# color images\n# file: 'x.bag'\n1305031102.175304 rgb/a.png\n"
    )
    (folder / "groundtruth.txt").write_text("")
    return folder


def euroc(folder: Path) -> Path:
    folder /= "V1_01_easy"
    camera = folder / "mav0" / "cam0"
    stamps = [1403636579763555584, 1403636579813555456]
    write_images(camera / "data", [f"{stamp}.png" for stamp in stamps])
    rows = [f"{stamp},{stamp}.png\r" for stamp in stamps]
    (camera / "data.csv").write_text("\n".join(["#timestamp [ns],filename\r", *rows]))
    (camera / "sensor.yaml").write_text(SENSOR)
    truth = folder / "mav0" / "state_groundtruth_estimate0"
    truth.mkdir()
    (truth / "data.csv").write_text("")
    return folder


def kitti(folder: Path, camera: int = 0) -> Path:
    sequence = folder / "sequences" / "03"
    write_images(sequence / f"image_{camera}", [f"{i:06d}.png" for i in range(3)])
    (sequence / "times.txt").write_text("0.000000e+00\n1.036224e-01\n2.072454e-01\n")
    rows = [f"P{i}: {60 + i} 0 31 0 0 {60 + i} 23 0 0 0 1 0" for i in range(4)]
    (sequence / "calib.txt").write_text("\n".join(rows))
    (folder / "poses").mkdir()
    (folder / "poses" / "03.txt").write_text("")
    return sequence


def refused(source: Path | str, kind: type[PliantError] = DatasetError, **options: object) -> str:
    with pytest.raises(kind) as caught:
        open_source(SourceSpec(location=str(source), **options))  # type: ignore[arg-type]
    line = str(caught.value)
    assert "\n" not in line
    return line


def stamps(dataset: Dataset) -> list[int]:
    frames = list(dataset)
    assert [frame.index for frame in frames] == list(range(len(frames)))
    assert dataset.frame_count == len(frames)
    return [frame.stamp_ns for frame in frames]


def test_listed_folder(tmp_path: Path) -> None:
    dataset = open_source(str(listed_folder(tmp_path / "desk")))
    assert dataset.name == "desk"
    assert not dataset.is_live
    assert dataset.ground_truth_path is None
    assert stamps(dataset) == [500000000, 533333000, 566667000]
    for number, frame in enumerate(dataset):  # a second time
        assert frame.encoding == "png"
        assert frame.data == encoded(number)
        assert decode(frame)[0, -1] == 10 * number


@pytest.mark.parametrize("separator", [" ", "\t", ",", ", ", ";"])
def test_lists_may_be_separated_and_commented_in_many_ways(tmp_path: Path, separator: str) -> None:
    folder = listed_folder(tmp_path)
    rows = [f"{i}.5{separator}images/00{i}.png  " for i in range(3)]
    (folder / "rgb.txt").write_text("\ufeff# a\r\n\r\n" + "\r\n# b\r\n".join(rows))
    assert stamps(open_source(str(folder))) == [500000000, 1500000000, 2500000000]


def test_lists_may_be_utf_16(tmp_path: Path) -> None:
    """As the shell of Windows writes them."""
    folder = listed_folder(tmp_path)
    rows = [f"{i}.5 images/00{i}.png" for i in range(3)]
    (folder / "rgb.txt").write_text("\r\n".join(rows), encoding="utf-16")
    assert stamps(open_source(str(folder))) == [500000000, 1500000000, 2500000000]


def test_file_names_with_spaces(tmp_path: Path) -> None:
    folder = listed_folder(tmp_path)
    write_images(folder / "my images", ["a b.png"])
    (folder / "rgb.txt").write_text('1 my images/a b.png\n2 "my images/a b.png"\n')
    assert len(list(open_source(str(folder)))) == 2


def test_stamps_are_exact() -> None:
    def stamp(text: str, unit: str = "seconds") -> int:
        return nanoseconds(number_of(text, "rgb.txt: line 1"), unit, "rgb.txt: line 1")

    assert stamp("1403715273.262142976") == 1403715273262142976
    assert stamp("1.036224e-01") == 103622400
    assert stamp("1403715273262142976", "nanoseconds") == 1403715273262142976
    for text, says in (
        ("nan", "not finite"),
        ("inf", "not finite"),
        ("-1", "not finite and positive"),
        ("1e999999", "too large"),
        ("1403715273262142976", "too large"),
        ("x", "is not a time"),
    ):
        with pytest.raises(DatasetError, match=says):
            stamp(text)


def test_names_of_files_lie(tmp_path: Path) -> None:
    folder = listed_folder(tmp_path)
    (folder / "images" / "000.png").write_bytes(encoded(0, ".jpg"))
    assert [frame.encoding for frame in open_source(str(folder))] == ["jpeg", "png", "png"]


def test_tum(tmp_path: Path) -> None:
    folder = tum(tmp_path)
    dataset = open_source(str(folder))
    assert stamps(dataset) == [1305031102175304000]
    assert dataset.calibration.fx == 520.908620
    assert dataset.calibration.lens.distorts
    assert dataset.ground_truth_path == folder / "groundtruth.txt"
    # A calibration beside the images wins over the benchmark's.
    write_calibration(folder, width=640, height=480, fx=500.0, cx=320.0)
    assert open_source(str(folder)).calibration.fx == 500.0


def test_tum_with_images_of_another_size(tmp_path: Path) -> None:
    folder = tum(tmp_path)
    (folder / "rgb" / "a.png").write_bytes(encoded(1))
    assert "640x480" in refused(folder, CalibrationError)


@pytest.mark.parametrize("below", ["", "mav0", "mav0/cam0"])
def test_euroc(tmp_path: Path, below: str) -> None:
    folder = euroc(tmp_path)
    dataset = open_source(str(folder / below))
    assert dataset.name == "V1_01_easy"
    assert stamps(dataset) == [1403636579763555584, 1403636579813555456]
    assert dataset.calibration.distortion == (-0.1, 0.01, 0.0, 0.0, 0.0)
    assert dataset.calibration.fps == 20.0
    assert dataset.ground_truth_path is not None


def test_euroc_that_lacks_something(tmp_path: Path) -> None:
    camera = euroc(tmp_path) / "mav0" / "cam0"
    (camera / "sensor.yaml").unlink()
    assert open_source(str(tmp_path / "V1_01_easy")).calibration.focal_sigma == UNSAID_SIGMA
    (camera / "data.csv").unlink()
    assert "data.csv: missing" in refused(tmp_path / "V1_01_easy")


@pytest.mark.parametrize("camera", [0, 2])
def test_kitti(tmp_path: Path, camera: int) -> None:
    dataset = open_source(str(kitti(tmp_path, camera)))
    assert dataset.name == "kitti_03"
    assert stamps(dataset) == [0, 103622400, 207245400]
    assert dataset.calibration.fx == 60.0 + camera
    assert dataset.ground_truth_path == tmp_path / "poses" / "03.txt"


def test_kitti_with_fewer_times_than_images(tmp_path: Path) -> None:
    sequence = kitti(tmp_path)
    (sequence / "times.txt").write_text("0\n0.1\n")
    assert "2 times for 3 images" in refused(sequence)
    (sequence / "times.txt").write_text("0\n0.1\n0.1\n")
    assert "line 3: the time 0.100000000 s repeats that of line 2" in refused(sequence)
    (sequence / "times.txt").unlink()
    assert "times.txt: missing" in refused(sequence)
    for image in (sequence / "image_0").iterdir():
        image.unlink()
    assert "no images" in refused(sequence)


def test_bare_folder(tmp_path: Path) -> None:
    write_images(tmp_path, ["frame10.png", "frame9.jpg", "frame1.png"])
    (tmp_path / "._frame1.png").write_bytes(b"what macOS leaves on foreign disks")
    (tmp_path / "notes.txt").write_text("")
    names = [path.name for path in image_files(tmp_path)]
    assert names == ["frame1.png", "frame9.jpg", "frame10.png"]
    dataset = open_source(SourceSpec(location=str(tmp_path), fov_deg=90.0))
    assert stamps(dataset) == [0, 33333333, 66666667]
    assert dataset.calibration.fx == pytest.approx(32.0)
    assert 0.0 < dataset.calibration.focal_sigma < UNSAID_SIGMA
    assert open_source(str(tmp_path)).calibration.focal_sigma == UNSAID_SIGMA
    write_calibration(tmp_path, fps=10)
    assert stamps(open_source(str(tmp_path))) == [0, 100000000, 200000000]


def test_the_users_calibration_wins(tmp_path: Path) -> None:
    folder = listed_folder(tmp_path / "a")
    other = tmp_path / "other.yaml"
    other.write_text(yaml.safe_dump({**CALIBRATION, "fx": 70.0}))
    assert open_source(SourceSpec(location=str(folder), calibration=other)).calibration.fx == 70.0
    both = refused(folder, CalibrationError, calibration=other, fov_deg=60.0)
    assert both == "--calibration and --fov exclude each other: pass only one"
    assert str(other) in refused(
        folder, CalibrationError, calibration=other.with_name("none.yaml")
    ).replace("none.yaml", "other.yaml")


def test_nothing_there(tmp_path: Path) -> None:
    for source, says in ((tmp_path / "none", "no such file"), (tmp_path, "is an empty folder")):
        line = refused(source)
        assert says in line
        assert line.endswith("see `pliant run --help` and docs/sources.md for supported sources")
        assert len(line) < len(str(source)) + 100
    (tmp_path / "readme.md").write_text("")
    assert "contains no source" in refused(tmp_path)
    assert "is empty" in refused("")
    assert "pass its folder" in refused(listed_folder(tmp_path / "a") / "rgb.txt")


@pytest.mark.parametrize(
    ("lines", "says"),
    [
        (["1 images/000.png", "1 images/001.png"], "line 2: the time 1.000000000 s repeats"),
        (["2 images/000.png", "", "1 images/001.png"], "line 3: the time 1.000000000 s runs backw"),
        (["1 images/000.png", "2"], "line 2: expected \"time file\", got '2'"),
        (["x images/000.png"], "line 1: 'x' is not a time"),
        (["nan images/000.png"], "line 1: the time nan"),
        (["1 images/000.png", "2 images/9.png"], "line 2: no file images/9.png"),
        (["1 ../../secret.png"], "line 1: '../../secret.png' is outside"),
        (["1 images/../../secret.png"], "is outside"),
        (["1 /etc/hostname"], "line 1: '/etc/hostname' is outside"),
        (["1 images/000.png\0"], "is outside"),
        (["1 images"], "no file images"),
        (["# only comments"], "lists no images"),
        ([], "lists no images"),
    ],
)
def test_broken_lists(tmp_path: Path, lines: list[str], says: str) -> None:
    folder = listed_folder(tmp_path)
    (folder / "rgb.txt").write_text("\n".join(lines))
    assert says in refused(folder)


def test_list_that_is_no_text(tmp_path: Path) -> None:
    folder = listed_folder(tmp_path)
    (folder / "rgb.txt").write_bytes(bytes(range(256)))
    assert "is not a text file" in refused(folder)


def test_calibration_of_other_images(tmp_path: Path) -> None:
    folder = listed_folder(tmp_path)
    write_calibration(folder, width=128, height=96)
    assert "128x96 px, but they have 64x48" in refused(folder, CalibrationError)


def test_images_that_are_none(tmp_path: Path) -> None:
    folder = listed_folder(tmp_path)
    for path in (folder / "images").iterdir():
        path.write_bytes(b"not an image")
    assert "none of the first 3 images does decode" in refused(folder)


def test_a_file_that_vanishes_is_a_broken_frame(tmp_path: Path) -> None:
    folder = listed_folder(tmp_path)
    dataset = open_source(str(folder))
    (folder / "images" / "001.png").unlink()
    rectifier = Rectifier(dataset.calibration)
    outcomes: list[bool] = []
    for frame in dataset:
        assert not frame.dropped
        try:
            rectifier.rectify(frame)
        except DatasetError:
            outcomes.append(False)
        else:
            outcomes.append(True)
    assert outcomes == [True, False, True]


@pytest.mark.parametrize(
    ("make", "kind"),
    [(listed_folder, "folder"), (tum, "tum-rgbd"), (euroc, "euroc"), (kitti, "kitti")],
)
def test_each_is_recognised_as_what_it_is(
    tmp_path: Path, make: Callable[[Path], Path], kind: str
) -> None:
    source = str(make(tmp_path / "data"))
    first = next(name for name, entry in FORMATS.items() if entry.recognises(source))
    assert first == kind


RIGID = Path(__file__).parents[3] / "shared" / "data" / "rigid"


@pytest.mark.skipif(not RIGID.is_dir(), reason="no ../shared/data")
@pytest.mark.parametrize(
    ("name", "frames", "size", "fx", "colour"),
    [
        ("tsukuba150", 150, (640, 480), 615.0, True),
        ("7scenes_redkitchen400", 400, (640, 480), 525.0, True),
        ("tsdfold_50", 50, (640, 480), 615.1951904296875, True),
        ("kitti_nn_seq1", 51, (1226, 370), 707.0912, False),
        ("euroc_v101_still30", 30, (752, 480), 458.654, False),
        ("fountain_p11_q", 11, (768, 512), 689.87, True),
        ("fox_ingp_half", 50, (540, 960), 687.76, True),
    ],
)
def test_real_sequences(
    name: str, frames: int, size: tuple[int, int], fx: float, colour: bool
) -> None:
    dataset = open_source(str(RIGID / name))
    assert (dataset.name, dataset.frame_count) == (name, frames)
    assert dataset.ground_truth_path is not None
    assert (dataset.calibration.width, dataset.calibration.height) == size
    assert dataset.calibration.fx == fx
    rectifier = Rectifier(dataset.calibration)
    grey, rgb = rectifier.rectify(next(iter(dataset)))
    assert grey.shape == (size[1], size[0])
    assert (rgb is not None) == colour
    if not dataset.calibration.lens.distorts:
        assert rectifier.camera == dataset.calibration.lens.pinhole

"""Folders as people have them: depth beside colour, several cameras, odd sizes, foreign files."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from pliant.datasets import notes_on, open_source, sources_in
from pliant.datasets.base import BrokenFrame
from pliant.datasets.rectifier import Rectifier
from pliant.datasets.source_spec import SourceSpec
from pliant.errors import DatasetError

COUNT = 5
COLOUR = np.full((24, 32, 3), 90, np.uint8)
GREY = np.full((24, 32), 90, np.uint8)
DEPTH = np.full((24, 32), 1200, np.uint16)


def write(folder: Path, pattern: str, pixels: np.ndarray, count: int = COUNT) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for row in range(count):
        assert cv2.imwrite(str(folder / pattern.format(row)), pixels)


def names(folder: Path) -> tuple[list[str], list[str]]:
    source = open_source(SourceSpec(location=str(folder), fov_deg=60.0))
    said = [note for note in notes_on(source) if not note.startswith("times: ")]
    return [frame.name for frame in source], said


@pytest.mark.parametrize(
    ("used", "other", "pixels"),
    [
        ("frame-{:06d}.color.png", "frame-{:06d}.depth.png", DEPTH),
        ("rgb_{}.png", "depth_{}.png", DEPTH),
        ("{}.jpg", "{}.png", DEPTH),
        ("z{}.png", "a{}.png", DEPTH),
        ("{}.png", "{}_mask.png", GREY),
        ("left_{}.png", "right_{}.png", COLOUR),
        ("cam0_{}.png", "cam1_{}.png", COLOUR),
        ("a_{}.png", "b_{}.png", COLOUR),
        ("photo{}.jpg", "photo{}.png", COLOUR[::2, ::2]),  # previews
    ],
)
def test_one_kind_is_used_with_a_note(
    used: str, other: str, pixels: np.ndarray, tmp_path: Path
) -> None:
    write(tmp_path, used, COLOUR)
    write(tmp_path, other, pixels)
    found, said = names(tmp_path)
    assert found == [used.format(row) for row in range(COUNT)]
    assert len(said) == 1
    assert "; skipping 5 " in said[0]


def test_kinds_of_other_frames_stay_together(tmp_path: Path) -> None:
    write(tmp_path, "a_{}.png", COLOUR)
    for row in range(COUNT):
        cv2.imwrite(str(tmp_path / f"b_{row + COUNT}.png"), COLOUR)
    found, said = names(tmp_path)
    assert (len(found), said) == (2 * COUNT, [])


def test_a_thumbnail_first_costs_itself(tmp_path: Path) -> None:
    write(tmp_path, "{}.png", COLOUR)
    cv2.imwrite(str(tmp_path / "0.png"), COLOUR[::2, ::2])
    source = open_source(SourceSpec(location=str(tmp_path), fov_deg=60.0))
    assert (source.calibration.width, source.calibration.height) == (32, 24)
    rectifier, broken = Rectifier(source.calibration), list[int]()
    for frame in source:
        try:
            rectifier.rectify(frame)
        except BrokenFrame:
            broken.append(frame.index)
    assert broken == [0]


def test_images_are_rotated_by_their_orientation_tag(tmp_path: Path) -> None:
    write(tmp_path, "{}.jpg", COLOUR)
    for path in tmp_path.iterdir():  # an EXIF header: orientation 6
        data = path.read_bytes()
        exif = b"Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0"
        path.write_bytes(data[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2) + exif + data[2:])
    calibration = open_source(SourceSpec(location=str(tmp_path), fov_deg=60.0)).calibration
    assert (calibration.width, calibration.height) == (24, 32)


@pytest.mark.parametrize("inner", ["rgb", "color", "images", "frames", "cam0"])
def test_images_in_a_usual_folder(inner: str, tmp_path: Path) -> None:
    write(tmp_path / inner, "{}.png", COLOUR)
    write(tmp_path / "depth", "{}.png", DEPTH)
    (tmp_path / "__MACOSX" / inner).mkdir(parents=True)
    (tmp_path / "__MACOSX" / inner / "._0.png").write_bytes(b"what macOS leaves")
    (tmp_path / ".DS_Store").write_bytes(b"\0")
    found, said = names(tmp_path)
    assert found == [f"{row}.png" for row in range(COUNT)]
    assert said == [f"the images are those in {inner}/"]


def test_files_of_other_formats_are_named(tmp_path: Path) -> None:
    write(tmp_path, "{}.jpg", COLOUR)
    for name in ("a.HEIC", "b.heic", "c.DNG", "notes.txt", "._d.heic"):
        (tmp_path / name).write_bytes(b"x")
    found, said = names(tmp_path)
    assert len(found) == COUNT
    assert said == [
        f"{tmp_path.name}: 3 files (.dng, .heic) passed over: unsupported format; convert "
        "to JPEG or PNG"
    ]


def test_a_folder_of_one_source_names_it(tmp_path: Path) -> None:
    write(tmp_path / "zip" / "seq_01", "{}.png", COLOUR)
    (tmp_path / "zip" / "__MACOSX" / "seq_01").mkdir(parents=True)
    (tmp_path / "zip" / "__MACOSX" / "seq_01" / "._0.png").write_bytes(b"x")
    with pytest.raises(
        DatasetError, match=r"is not a source, but contains one: use `pliant run .*/seq_01`"
    ):
        open_source(str(tmp_path / "zip"))
    heic = tmp_path / "heic"
    heic.mkdir()
    (heic / "IMG_0001.HEIC").write_bytes(b"x")
    with pytest.raises(DatasetError, match=r"1 file \(\.heic\): unsupported format; convert"):
        open_source(str(heic))


def test_pages_behind_the_first_are_named(tmp_path: Path) -> None:
    for row in range(2):
        assert cv2.imwritemulti(str(tmp_path / f"{row}.tiff"), [GREY, GREY, GREY])
    found, said = names(tmp_path)
    assert len(found) == 2
    assert said == ["0.tiff: has 3 pages or frames, and only the first is read: convert it"]


def test_images_that_a_list_leaves_out_are_named(tmp_path: Path) -> None:
    write(tmp_path / "rgb", "{}.png", COLOUR, count=30)
    lines = [f"{0.1 * row:.1f} rgb/{row}.png" for row in range(20)]
    (tmp_path / "rgb.txt").write_text("\n".join(lines))
    source = open_source(SourceSpec(location=str(tmp_path), fov_deg=60.0))
    assert notes_on(source) == ["rgb.txt: lists 20 images; 10 more in rgb/ are skipped"]


def test_a_listed_file_that_is_missing_costs_itself(tmp_path: Path) -> None:
    write(tmp_path / "rgb", "{}.png", COLOUR, count=20)
    lines = [f"{0.1 * row:.1f} rgb/{row}.png" for row in range(20)]
    (tmp_path / "rgb.txt").write_text("\n".join(lines))
    (tmp_path / "rgb" / "7.png").unlink()
    source = open_source(SourceSpec(location=str(tmp_path), fov_deg=60.0))
    assert [frame.index for frame in source if not frame.data] == [7]
    assert notes_on(source) == [
        "rgb.txt: 1 file of 20 (the first in line 8) are missing and count as broken"
    ]
    for row in range(3):
        (tmp_path / "rgb" / f"{row}.png").unlink()
    with pytest.raises(DatasetError, match="4 of 20 listed images are missing"):
        open_source(SourceSpec(location=str(tmp_path), fov_deg=60.0))


def test_a_raw_drive_of_kitti(tmp_path: Path) -> None:
    drive = tmp_path / "2011_09_26" / "2011_09_26_drive_0001_sync"
    write(drive / "image_00" / "data", "{:010d}.png", GREY, count=3)
    write(drive / "image_02" / "data", "{:010d}.png", COLOUR, count=3)
    times = [f"2011-09-26 13:02:25.{row}94360375" for row in range(3)]
    (drive / "image_00" / "timestamps.txt").write_text("\n".join(times) + "\n")
    row = "30.0 0 16.0 0 0 30.0 12.0 0 0 0 1 0"
    (tmp_path / "2011_09_26" / "calib_cam_to_cam.txt").write_text(f"P_rect_00: {row}\n")
    source = open_source(str(drive))
    assert [f.stamp_ns - 1317042145094360375 for f in source] == [0, 10**8, 2 * 10**8]
    assert (source.calibration.fx, source.name) == (30.0, drive.name)
    (drive / "image_00" / "timestamps.txt").write_text("a\nb\nc\n")
    with pytest.raises(DatasetError, match="line 1: 'a' is not a date"):
        open_source(str(drive))


@pytest.mark.parametrize("other", ["kitchen/0.png", "clip.mp4", "drive.bag"])
def test_a_collection_is_no_sequence(other: str, tmp_path: Path) -> None:
    write(tmp_path / "data", "{}.png", COLOUR)
    (tmp_path / other).parent.mkdir(exist_ok=True)
    cv2.imwrite(str(tmp_path / "x.png"), COLOUR)
    (tmp_path / "x.png").rename(tmp_path / other)
    found = [path.name for path in sources_in(tmp_path, but=tmp_path / "results")]
    assert found == sorted(["data", Path(other).parts[0]])
    with pytest.raises(DatasetError, match="contains several: pass one of them"):
        open_source(str(tmp_path))

"""Names of files that are times, and lists in units of their own."""

from decimal import Decimal
from pathlib import Path

import cv2
import numpy as np
import pytest

from pliant.datasets import notes_on, open_source
from pliant.datasets.named_times import times_in_names
from pliant.datasets.source_spec import SourceSpec
from pliant.datasets.times import likely_unit

S, MS = 10**9, 10**6
A, B = 1305031102175304000, 1305031102211214000
C, D = 1403636579763555584, 1403636579813555456
E = 1700000000 * S


@pytest.mark.parametrize(
    ("names", "order", "stamps_ns"),
    [
        # seconds with unequal decimals, of unequal length, and without a leading zero
        (["0.1", "0.13", "0.2"], [0, 1, 2], [S // 10, 13 * S // 100, S // 5]),
        (["0.2", "0.13", "0.1"], [2, 1, 0], [S // 10, 13 * S // 100, S // 5]),
        (["10.5", "9.5"], [1, 0], [95 * S // 10, 105 * S // 10]),
        ([".9", "1.0", ".95"], [0, 2, 1], [9 * S // 10, 95 * S // 100, S]),
        (["x0.1", "x0.13", "x0.2"], [0, 1, 2], [S // 10, 13 * S // 100, S // 5]),
        (["1305031102.175304", "1305031102.211214"], [0, 1], [A, B]),
        # nano-, micro- and milliseconds, from zero and of a date
        (["1403636579763555584", "1403636579813555456"], [0, 1], [C, D]),
        (["0", "33333333", "66666667", "100000000"],
         [0, 1, 2, 3], [0, 33333333, 66666667, S // 10]),
        (["999999999", "1033333333"], [0, 1], [999999999, 1033333333]),
        (["1700000000033000", "1700000000000000"], [1, 0], [E, E + 33 * MS]),
        (["1700000000033", "1700000000000"], [1, 0], [E, E + 33 * MS]),
        (["0", "33333", "66667"], [0, 1, 2], [0, 33333000, 66667000]),
        (["0", "33", "67", "100", "133"], [0, 1, 2, 3, 4], [i * MS for i in (0, 33, 67, 100, 133)]),
        # beside another number
        (["f_0001_1.5", "f_0002_1.53", "f_0003_1.6"],
         [0, 1, 2], [15 * S // 10, 153 * S // 100, 16 * S // 10]),
        # whole seconds of a date
        (["1700000010", "1700000000"], [1, 0], [1700000000 * S, 1700000010 * S]),
        # seconds and their fraction
        (["1305031102_175304000", "1305031102_211214000"], [0, 1], [A, B]),
        (["1305031102_5304000", "1305031102_211214000"], [0, 1], [A - 170 * MS, B]),
        (["1305031102_175304", "1305031102_211214"], [0, 1], [A, B]),
        # dates
        (["IMG_20240102_123005", "IMG_20240102_123004"], [1, 0], [1704198604 * S, 1704198605 * S]),
        (["2024-01-02T12-30-05.250", "2024-01-02T12-30-05.300"],
         [0, 1], [1704198605 * S + ms * MS for ms in (250, 300)]),
    ],
)  # fmt: skip
def test_names_that_are_times(names: list[str], order: list[int], stamps_ns: list[int]) -> None:
    found = times_in_names(names)
    assert found is not None
    assert (found.order, found.stamps_ns) == (order, stamps_ns)


@pytest.mark.parametrize(
    "names",
    [
        ["0001", "0002", "0003"],
        ["1", "2", "10"],
        ["0", "5", "10", "15"],  # every fifth
        ["0", "30", "60", "90"],
        ["3", "17", "25", "60", "61"],  # keyframes
        ["a", "b", "c"],
        ["IMG_1234", "IMG_1235", "IMG_1240"],
        ["img-1.0", "img-1.00"],  # the same time twice
        ["frame.0001", "frame.0002", "frame.0003"],
        ["frame.1", "frame.2", "frame.13"],
        ["shot1.0001", "shot1.0002", "shot1.0003"],
        ["v2.01", "v2.02", "v2.03"],
        ["a1.0001", "a1.0003", "a1.0004"],
        ["v2.01", "v2.03", "v2.04"],
        ["frame_1", "other_2"],
        ["20240102_123005", "20240102_123005_1"],
        ["20249902_123005", "20249902_123006"],
        ["only"],
        [],
    ],
)
def test_names_that_are_none(names: list[str]) -> None:
    assert times_in_names(names) is None


@pytest.mark.parametrize(
    ("values", "known", "unit"),
    [
        ([0, 0.033, 0.067], "seconds", "seconds"),
        ([0, 1, 2], "seconds", "seconds"),
        ([0, 10, 20], "seconds", "seconds"),
        ([1700000000, 1700000030], "seconds", "seconds"),
        ([0, 33, 67], "seconds", "milliseconds"),
        ([0, 33333333], "seconds", "nanoseconds"),
        ([1403636579763555584, 1403636579813555456], "seconds", "nanoseconds"),
        ([1403636579763555584, 1403636579813555456], "nanoseconds", "nanoseconds"),
        ([1403636579.7635, 1403636579.8135], "nanoseconds", "seconds"),
        ([0.05, 0.1], "nanoseconds", "seconds"),
        ([0, 50000000], "nanoseconds", "nanoseconds"),
        ([7], "seconds", "seconds"),
        ([], "seconds", "seconds"),
    ],
)
def test_units(values: list[float], known: str, unit: str) -> None:
    assert likely_unit([Decimal(repr(value)) for value in values], known) == unit


def write(folder: Path, names: list[str]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for row, name in enumerate(names):
        cv2.imwrite(str(folder / name), np.full((24, 32), row, np.uint8))


def test_a_folder_is_in_the_order_of_its_times_with_a_note_on_them(tmp_path: Path) -> None:
    write(tmp_path / "a", ["0.1.png", "0.2.png", "0.13.png"])
    source = open_source(SourceSpec(location=str(tmp_path / "a"), fov_deg=60.0))
    frames = list(source)
    assert [f.name for f in frames] == ["0.1.png", "0.13.png", "0.2.png"]
    assert [f.stamp_ns for f in frames] == [100000000, 130000000, 200000000]
    assert notes_on(source) == ["times: from the file names, in seconds: 14.3 images/s"]


def test_times_without_a_leading_zero_are_no_hidden_files(tmp_path: Path) -> None:
    write(tmp_path, [".9.png", "1.0.png", ".95.png"])
    (tmp_path / "._1.0.png").write_bytes(b"what macOS leaves")
    (tmp_path / ".thumb.png").write_bytes(b"hidden")
    frames = list(open_source(SourceSpec(location=str(tmp_path), fov_deg=60.0)))
    assert [f.name for f in frames] == [".9.png", ".95.png", "1.0.png"]
    assert [f.stamp_ns for f in frames] == [900000000, 950000000, 1000000000]


def test_a_folder_without_times_in_names_has_a_note_on_the_assumption(tmp_path: Path) -> None:
    write(tmp_path / "a", ["2.png", "10.png", "1.png"])
    source = open_source(SourceSpec(location=str(tmp_path / "a"), fov_deg=60.0))
    assert [f.name for f in source] == ["1.png", "2.png", "10.png"]
    (note,) = notes_on(source)
    assert note.startswith("times: none in the file names, assuming 30 images/s")


@pytest.mark.parametrize(
    ("times", "note"),
    [
        (["0", "33333333", "66666667"], ["nanoseconds, not seconds: 30 images/s"]),
        (["0", "33", "67"], ["milliseconds, not seconds: 29.4 images/s"]),
        (["0.000", "0.033", "0.067"], []),
    ],
)  # fmt: skip
def test_a_list_may_have_other_units(times: list[str], note: list[str], tmp_path: Path) -> None:
    write(tmp_path, ["0.png", "1.png", "2.png"])
    lines = [f"{time} {row}.png" for row, time in enumerate(times)]
    (tmp_path / "rgb.txt").write_text("\n".join(lines))
    source = open_source(SourceSpec(location=str(tmp_path), fov_deg=60.0))
    assert [round(f.stamp_ns / 1e6) for f in source] == [0, 33, 67]
    assert notes_on(source) == [f"rgb.txt: times are taken as {each}" for each in note]


@pytest.mark.parametrize("header", ["#timestamp [ns],filename", "timestamp,filename"])
def test_euroc_in_seconds(header: str, tmp_path: Path) -> None:
    camera = tmp_path / "mav0" / "cam0"
    write(camera / "data", ["a.png", "b.png"])
    rows = [header, "1403636579.763555584,a.png", "1403636579.813555456,b.png"]
    (camera / "data.csv").write_text("\n".join(rows))
    source = open_source(SourceSpec(location=str(tmp_path), fov_deg=60.0))
    assert [f.stamp_ns for f in source] == [1403636579763555584, 1403636579813555456]
    assert notes_on(source) == [
        "data.csv: times are taken as seconds, not nanoseconds: 20 images/s"
    ]


@pytest.mark.parametrize("swapped", [False, True])
@pytest.mark.parametrize("name", ["associations.txt", "rgb.txt"])
def test_associations_have_four_columns(name: str, swapped: bool, tmp_path: Path) -> None:
    write(tmp_path / "rgb", ["0.png", "1.png"])
    (tmp_path / "depth").mkdir()
    for row in range(2):
        cv2.imwrite(str(tmp_path / "depth" / f"{row}.png"), np.full((24, 32), 9, np.uint16))
    rows = [
        (f"{5 + row / 30:.4f} rgb/{row}.png", f"{5.01 + row / 30:.4f} depth/{row}.png")
        for row in range(2)
    ]
    lines = [" ".join(row[::-1] if swapped else row) for row in rows]
    (tmp_path / name).write_text("\n".join(lines))
    (tmp_path / "calib.yaml").write_text(
        "width: 32\nheight: 24\nfx: 30\nfy: 30\ncx: 16\ncy: 12\ndepth_scale: 0.001\n"
    )
    frames = list(open_source(SourceSpec(location=str(tmp_path), depth="all")))
    assert [f.stamp_ns for f in frames] == [5000000000, 5033300000]
    assert [f.name for f in frames] == ["0.png", "1.png"]
    assert all(f.depth == (tmp_path / "depth" / f.name).read_bytes() for f in frames)

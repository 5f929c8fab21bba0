"""Depth maps that come with a source: whose frame they are, and metres in rectified pixels."""

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from running import write_sequence

from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.rectification import rectified_camera
from pliant.datasets import open_source
from pliant.datasets.base import BrokenFrame
from pliant.datasets.calibration import Calibration, DepthImages
from pliant.datasets.depth import DepthRectifier
from pliant.datasets.source_spec import SourceSpec
from pliant.errors import CalibrationError, DatasetError

WIDTH, HEIGHT = 32, 24


def png(units: np.ndarray) -> bytes:
    return cv2.imencode(".png", units)[1].tobytes()


def depth_png(value: int) -> bytes:
    return png(np.full((HEIGHT, WIDTH), value, np.uint16))


def sequence(
    folder: Path, depths: Sequence[tuple[float, int]], frames: int = 4, **calibration: object
) -> Path:
    """A folder with images every 1/30 s and depth maps at given times."""
    images = [np.full((HEIGHT, WIDTH), 10 * i, np.uint8) for i in range(frames)]
    calibration = {"depth_scale": 0.001, **calibration}
    write_sequence(folder, images, **calibration)
    lines = []
    for i, (stamp, value) in enumerate(depths):
        (folder / f"depth{i}.png").write_bytes(depth_png(value))
        lines.append(f"{stamp:.6f} depth{i}.png")
    (folder / "depth.txt").write_text("\n".join(lines) + "\n")
    return folder


def found(folder: Path, depth: str) -> list[float]:
    """The depth of each frame in metres, 0 without."""
    source = open_source(SourceSpec(location=str(folder), depth=depth))  # type: ignore[arg-type]
    rectifier = DepthRectifier(source.calibration)
    return [
        float(rectifier.rectify(frame.index, frame.depth)[0, 0]) if frame.depth else 0.0
        for frame in source
    ]


def test_depth_belongs_to_the_image_that_is_nearest_in_time(tmp_path: Path) -> None:
    folder = sequence(tmp_path / "s", [(0.005, 1000), (0.070, 2000), (0.090, 3000), (9.0, 4000)])
    assert found(folder, "all") == [1.0, 0.0, 2.0, 3.0]
    assert found(folder, "first") == [1.0, 0.0, 0.0, 0.0]
    assert found(folder, "none") == [0.0, 0.0, 0.0, 0.0]


def test_the_first_depth_map_need_not_be_of_the_first_frame(tmp_path: Path) -> None:
    folder = sequence(tmp_path / "s", [(1 / 30, 1500), (2 / 30, 2000)])
    assert found(folder, "first") == [0.0, 1.5, 0.0, 0.0]


def test_a_source_without_depth_is_refused_in_one_line(tmp_path: Path) -> None:
    folder = sequence(tmp_path / "s", [(0.0, 1000)])
    (folder / "depth.txt").unlink()
    with pytest.raises(DatasetError, match=r"no depth\.txt"):
        open_source(SourceSpec(location=str(folder), depth="first"))
    assert len(list(open_source(str(folder)))) == 4
    with pytest.raises(DatasetError, match="has no depth: use"):
        open_source(SourceSpec(location=str(folder / "images"), fov_deg=60.0, depth="first"))
    with pytest.raises(CalibrationError, match="depth_scale"):
        open_source(
            SourceSpec(
                location=str(sequence(tmp_path / "t", [(0.0, 1000)], depth_scale=None)),
                depth="first",
            )
        )
    with pytest.raises(DatasetError, match="within 20 ms"):
        open_source(SourceSpec(location=str(sequence(tmp_path / "u", [(5.0, 1000)])), depth="all"))


def test_depth_goes_into_the_pixels_of_the_rectified_image() -> None:
    """Of a lens with distortion and a depth camera with other focal lengths, pixel by pixel."""
    calibration = Calibration(
        model="pinhole-radtan", width=64, height=48, fx=60.0, fy=61.0, cx=31.0, cy=24.0,
        distortion=(-0.2, 0.05, 0.001, -0.002, 0.0),
        depth=DepthImages(
            scale_m=0.002, invalid=(0, 7),
            camera=PinholeCamera(width=64, height=48, fx=50.0, fy=52.0, cx=33.0, cy=23.0),
        ),
    )  # fmt: skip
    units = np.random.default_rng(0).integers(0, 20, (48, 64), np.uint16)
    metres = DepthRectifier(calibration).rectify(0, png(units))
    camera = rectified_camera(calibration.lens)
    checked = 0
    for row in range(48):
        for column in range(64):
            x = (column - camera.cx) / camera.fx
            y = (row - camera.cy) / camera.fy
            u, v = 50.0 * x + 33.0, 52.0 * y + 23.0
            if min(abs(u % 1.0 - 0.5), abs(v % 1.0 - 0.5)) < 0.05:
                continue  # half-way between two pixels
            u, v = round(u), round(v)
            inside = 0 <= u < 64 and 0 <= v < 48
            expected = 0.002 * int(units[v, u]) if inside and units[v, u] != 7 else 0.0
            assert metres[row, column] == expected
            checked += 1
    assert checked > 2000


def test_without_distortion_depth_is_exact() -> None:
    camera = PinholeCamera(width=WIDTH, height=HEIGHT, fx=30.0, fy=30.0, cx=16.0, cy=12.0)
    calibration = Calibration(
        model="pinhole", width=WIDTH, height=HEIGHT, fx=30.0, fy=30.0, cx=16.0, cy=12.0,
        depth=DepthImages(scale_m=0.0001, camera=camera),
    )  # fmt: skip
    units = np.random.default_rng(0).integers(0, 65536, (HEIGHT, WIDTH), np.uint16)
    np.testing.assert_array_equal(DepthRectifier(calibration).rectify(0, png(units)), units * 1e-4)
    none = Calibration(
        model="pinhole", width=WIDTH, height=HEIGHT, fx=30.0, fy=30.0, cx=16.0, cy=12.0
    )
    with pytest.raises(BrokenFrame, match="depth_scale"):
        DepthRectifier(none).rectify(3, png(units))


@settings(max_examples=30)
@given(st.binary(max_size=200) | st.integers(0, 400).map(lambda n: depth_png(5)[:n]))
def test_what_is_no_depth_map_is_a_broken_frame(data: bytes) -> None:
    camera = PinholeCamera(width=WIDTH, height=HEIGHT, fx=30.0, fy=30.0, cx=16.0, cy=12.0)
    calibration = Calibration(
        model="pinhole", width=WIDTH, height=HEIGHT, fx=30.0, fy=30.0, cx=16.0, cy=12.0,
        depth=DepthImages(scale_m=0.001, camera=camera),
    )  # fmt: skip
    rectifier = DepthRectifier(calibration)
    for wrong in (png(np.zeros((HEIGHT, WIDTH), np.uint8)), png(np.zeros((5, 5), np.uint16))):
        with pytest.raises(BrokenFrame, match="frame 2: its depth map"):
            rectifier.rectify(2, wrong)
    with suppress(BrokenFrame):  # and nothing else
        assert rectifier.rectify(0, data).shape == (HEIGHT, WIDTH)

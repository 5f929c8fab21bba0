"""``pliant calibrate`` without a board: the run that finds its camera."""

import math
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from running import TINY, assert_one_line, in_this_process

from pliant.datasets.builtin import builtin_folder
from pliant.datasets.calibration_files import read_calibration

pytestmark = [pytest.mark.slow, pytest.mark.system]


def test_a_camera_is_found_without_a_board(tmp_path: Path) -> None:
    file = tmp_path / "found.yaml"
    given = in_this_process("calibrate", TINY, "--output", file)
    assert_one_line(given, "has a calibration, which `pliant run` uses: pass --fov DEGREES")
    done = in_this_process("calibrate", TINY, "--fov", "50", "--output", file)
    assert done.returncode == 0, done.stderr
    assert "estimated focal length" in done.stdout
    picture = tmp_path / "found.png"
    assert f"written: {file}, {picture}" in done.stdout
    found, true = read_calibration(file), read_calibration(builtin_folder(TINY) / "calib.yaml")
    guess = 0.5 * true.width / math.tan(math.radians(25.0))
    off = abs(math.log(found.fx / true.fx))
    assert off < 3.0 * found.focal_sigma
    assert off < 0.25 * abs(math.log(guess / true.fx))
    assert {path.name for path in tmp_path.iterdir()} == {"found.yaml", "found.png"}
    drawn = cv2.imread(str(picture))
    assert drawn is not None
    assert (drawn == (40, 60, 190)).all(axis=2).sum() > 500  # arrows
    black = np.zeros((48, 64), np.uint8)
    cv2.imwrite(str(tmp_path / "black.png"), black)
    for name, says in (("black.png", "is completely black"), ("none.png", "cannot be read")):
        mask = tmp_path / name
        done = in_this_process(
            "calibrate", TINY, "--fov", "50", "--mask", mask, "--output", file, "--force"
        )
        assert_one_line(done, f"--mask {mask}: {says}")
    black[:44] = 255
    cv2.imwrite(str(tmp_path / "mask.png"), black)
    anew = tmp_path / "masked.yaml"
    film = enlarged(builtin_folder(f"{TINY}?frames=24"), tmp_path / "film")
    masked = in_this_process(
        "calibrate", film, "--fov", "50", "--mask", tmp_path / "mask.png", "--output", anew
    )
    assert "8 % of each image are ignored (mask.png)" in masked.stderr
    assert masked.returncode == 0, masked.stderr
    # It was worked on at half its size: what was seen covers its picture's image all the same, of
    # which the mask leaves 92 %, as the first one's.
    assert read_calibration(anew).width == 4 * found.width
    assert 0.8 < covered(anew.with_suffix(".png")) / covered(picture) < 0.97


def covered(picture: Path) -> float:
    """Share of a picture of a calibration that is blue: where the image has been seen."""
    drawn = cv2.imread(str(picture)).astype(int)
    return float((drawn[..., 0] > drawn[..., 2] + 50).mean())


def enlarged(folder: Path, film: Path) -> Path:
    """A sequence without a calibration, whose images are four times as large as their details."""
    shutil.copytree(folder, film)
    (film / "calib.yaml").unlink()
    for image in (film / "images").iterdir():
        pixels = cv2.imread(str(image), cv2.IMREAD_UNCHANGED)
        assert pixels is not None
        cv2.imwrite(str(image), cv2.resize(pixels, None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC))
    return film

"""A camera that is covered in mid-turn: its gyro carries it through."""

import json
from pathlib import Path

import pytest
from dark_clip import DARK, assert_placed, gyro_samples, write_clip
from running import NO_MESH, in_this_process
from sample_files import write_imu_csv

from pliant.formats.tum import read_tum

pytestmark = pytest.mark.system


def test_dark_frames_are_placed_by_the_gyro(tmp_path: Path) -> None:
    folder, result = write_clip(tmp_path / "room"), tmp_path / "result"
    imu = write_imu_csv(tmp_path / "imu.csv", gyro_samples())
    done = in_this_process(
        "run", folder, "--imu", imu, *NO_MESH, "--on-crash", "restart", "--output", result
    )
    assert done.returncode == 0, done.stderr
    assert (
        f"{len(DARK)} frames without a pose by images, placed by the gyro between others"
        in done.stdout
    )
    report = json.loads((result / "report.json").read_text())
    assert len(report["segments"]) == 1
    assert report["frames_by_gyro"] == list(DARK)
    assert report["frames_with_pose"] == report["frames"] - len(DARK)
    assert_placed(read_tum(result / "trajectory.txt"))

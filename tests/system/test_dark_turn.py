"""A camera that is covered in mid-turn: its gyro carries it through."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from inertial_motion import PHONE, Motion, samples_of
from running import NO_MESH, in_this_process
from sample_files import write_imu_csv

from pliant.algorithms.geometry import align_umeyama, so3_exp
from pliant.datasets.builtin import builtin_folder
from pliant.formats.tum import read_tum

pytestmark = pytest.mark.system

SOURCE = "built-in:room?width=320"
EVERY = 2
"""Frames of the source for one of the clip."""
DARK = range(125, 133)
"""Half a second, in which the camera turns by 23 degrees."""


def test_dark_frames_are_placed_by_the_gyro(tmp_path: Path) -> None:
    source, folder = builtin_folder(SOURCE), tmp_path / "room"
    shutil.copytree(source, folder, ignore=shutil.ignore_patterns("depth", "*.ply"))
    truth = read_tum(source / "groundtruth.txt")
    images = (folder / "rgb.txt").read_text().splitlines()[-len(truth) :: EVERY]
    (folder / "rgb.txt").write_text("\n".join(images) + "\n")
    for number in DARK:
        name = folder / images[number].split()[1]
        image = cv2.imread(str(name))
        assert image is not None
        cv2.imwrite(str(name), np.zeros_like(image))
    samples = samples_of(
        Motion(truth.stamps_ns, truth.T_world_camera), PHONE, np.random.default_rng(1),
        R_camera_imu=so3_exp(np.array([0.4, 1.0, 2.0])),
        p_camera_imu=np.array([0.02, -0.01, 0.03]), offset_s=0.08,
    )  # fmt: skip
    imu = write_imu_csv(tmp_path / "imu.csv", samples)
    result = tmp_path / "result"
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
    found = read_tum(result / "trajectory.txt")
    rows = np.searchsorted(truth.stamps_ns, found.stamps_ns)
    assert set(DARK) <= set((rows // EVERY).tolist())
    scale, R, t = align_umeyama(found.positions, truth.positions[rows], with_scale=True)
    errors = np.linalg.norm(scale * found.positions @ R.T + t - truth.positions[rows], axis=1)
    assert errors.max() < 0.01

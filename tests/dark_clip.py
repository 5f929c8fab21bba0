"""A clip of the room that is dark for half a second in mid-turn, and a gyro's samples of it."""

import shutil
from pathlib import Path

import cv2
import numpy as np
from inertial_motion import PHONE, Motion, samples_of

from pliant.algorithms.geometry import align_umeyama, so3_exp
from pliant.algorithms.inertial.samples import ImuSamples
from pliant.datasets.builtin import builtin_folder
from pliant.formats.tum import read_tum
from pliant.trajectory import Trajectory

SOURCE = "built-in:room?width=320"
EVERY = 2
"""Frames of the source for one of the clip."""
DARK = range(125, 133)
"""Half a second, in which the camera turns by 23 degrees."""
OFFSET_S = 0.08
"""Of the gyro's clock."""


def truth() -> Trajectory:
    """Of the source."""
    return read_tum(builtin_folder(SOURCE) / "groundtruth.txt")


def write_clip(folder: Path) -> Path:
    """Write it into a new folder."""
    shutil.copytree(builtin_folder(SOURCE), folder, ignore=shutil.ignore_patterns("depth", "*.ply"))
    images = (folder / "rgb.txt").read_text().splitlines()[-len(truth()) :: EVERY]
    (folder / "rgb.txt").write_text("\n".join(images) + "\n")
    for number in DARK:
        name = folder / images[number].split()[1]
        image = cv2.imread(str(name))
        assert image is not None
        cv2.imwrite(str(name), np.zeros_like(image))
    return folder


def gyro_samples() -> ImuSamples:
    """Of the motion, by a phone."""
    motion = Motion(truth().stamps_ns, truth().T_world_camera)
    return samples_of(
        motion, PHONE, np.random.default_rng(1), R_camera_imu=so3_exp(np.array([0.4, 1.0, 2.0])),
        p_camera_imu=np.array([0.02, -0.01, 0.03]), offset_s=OFFSET_S,
    )  # fmt: skip


def assert_placed(found: Trajectory) -> None:
    """The dark frames have a pose, and all are within 1 cm of the truth."""
    true = truth()
    rows = np.searchsorted(true.stamps_ns, found.stamps_ns)
    assert set(DARK) <= set((rows // EVERY).tolist())
    scale, R, t = align_umeyama(found.positions, true.positions[rows], with_scale=True)
    errors = np.linalg.norm(scale * found.positions @ R.T + t - true.positions[rows], axis=1)
    assert errors.max() < 0.01

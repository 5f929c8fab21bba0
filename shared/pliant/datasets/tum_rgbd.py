"""TUM RGB-D benchmark sequences, as they are unpacked.

    rgbd_dataset_freiburg1_xyz/rgb.txt           "seconds rgb/file.png" a line
    rgbd_dataset_freiburg1_xyz/rgb/*.png
    rgbd_dataset_freiburg1_xyz/depth.txt         likewise, depth in steps of 0.2 mm; only surfels
                                                 read it
    rgbd_dataset_freiburg1_xyz/groundtruth.txt   true poses

The name of the folder has the camera, one of three (``freiburg1`` or ``fr1``, ...).
"""

import re
from pathlib import Path

from pliant.algorithms.camera import PinholeCamera
from pliant.datasets.base import Dataset
from pliant.datasets.calibration import Calibration, DepthImages
from pliant.datasets.depth import with_depth
from pliant.datasets.folder import CALIBRATION_NAME, GROUND_TRUTH_NAME, LIST_NAME
from pliant.datasets.image_lists import read_list
from pliant.datasets.images import (
    ImageFiles,
    choose_calibration,
    existing,
    image_size,
)
from pliant.datasets.source_spec import SourceSpec

_WIDTH, _HEIGHT = 640, 480
# The benchmark's calibration of the colour cameras (page "Intrinsic camera calibration of the
# Kinect"): fx, fy, cx, cy; k1, k2, p1, p2, k3.  The images of freiburg3 are rectified already.
_CAMERAS: dict[str, tuple[tuple[float, ...], tuple[float, ...]]] = {
    "1": (
        (517.306408, 516.469215, 318.643040, 255.313989),
        (0.262383, -0.953104, -0.005358, 0.002628, 1.163314),
    ),
    "2": (
        (520.908620, 521.007327, 325.141442, 249.701764),
        (0.231222, -0.784899, -0.003257, -0.000105, 0.917205),
    ),
    "3": ((535.4, 539.2, 320.1, 247.6), (0.0, 0.0, 0.0, 0.0, 0.0)),
}
_DEPTH_SCALE_M = 1.0 / 5000.0


def is_tum_rgbd(source: str) -> bool:
    """Whether it is a sequence of a known camera, without a calibration of its own."""
    folder = Path(source)
    listed = (folder / LIST_NAME).is_file() and not (folder / CALIBRATION_NAME).is_file()
    return listed and _camera_number(folder) is not None


def open_tum_rgbd(spec: SourceSpec) -> Dataset:
    """A sequence of the benchmark.  Raises DatasetError and CalibrationError."""
    folder = Path(spec.location)
    listed = read_list(folder / LIST_NAME, folder)
    calibration = choose_calibration(
        spec,
        image_size(listed.images),
        found=tum_calibration(_camera_number(folder) or "1"),
        where=spec.location,
    )
    return ImageFiles(
        name=folder.resolve().name,
        images=with_depth(listed, folder, calibration, spec),
        notes=listed.notes,
        calibration=calibration,
        ground_truth_path=existing(folder / GROUND_TRUTH_NAME),
    )


def tum_calibration(camera: str) -> Calibration:
    """The calibration of camera "1", "2" or "3" of the benchmark."""
    (fx, fy, cx, cy), distortion = _CAMERAS[camera]
    pinhole = PinholeCamera(width=_WIDTH, height=_HEIGHT, fx=fx, fy=fy, cx=cx, cy=cy)
    return Calibration(
        model="pinhole-radtan",
        width=_WIDTH,
        height=_HEIGHT,
        fx=fx,
        fy=fy,
        cx=cx,
        cy=cy,
        distortion=distortion,
        fps=30.0,
        # Depth was registered to the colour image when it was recorded.
        depth=DepthImages(scale_m=_DEPTH_SCALE_M, camera=pinhole),
    )


def _camera_number(folder: Path) -> str | None:
    match = re.search(r"(?:freiburg|fr)([123])(?![0-9])", folder.resolve().name)
    return match.group(1) if match else None

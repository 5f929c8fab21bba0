"""Calibration files: read and checked, whichever of the ``calibration_formats`` they have."""

import re
from pathlib import Path

from pliant.datasets.calibration import Calibration, calibration_from_keys
from pliant.datasets.calibration_formats import (
    UNDERSTOOD,
    Keys,
    Wanted,
    flat_from_keys,
    flat_keys,
)
from pliant.datasets.calibration_text import calibration_text
from pliant.errors import CalibrationError

_CAMERA = re.compile(r"(.+):((?:cam)?[0-9]+)")
NAMES = (
    *("calib.yaml", "calibration.yaml", "cameras.txt", "cameras.bin", "calibration.txt"),
    *("sparse/0/cameras.txt", "sparse/0/cameras.bin", "intrinsic/intrinsic_color.txt"),
)
"""Calibrations that are found beside images."""


def read_calibration(
    file: Path,
    image_size: tuple[int, int] | None = None,
    *,
    kitti_camera: int = 0,
    source: str = "",
) -> Calibration:
    """Read a calibration file of any kind that is understood.

    file: or the folder that it is in; ``FILE:cam1`` where it has several cameras.
    image_size: (width, height) of the images, if known: must agree with the file.
    kitti_camera: which projection matrix of a KITTI file is meant.   source: topic or folder of
    the images, which may tell the camera.

    Raises CalibrationError: one line with the file, what is wrong and what to do.
    """
    file, camera = file_and_camera(file)
    file = next((file / name for name in NAMES if (file / name).is_file()), file)
    text = _read(file)
    wanted = Wanted(image_size=image_size, kitti_camera=kitti_camera, camera=camera, source=source)
    try:
        calibration = calibration_from_keys(flat_keys(text, wanted), image_size)
    except CalibrationError as error:
        raise CalibrationError(f"{file}: {error}") from None
    check_size(calibration, image_size, str(file))
    return calibration


def file_and_camera(file: Path) -> tuple[Path, str]:
    """The file and the camera of ``FILE:cam1``; "" if no camera is named."""
    named = _CAMERA.fullmatch(str(file))
    if named is None or file.exists() or not Path(named[1]).exists():
        return file, ""
    return Path(named[1]), named[2]


def calibration_from_camera_info(content: Keys) -> Calibration:
    """From the keys of a ROS camera_info file: what such a message holds, too.

    Raises CalibrationError.
    """
    return calibration_from_keys(flat_from_keys(content, Wanted()))


def check_size(calibration: Calibration, image_size: tuple[int, int] | None, where: str) -> None:
    """Raise CalibrationError if the images are not of the size that the calibration is for."""
    size = (calibration.width, calibration.height)
    if image_size is not None and image_size != size:
        raise CalibrationError(
            f"{where}: is for images of {size[0]}x{size[1]} px, but they have "
            f"{image_size[0]}x{image_size[1]}; pass the calibration of these images"
        )


def _read(file: Path) -> str:
    try:
        return calibration_text(file)
    except FileNotFoundError:
        raise CalibrationError(
            f"{file}: no such calibration file; write one with {UNDERSTOOD}"
        ) from None
    except IsADirectoryError:
        raise CalibrationError(
            f"{file}: a folder without a calibration file: pass the file"
        ) from None
    except OSError as error:
        raise CalibrationError(f"{file}: cannot be read: {error.strerror}") from None

"""Calibration files: read and checked, whichever of the ``calibration_formats`` they have."""

from pathlib import Path

from pliant.datasets.calibration import Calibration, calibration_from_keys
from pliant.datasets.calibration_formats import (
    UNDERSTOOD,
    Keys,
    Wanted,
    flat_from_keys,
    flat_keys,
)
from pliant.errors import CalibrationError

_MAX_BYTES = 1 << 20
_MAX_JSON_BYTES = 1 << 26
"""A transforms.json has the pose of every image."""


def read_calibration(
    file: Path, image_size: tuple[int, int] | None = None, *, kitti_camera: int = 0
) -> Calibration:
    """Read a calibration file of any kind that is understood.

    image_size: (width, height) of the images, if known: must agree with the file.
    kitti_camera: which projection matrix of a KITTI file is meant.

    Raises CalibrationError: one line with the file, what is wrong and what to do.
    """
    text = _read(file)
    try:
        keys = flat_keys(text, Wanted(image_size=image_size, kitti_camera=kitti_camera))
        calibration = calibration_from_keys(keys, image_size)
    except CalibrationError as error:
        raise CalibrationError(f"{file}: {error}") from None
    check_size(calibration, image_size, str(file))
    return calibration


def calibration_from_camera_info(content: Keys) -> Calibration:
    """From the keys of a ROS camera_info file: what such a message holds, too.

    Raises CalibrationError.
    """
    return calibration_from_keys(flat_from_keys(content, Wanted()))


def check_size(calibration: Calibration, image_size: tuple[int, int] | None, where: str) -> None:
    """Raise CalibrationError where the images are not of the size that the calibration is for."""
    size = (calibration.width, calibration.height)
    if image_size is not None and image_size != size:
        raise CalibrationError(
            f"{where}: is for images of {size[0]}x{size[1]} px, but they have "
            f"{image_size[0]}x{image_size[1]}; give the calibration of these images"
        )


def _read(file: Path) -> str:
    try:
        limit = _MAX_JSON_BYTES if file.suffix == ".json" else _MAX_BYTES
        if file.is_file() and file.stat().st_size > limit:
            raise CalibrationError(
                f"{file}: too large for a calibration file; is it the right one?"
            )
        return file.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise CalibrationError(
            f"{file}: no such calibration file; write one with {UNDERSTOOD}"
        ) from None
    except UnicodeDecodeError:
        raise CalibrationError(f"{file}: not a text file; understood are {UNDERSTOOD}") from None
    except OSError as error:
        raise CalibrationError(f"{file}: cannot be read: {error.strerror}") from None

"""Readers of calibration files: our own, EuRoC's and Kalibr's, ROS's camera_info, KITTI's."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeAlias, cast

import yaml

from pliant.algorithms.rectification import LensModel
from pliant.datasets.calibration import COEFFICIENTS, Calibration, calibration_from_keys
from pliant.errors import CalibrationError

UNDERSTOOD = (
    "keys fx fy cx cy width height (calib.yaml), EuRoC's sensor.yaml, Kalibr's camchain.yaml, "
    "ROS's camera_info or KITTI's calib.txt"
)
_MAX_BYTES = 1 << 20
_DISTORTION: dict[str, LensModel] = {
    "none": "pinhole",
    "pinhole-radtan": "pinhole-radtan",
    "radial-tangential": "pinhole-radtan",
    "radtan": "pinhole-radtan",
    "plumb_bob": "pinhole-radtan",
    "rational_polynomial": "pinhole-rational",
    "equidistant": "fisheye",
    "equi": "fisheye",
    "kannala-brandt": "fisheye",
    "fisheye": "fisheye",
}
"""What others call the models."""

_Mapping: TypeAlias = dict[str, Any]


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
        if re.search(r"^P\d+:", text, re.MULTILINE):
            calibration = _kitti(text, kitti_camera, image_size)
        else:
            calibration = calibration_from_keys(_flat(_mapping(text)), image_size)
    except CalibrationError as error:
        raise CalibrationError(f"{file}: {error}") from None
    check_size(calibration, image_size, str(file))
    return calibration


def calibration_from_camera_info(content: _Mapping) -> Calibration:
    """From the keys of a ROS camera_info file: what such a message holds, too.

    Raises CalibrationError.
    """
    return calibration_from_keys(_flat(content))


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
        if file.is_file() and file.stat().st_size > _MAX_BYTES:
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


def _mapping(text: str) -> _Mapping:
    # OpenCV's writer begins with a directive that is not YAML's, and has a tag of its own.
    text = re.sub(r"\A%YAML:[\d.]+\s*\n(---\s*\n)?", "", text).replace("!!opencv-matrix", "")
    try:
        content = yaml.safe_load(text)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise CalibrationError(
            f"not YAML ({' '.join(str(error).split())}); understood are {UNDERSTOOD}"
        ) from None
    if not isinstance(content, dict):
        raise CalibrationError(f"no keys and values; understood are {UNDERSTOOD}")
    return {str(key): value for key, value in content.items()}


def _flat(content: _Mapping) -> _Mapping:
    """The content of any kind of YAML file under the keys of ``calib.yaml``."""
    if isinstance(content.get("cam0"), dict):
        return _flat(cast(_Mapping, content["cam0"]))
    if "intrinsics" in content:
        return _from_lists(
            content,
            intrinsics=_numbers(content, "intrinsics", 4),
            size=_numbers(content, "resolution", 2) if "resolution" in content else None,
            coefficients=_coefficients(content),
        )
    if "camera_matrix" in content:
        K = _numbers(content, "camera_matrix", 9)
        width, height = content.get("image_width"), content.get("image_height")
        return _from_lists(
            content,
            intrinsics=[K[0], K[4], K[2], K[5]],
            size=None if width is None or height is None else [width, height],
            coefficients=_coefficients(content),
        )
    if not any(key in content for key in ("fx", "fy", "cx", "cy")):
        raise CalibrationError(f"holds no camera; understood are {UNDERSTOOD}")
    return content


def _coefficients(content: _Mapping) -> list[Any]:
    for key in ("distortion_coefficients", "distortion_coeffs"):
        if key in content:
            return _numbers(content, key, None)
    raise CalibrationError("no distortion_coefficients: add what is missing (zeros if rectified)")


def _from_lists(
    content: _Mapping, *, intrinsics: list[Any], size: list[Any] | None, coefficients: list[Any]
) -> _Mapping:
    camera = str(content.get("camera_model", "pinhole")).lower()
    if camera not in ("pinhole", "pinhole-radtan", "fisheye"):
        raise CalibrationError(f"camera_model {camera!r} is not understood: only pinhole is")
    said = str(content.get("distortion_model") or ("" if coefficients else "none")).lower()
    model = _DISTORTION.get(said)
    if model is None:
        raise CalibrationError(
            f"distortion_model {said!r} is not understood: use radtan or equidistant"
        )
    names = COEFFICIENTS[model]
    while len(coefficients) > len(names) and coefficients[-1] == 0:
        coefficients = coefficients[:-1]  # more terms than the model has, if they are zero
    if model == "pinhole-rational":
        coefficients = [*coefficients, *[0.0] * (len(names) - len(coefficients))]
        if not any(coefficients[5:]):
            model, names, coefficients = "pinhole-radtan", names[:5], coefficients[:5]
    if len(coefficients) > len(names):
        raise CalibrationError(
            f"{len(coefficients)} distortion coefficients, but {said} is understood with at most "
            f"{len(names)} ({' '.join(names)}): calibrate again with those"
        )
    flat: _Mapping = {"model": model}
    flat.update(zip(("fx", "fy", "cx", "cy"), intrinsics, strict=True))
    flat.update(zip(names, coefficients, strict=False))
    if size is not None:
        flat.update(width=size[0], height=size[1])
    if "rate_hz" in content:
        flat["fps"] = content["rate_hz"]
    return flat


def _numbers(content: _Mapping, key: str, count: int | None) -> list[Any]:
    """A list, or what OpenCV and ROS write for a matrix: a mapping with ``data``."""
    value = content[key]
    if isinstance(value, dict):
        value = cast(_Mapping, value).get("data")
    if not isinstance(value, list) or (count is not None and len(cast(list[Any], value)) != count):
        expected = "a list of numbers" if count is None else f"{count} numbers"
        raise CalibrationError(f"{key} is {content[key]!r}: expected {expected}")
    return cast(list[Any], value)


def _kitti(text: str, camera: int, image_size: tuple[int, int] | None) -> Calibration:
    """From the row ``P<camera>:`` with the 3x4 projection matrix; those images are rectified."""
    match = re.search(rf"^P{camera}:(.*)$", text, re.MULTILINE)
    if match is None:
        raise CalibrationError(f"no row P{camera}: add the projection matrix of this camera")
    row: Sequence[str] = match.group(1).split()
    if len(row) != 12:
        raise CalibrationError(f"P{camera} has {len(row)} numbers: expected 12")
    if image_size is None:
        raise CalibrationError("a KITTI calibration does not say how large the images are")
    keys = {"fx": row[0], "fy": row[5], "cx": row[2], "cy": row[6]}
    return calibration_from_keys({"model": "pinhole", **keys}, image_size)

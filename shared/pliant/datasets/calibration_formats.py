"""Calibration files of other programs, read under the keys of our own ``calib.yaml``.

``FORMATS`` is the list: how a file of a kind is recognised, and what reads it.  Whatever they hold
is checked where the keys become a ``Calibration``; a lens that none of our models is, is refused
here.  Pixels have (0, 0) at the centre of the top-left one; COLMAP's and nerfstudio's have (0.5,
0.5) there, and lose that half on the way.
"""

import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, cast

from pliant.algorithms.rectification import LensModel
from pliant.datasets.calibration import COEFFICIENTS
from pliant.datasets.calibration_colmap import COLMAP_LINE, colmap, nerfstudio
from pliant.datasets.calibration_keys import Keys, Wanted
from pliant.datasets.opencv_xml import is_xml, keys_of_xml
from pliant.errors import CalibrationError
from pliant.wording import shown
from pliant.yaml_text import YamlError, load_yaml


@dataclass(frozen=True)
class CalibrationFormat:
    """One kind of calibration file.

    name: for people.     mark: the keys of which one is in every such file, or, where it has no
    keys, a line as it has.     flat: from what it holds (its keys, or its text) to the keys of
    ``calib.yaml``; raises CalibrationError.
    """

    name: str
    mark: tuple[str, ...] | re.Pattern[str]
    flat: Callable[[Any, Wanted], Keys]


def flat_keys(text: str, wanted: Wanted) -> Keys:
    """The camera of a file of any of the ``FORMATS``.

    Raises CalibrationError, without the name of the file.
    """
    for kind in FORMATS:
        if isinstance(kind.mark, re.Pattern) and kind.mark.search(text):
            return kind.flat(text, wanted)
    return flat_from_keys(keys_of_xml(text) if is_xml(text) else _keys(text), wanted)


def flat_from_keys(content: Keys, wanted: Wanted) -> Keys:
    """Convert a file that is already keys and values.  Raises CalibrationError."""
    for kind in FORMATS:
        if not isinstance(kind.mark, re.Pattern) and any(key in content for key in kind.mark):
            return kind.flat(content, wanted)
    raise CalibrationError(f"contains no camera; supported are {UNDERSTOOD}")


def _keys(text: str) -> Keys:
    # OpenCV's writer begins with a directive that is not YAML's, and has a tag of its own.
    text = re.sub(r"^%YAML:[\d.]+\s*\n(---\s*\n)?", "", text, count=1, flags=re.MULTILINE)
    text = text.replace("!!opencv-matrix", "").replace("\t", "  ")  # which YAML has no room for
    try:
        content = _json(text) or load_yaml(text)
    except YamlError as error:
        raise CalibrationError(f"not YAML ({error}); supported are {UNDERSTOOD}") from None
    if not isinstance(content, dict):
        raise CalibrationError(f"no keys and values; supported are {UNDERSTOOD}")
    return {str(key): value for key, value in cast(Keys, content).items()}


def _json(text: str) -> Any:
    """None if it is none.  YAML reads JSON, too, but takes minutes for a thousand poses."""
    if not text.lstrip().startswith("{"):
        return None
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return None


# --- our own, and lists of numbers: EuRoC, Kalibr, OpenCV, ROS ---------------------------------

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
"""The models by the names of other programs."""
_MATRIX = ("camera_matrix", "cameraMatrix", "Camera_Matrix", "camera_Matrix")
_SIZE = (("image_width", "image_Width"), ("image_height", "image_Height"))
_COEFFICIENTS = (
    *("distortion_coefficients", "distortion_coeffs", "Distortion_Coefficients"),
    *("dist_coeffs", "dist_coeff", "distCoeffs", "distortionCoefficients"),
)


def _own(content: Keys, wanted: Wanted) -> Keys:
    return content


_CHAINED = re.compile(r"cam([0-9]+)")


def _kalibr(content: Keys, wanted: Wanted) -> Keys:
    name = _of_chain(
        {key: value for key, value in content.items() if _CHAINED.fullmatch(key)}, wanted
    )
    if not isinstance(content[name], dict):
        raise CalibrationError(f"{name} is {shown(content[name])}: expected the keys of a camera")
    return flat_from_keys(cast(Keys, content[name]), wanted)


def _of_chain(cameras: Keys, wanted: Wanted) -> str:
    """Which camera of a chain took the images: the one the user names, or their topic or folder,
    or their size.  Raises CalibrationError if none of them does."""
    names = list(cameras)
    if wanted.camera:
        named = [
            name for name in names if name.removeprefix("cam") == wanted.camera.removeprefix("cam")
        ]
        if not named:
            raise CalibrationError(f"no {shown(wanted.camera)}: it has {', '.join(names)}")
        return named[0]
    places = wanted.source.strip("/").split("/")
    size = None if wanted.image_size is None else list(wanted.image_size)
    keys = {
        name: cast(Keys, each) if isinstance(each, dict) else {} for name, each in cameras.items()
    }
    for chosen in (
        names if len(names) == 1 else [],
        [n for n in names if str(keys[n].get("rostopic", "")).strip("/") == "/".join(places)],
        [n for n in names if {n, n.replace("cam", "cam_"), n.replace("cam", "camera")} & {*places}],
        [n for n in names if size is not None and keys[n].get("resolution") == size],
    ):
        if len(chosen) == 1:
            return chosen[0]
    raise CalibrationError(
        f"has {len(names)} cameras ({', '.join(names)}): select the camera of the images, as in "
        f"--calibration FILE:{names[-1]}"
    )


def _euroc(content: Keys, wanted: Wanted) -> Keys:
    camera = str(content.get("camera_model", "pinhole")).lower()
    if camera not in ("pinhole", "pinhole-radtan", "fisheye"):
        raise CalibrationError(
            f"camera_model {shown(camera)} is not supported: calibrate again with pinhole (a wide "
            "lens: with pinhole-equi)"
        )
    size = _numbers(content, "resolution", 2) if "resolution" in content else None
    return _lens(content, _numbers(content, "intrinsics", 4), size, _model_name(content))


def _opencv(content: Keys, wanted: Wanted) -> Keys:
    """Its files name no model: the number of coefficients, or ``fisheye_model``, determines it."""
    K = _numbers(content, _first(content, _MATRIX), 9)
    width, height = (content.get(_first(content, names)) for names in _SIZE)
    model = _model_name(content)
    if not model:
        model = "fisheye" if content.get("fisheye_model") else "rational_polynomial"
    size = None if width is None or height is None else [width, height]
    return _lens(content, [K[0], K[4], K[2], K[5]], size, model)


def _model_name(content: Keys) -> str:
    model_name = content.get("distortion_model")
    coefficients = _first(content, _COEFFICIENTS)
    if not model_name and coefficients and not _numbers(content, coefficients, None):
        return "none"
    return str(model_name or "").lower()


def _lens(content: Keys, intrinsics: list[Any], size: list[Any] | None, model_name: str) -> Keys:
    key = _first(content, _COEFFICIENTS)
    if not key:
        raise CalibrationError(
            "no distortion_coefficients: add what is missing (zeros if rectified)"
        )
    model, coefficients = _DISTORTION.get(model_name), _numbers(content, key, None)
    if model is None:
        raise CalibrationError(
            f"distortion_model {shown(model_name)} is not supported: calibrate again with radtan "
            "or equidistant"
        )
    names = COEFFICIENTS[model]
    while len(coefficients) > len(names) and coefficients[-1] == 0:
        coefficients = coefficients[:-1]  # more terms than the model has, if they are zero
    if len(coefficients) > len(names):
        raise CalibrationError(
            f"{len(coefficients)} distortion coefficients, but {model_name} is supported with at "
            f"most {len(names)} ({' '.join(names)}): calibrate again with those"
        )
    if model == "pinhole-rational":
        coefficients = [*coefficients, *[0.0] * (len(names) - len(coefficients))]
        if not any(coefficients[5:]):
            model, names, coefficients = "pinhole-radtan", names[:5], coefficients[:5]
    flat: Keys = {"model": model}
    flat.update(zip(("fx", "fy", "cx", "cy"), intrinsics, strict=True))
    flat.update(zip(names, coefficients, strict=False))
    if size is not None:
        flat.update(width=size[0], height=size[1])
    if "rate_hz" in content:
        flat["fps"] = content["rate_hz"]
    return flat


def _first(content: Keys, names: tuple[str, ...]) -> str:
    return next((name for name in names if name in content), "")


def _numbers(content: Keys, key: str, count: int | None) -> list[Any]:
    """A list, perhaps of rows, or what OpenCV and ROS write for a matrix: keys with ``data``."""
    value = content[key]
    if isinstance(value, dict):
        value = cast(Keys, value).get("data")
    rows = cast(list[Any], value if isinstance(value, list) else [])
    if rows and all(isinstance(row, list) for row in rows):
        value = [number for row in cast(list[list[Any]], rows) for number in row]
    if not isinstance(value, list) or (count is not None and len(cast(list[Any], value)) != count):
        expected = "a list of numbers" if count is None else f"{count} numbers"
        raise CalibrationError(f"{key} is {shown(content[key])}: expected {expected}")
    return cast(list[Any], value)


# --- ORB-SLAM's settings ------------------------------------------------------------------------

_ORB_SLAM: dict[str, LensModel] = {
    "pinhole": "pinhole-radtan",
    "kannalabrandt8": "fisheye",
    "rectified": "pinhole",
}


def _orb_slam(content: Keys, wanted: Wanted) -> Keys:
    """``Camera1.fx`` of version 3, ``Camera.fx`` of those before; the size if it is there."""
    if "LEFT.K" in content:
        raise CalibrationError(
            "is for a stereo pair that ORB-SLAM rectifies first (LEFT.K): give the calibration of "
            "the images as they are, or of one camera"
        )
    model_name = str(content.get("Camera.type", "PinHole"))
    model = _ORB_SLAM.get(model_name.lower())
    if model is None:
        raise CalibrationError(
            f"Camera.type {shown(model_name)} is not supported: calibrate again with PinHole or "
            "KannalaBrandt8"
        )
    camera = "Camera1" if "Camera1.fx" in content else "Camera"
    flat: Keys = {"model": model, **dict.fromkeys(COEFFICIENTS[model], 0.0)}
    for key in ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"):
        if f"{camera}.{key}" in content and not (model == "pinhole" and key[0] in "kp"):
            flat[key] = content[f"{camera}.{key}"]
    for key in ("width", "height", "fps"):
        if f"Camera.{key}" in content:
            flat[key] = content[f"Camera.{key}"]
    return flat


# --- KITTI --------------------------------------------------------------------------------------

_KITTI_LINE = re.compile(r"^P(?:_rect_0)?\d+:", re.MULTILINE)


def _kitti(text: str, wanted: Wanted) -> Keys:
    """From the row ``P<camera>:`` with the 3x4 projection matrix; those images are rectified."""
    camera = wanted.kitti_camera
    match = re.search(rf"^P(?:_rect_0)?{camera}:(.*)$", text, re.MULTILINE)
    if match is None:
        raise CalibrationError(f"no row P{camera}: add the projection matrix of this camera")
    row = match.group(1).split()
    if len(row) != 12:
        raise CalibrationError(f"P{camera} has {len(row)} numbers: expected 12")
    if wanted.image_size is None:
        raise CalibrationError("a KITTI calibration has no image size")
    return {"model": "pinhole", "fx": row[0], "fy": row[5], "cx": row[2], "cy": row[6]}


# --- numbers alone: ETH3D, ScanNet, and a matrix saved by numpy ----------------------------------

_NUMBER = r"[-+]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][-+]?[0-9]+)?"
_NUMBERS_ALONE = re.compile(
    rf"\A(?:\s*#[^\n]*\n)*\s*(?:{_NUMBER}[\s,;]+){{3,15}}{_NUMBER}[\s,;]*\Z"
)


def _alone(text: str, wanted: Wanted) -> Keys:
    """``fx fy cx cy``, or a matrix of 3 or 4 rows; of images without distortion."""
    lines = [line for line in text.splitlines() if not line.lstrip().startswith("#")]
    numbers = re.split(r"[\s,;]+", "\n".join(lines).strip(" \n\t,;"))
    side = {9: 3, 16: 4, 12: 4}.get(len(numbers))
    if side is None and len(numbers) != 4:
        raise CalibrationError(f"{len(numbers)} numbers: expected fx fy cx cy, or a matrix")
    if side is not None:
        numbers = [numbers[0], numbers[side + 1], numbers[2], numbers[side + 2]]
    return {"model": "pinhole", **dict(zip(("fx", "fy", "cx", "cy"), numbers, strict=True))}


FORMATS = (
    CalibrationFormat("KITTI's calib.txt", _KITTI_LINE, _kitti),
    CalibrationFormat("COLMAP's cameras.txt or .bin", COLMAP_LINE, colmap),
    CalibrationFormat("fx fy cx cy or a matrix alone", _NUMBERS_ALONE, _alone),
    CalibrationFormat("Kalibr's camchain.yaml", ("cam0", "cam1"), _kalibr),
    CalibrationFormat("EuRoC's sensor.yaml", ("intrinsics",), _euroc),
    CalibrationFormat("OpenCV's and ROS's camera_matrix", _MATRIX, _opencv),
    CalibrationFormat("ORB-SLAM's settings", ("Camera1.fx", "Camera.fx"), _orb_slam),
    CalibrationFormat(
        "nerfstudio's transforms.json", ("fl_x", "camera_angle_x", "frames"), nerfstudio
    ),
    CalibrationFormat("Pliant's calib.yaml", ("fx", "fy", "cx", "cy"), _own),
)
"""Every kind of calibration file; the first that a file looks like reads it."""

UNDERSTOOD = (
    f"keys fx fy cx cy width height (calib.yaml), {', '.join(k.name for k in FORMATS[:-1])}"
)
"""The kinds, in one line."""

"""What calibration files of others say, under the keys of our own ``calib.yaml``.

``FORMATS`` is the list: how a file of a kind is recognised, and what reads it.  Whatever they hold
is checked where the keys become a ``Calibration``; a lens that none of our models is, is refused
here.  Pixels have (0, 0) at the centre of the top-left one; COLMAP's and nerfstudio's have (0.5,
0.5) there, and lose that half on the way.
"""

import json
import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias, cast

from pliant.algorithms.rectification import LensModel
from pliant.datasets.calibration import COEFFICIENTS, number
from pliant.errors import CalibrationError
from pliant.wording import shown
from pliant.yaml_text import YamlError, load_yaml

Keys: TypeAlias = dict[str, Any]
"""What a file says, by key."""


@dataclass(frozen=True)
class Wanted:
    """Which camera of a file is meant.

    image_size: (width, height) of its images, if known.    kitti_camera: number of KITTI's.
    """

    image_size: tuple[int, int] | None = None
    kitti_camera: int = 0


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
    return flat_from_keys(_keys(text), wanted)


def flat_from_keys(content: Keys, wanted: Wanted) -> Keys:
    """Of what has keys already.  Raises CalibrationError."""
    for kind in FORMATS:
        if not isinstance(kind.mark, re.Pattern) and any(key in content for key in kind.mark):
            return kind.flat(content, wanted)
    raise CalibrationError(f"holds no camera; understood are {UNDERSTOOD}")


def _keys(text: str) -> Keys:
    # OpenCV's writer begins with a directive that is not YAML's, and has a tag of its own.
    text = re.sub(r"^%YAML:[\d.]+\s*\n(---\s*\n)?", "", text, count=1, flags=re.MULTILINE)
    text = text.replace("!!opencv-matrix", "")
    try:
        content = _json(text) or load_yaml(text)
    except YamlError as error:
        raise CalibrationError(f"not YAML ({error}); understood are {UNDERSTOOD}") from None
    if not isinstance(content, dict):
        raise CalibrationError(f"no keys and values; understood are {UNDERSTOOD}")
    return {str(key): value for key, value in cast(Keys, content).items()}


def _json(text: str) -> Any:
    """None where it is none.  YAML reads JSON, too, but takes minutes for a thousand poses."""
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
"""What others call the models."""
_MATRIX = ("camera_matrix", "cameraMatrix", "Camera_Matrix", "camera_Matrix")
_COEFFICIENTS = (
    *("distortion_coefficients", "distortion_coeffs", "Distortion_Coefficients"),
    *("dist_coeffs", "dist_coeff", "distCoeffs", "distortionCoefficients"),
)


def _own(content: Keys, wanted: Wanted) -> Keys:
    return content


def _kalibr(content: Keys, wanted: Wanted) -> Keys:
    if not isinstance(content["cam0"], dict):
        raise CalibrationError(f"cam0 is {shown(content['cam0'])}: expected the keys of a camera")
    return flat_from_keys(cast(Keys, content["cam0"]), wanted)


def _euroc(content: Keys, wanted: Wanted) -> Keys:
    camera = str(content.get("camera_model", "pinhole")).lower()
    if camera not in ("pinhole", "pinhole-radtan", "fisheye"):
        raise CalibrationError(
            f"camera_model {shown(camera)} is not understood: calibrate again with pinhole "
            "(a wide lens: with pinhole-equi)"
        )
    size = _numbers(content, "resolution", 2) if "resolution" in content else None
    return _lens(content, _numbers(content, "intrinsics", 4), size, _said_model(content))


def _opencv(content: Keys, wanted: Wanted) -> Keys:
    """Its samples name no model: the count of the coefficients, or ``fisheye_model``, tells."""
    K = _numbers(content, _first(content, _MATRIX), 9)
    width, height = content.get("image_width"), content.get("image_height")
    model = _said_model(content)
    if not model:
        model = "fisheye" if content.get("fisheye_model") else "rational_polynomial"
    size = None if width is None or height is None else [width, height]
    return _lens(content, [K[0], K[4], K[2], K[5]], size, model)


def _said_model(content: Keys) -> str:
    said = content.get("distortion_model")
    coefficients = _first(content, _COEFFICIENTS)
    if not said and coefficients and not _numbers(content, coefficients, None):
        return "none"
    return str(said or "").lower()


def _lens(content: Keys, intrinsics: list[Any], size: list[Any] | None, said: str) -> Keys:
    key = _first(content, _COEFFICIENTS)
    if not key:
        raise CalibrationError(
            "no distortion_coefficients: add what is missing (zeros if rectified)"
        )
    model, coefficients = _DISTORTION.get(said), _numbers(content, key, None)
    if model is None:
        raise CalibrationError(
            f"distortion_model {shown(said)} is not understood: calibrate again with radtan or "
            "equidistant"
        )
    names = COEFFICIENTS[model]
    while len(coefficients) > len(names) and coefficients[-1] == 0:
        coefficients = coefficients[:-1]  # more terms than the model has, if they are zero
    if len(coefficients) > len(names):
        raise CalibrationError(
            f"{len(coefficients)} distortion coefficients, but {said} is understood with at most "
            f"{len(names)} ({' '.join(names)}): calibrate again with those"
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
    """``Camera1.fx`` of version 3, ``Camera.fx`` of those before; the size where it is said."""
    if "LEFT.K" in content:
        raise CalibrationError(
            "is for a stereo pair that ORB-SLAM rectifies first (LEFT.K): give the calibration of "
            "the images as they are, or of one camera"
        )
    said = str(content.get("Camera.type", "PinHole"))
    model = _ORB_SLAM.get(said.lower())
    if model is None:
        raise CalibrationError(
            f"Camera.type {shown(said)} is not understood: calibrate again with PinHole or "
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


# --- COLMAP and nerfstudio ----------------------------------------------------------------------

_COLMAP: dict[str, tuple[LensModel, str]] = {
    "SIMPLE_PINHOLE": ("pinhole", "f cx cy"),
    "PINHOLE": ("pinhole", "fx fy cx cy"),
    "SIMPLE_RADIAL": ("pinhole-radtan", "f cx cy k1"),
    "RADIAL": ("pinhole-radtan", "f cx cy k1 k2"),
    "OPENCV": ("pinhole-radtan", "fx fy cx cy k1 k2 p1 p2"),
    "FULL_OPENCV": ("pinhole-rational", "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6"),
    "SIMPLE_FISHEYE": ("fisheye", "f cx cy"),
    "FISHEYE": ("fisheye", "fx fy cx cy"),
    "SIMPLE_RADIAL_FISHEYE": ("fisheye", "f cx cy k1"),
    "RADIAL_FISHEYE": ("fisheye", "f cx cy k1 k2"),
    "OPENCV_FISHEYE": ("fisheye", "fx fy cx cy k1 k2 k3 k4"),
}
"""COLMAP's models that are ours, with their parameters in order (src/colmap/sensor/models.h)."""
_COLMAP_LINE = re.compile(
    r"^[ \t]*\d+[ \t]+[A-Z][A-Z0-9_]+[ \t]+\d+[ \t]+\d+[ \t]+\S", re.MULTILINE
)


def _colmap(text: str, wanted: Wanted) -> Keys:
    """``CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]``: one camera, or the one of that size."""
    lines = [line.split() for line in text.splitlines() if _COLMAP_LINE.match(line)]
    cameras = list(dict.fromkeys(tuple(row[1:]) for row in lines))
    if wanted.image_size is not None and len(cameras) > 1:
        size = tuple(map(str, wanted.image_size))
        cameras = [row for row in cameras if row[1:3] == size] or cameras
    if len(cameras) > 1:
        raise CalibrationError(
            f"holds {len(cameras)} cameras: leave the line of the one that took the images"
        )
    name, width, height, *values = cameras[0]
    model, parameters = _known_colmap(name)
    names = parameters.split()
    if len(values) != len(names):
        raise CalibrationError(
            f"{name} has {len(values)} parameters: expected {len(names)} ({parameters})"
        )
    flat: Keys = {"model": model, "width": width, "height": height}
    flat.update(dict.fromkeys(COEFFICIENTS[model], 0.0))
    flat.update(zip(names, values, strict=True))
    if "f" in flat:
        flat["fx"] = flat["fy"] = flat.pop("f")
    return _half_a_pixel_back(flat)


def _nerfstudio(content: Keys, wanted: Wanted) -> Keys:
    """The camera of all images; a file that gives each its own is read where all are the same."""
    said = content.get("camera_model", "OPENCV_FISHEYE" if content.get("is_fisheye") else "OPENCV")
    model, _ = _known_colmap(str(said))
    content = {**_of_all_frames(content), **content}
    flat: Keys = {"model": model, **dict.fromkeys(COEFFICIENTS[model], 0.0)}
    names = {"w": "width", "h": "height", "fl_x": "fx", "fl_y": "fy", "cx": "cx", "cy": "cy"}
    names |= {k: k for k in ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")}
    flat.update({own: content[key] for key, own in names.items() if content.get(key) is not None})
    if "fx" not in flat and "camera_angle_x" in content and "width" in flat:
        angle = min(max(number(content, "camera_angle_x"), 1e-3), math.pi - 1e-3)
        flat["fx"] = 0.5 * number(flat, "width") / math.tan(0.5 * angle)
    if "fx" in flat:
        flat.setdefault("fy", flat["fx"])
    return _half_a_pixel_back(flat)


def _of_all_frames(content: Keys) -> Keys:
    frames = content.get("frames")
    if "fl_x" in content or "camera_angle_x" in content or not isinstance(frames, list):
        return {}
    names = ("w", "h", "fl_x", "fl_y", "cx", "cy", "k1", "k2", "k3", "k4", "p1", "p2")
    each = [
        {key: frame[key] for key in names if key in frame}
        for frame in cast(list[Any], frames)
        if isinstance(frame, dict)
    ]
    if any(camera != each[0] for camera in each):
        raise CalibrationError("gives images cameras that differ: give the calibration of one")
    return each[0] if each else {}


def _known_colmap(name: str) -> tuple[LensModel, str]:
    if name not in _COLMAP:
        raise CalibrationError(
            f"camera model {name} is not understood: calibrate again with OPENCV "
            "(a wide lens: with OPENCV_FISHEYE)"
        )
    return _COLMAP[name]


def _half_a_pixel_back(flat: Keys) -> Keys:
    return {**flat, **{k: number(flat, k) - 0.5 for k in ("cx", "cy") if k in flat}}


# --- KITTI --------------------------------------------------------------------------------------

_KITTI_LINE = re.compile(r"^P\d+:", re.MULTILINE)


def _kitti(text: str, wanted: Wanted) -> Keys:
    """From the row ``P<camera>:`` with the 3x4 projection matrix; those images are rectified."""
    camera = wanted.kitti_camera
    match = re.search(rf"^P{camera}:(.*)$", text, re.MULTILINE)
    if match is None:
        raise CalibrationError(f"no row P{camera}: add the projection matrix of this camera")
    row = match.group(1).split()
    if len(row) != 12:
        raise CalibrationError(f"P{camera} has {len(row)} numbers: expected 12")
    if wanted.image_size is None:
        raise CalibrationError("a KITTI calibration does not say how large the images are")
    return {"model": "pinhole", "fx": row[0], "fy": row[5], "cx": row[2], "cy": row[6]}


FORMATS = (
    CalibrationFormat("KITTI's calib.txt", _KITTI_LINE, _kitti),
    CalibrationFormat("COLMAP's cameras.txt", _COLMAP_LINE, _colmap),
    CalibrationFormat("Kalibr's camchain.yaml", ("cam0",), _kalibr),
    CalibrationFormat("EuRoC's sensor.yaml", ("intrinsics",), _euroc),
    CalibrationFormat("OpenCV's and ROS's camera_matrix", _MATRIX, _opencv),
    CalibrationFormat("ORB-SLAM's settings", ("Camera1.fx", "Camera.fx"), _orb_slam),
    CalibrationFormat(
        "nerfstudio's transforms.json", ("fl_x", "camera_angle_x", "frames"), _nerfstudio
    ),
    CalibrationFormat("our own calib.yaml", ("fx", "fy", "cx", "cy"), _own),
)
"""Every kind of calibration file; the first that a file looks like reads it."""

UNDERSTOOD = (
    f"keys fx fy cx cy width height (calib.yaml), {', '.join(k.name for k in FORMATS[:-1])}"
)
"""The kinds, in one line."""

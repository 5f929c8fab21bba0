"""The cameras of COLMAP and nerfstudio, under the keys of our own ``calib.yaml``.

They have (0.5, 0.5) at the centre of the top-left pixel, and lose that half on the way.
"""

import math
import re
from typing import Any, cast

from pliant.algorithms.rectification import LensModel
from pliant.datasets.calibration import COEFFICIENTS, number
from pliant.datasets.calibration_keys import Keys, Wanted
from pliant.errors import CalibrationError

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
COLMAP_LINE = re.compile(r"^[ \t]*\d+[ \t]+[A-Z][A-Z0-9_]+[ \t]+\d+[ \t]+\d+[ \t]+\S", re.MULTILINE)


def colmap(text: str, wanted: Wanted) -> Keys:
    """``CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]``: one camera, or the one of that size."""
    lines = [line.split() for line in text.splitlines() if COLMAP_LINE.match(line)]
    cameras = list(dict.fromkeys(tuple(row[1:]) for row in lines))
    if wanted.camera:
        cameras = [tuple(row[1:]) for row in lines if row[0] == wanted.camera.removeprefix("cam")]
        if not cameras:
            raise CalibrationError(f"no camera {wanted.camera}: use a number of the first column")
    if wanted.image_size is not None and len(cameras) > 1:
        size = tuple(map(str, wanted.image_size))
        cameras = [row for row in cameras if row[1:3] == size] or cameras
    if len(cameras) > 1:
        raise CalibrationError(
            f"has {len(cameras)} cameras: select the camera of the images, as in --calibration "
            f"FILE:{lines[-1][0]}"
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


def nerfstudio(content: Keys, wanted: Wanted) -> Keys:
    """The camera of all images; a file that gives each its own is read where all are the same."""
    model_name = content.get(
        "camera_model", "OPENCV_FISHEYE" if content.get("is_fisheye") else "OPENCV"
    )
    model, _ = _known_colmap(str(model_name))
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
        raise CalibrationError("has different cameras for its images: pass the calibration of one")
    return each[0] if each else {}


def _known_colmap(name: str) -> tuple[LensModel, str]:
    if name not in _COLMAP:
        raise CalibrationError(
            f"camera model {name} is not supported: calibrate again with OPENCV (a wide lens: "
            "with OPENCV_FISHEYE)"
        )
    return _COLMAP[name]


def _half_a_pixel_back(flat: Keys) -> Keys:
    return {**flat, **{k: number(flat, k) - 0.5 for k in ("cx", "cy") if k in flat}}

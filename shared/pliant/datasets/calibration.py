"""The calibration of a camera as a checked value, and as YAML in recordings.

The YAML is flat, as the ``calib.yaml`` beside an image folder:

    model: pinhole-radtan      # pinhole, pinhole-radtan (k1 k2 p1 p2 [k3]), fisheye (k1 k2 k3 k4),
                               # pinhole-rational (k1 k2 p1 p2 k3 k4 k5 k6)
    width: 752                 # pixels
    height: 480
    fx: 458.654                # pixels; (0, 0) is the centre of the top-left pixel
    fy: 457.296
    cx: 367.215
    cy: 248.375
    k1: -0.28340811
    k2: 0.07395907
    p1: 0.00019359
    p2: 1.76187114e-05
    fps: 20                    # optional: for sources without time stamps
    depth_scale: 0.001         # optional: metres per unit of the depth images, with depth_fx,
    depth_fx: 460.0            #   depth_fy, depth_cx, depth_cy (default: the camera's own)
    depth_invalid: [0]         #   and the values that mean "no depth"
    stereo_baseline: 0.0053    # optional: metres to the right camera of a rectified pair
    focal_sigma: 0.3           # optional: fx is a guess; standard deviation of its logarithm
"""

import math
from dataclasses import dataclass
from typing import Any, cast, get_args

import yaml

from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.rectification import Lens, LensModel, rectified_camera
from pliant.errors import CalibrationError
from pliant.wording import shown
from pliant.yaml_text import YamlError, load_yaml

COEFFICIENTS: dict[LensModel, tuple[str, ...]] = {
    "pinhole": (),
    "pinhole-radtan": ("k1", "k2", "p1", "p2", "k3"),
    "pinhole-rational": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "fisheye": ("k1", "k2", "k3", "k4"),
}
"""Names of the distortion coefficients, in the order of OpenCV."""
_OPTIONAL = {("pinhole-radtan", "k3")}
_MODELS: tuple[str, ...] = get_args(LensModel)
SAID_SIGMA = 0.3
"""Uncertainty of a field of view given by the user: standard deviation of log focal."""
UNSAID_FOV_DEG, UNSAID_SIGMA = 60.0, 0.4
"""Default along the longer side: +-2 standard deviations are 29 to 104 degrees."""
_MAX_SIGMA = 1.0
_MAX_UNITS = 65535  # of a 16-bit depth map
_MAX_SIDE_PX = 32767  # what the fixed-point maps can address


@dataclass(frozen=True, kw_only=True)
class DepthImages:
    """How depth images that come with a source are read: metres = value * scale_m.

    camera: their pinhole camera.     invalid: values that mean "no depth".
    baseline_m: of the rectified stereo pair from which they are made; 0 where they come as images.
    """

    scale_m: float
    camera: PinholeCamera
    invalid: tuple[int, ...] = (0,)
    baseline_m: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """A camera: size and intrinsics in pixels, and distortion in the order of ``COEFFICIENTS``.

    fps: frames a second of a source without time stamps.
    focal_sigma: standard deviation of the log focal length where it is a guess; 0: calibrated.

    Raises CalibrationError, in one line without the name of the file, on impossible values.
    """

    model: LensModel
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()
    fps: float | None = None
    depth: DepthImages | None = None
    focal_sigma: float = 0.0

    def __post_init__(self) -> None:
        _check_intrinsics(self)
        _check_distortion(self)
        try:
            rectified_camera(self.lens)
        except ValueError as error:
            values = ", ".join(f"{value:g}" for value in self.distortion)
            raise CalibrationError(
                f"distortion ({values}): {error}; check the coefficients and their order "
                f"({' '.join(COEFFICIENTS[self.model])})"
            ) from None

    @property
    def lens(self) -> Lens:
        """The lens, for the rectification."""
        return Lens(
            model=self.model,
            width=self.width,
            height=self.height,
            fx=self.fx,
            fy=self.fy,
            cx=self.cx,
            cy=self.cy,
            coefficients=self.distortion,
        )


def calibration_from_fov(
    width: int, height: int, fov_deg: float | None = None, *, pixel_aspect: float = 1.0
) -> Calibration:
    """A first guess: a pinhole camera with this horizontal field of view, looking straight ahead.

    fov_deg: None: the default, the same for upright and wide images.
    pixel_aspect: width over height of a pixel, which is fy over fx.

    Raises CalibrationError for a field of view that a pinhole camera cannot have.
    """
    is_given = fov_deg is not None
    side = width if is_given else max(width, height / pixel_aspect)
    fov_deg = fov_deg if is_given else UNSAID_FOV_DEG
    if not 1.0 <= fov_deg <= 170.0:  # also refuses NaN
        raise CalibrationError(
            f"--fov {fov_deg:g}: the horizontal field of view must be 1 to 170 degrees; "
            "a wider lens needs a calibration file"
        )
    focal = 0.5 * side / math.tan(math.radians(0.5 * fov_deg))
    return Calibration(
        model="pinhole",
        width=width,
        height=height,
        fx=focal,
        fy=focal * pixel_aspect,
        cx=0.5 * (width - 1),
        cy=0.5 * (height - 1),
        focal_sigma=SAID_SIGMA if is_given else UNSAID_SIGMA,
    )


def calibration_yaml(calibration: Calibration) -> str:
    """The calibration as YAML that ``calibration_from_yaml`` reads back to the same numbers."""
    content: dict[str, Any] = {
        "model": calibration.model,
        "width": calibration.width,
        "height": calibration.height,
    }
    for key in ("fx", "fy", "cx", "cy"):
        content[key] = getattr(calibration, key)
    content.update(zip(COEFFICIENTS[calibration.model], calibration.distortion, strict=True))
    if calibration.fps is not None:
        content["fps"] = calibration.fps
    if calibration.focal_sigma > 0.0:
        content["focal_sigma"] = calibration.focal_sigma
    if calibration.depth is not None:
        depth = calibration.depth
        if depth.baseline_m > 0.0:
            content["stereo_baseline"] = depth.baseline_m
        content["depth_scale"] = depth.scale_m
        for key in ("fx", "fy", "cx", "cy"):
            content[f"depth_{key}"] = getattr(depth.camera, key)
        content["depth_invalid"] = list(depth.invalid)
    return yaml.safe_dump(content, sort_keys=False)


def calibration_from_yaml(text: str) -> Calibration:
    """The inverse of ``calibration_yaml``, for what a recording carries.

    Raises CalibrationError.
    """
    try:
        content = load_yaml(text)
    except YamlError as error:
        raise CalibrationError(f"not YAML: {error}") from None
    if not isinstance(content, dict):
        raise CalibrationError("expected keys and values: width, height, fx, fy, cx, cy, ...")
    return calibration_from_keys(cast(dict[str, Any], content))


def calibration_from_keys(
    content: dict[str, Any], image_size: tuple[int, int] | None = None
) -> Calibration:
    """From flat keys; others are passed over, since files of data sets carry many more.

    image_size: (width, height) for content without it.     Raises CalibrationError.
    """
    size = {"width": image_size[0], "height": image_size[1]} if image_size else {}
    content = {**size, **content}
    missing = [k for k in ("width", "height", "fx", "fy", "cx", "cy") if content.get(k) is None]
    if missing:
        raise CalibrationError(f"no {', '.join(missing)}: add what is missing")
    model = _model(content)
    names = COEFFICIENTS[model]
    missing = [k for k in names if content.get(k) is None and (model, k) not in _OPTIONAL]
    if missing:
        raise CalibrationError(f"model {model}, but no {', '.join(missing)}: add what is missing")
    width, height = _whole(content, "width"), _whole(content, "height")
    intrinsics = {key: number(content, key) for key in ("fx", "fy", "cx", "cy")}
    fps = content.get("fps")
    return Calibration(
        model=model,
        width=width,
        height=height,
        distortion=tuple(0.0 if content.get(k) is None else number(content, k) for k in names),
        # Files describe their rate in words, too; those have no meaning here.
        fps=float(fps) if isinstance(fps, int | float) and 0.0 < fps < 1e6 else None,
        depth=_depth(content, width, height, intrinsics),
        focal_sigma=_sigma(content),
        **intrinsics,
    )


def number(content: dict[str, Any], key: str) -> float:
    """A finite number of a mapping.  YAML reads ``1e-5`` as text; that is a number here."""
    value = content[key]
    try:
        result = math.nan if isinstance(value, bool) else float(value)
    except (TypeError, ValueError, OverflowError):
        raise CalibrationError(f"{key} is {shown(value)}: expected a number") from None
    if not math.isfinite(result):
        raise CalibrationError(f"{key} is {shown(value)}: expected a finite number")
    return result


def _sigma(content: dict[str, Any]) -> float:
    if content.get("focal_sigma") is None:
        return 0.0
    sigma = number(content, "focal_sigma")
    if not 0.0 <= sigma <= _MAX_SIGMA:
        raise CalibrationError(f"focal_sigma is {sigma:g}: expected 0 to {_MAX_SIGMA:g}")
    return sigma


def _whole(content: dict[str, Any], key: str) -> int:
    value = number(content, key)
    if value != int(value):
        raise CalibrationError(f"{key} is {value:g}: expected a whole number of pixels")
    return int(value)


def _model(content: dict[str, Any]) -> LensModel:
    names = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
    distorted = [k for k in names if content.get(k) is not None and number(content, k) != 0.0]
    given = content.get("model")
    if given is None:
        if {"k5", "k6"} & set(distorted):
            return "pinhole-rational"
        return "pinhole-radtan" if distorted else "pinhole"
    if given not in _MODELS:
        raise CalibrationError(f"model {shown(given)} is not supported: use {', '.join(_MODELS)}")
    model = cast(LensModel, given)
    unused = [k for k in distorted if k not in COEFFICIENTS[model]]
    if unused:
        raise CalibrationError(
            f"model {model} has no {', '.join(unused)}, but the file gives a value: use the model "
            "that fits (pinhole-radtan: k1 k2 p1 p2 k3, pinhole-rational: these and k4 k5 k6, "
            "fisheye: k1 k2 k3 k4), or remove it"
        )
    return model


def _depth(
    content: dict[str, Any], width: int, height: int, intrinsics: dict[str, float]
) -> DepthImages | None:
    baseline = number(content, "stereo_baseline") if content.get("stereo_baseline") else 0.0
    if baseline < 0.0:
        raise CalibrationError("stereo_baseline must be positive: metres to the right camera")
    if content.get("depth_scale") is None and baseline == 0.0:
        return None
    own = {
        key: number(content, f"depth_{key}") if content.get(f"depth_{key}") is not None else value
        for key, value in intrinsics.items()
    }
    if content.get("depth_scale") is None:  # the farthest, one pixel of disparity, still fits
        content = {**content, "depth_scale": own["fx"] * baseline / _MAX_UNITS}
    scale = number(content, "depth_scale")
    if scale <= 0.0 or min(own["fx"], own["fy"]) <= 0.0:
        raise CalibrationError("depth_scale, depth_fx and depth_fy must be positive")
    invalid = content.get("depth_invalid", [0])
    values = invalid if isinstance(invalid, list) else [invalid]
    if not all(isinstance(value, int) for value in values):
        raise CalibrationError(f"depth_invalid is {shown(invalid)}: expected whole numbers")
    camera = PinholeCamera(width=width, height=height, **own)
    return DepthImages(
        scale_m=scale,
        camera=camera,
        invalid=tuple(cast(list[int], values)),
        baseline_m=baseline,
    )


def _check_intrinsics(calibration: Calibration) -> None:
    for key in ("width", "height"):
        side = getattr(calibration, key)
        if not 1 < side <= _MAX_SIDE_PX:
            raise CalibrationError(f"{key} is {side}: expected 2 to {_MAX_SIDE_PX} pixels")
    for key in ("fx", "fy", "cx", "cy"):
        if not math.isfinite(getattr(calibration, key)):
            raise CalibrationError(
                f"{key} is {getattr(calibration, key)}: expected a finite number"
            )
    longest = max(calibration.width, calibration.height)
    for key in ("fx", "fy"):
        focal = getattr(calibration, key)
        if focal <= 0.0:
            raise CalibrationError(f"{key} is {focal:g}: a focal length is positive")
        if not 0.05 * longest <= focal <= 100.0 * longest:
            raise CalibrationError(
                f"{key} is {focal:g}: not plausible for an image of {longest} px; it is given in "
                "pixels, for the images as they are (not in mm, not for another resolution)"
            )
    for key, side in (("cx", calibration.width), ("cy", calibration.height)):
        centre = getattr(calibration, key)
        # Crops have their principal point outside; a mistake has it far outside.
        if not -side <= centre <= 2 * side:
            raise CalibrationError(
                f"{key} is {centre:g}: far outside of the {side} px of the image; it is given in "
                "pixels, for the images as they are"
            )


def _check_distortion(calibration: Calibration) -> None:
    names = COEFFICIENTS[calibration.model]
    if len(calibration.distortion) != len(names):
        raise CalibrationError(
            f"model {calibration.model} takes {len(names)} coefficients ({' '.join(names)}), "
            f"got {len(calibration.distortion)}"
        )
    for name, value in zip(names, calibration.distortion, strict=True):
        if not math.isfinite(value):
            raise CalibrationError(f"{name} is {value}: expected a finite number")

"""Lenses with distortion, and the pinhole image that everybody behind the ingest works on.

Three models of a lens, all as OpenCV defines them.  With (x, y) on the plane z = 1 and
r^2 = x^2 + y^2, the image point is (fx x_d + cx, fy y_d + cy), where

radial-tangential (Brown 1966; k1 k2 p1 p2 [k3]):
    x_d = x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2), likewise y_d

rational (Claus and Fitzgibbon 2005; k1 k2 p1 p2 k3 k4 k5 k6): the radial factor of the model above
    divided by 1 + k4 r^2 + k5 r^4 + k6 r^6

fisheye (Kannala and Brandt 2006; k1 k2 k3 k4):
    theta = atan(r),  x_d = x/r (theta + k1 theta^3 + k2 theta^5 + k3 theta^7 + k4 theta^9)
"""

from dataclasses import dataclass
from typing import Any, Literal, TypeAlias, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from pliant.algorithms.arrays import F64, U8
from pliant.algorithms.camera import PinholeCamera

LensModel: TypeAlias = Literal["pinhole", "pinhole-radtan", "pinhole-rational", "fisheye"]
RectificationMaps: TypeAlias = tuple[NDArray[np.int16], NDArray[np.uint16]]

MIN_CENTRAL_SCALE = 0.8
"""The rectified focal length is at least this part of the lens's: resolution comes before width."""
MAX_CENTRAL_SCALE = 4.0
"""A lens that leaves less than a fourth of its view valid has a broken calibration."""
_BISECTIONS = 40
_NEWTON_STEPS = 20
_LARGEST_R = 20.0  # 87 degrees off the axis: no rectified image reaches that far


@dataclass(frozen=True, kw_only=True)
class Lens:
    """A camera with distortion.  Focal lengths and principal point in pixels.

    coefficients: () for "pinhole", (k1, k2, p1, p2, k3) for "pinhole-radtan",
    (k1, k2, p1, p2, k3, k4, k5, k6) for "pinhole-rational", (k1, k2, k3, k4) for "fisheye".
    """

    model: LensModel
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    coefficients: tuple[float, ...] = ()

    @property
    def distorts(self) -> bool:
        """Whether the image differs from a pinhole's; a fisheye does even with all k = 0."""
        return self.model == "fisheye" or any(k != 0.0 for k in self.coefficients)

    @property
    def pinhole(self) -> PinholeCamera:
        """The camera without its distortion."""
        return PinholeCamera(
            width=self.width, height=self.height, fx=self.fx, fy=self.fy, cx=self.cx, cy=self.cy
        )

    def project(self, points_plane: F64) -> F64:
        """Project (..., 2) points of the plane z = 1 to (..., 2) pixels of the source image."""
        return distort(points_plane, self) * (self.fx, self.fy) + (self.cx, self.cy)


def distort(points_plane: F64, lens: Lens) -> F64:
    """Where the lens puts (..., 2) points of the plane z = 1, on that plane."""
    if not lens.distorts:
        return np.array(points_plane, np.float64)
    x, y = points_plane[..., 0], points_plane[..., 1]
    square = x * x + y * y
    if lens.model == "fisheye":
        r = np.sqrt(square)
        with np.errstate(invalid="ignore", divide="ignore"):
            scale = np.where(r > 1e-9, _radial(r, lens) / r, 1.0)
        return np.stack([x * scale, y * scale], axis=-1)
    _, _, p1, p2, *_ = lens.coefficients
    scale = _factor(square, lens)[0]
    return np.stack(
        [
            x * scale + 2.0 * p1 * x * y + p2 * (square + 2.0 * x * x),
            y * scale + 2.0 * p2 * x * y + p1 * (square + 2.0 * y * y),
        ],
        axis=-1,
    )


def fold_radius(lens: Lens) -> float:
    """The radius on the plane z = 1 beyond which the lens model runs back on itself.

    Calibrated polynomials are meaningless outside the image they were fitted to, and often turn
    there: points beyond would be drawn into the image a second time.  inf if it never turns
    (before 87 degrees off the axis).
    """
    r = np.concatenate([np.linspace(0.0, 4.0, 4001), np.linspace(4.0, _LARGEST_R, 1601)[1:]])
    turns = np.flatnonzero(np.diff(_radial(r, lens)) <= 0.0)
    return float(r[turns[0]]) if turns.size else np.inf


def undistort(points_plane: F64, lens: Lens) -> F64:
    """The inverse of ``distort`` for (..., 2) points, by Newton's method on the radius and plane.

    NaN where no point within the fold radius is drawn there (also: 87 degrees off the axis and
    more).
    """
    target = np.asarray(points_plane, np.float64)
    out = _undistort_radially(target, lens)
    if lens.model in ("pinhole-radtan", "pinhole-rational") and lens.distorts:
        for _ in range(_NEWTON_STEPS):
            # Coefficients may be anything: what comes of absurd ones is refused below.
            with np.errstate(all="ignore"):
                error = distort(out, lens) - target
                J = _radtan_jacobian(out, lens)
                det = J[..., 0, 0] * J[..., 1, 1] - J[..., 0, 1] * J[..., 1, 0]
                out[..., 0] -= (J[..., 1, 1] * error[..., 0] - J[..., 0, 1] * error[..., 1]) / det
                out[..., 1] -= (J[..., 0, 0] * error[..., 1] - J[..., 1, 0] * error[..., 0]) / det
    residual = np.hypot(*np.moveaxis(distort(out, lens) - target, -1, 0))
    radius = np.hypot(out[..., 0], out[..., 1])
    good = (residual < 1e-9) & (radius <= min(fold_radius(lens), _LARGEST_R))
    out[~good] = np.nan
    return out


def rectified_camera(lens: Lens) -> PinholeCamera:
    """The pinhole camera into which the image of ``lens`` is rectified; its own if undistorted.

    It has the size of the source image and square pixels, and its centre looks where the centre
    of the source looks.  Its focal length is the smallest (the widest view) for which every
    rectified pixel lies inside the source image and inside the fold of the lens model.  It is at
    least 0.8 of the lens's own: a wide fisheye loses the rim of its view, so that the centre keeps
    its resolution.  No pixel of the result is made up.

    Raises ValueError if the coefficients leave no usable image.
    """
    if not lens.distorts:
        return lens.pinhole
    middle = (np.array([lens.width, lens.height]) - 1.0) / 2.0
    axis = undistort((middle - (lens.cx, lens.cy)) / (lens.fx, lens.fy), lens)
    fold = fold_radius(lens)
    if not np.all(np.isfinite(axis)):
        raise ValueError("the distortion folds the image at its centre")

    def camera(scale: float) -> PinholeCamera:
        focal = scale * max(lens.fx, lens.fy)
        cx, cy = middle - focal * axis
        return PinholeCamera(
            width=lens.width, height=lens.height, fx=focal, fy=focal, cx=float(cx), cy=float(cy)
        )

    def valid(scale: float) -> bool:
        border = _border(lens.width, lens.height)
        points = camera(scale).normalise(border)
        if np.any(np.hypot(points[:, 0], points[:, 1]) >= fold):
            return False
        source = lens.project(points)
        return bool(np.all(source >= 0.0) and np.all(source <= 2.0 * middle))

    low, high = MIN_CENTRAL_SCALE, MAX_CENTRAL_SCALE
    if valid(low):
        return camera(low)
    if not valid(high):
        raise ValueError("the distortion leaves less than a fourth of the view usable")
    for _ in range(_BISECTIONS):
        scale = 0.5 * (low + high)
        low, high = (low, scale) if valid(scale) else (scale, high)
    return camera(high)


def source_pixels(lens: Lens, camera: PinholeCamera) -> F64:
    """(H, W, 2) pixels of the source image at which the pixels of ``camera`` are found."""
    u, v = np.meshgrid(np.arange(camera.width, dtype=np.float64), np.arange(float(camera.height)))
    points = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy], axis=-1)
    return lens.project(points)


def rectification_maps(lens: Lens, camera: PinholeCamera) -> RectificationMaps:
    """The maps of ``resample``: OpenCV's fixed-point form, good to 1/64 pixel."""
    source = source_pixels(lens, camera).astype(np.float32)
    whole, fraction = cv2.convertMaps(
        np.ascontiguousarray(source[..., 0]), np.ascontiguousarray(source[..., 1]), cv2.CV_16SC2
    )
    return cast(RectificationMaps, (whole, fraction))


def resample(image: U8, maps: RectificationMaps) -> U8:
    """Rectify an (H, W) or (H, W, 3) image, bilinearly."""
    whole, fraction = maps
    border: Any = cv2.BORDER_REPLICATE
    return cast(U8, cv2.remap(image, whole, fraction, cv2.INTER_LINEAR, borderMode=border))


def _radial(r: F64, lens: Lens) -> F64:
    """Distorted radius of radius r, without the tangential part."""
    if not lens.distorts:
        return r
    if lens.model == "fisheye":
        k1, k2, k3, k4 = lens.coefficients
        theta = np.arctan(r)
        square = theta * theta
        return theta * (1.0 + square * (k1 + square * (k2 + square * (k3 + square * k4))))
    return r * _factor(r * r, lens)[0]


def _factor(square: F64, lens: Lens) -> tuple[F64, F64]:
    """How much a pinhole lens scales a point at r^2 = square, and twice the slope of that."""
    k1, k2, _, _, k3, k4, k5, k6 = (*lens.coefficients, 0.0, 0.0, 0.0)[:8]
    over = 1.0 + square * (k1 + square * (k2 + square * k3))
    under = 1.0 + square * (k4 + square * (k5 + square * k6))
    over_slope = k1 + square * (2.0 * k2 + square * 3.0 * k3)
    under_slope = k4 + square * (2.0 * k5 + square * 3.0 * k6)
    with np.errstate(divide="ignore", invalid="ignore"):  # a pole: the fold lies before it
        slope = 2.0 * (over_slope * under - over * under_slope) / (under * under)
        return over / under, slope


def _undistort_radially(target: F64, lens: Lens) -> F64:
    """The start of Newton's method: the radial model inverted by interpolation, then refined.

    The refinement is a safeguarded Newton iteration within the table's cell, exact to rounding.
    """
    if not lens.distorts:
        return target.copy()
    fold = min(fold_radius(lens), _LARGEST_R)
    table = np.tan(np.linspace(0.0, np.arctan(fold), 4096))
    values = _radial(table, lens)
    wanted = np.hypot(target[..., 0], target[..., 1])
    cell = np.clip(np.searchsorted(values, wanted) - 1, 0, len(table) - 2)
    low, high = table[cell], table[cell + 1]
    r = np.interp(wanted, values, table)
    for _ in range(_NEWTON_STEPS):
        step = 1e-6 * (1.0 + r)
        slope = (_radial(r + step, lens) - _radial(r - step, lens)) / (2.0 * step)
        with np.errstate(invalid="ignore", divide="ignore"):
            r = np.clip(r - (_radial(r, lens) - wanted) / slope, low, high)
    with np.errstate(invalid="ignore", divide="ignore"):
        scale = np.where(wanted > 1e-12, r / wanted, 1.0)
    return target * scale[..., None]


def _radtan_jacobian(points: F64, lens: Lens) -> F64:
    """(..., 2, 2) derivative of the pinhole lenses' ``distort`` by its points."""
    _, _, p1, p2, *_ = lens.coefficients
    x, y = points[..., 0], points[..., 1]
    scale, slope = _factor(x * x + y * y, lens)
    J = np.empty((*points.shape[:-1], 2, 2))
    J[..., 0, 0] = scale + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
    J[..., 0, 1] = x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y
    J[..., 1, 0] = x * y * slope + 2.0 * p2 * y + 2.0 * p1 * x
    J[..., 1, 1] = scale + y * y * slope + 2.0 * p2 * x + 6.0 * p1 * y
    return J


def _border(width: int, height: int) -> F64:
    """The pixels of the border of an image, (N, 2)."""
    u, v = np.arange(float(width)), np.arange(float(height))
    return np.concatenate(
        [
            np.stack([u, np.zeros_like(u)], axis=1),
            np.stack([u, np.full_like(u, height - 1.0)], axis=1),
            np.stack([np.zeros_like(v), v], axis=1),
            np.stack([np.full_like(v, width - 1.0), v], axis=1),
        ]
    )

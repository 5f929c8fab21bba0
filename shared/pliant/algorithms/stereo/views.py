"""A keyframe's image at the size at which depth is swept, and how its pixels move with depth.

A point with inverse depth w along z at the pixel x of one view is seen by another one, at

    x' ~ A x + b w,    A = K R K^-1,    b = K t,                                             (1)

where R, t take points of the first camera to the second.  The third component of the right side
is the ratio of the two depths, so that the inverse depth there is w / (A x + b w)_3.
"""

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from pliant.algorithms.arrays import F32, F64, U8, BoolArray, Shape
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import inverse

NOT_SHOWN = 0
"""Grey of a pixel that shows nothing: a mask covers it, or the lens does not reach it."""
_FINE_PX = 320 * 240
"""Pixels at which surfaces are swept, within a factor of two either way: half of 640x480."""


@dataclass(frozen=True)
class StereoView:
    """grey: 1 to 255, NOT_SHOWN where there is nothing.    camera: of that size.

    T_world_camera: (4, 4).
    """

    grey: Annotated[U8, Shape("H", "W")]
    camera: PinholeCamera
    T_world_camera: Annotated[F64, Shape(4, 4)]

    def halved(self) -> "StereoView":
        """The same at half the size."""
        shown = self.grey != NOT_SHOWN
        return StereoView(
            shrunk(self.grey, shown, 2), shrunk_camera(self.camera, 2), self.T_world_camera
        )


@dataclass(frozen=True)
class DenseDepth:
    """Inverse depths along z and how far each is to be trusted, in [0, 1].  0: unknown."""

    inverse_depths: Annotated[F32, Shape("H", "W")]
    confidences: Annotated[F32, Shape("H", "W")]


@dataclass(frozen=True)
class Motion:
    """A and b of equation (1), from one view to several others."""

    homographies: Annotated[F64, Shape("S", 3, 3)]
    translations: Annotated[F64, Shape("S", 3)]


def reduction(camera: PinholeCamera) -> int:
    """How many times smaller, a power of two, images are swept than they are.

    By pixels and not by columns, so that images held upright and wide ones cost the same.
    """
    halvings = 0.5 * math.log2(camera.width * camera.height / _FINE_PX)
    return 2 ** max(0, round(halvings))


def shrunk(grey: U8, shown: BoolArray, times: int) -> U8:
    """Means of (times x times) pixels, rounded; NOT_SHOWN where one of them is not shown.

    grey, shown: (H, W).  A rest of rows and columns at the lower right is left out.
    """
    height, width = (size // times for size in grey.shape)
    cut = slice(0, height * times), slice(0, width * times)
    sums = np.zeros((height, width), np.uint32)
    whole = np.ones((height, width), np.bool_)
    for row in range(times):
        for column in range(times):
            sums += grey[cut][row::times, column::times]
            whole &= shown[cut][row::times, column::times]
    count = times * times
    means = ((sums + count // 2) // count).astype(np.uint8)
    return np.where(whole, np.maximum(means, 1), np.uint8(NOT_SHOWN))


def shrunk_camera(camera: PinholeCamera, times: int) -> PinholeCamera:
    """The camera of such an image: pixel u of it is (u + 1/2) / times - 1/2."""
    return PinholeCamera(
        width=camera.width // times,
        height=camera.height // times,
        fx=camera.fx / times,
        fy=camera.fy / times,
        cx=(camera.cx + 0.5) / times - 0.5,
        cy=(camera.cy + 0.5) / times - 0.5,
    )


def motion(camera: PinholeCamera, T_world_camera: F64, others: F64) -> Motion:
    """From a view of a camera to others of the same camera, at poses (S, 4, 4)."""
    T_other_camera = inverse(others) @ T_world_camera
    K = camera.K
    return Motion(
        homographies=K @ T_other_camera[:, :3, :3] @ np.linalg.inv(K),
        translations=T_other_camera[:, :3, 3] @ K.T,
    )


def parallax_px(moved: Motion, pixels: F64, inverse_depths: F64) -> F64:
    """(S, N) how far each point moves in each other view per unit of inverse depth, pixels.

    pixels: (N, 2).    inverse_depths: (N,).  The derivative of (1): with p = A x + b w it is
    (b_1 - b_3 p_1 / p_3, b_2 - b_3 p_2 / p_3) / p_3.  NaN behind the other view.
    """
    ones = np.ones((len(pixels), 1))
    rays = np.concatenate([pixels, ones], axis=1) @ np.swapaxes(moved.homographies, 1, 2)
    b = moved.translations[:, None]
    p = rays + b * inverse_depths[:, None]
    depth = np.where(p[..., 2:] > 0.0, p[..., 2:], np.nan)
    slopes = (b[..., :2] - b[..., 2:] * p[..., :2] / depth) / depth
    return np.linalg.norm(slopes, axis=2)

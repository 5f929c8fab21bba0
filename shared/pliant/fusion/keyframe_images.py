"""A keyframe's image and mask, in the pixels of the ideal camera."""

from functools import lru_cache
from typing import TypeAlias

import cv2
import numpy as np

from pliant.algorithms.arrays import U8, BoolArray
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.image.masks import unpacked
from pliant.algorithms.slam.calibration.corrected_view import CorrectedView
from pliant.algorithms.slam.calibration.rolling_shutter import RolledFrame

View: TypeAlias = CorrectedView | RolledFrame
"""The second removes a rolling shutter, too."""


@lru_cache(maxsize=4)
def view_of(camera: PinholeCamera, correction: tuple[float, ...]) -> CorrectedView:
    """One view for all keyframes of a segment, so that its tables are made once."""
    return CorrectedView(camera, correction)


def colour_of(jpeg: bytes, view: View) -> U8 | None:
    """(H, W, 3) RGB; None where the image is missing or broken."""
    if not jpeg:
        return None
    pixels = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR_RGB)
    if pixels is None:
        return None
    return view.image(np.asarray(pixels, np.uint8))


def grey_of(colour: U8) -> U8:
    """(H, W) of an (H, W, 3) image."""
    return np.asarray(cv2.cvtColor(colour, cv2.COLOR_RGB2GRAY), np.uint8)


def unmasked(mask: bytes, view: View) -> BoolArray | None:
    """(H, W) what the mask of an image leaves; None: all, where there is none."""
    if not mask:
        return None
    shown = np.uint8(255) * unpacked(mask).astype(np.uint8)
    return view.image(shown) == 255

"""Depth of a rectified stereo pair, for surfels that start where no sensor measures depth.

    FOLDER/right.txt    "seconds file" a line, as in rgb.txt: images of the right camera, rectified
                        like the left ones of rgb.txt: same intrinsics, rows at the same height
    FOLDER/calib.yaml   with ``stereo_baseline``: metres from the left camera to the right one

OpenCV's semi-global matching with a check from right to left; what does not agree has no depth.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from pliant.algorithms.arrays import F32, U8
from pliant.algorithms.image.decoding import decoded

LIST_NAME = "right.txt"
_BLOCK_PX = 7
_STEP = 16  # disparities are in sixteenths of a pixel, and searched in multiples of 16
_MAX_DIFFERENCE_PX = 1.0
_SPECKLE_PX, _SPECKLE_STEP = 100, 2
_DEEPEST = 65535


@dataclass(frozen=True)
class StereoPair:
    """The image of the right camera that belongs to an image.

    right: its image.     focal_px, baseline_m: of the pair.     scale_m: metres a unit of depth.
    """

    right: Path
    focal_px: float
    baseline_m: float
    scale_m: float

    def depth(self, left: bytes) -> bytes:
        """The depth map as a 16-bit PNG, 0 where nothing is known; b"" if a file is no image.

        left: an image file.
        """
        try:
            pair = [_grey(left), _grey(self.right.read_bytes())]
        except OSError:
            return b""
        if pair[0] is None or pair[1] is None or pair[0].shape != pair[1].shape:
            return b""
        disparities = consistent_disparities(pair[0], pair[1])
        with np.errstate(divide="ignore"):
            units = self.focal_px * self.baseline_m / disparities / self.scale_m
        known = (disparities > 0.0) & (units < _DEEPEST)
        return cv2.imencode(".png", np.where(known, np.rint(units), 0).astype(np.uint16))[
            1
        ].tobytes()


def consistent_disparities(left: U8, right: U8) -> F32:
    """(H, W) pixels from where the left image sees a point to where the right one does, leftwards.

    0 where the two do not agree to within a pixel about it, or nothing was found.
    """
    search = max(_STEP, left.shape[1] // 4 // _STEP * _STEP)
    forward = _match(left, right, search)
    # The same matcher, with left and right exchanged by mirrors.
    backward = _match(right[:, ::-1], left[:, ::-1], search)[:, ::-1]
    columns = np.arange(left.shape[1], dtype=np.float32)
    there = np.rint(columns - forward).astype(np.int64)
    rows = np.arange(left.shape[0])[:, None]
    agreed = np.abs(backward[rows, np.clip(there, 0, None)] - forward) <= _MAX_DIFFERENCE_PX
    return np.where((forward > 0.0) & (there >= 0) & agreed, forward, np.float32(0.0))


def _match(left: U8, right: U8, search: int) -> F32:
    """Disparities of the left image, 0 where none was found."""
    matcher: Any = cv2.StereoSGBM.create(
        minDisparity=0, numDisparities=search, blockSize=_BLOCK_PX,
        P1=8 * _BLOCK_PX**2, P2=32 * _BLOCK_PX**2, disp12MaxDiff=-1, uniquenessRatio=5,
        speckleWindowSize=_SPECKLE_PX, speckleRange=_SPECKLE_STEP,
    )  # fmt: skip
    # A margin, or the matcher leaves out the columns that it cannot search to the end.
    padded = [
        cv2.copyMakeBorder(np.ascontiguousarray(image), 0, 0, search, 0, cv2.BORDER_REPLICATE)
        for image in (left, right)
    ]
    found = matcher.compute(*padded)[:, search:].astype(np.float32) / _STEP
    return np.maximum(found, np.float32(0.0))


def _grey(data: bytes) -> U8 | None:
    return decoded(data, cv2.IMREAD_GRAYSCALE)

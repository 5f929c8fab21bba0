"""Frames as sources deliver them, and cameras with and without distortion."""

import cv2
import numpy as np

from pliant.datasets.base import SourceFrame
from pliant.datasets.calibration import Calibration

WIDTH, HEIGHT = 64, 48


PLAIN = Calibration(model="pinhole", width=WIDTH, height=HEIGHT, fx=60, fy=60, cx=31.5, cy=23.5)


DISTORTED = Calibration(
    model="pinhole-radtan",
    width=WIDTH,
    height=HEIGHT,
    fx=60,
    fy=60,
    cx=31.5,
    cy=23.5,
    distortion=(-0.2, 0.03, 1e-3, -1e-3, 0.0),
)


def picture(colour: bool = True) -> np.ndarray:
    shape = (HEIGHT, WIDTH, 3) if colour else (HEIGHT, WIDTH)
    noise = np.random.default_rng(3).integers(0, 256, shape, np.uint8)
    return cv2.GaussianBlur(noise, (0, 0), 2.0)


def raw(image: np.ndarray, encoding: str) -> SourceFrame:
    return SourceFrame(
        index=7, stamp_ns=1, encoding=encoding, data=image.tobytes(), width=WIDTH, height=HEIGHT
    )

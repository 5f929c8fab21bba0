"""Textured planes that fill the image of a camera."""

import cv2
import numpy as np

from pliant.algorithms.arrays import F64
from pliant.algorithms.camera import PinholeCamera

CAMERA = PinholeCamera(width=320, height=240, fx=300.0, fy=300.0, cx=159.5, cy=119.5)
DEPTH = np.ones((240, 320))


def texture(seed: int) -> F64:
    """(240, 320) smooth noise of mean 0 and standard deviation 1."""
    grey = np.random.default_rng(seed).normal(size=(240, 320))
    grey = cv2.GaussianBlur(grey, (0, 0), 2.5)
    return np.asarray(grey / grey.std(), np.float64)

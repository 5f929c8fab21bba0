"""Compiles every kernel of the surfels by following a few of them through two small images."""

import numpy as np

from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.surfels.parameters import SurfelParameters
from pliant.algorithms.surfels.tracker import SurfelTracker


def warm_up() -> None:
    """Run every kernel once, with the types of the real work."""
    camera = PinholeCamera(width=96, height=72, fx=90.0, fy=90.0, cx=47.5, cy=35.5)
    image = np.random.default_rng(0).integers(0, 200, (72, 96), np.uint8)
    tracker = SurfelTracker(SurfelParameters(max_surfels=20))
    depth = np.ones((72, 96))
    tracker.start(image, depth, camera)
    tracker.track(image, depth=depth)

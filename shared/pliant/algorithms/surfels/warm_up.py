"""Compiles every kernel of the surfels by following a few of them through two small images."""

from typing import Literal

import numpy as np

from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.surfels.parameters import SurfelParameters
from pliant.algorithms.surfels.prediction import predict
from pliant.algorithms.surfels.surfel_tracker import SurfelTracker
from pliant.algorithms.tracks import FrameTracks


def warm_up() -> None:
    """Run every kernel once, with the types of the real work."""
    camera = PinholeCamera(width=96, height=72, fx=90.0, fy=90.0, cx=47.5, cy=35.5)
    image = np.random.default_rng(0).integers(0, 200, (72, 96), np.uint8)
    depth, nothing = np.ones((72, 96)), FrameTracks.empty()
    modes: tuple[Literal["static", "moving"], ...] = ("static", "moving")
    for mode in modes:
        tracker = SurfelTracker(SurfelParameters(camera=mode, max_surfels=20))
        first = tracker.start(image, depth, camera)
        tracker.track(image, predict(first.points_px, nothing, nothing), depth)

"""Surfels that move on their own, followed through the images of one camera (DSDT)."""

from pliant.algorithms.surfels.depth_maps import agree
from pliant.algorithms.surfels.parameters import SurfelParameters
from pliant.algorithms.surfels.prediction import predict
from pliant.algorithms.surfels.surfel_frame import SurfelFrame, SurfelState
from pliant.algorithms.surfels.surfel_tracker import SurfelTracker
from pliant.algorithms.surfels.warm_up import warm_up

__all__ = [
    "SurfelFrame",
    "SurfelParameters",
    "SurfelState",
    "SurfelTracker",
    "agree",
    "predict",
    "warm_up",
]

"""Dense tracking of curvature extrema informed by a dominant flow (VITAMIN-E, section 2)."""

from pliant.algorithms.tracking.parameters import TrackingParameters
from pliant.algorithms.tracking.tracker import ExtremaTracker, warm_up

__all__ = ["ExtremaTracker", "TrackingParameters", "warm_up"]

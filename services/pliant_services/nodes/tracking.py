"""Tracking: follows curvature extrema through the video.

in   camera/stream    once
     camera/image     every frame
out  tracks/extrema   one per frame, empty where the frame has no pixels
"""

import numpy as np

from pliant.algorithms.tracking.parameters import TrackingParameters
from pliant.algorithms.tracking.tracker import ExtremaTracker
from pliant.algorithms.tracks import FrameExtrema
from pliant.bus.base import Bus, receive_one, resume
from pliant.config import Config
from pliant.messages import topics
from pliant.messages.types import CameraStream, Extrema
from pliant_services.runtime.keeping_up import readers_that_may_lag
from pliant_services.runtime.link_images import clearance, receive_images
from pliant_services.runtime.monitor import Monitor


def run(bus: Bus, config: Config, monitor: Monitor) -> None:
    """Track until the images end."""

    def start() -> ExtremaTracker:
        stream = receive_one(bus, topics.STREAM, CameraStream)
        return ExtremaTracker(stream.width, stream.height, config.tracking, config.seed)

    tracker = resume(bus, start)
    for image in receive_images(bus):
        if image.missing:
            tracks = FrameExtrema.empty()
        else:
            tracks = tracker.track(image.grey, image.stamp_ns, monitor.stage, clearance(image))
        extrema = Extrema.of(image, tracks, missing=image.missing)
        may_lag = readers_that_may_lag(image)
        bus.publish(topics.EXTREMA, extrema, live=image.live, may_lag=may_lag)
        monitor.report(image, tracks=len(tracks.ids), maxima=len(tracks.maxima))
        bus.checkpoint(image.frame, tracker)


def warm_up() -> None:
    """Two frames of noise."""
    grey = np.random.default_rng(0).integers(0, 256, (120, 160), np.uint8)
    tracker = ExtremaTracker(160, 120, TrackingParameters())
    for stamp_ns in range(2):
        tracker.track(grey, stamp_ns)

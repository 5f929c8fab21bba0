"""Surfels: follows small patches of a deforming surface, each on its own, from a depth map on.

in   camera/stream    once
     camera/image     every frame
     camera/depth     every frame: empty, or a depth map: the first one starts the surfels
out  surfels/state    one per frame: all surfels, and the camera; empty without pixels
"""

import numpy as np

from pliant.algorithms.surfels import SurfelFrame, SurfelState, SurfelTracker
from pliant.bus.base import Bus, join, receive, receive_one, resume
from pliant.config import Config
from pliant.datasets.base import BrokenFrame
from pliant.datasets.calibration import calibration_from_yaml
from pliant.datasets.depth import DepthRectifier
from pliant.messages import topics
from pliant.messages.types import WORLD_FRAME_ID, CameraStream, Depth, Image, Surfels
from pliant_services.monitor import Monitor

WAITING = "waiting for depth"


def run(bus: Bus, config: Config, monitor: Monitor) -> None:
    """Follow surfels until the images end."""

    def start() -> tuple[CameraStream, SurfelTracker, bool]:
        stream = receive_one(bus, topics.STREAM, CameraStream)
        return stream, SurfelTracker(config.surfels), False

    stream, tracker, started = resume(bus, start)
    rectifier = DepthRectifier(calibration_from_yaml(stream.calibration))
    for image, depth in join(receive(bus, topics.IMAGE, Image), receive(bus, topics.DEPTH, Depth)):
        frame, missing = SurfelFrame.empty(), image.missing
        metres, note = None, ""
        if depth.data and not missing:
            try:
                metres = rectifier.rectify(depth.frame, depth.data)
            except BrokenFrame as error:
                note = str(error)
        if not missing and started:
            with monitor.stage("track"):
                frame = tracker.track(image.grey, depth=metres)
        elif not missing and metres is not None:
            with monitor.stage("start"):
                frame, started = tracker.start(image.grey, metres, stream.camera), True
        elif not missing:
            missing = WAITING
        message = Surfels.of(image, frame, frame_id=WORLD_FRAME_ID, missing=missing, note=note)
        bus.publish(topics.SURFELS, message)
        monitor.report(
            image,
            note=missing or note or ("tracking is lost" if frame.lost else ""),
            surfels=len(frame.ids),
            alive=np.count_nonzero(frame.state == SurfelState.TRACKED),
        )
        bus.checkpoint(image.frame, (stream, tracker, started))

"""The rigid pipeline in one process, without a bus: for benchmarks, ablations and scripts.

The same algorithms in the same order as the services run them, so the same numbers come out.
"""

from collections.abc import Iterator
from dataclasses import dataclass

from pliant.algorithms.map_delta import MapDelta
from pliant.algorithms.mapping.trial import mapper_for
from pliant.algorithms.stages import StageTimer, no_stages
from pliant.algorithms.tracking.tracker import ExtremaTracker
from pliant.algorithms.tracks import FrameTracks
from pliant.config import Config
from pliant.datasets.base import Dataset
from pliant.datasets.rectifier import Rectifier, rectified
from pliant.map_history import MapHistory
from pliant.messages.types import Image


@dataclass(frozen=True)
class Frame:
    """What one frame led to."""

    image: Image
    tracks: FrameTracks
    delta: MapDelta


@dataclass(frozen=True)
class Timers:
    """Stopwatches of the two algorithms."""

    tracking: StageTimer = no_stages
    bundle_adjustment: StageTimer = no_stages


def process(
    dataset: Dataset,
    config: Config,
    history: MapHistory,
    *,
    timers: Timers = Timers(),
) -> Iterator[Frame]:
    """Track and map every frame of a source; ``history`` is complete once the iterator ends."""
    rectifier = Rectifier(dataset.calibration)
    camera = rectifier.camera
    tracker = ExtremaTracker(camera.width, camera.height, config.tracking, config.seed)
    focal_sigma = dataset.calibration.focal_sigma
    mapper = mapper_for(camera, config.bundle_adjustment, config.seed, focal_sigma)
    last = 0
    for source in dataset:
        image = rectified(source, rectifier)
        if image.missing:
            tracks = FrameTracks.empty()
            delta = mapper.skip(image.frame)
        else:
            tracks = tracker.track(image.grey, timers.tracking)
            colour = image.colour if image.colour.size else None
            delta = mapper.process(
                image.frame, image.stamp_ns, tracks, image.grey, colour, timers.bundle_adjustment
            )
        history.apply(delta, frame=image.frame, stamp_ns=image.stamp_ns)
        yield Frame(image, tracks, delta)
        last = image.frame
    history.apply(mapper.finish(), frame=last, stamp_ns=0, final=True)

"""The rigid pipeline in one process, without a bus: for benchmarks, ablations and scripts.

The same algorithms in the same order as the services run them, so the same numbers come out.
"""

from dataclasses import dataclass

from pliant.algorithms.image.masks import clearance_in, filled
from pliant.algorithms.inertial.samples import ImuSamples
from pliant.algorithms.map_delta import MapDelta
from pliant.algorithms.slam.atlas.known_places import KnownPlaces
from pliant.algorithms.slam.calibration_bootstrap import mapper_for
from pliant.algorithms.slam.frame import Frame
from pliant.algorithms.slam.map.kept_keyframe import KeptKeyframe
from pliant.algorithms.slam.mapper import Mapper
from pliant.algorithms.stages import StageTimer, no_stages
from pliant.algorithms.tracking.tracker import ExtremaTracker
from pliant.algorithms.tracks import FrameExtrema
from pliant.config import Config
from pliant.datasets.base import SourceFrame
from pliant.datasets.calibration import Calibration
from pliant.datasets.rectifier import Rectifier, rectified
from pliant.map_history import MapHistory
from pliant.messages.types import Image


@dataclass(frozen=True)
class MappedFrame:
    """The results of one frame."""

    image: Image
    tracks: FrameExtrema
    delta: MapDelta


class Pipeline:
    """Tracker and mapper of one camera; ``history`` is complete after ``finish``."""

    def __init__(
        self,
        calibration: Calibration,
        config: Config,
        history: MapHistory,
        timer: StageTimer = no_stages,
        places: KnownPlaces | None = None,
    ) -> None:
        """timer: of the stages of both.    places: where the camera may be recognised, instead of a
        mapper's own.
        """
        self.history = history
        self._timer = timer
        self._rectifier = Rectifier(calibration)
        camera = self._rectifier.camera
        self._tracker = ExtremaTracker(camera.width, camera.height, config.tracking, config.seed)
        self._mapper = mapper_for(
            camera, config.bundle_adjustment, config.seed, calibration.focal_sigma
        )
        if places is not None and isinstance(self._mapper, Mapper):
            self._mapper.atlas.places = places
        self._last = 0

    def add_samples(self, samples: ImuSamples) -> None:
        """Take in the next inertial samples of the source."""
        self._mapper.add_samples(samples)

    def take(self, source: SourceFrame) -> MappedFrame:
        """Track and map the next frame."""
        image = rectified(source, self._rectifier)
        if image.missing:
            tracks = FrameExtrema.empty()
            delta = self._mapper.skip(image.frame)
        else:
            clearance = clearance_in(image.mask)
            tracks = self._tracker.track(image.grey, image.stamp_ns, self._timer, clearance)
            colour = image.colour if image.colour.size else None
            frame = Frame(
                image.frame, image.stamp_ns, tracks, filled(image.grey, clearance), colour
            )
            delta = self._mapper.process(frame, self._timer)
        self.history.apply(delta, frame=image.frame, stamp_ns=image.stamp_ns)
        self._last = image.frame
        return MappedFrame(image, tracks, delta)

    def finish(self, timer: StageTimer = no_stages) -> MapDelta:
        """The corrections at the end of the stream."""
        delta = self._mapper.finish(timer)
        self.history.apply(delta, frame=self._last, stamp_ns=0, final=True)
        return delta

    @property
    def counters(self) -> dict[str, float]:
        """As those of a mapper."""
        return self._mapper.counters

    def kept(self) -> list[KeptKeyframe]:
        """The map as it is to be kept, once it is finished."""
        return list(self._mapper.kept())

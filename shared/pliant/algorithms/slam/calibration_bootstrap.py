"""The mapper of a camera whose calibration is a guess.

A map that begins with a wrong focal length loses landmarks and poses for good.  So a first map is
made on trial, only to estimate the calibration, while its frames wait as they do for a start.  Once
the focal length is certain, or no more frames can wait, the map begins again with all of them and
with the estimated camera.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.inertial.samples import ImuSamples, append
from pliant.algorithms.map_delta import TRACKING, WAITING, KeyframeDelta, MapDelta
from pliant.algorithms.slam.adjust.global_adjustment import GlobalAdjustment
from pliant.algorithms.slam.calibration.self_calibration import is_guess, widened
from pliant.algorithms.slam.frame import Frame
from pliant.algorithms.slam.frame_mapper import FrameMapper
from pliant.algorithms.slam.journal import Journal, Outcome
from pliant.algorithms.slam.localiser import Localiser
from pliant.algorithms.slam.map.kept_keyframe import KeptKeyframe
from pliant.algorithms.slam.map.landmarks import Landmarks
from pliant.algorithms.slam.mapper import Mapper
from pliant.algorithms.slam.parameters import MappingParameters
from pliant.algorithms.slam.start.first_map import keep_newest
from pliant.algorithms.slam.store.kept_map import known_camera
from pliant.algorithms.stages import StageTimer, no_stages

_KNOWN = 0.01
"""Standard deviation of the log focal length below which the final map can begin."""


class _Taken(NamedTuple):
    """A frame that has been mapped on trial, or has only been localised."""

    frame: Frame
    is_mapped: bool = True

    @property
    def stamp_ns(self) -> int:
        """Capture time of the frame."""
        return self.frame.stamp_ns


class BootstrapMapper:
    """A ``FrameMapper`` that waits for its calibration.

    mapper: the trial, or the final one.    taken: during the trial, the newest frames.
    """

    def __init__(
        self,
        camera: PinholeCamera,
        parameters: MappingParameters,
        seed: int,
        known: Sequence[KeptKeyframe] = (),
    ) -> None:
        """known: as of ``Mapper``; the trial ignores it."""
        self._given = (camera, parameters, seed)
        self._known, self._samples = list(known), list[ImuSamples]()
        self._mapper = Mapper(camera, parameters, seed)
        self._taken: list[_Taken] = []
        self._on_trial = True

    def add_samples(self, samples: ImuSamples) -> None:
        """As ``Mapper.add_samples``; the trial ignores them."""
        if self._on_trial:
            append(self._samples, samples)
        else:
            self._mapper.add_samples(samples)

    def process(self, frame: Frame, timer: StageTimer = no_stages) -> MapDelta:
        """As ``Mapper.process``."""
        if not self._on_trial:
            return self._mapper.process(frame, timer)
        outcome = self._mapper.take(frame, timer)
        taken, first = _Taken(frame), self._first
        kept = keep_newest(self._taken, taken, self._given[1].start)
        uncertain = float(self._mapper.calibration.sigmas[0])
        ready = first is not None and (uncertain < _KNOWN or kept[0].frame.number > first)
        if ready and outcome.state == TRACKING:
            self._taken.append(taken)
            outcome = self._map_all_taken(timer)
            return self._mapper.publish(outcome)  # of another mapper by now
        self._taken = kept
        reason = outcome.reason or f"the focal length is known to {100.0 * uncertain:.1f} %"
        return _nothing(reason)

    def only_localise(self, frame: Frame, otherwise: str) -> MapDelta:
        """As ``Mapper.only_localise``; a trial continues until the next mapped frame."""
        if not self._on_trial:
            return self._mapper.only_localise(frame, otherwise)
        self._mapper.take_tracks(frame, otherwise)
        self._taken.append(_Taken(frame, is_mapped=False))
        return _nothing(otherwise)

    def skip(self, frame: int, reason: str = "the frame has no pixels") -> MapDelta:
        """As ``Mapper.skip``."""
        return _nothing(reason) if self._on_trial else self._mapper.skip(frame, reason)

    @property
    def waiting_frames(self) -> list[int]:
        """As ``Mapper.waiting_frames``."""
        if self._on_trial:
            return [taken.frame.number for taken in self._taken]
        return self._mapper.waiting_frames

    @property
    def global_adjustment(self) -> GlobalAdjustment:
        """As ``Mapper.global_adjustment``."""
        return self._mapper.global_adjustment

    @property
    def point_count(self) -> int:
        """As ``Mapper.point_count``."""
        return 0 if self._on_trial else self._mapper.point_count

    @property
    def counters(self) -> dict[str, float]:
        """As ``Mapper.counters``."""
        return {} if self._on_trial else self._mapper.counters

    def finish(self, timer: StageTimer = no_stages) -> MapDelta:
        """As ``Mapper.finish``; a trial still running ends first."""
        if self._on_trial and (self._first is not None or self._mapper.start_at_last()):
            self._map_all_taken(no_stages)
        return self._mapper.finish(timer)

    def kept(self) -> Iterator[KeptKeyframe]:
        """As ``Mapper.kept``; the loaded map if the trial found none."""
        return iter(self._known) if self._on_trial else self._mapper.kept()

    def publish_keyframes(self) -> KeyframeDelta:
        """As ``Mapper.publish_keyframes``."""
        if self._on_trial:
            return Journal(Landmarks()).publish_keyframes(None, self._mapper.calibration)
        return self._mapper.publish_keyframes()

    @property
    def _first(self) -> int | None:
        """The first frame that the trial gave a pose."""
        return self._mapper.journal.first_frame

    def _map_all_taken(self, timer: StageTimer) -> Outcome:
        """Map all waiting frames with the estimated camera.  Returns the newest outcome."""
        self._mapper = Mapper(*self._given, self._mapper.calibration, known=self._known)
        self._on_trial = False
        for samples in self._samples:
            self.add_samples(samples)
        self._samples = []
        taken, self._taken = self._taken, []
        return [self._map_again(each, timer) for each in taken][-1]

    def _map_again(self, taken: _Taken, timer: StageTimer) -> Outcome:
        if taken.is_mapped:
            outcome = self._mapper.take(taken.frame, timer)
        else:
            outcome = self._mapper.take_tracks(taken.frame, "")
        self._mapper.atlas.stay()
        return outcome


def mapper_for(
    camera: PinholeCamera,
    parameters: MappingParameters,
    seed: int,
    focal_sigma: float = 0.0,
    known: Sequence[KeptKeyframe] = (),
) -> FrameMapper:
    """Return the mapper for a camera, depending on how certain its calibration is: see ``widened``.

    known: a loaded map; if it is of the same camera, its calibration is used.
    """
    parameters = widened(parameters, focal_sigma)
    if parameters.only_localise:
        return Localiser(camera, parameters, seed, known=known)
    found = known_camera(known, camera)
    if is_guess(parameters.calibration) and (found is None or found.sigmas[0] > _KNOWN):
        return BootstrapMapper(camera, parameters, seed, known)
    return Mapper(camera, parameters, seed, known=known)


def _nothing(reason: str) -> MapDelta:
    """The update of a frame on trial."""
    return Journal(Landmarks()).publish(Outcome(WAITING, reason, 0, -1, np.zeros(3)))

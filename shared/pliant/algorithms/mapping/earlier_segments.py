"""Segments of the map that lost their camera: kept until they are recognised, or until the end,
when each is adjusted as a whole."""

from typing import NamedTuple

from pliant.algorithms.mapping.lens_change import see_by
from pliant.algorithms.mapping.map_store import PointRows
from pliant.algorithms.mapping.parameters import MappingParameters
from pliant.algorithms.mapping.segment import Segment
from pliant.algorithms.mapping.self_calibration import SelfCalibration


class _Earlier(NamedTuple):
    """A segment, and the calibration whose pixels its keyframes have.

    known: it is as an earlier session left it.
    """

    segment: Segment
    calibration: SelfCalibration
    known: bool


class EarlierSegments:
    """adjusted: those that have been adjusted, oldest first."""

    def __init__(self) -> None:
        self.adjusted: list[Segment] = []
        self._kept: list[_Earlier] = []

    def keep(self, segment: Segment, calibration: SelfCalibration, *, known: bool = False) -> None:
        """A segment has lost its camera, or an earlier session has mapped it."""
        self._kept.append(_Earlier(segment, calibration, known))

    def everything(self) -> list[tuple[Segment, SelfCalibration]]:
        """All of them, oldest first."""
        return [(each.segment, each.calibration) for each in self._kept]

    def like(self, calibration: SelfCalibration) -> list[Segment]:
        """Those whose keyframes have the pixels of a calibration, whatever its readout was, oldest
        first."""
        return [each.segment for each in self._kept if each.calibration.sees_like(calibration)]

    def see_by(self, before: SelfCalibration, known: SelfCalibration) -> None:
        """Those with the pixels of a calibration get those of a better one."""
        for n, each in enumerate(self._kept):
            if each.calibration.sees_like(before):
                see_by(each.segment, each.calibration.view, known)
                self._kept[n] = each._replace(calibration=known)

    def take(self, id: int) -> Segment:
        """A segment goes on."""
        (taken,) = (each for each in self._kept if each.segment.id == id)
        self._kept = [each for each in self._kept if each is not taken]
        return taken.segment

    def segment_of(self, keyframe: int) -> int:
        """That of a keyframe of one of them."""
        known = (k for each in self._kept for k in each.segment.keyframes)
        return next(k.segment for k in known if k.id == keyframe)

    def make_room(self, points: PointRows, max_keyframes: int) -> None:
        """Give back the oldest segments, which have been published, beyond so many keyframes of
        all together."""
        own = [each for each in self._kept if not each.known]
        while sum(len(e.segment.keyframes) + e.segment.culled for e in own) > max_keyframes:
            oldest = own.pop(0)
            points.cull(oldest.segment.mapped_rows())
            self._kept = [each for each in self._kept if each is not oldest]

    def adjust(self, parameters: MappingParameters) -> None:
        """Adjust each of them, no earlier than the end of the stream; what nobody has gone on in
        is as an earlier session left it."""
        for n, earlier in enumerate(self._kept):
            if not earlier.known:
                found = earlier.segment.adjust(earlier.calibration, parameters)
                self._kept[n] = earlier._replace(calibration=found)
        self.adjusted = [earlier.segment for earlier in self._kept if not earlier.known]

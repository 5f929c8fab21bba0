"""Segments that the camera has left: kept until they are recognised, or adjusted at the end."""

from typing import NamedTuple

import numpy as np

from pliant.algorithms.map_delta import MapMoves
from pliant.algorithms.slam.adjust.segment import InertialSource, Segment, see_by
from pliant.algorithms.slam.calibration.self_calibration import SelfCalibration
from pliant.algorithms.slam.map.landmarks import Landmarks
from pliant.algorithms.slam.parameters import MappingParameters, WindowParameters
from pliant.algorithms.slam.store.sparsification import observations_of, sparsify


class _Earlier(NamedTuple):
    """A segment, and the calibration whose pixels its keyframes have.

    known: unchanged since an earlier session.
    """

    segment: Segment
    calibration: SelfCalibration
    known: bool


class EarlierSegments:
    """adjusted: the adjusted ones, oldest first.   dropped_keyframes: of segments that exceeded the
    memory.
    """

    def __init__(self) -> None:
        self.adjusted: list[Segment] = []
        self.dropped_keyframes = 0
        self._kept: list[_Earlier] = []

    def keep(self, segment: Segment, calibration: SelfCalibration, *, known: bool = False) -> None:
        """Add a segment that lost its camera, or one of a loaded map."""
        self._kept.append(_Earlier(segment, calibration, known))

    def everything(self) -> list[tuple[Segment, SelfCalibration]]:
        """Return all of them, oldest first."""
        return [(each.segment, each.calibration) for each in self._kept]

    def like(self, calibration: SelfCalibration) -> list[Segment]:
        """Return the segments with the pixels of a calibration, whatever its readout,
        oldest first.
        """
        return [each.segment for each in self._kept if each.calibration.sees_like(calibration)]

    def see_by(self, before: SelfCalibration, known: SelfCalibration) -> None:
        """Convert the segments with the pixels of a calibration to those of a better one."""
        for n, each in enumerate(self._kept):
            if each.calibration.sees_like(before):
                see_by(each.segment, each.calibration.view, known)
                self._kept[n] = each._replace(calibration=known)

    def take(self, id: int) -> Segment:
        """Remove and return a segment that becomes active again."""
        (taken,) = (each for each in self._kept if each.segment.id == id)
        self._kept = [each for each in self._kept if each is not taken]
        return taken.segment

    def segment_of(self, keyframe: int) -> int:
        """Return the segment of one of their keyframes."""
        for segment in (each.segment for each in self._kept):
            known = {k.id for k in segment.keyframes}
            if keyframe in known or keyframe in segment.dropped.ids:
                return segment.id
        raise ValueError(f"keyframe {keyframe} is in no earlier segment")

    def share_room(self, points: Landmarks, limits: WindowParameters) -> int:
        """Return the maximum number of observations of the active segment.

        It is at least half of the whole.  The others are sparsified to share the rest equally; if
        that is not enough, the oldest stay as they were published.
        """
        room = limits.kept_observations // 2
        own = [each for each in self._kept if not each.known]
        size, rest = float(room), room
        sizes = sorted(observations_of([each.segment]) for each in own)
        for n, some in enumerate(sizes):
            size = rest / (len(sizes) - n)
            if some > size:
                break
            rest -= some

        def sparsify_earlier(whole: int) -> None:
            for each in own:
                sparsify(each.segment, int(size), limits, np.zeros(0, np.int32), whole=whole)

        sparsify_earlier(limits.keyframes)  # the newest may not be published yet
        if self._observations(own) > room:
            sparsify_earlier(1)
        while self._observations(own) > room:
            oldest = own.pop(0)
            self.dropped_keyframes += len(oldest.segment.keyframes) + len(oldest.segment.dropped)
            points.cull(oldest.segment.mapped_rows())
            self._kept = [each for each in self._kept if each is not oldest]
        return limits.kept_observations - self._observations(own)

    @staticmethod
    def _observations(some: list[_Earlier]) -> int:
        return observations_of([each.segment for each in some])

    def adjust(
        self, parameters: MappingParameters, inertial: InertialSource | None = None
    ) -> list[tuple[int, MapMoves]]:
        """Adjust each of them at the end of the stream, except unchanged segments of a loaded map.

        Returns the moves of each segment, by its number, and of what it has dropped.
        """
        moves: list[tuple[int, MapMoves]] = []
        for n, earlier in enumerate(self._kept):
            if not earlier.known:
                back = earlier.segment.back()
                if back is not None:
                    earlier.segment.move(back)
                found, moved = earlier.segment.adjust(earlier.calibration, parameters, inertial)
                self._kept[n] = earlier._replace(calibration=found)
                moves += [(earlier.segment.id, each) for each in (back, moved) if each is not None]
        self.adjusted = [earlier.segment for earlier in self._kept if not earlier.known]
        return moves

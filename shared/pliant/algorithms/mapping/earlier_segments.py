"""Segments of the map that lost their camera: kept until they are recognised, or until the end,
when each is adjusted as a whole."""

from typing import NamedTuple

from pliant.algorithms.mapping.active_map import ActiveMap
from pliant.algorithms.mapping.map_store import PointRows
from pliant.algorithms.mapping.rolling_shutter import Path
from pliant.algorithms.mapping.self_calibration import SelfCalibration


class _Earlier(NamedTuple):
    """A segment, the poses of its frames, and the calibration whose pixels its keyframes have.

    known: it is as an earlier session left it.
    """

    map: ActiveMap
    path: Path
    calibration: SelfCalibration
    known: bool = False


class EarlierSegments:
    """adjusted: those that have been adjusted, oldest first."""

    def __init__(self) -> None:
        self.adjusted: list[ActiveMap] = []
        self._kept: list[_Earlier] = []

    def keep(self, active: ActiveMap, path: Path, calibration: SelfCalibration) -> None:
        """A segment has lost its camera."""
        active.close()
        self._kept.append(_Earlier(active, path, calibration))

    def know(self, known: ActiveMap, path: Path, calibration: SelfCalibration) -> None:
        """A segment of an earlier session, in which the camera may be recognised."""
        self._kept.append(_Earlier(known, path, calibration, known=True))

    def everything(self) -> list[tuple[ActiveMap, Path, SelfCalibration]]:
        """All of them, oldest first."""
        return [(each.map, each.path, each.calibration) for each in self._kept]

    def maps(self, calibration: SelfCalibration) -> list[ActiveMap]:
        """Those whose keyframes have the pixels of a calibration, whatever its readout was, oldest
        first."""
        view = calibration.view
        known = view.camera, view.lens
        views = [each.calibration.view for each in self._kept]
        same = [(view.camera, view.lens) == known for view in views]
        return [e.map for e, fits in zip(self._kept, same, strict=True) if fits]

    def take(self, segment: int) -> tuple[ActiveMap, Path]:
        """A segment goes on."""
        (taken,) = (each for each in self._kept if each.map.segment == segment)
        self._kept = [each for each in self._kept if each is not taken]
        return taken.map, taken.path

    def segment_of(self, keyframe: int) -> int:
        """That of a keyframe of one of them."""
        known = (k for each in self._kept for k in each.map.keyframes)
        return next(k.segment for k in known if k.id == keyframe)

    def make_room(self, points: PointRows, max_keyframes: int) -> None:
        """Give back the oldest segments, which have been published, beyond so many keyframes of
        all together."""
        own = [each for each in self._kept if not each.known]
        while sum(len(each.map.keyframes) + each.map.culled for each in own) > max_keyframes:
            oldest = own.pop(0)
            points.cull(oldest.map.mapped_rows())
            self._kept = [each for each in self._kept if each is not oldest]

    def adjust(self) -> None:
        """Adjust each of them, no earlier than the end of the stream; what nobody has gone on in
        is as an earlier session left it."""
        for n, earlier in enumerate(self._kept):
            if not earlier.known:
                found = earlier.map.adjust_all(earlier.path, earlier.calibration)
                self._kept[n] = earlier._replace(calibration=found)
        self.adjusted = [earlier.map for earlier in self._kept if not earlier.known]

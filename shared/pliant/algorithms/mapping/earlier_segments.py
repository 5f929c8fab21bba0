"""Segments of the map that lost their camera: kept until they are recognised, or until the end,
when each is adjusted as a whole."""

from typing import NamedTuple

from pliant.algorithms.mapping.active_map import ActiveMap
from pliant.algorithms.mapping.map_store import PointRows
from pliant.algorithms.mapping.rolling_shutter import Path
from pliant.algorithms.mapping.self_calibration import SelfCalibration


class _Earlier(NamedTuple):
    """A segment, the poses of its frames, and the calibration whose pixels its keyframes have."""

    map: ActiveMap
    path: Path
    calibration: SelfCalibration


class EarlierSegments:
    """adjusted: those that have been adjusted, oldest first."""

    def __init__(self) -> None:
        self.adjusted: list[ActiveMap] = []
        self._kept: list[_Earlier] = []

    def keep(self, active: ActiveMap, path: Path, calibration: SelfCalibration) -> None:
        """A segment has lost its camera."""
        active.close()
        self._kept.append(_Earlier(active, path, calibration))

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

    def make_room(self, points: PointRows, max_keyframes: int) -> None:
        """Give back the oldest segments, which have been published, beyond so many keyframes of
        all together."""
        while sum(len(each.map.keyframes) + each.map.culled for each in self._kept) > max_keyframes:
            points.cull(self._kept.pop(0).map.mapped_rows())

    def adjust(self) -> None:
        """Adjust each of them, no earlier than the end of the stream."""
        for earlier in self._kept:
            earlier.map.adjust_all(earlier.path, earlier.calibration)
        self.adjusted = [earlier.map for earlier in self._kept]

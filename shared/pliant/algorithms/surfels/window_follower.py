"""Camera and equilibrium of surfels by the map of the last seconds of a scene that deforms.

The equilibrium (Eq. 20) places the camera as if each surfel were near its birth place.  A window
knows better: its camera follows from what is stiff, and its landmarks tell where the surface rests
and how far it moves.
"""

from dataclasses import dataclass, field

import numpy as np

from pliant.algorithms.arrays import F64, I64
from pliant.algorithms.deformable.priors import STIFF
from pliant.algorithms.deformable.window import SPAN_NS, WindowMap
from pliant.algorithms.geometry import inverse, transform
from pliant.algorithms.surfels.surfel_frame import SurfelFrame, SurfelState
from pliant.algorithms.surfels.surfel_tracker import SurfelTracker

_AROUND = 4
"""Landmarks around a surfel."""
_FEWEST = 8
"""Surfels that determine a unit."""


@dataclass(frozen=True)
class _Seen:
    """The camera (4, 4) of a frame, and its tracked surfels in it (S, 3)."""

    stamp_ns: int
    T_world_camera: F64
    in_camera: F64


@dataclass
class WindowFollower:
    """deforms: whether the last window is trusted.    ratio: units of the surfels by one of the
    windows, 0 before the first of those that continue each other.    seen: frames that a window may
    have, since the last one that placed the camera."""

    deforms: bool = False
    ratio: float = 0.0
    seen: dict[int, _Seen] = field(default_factory=dict[int, _Seen])
    newest: WindowMap | None = None

    def note(self, frame: int, stamp_ns: int, surfels: SurfelFrame) -> None:
        """Remember a frame, which must have pixels."""
        if surfels.lost:
            self.seen = {}
            return
        tracked = surfels.state == SurfelState.TRACKED
        T = surfels.T_world_camera.copy()
        in_camera = transform(inverse(T), surfels.positions[tracked])
        self.seen[frame] = _Seen(stamp_ns, T, in_camera)
        for old in [n for n, seen in self.seen.items() if stamp_ns - seen.stamp_ns > SPAN_NS]:
            del self.seen[old]

    def take(self, found: WindowMap) -> WindowMap | None:
        """The window of a frame, if it has one that is trusted."""
        if found.problem:
            self.deforms, self.ratio = False, 0.0
        if not len(found.frames):
            return None
        self.deforms, self.newest = True, found
        return found

    def place(self, tracker: SurfelTracker, surfels: SurfelFrame) -> float:
        """Place the camera by the newest window; returns the ratio.

        surfels: in the newest keyframe.    The camera moves as in the window, since the first of
        its keyframes that is known: if possible the last one that was placed so.
        """
        found = self.newest
        assert found is not None
        rows = [row for row, frame in enumerate(found.frames.tolist()) if frame in self.seen]
        if not rows:
            return self.ratio or 1.0
        since = self.seen[int(found.frames[rows[0]])]
        self.seen = {}
        if not self.ratio:
            self.ratio = _ratio(found, rows[0], since)
        motion = inverse(found.T_world_camera[rows[0]]) @ found.T_world_camera[-1]
        motion[:3, 3] *= self.ratio
        T_world_camera = since.T_world_camera @ motion
        _settle(tracker, tracker.place(T_world_camera), found, self.ratio)
        return self.ratio


def _ratio(found: WindowMap, row: int, seen: _Seen) -> float:
    """Units of the surfels by one of the window, in one of its keyframes: 1 for too few surfels."""
    points = found.rest + found.moved()[row]
    points = transform(inverse(found.T_world_camera[row]), points)
    points = points[points[:, 2] > 0.0]
    there = seen.in_camera[seen.in_camera[:, 2] > 0.0]
    if len(there) < _FEWEST or len(points) < _AROUND:
        return 1.0
    near = _nearest(there[:, :2] / there[:, 2:], points[:, :2] / points[:, 2:])
    return float(np.median(there[:, 2] / points[near, 2].mean(axis=1)))


def _settle(tracker: SurfelTracker, surfels: SurfelFrame, found: WindowMap, ratio: float) -> None:
    """Surfels rest where the landmarks around them do, and move as far."""
    T = surfels.T_world_camera
    tracked = np.flatnonzero(surfels.state == SurfelState.TRACKED)
    in_view = found.in_view
    landmarks_px = found.points_px[in_view].astype(np.float64)
    near = in_view[_nearest(surfels.points_px[tracked].astype(np.float64), landmarks_px)]
    moved = ratio * found.moved()[:, near].mean(axis=2)  # (K, S, 3), the window's axes
    now = moved[-1] @ (T[:3, :3] @ found.T_world_camera[-1, :3, :3].T).T
    positions = surfels.positions[tracked]
    sizes = np.sqrt((moved**2).sum(axis=2).mean(axis=0))
    depths = transform(inverse(T), positions)[:, 2]
    tracker.settle(tracked, positions - now, np.hypot(sizes, STIFF * depths))


def _nearest(points: F64, others: F64) -> I64:
    """(P, _AROUND) rows of the nearest others of points (P, 2)."""
    squares = ((points[:, None] - others[None]) ** 2).sum(axis=2)
    return np.argsort(squares, axis=1, kind="stable")[:, :_AROUND]

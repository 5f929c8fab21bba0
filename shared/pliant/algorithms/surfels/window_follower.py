"""Camera and equilibrium of surfels by the map of the last seconds of a scene that deforms.

The equilibrium (Eq. 20) places the camera as if each surfel were near its birth place.  A window
knows better: its camera follows from what is stiff, and its landmarks tell where the surface rests
and how far it moves.
"""

from dataclasses import dataclass, field

import numpy as np

from pliant.algorithms.arrays import F64, I64
from pliant.algorithms.deformable.deforming_window import SPAN_NS
from pliant.algorithms.deformable.moving_landmarks import WindowMap
from pliant.algorithms.deformable.priors import STIFF
from pliant.algorithms.geometry import inverse, transform
from pliant.algorithms.surfels.surfel_frame import SurfelFrame, SurfelState
from pliant.algorithms.surfels.surfel_tracker import SurfelTracker

_AROUND = 4
"""Landmarks around a surfel."""


@dataclass
class WindowFollower:
    """deforms: whether the last window is trusted.    segment: of the surfels.
    cameras: stamp, and T_world_camera (4, 4), of frames of that segment which a window may have,
    since the last one that placed the camera."""

    deforms: bool = False
    segment: int = 0
    cameras: dict[int, tuple[int, F64]] = field(default_factory=dict[int, tuple[int, F64]])

    def note(self, frame: int, stamp_ns: int, surfels: SurfelFrame) -> None:
        """Remember a frame, which must have pixels."""
        if surfels.lost or surfels.segment != self.segment:  # another segment is another world
            self.cameras, self.segment = {}, surfels.segment
        if surfels.lost:
            return
        self.cameras[frame] = stamp_ns, surfels.T_world_camera.copy()
        for old in [n for n, (at, _) in self.cameras.items() if stamp_ns - at > SPAN_NS]:
            del self.cameras[old]

    def judge(self, found: WindowMap) -> bool:
        """Whether a frame has a window that is trusted."""
        if found.problem:
            self.deforms = False
        is_trusted = len(found.frames) > 0
        self.deforms = self.deforms or is_trusted
        return is_trusted

    def place(self, tracker: SurfelTracker, surfels: SurfelFrame, found: WindowMap) -> float:
        """Place the camera by a window; returns units of the surfels by one of the window.

        surfels: in the newest keyframe, not lost.    The camera moves as in the window, since the
        first of its keyframes that is known: if possible the last one that was placed so.
        """
        ratio = _ratio(found, surfels)
        known = self.cameras if surfels.segment == self.segment else {}
        rows = [row for row, frame in enumerate(found.frames.tolist()) if frame in known]
        if rows:
            motion = inverse(found.T_world_camera[rows[0]]) @ found.T_world_camera[-1]
            motion[:3, 3] *= ratio
            surfels = tracker.place(known[int(found.frames[rows[0]])][1] @ motion)
        self.cameras = {}
        _settle(tracker, surfels, found, ratio)
        return ratio


def _ratio(found: WindowMap, surfels: SurfelFrame) -> float:
    """Units of the surfels by one of the window: the median of their depths by the landmarks'."""
    tracked = np.flatnonzero(surfels.state == SurfelState.TRACKED)
    near = _landmarks_around(found, surfels, tracked)
    landmarks = transform(inverse(found.T_world_camera[-1]), found.rest + found.moved()[-1])
    depths = transform(inverse(surfels.T_world_camera), surfels.positions[tracked])[:, 2]
    return float(np.median(depths / landmarks[near, 2].mean(axis=1)))


def _settle(tracker: SurfelTracker, surfels: SurfelFrame, found: WindowMap, ratio: float) -> None:
    """Surfels rest where the landmarks around them do, and move as far."""
    T = surfels.T_world_camera
    tracked = np.flatnonzero(surfels.state == SurfelState.TRACKED)
    near = _landmarks_around(found, surfels, tracked)
    moved = ratio * found.moved()[:, near].mean(axis=2)  # (K, S, 3), the window's axes
    now = moved[-1] @ (T[:3, :3] @ found.T_world_camera[-1, :3, :3].T).T
    positions = surfels.positions[tracked]
    sizes = np.sqrt((moved**2).sum(axis=2).mean(axis=0))
    depths = transform(inverse(T), positions)[:, 2]
    tracker.settle(tracked, positions - now, np.hypot(sizes, STIFF * depths))


def _landmarks_around(found: WindowMap, surfels: SurfelFrame, tracked: I64) -> I64:
    """(S, _AROUND) the nearest landmarks in the image."""
    rows = found.in_view
    apart = surfels.points_px[tracked, None].astype(np.float64) - found.points_px[rows]
    return rows[np.argsort((apart**2).sum(axis=2), axis=1, kind="stable")[:, :_AROUND]]

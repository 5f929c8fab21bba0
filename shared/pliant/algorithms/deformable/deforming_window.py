"""The map of the last seconds, while the scene deforms: a sliding adjustment.

Once a second cameras, rest shape and displacements of the last keyframes are adjusted together
(``adjustment.py``), and judged by tracks of their own (``judged_map.py``).  A few seconds determine
the shape as well as a whole run does.  They determine world and unit less well, as the rigid map
from which they start is wrong.  So keyframes that an earlier window had start where it left them,
later ones by the rigid map's motion, and the unit is that in which landmarks keep the depths that
the earlier window found.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from pliant.algorithms.arrays import F32, F64, I64
from pliant.algorithms.deformable.judged_map import INTERVAL_NS, JudgedMap, judged_map
from pliant.algorithms.deformable.moving_landmarks import WindowMap
from pliant.algorithms.geometry import inverse, transform
from pliant.algorithms.slam.calibration.corrected_view import CorrectedView

SPAN_NS = 3_000_000_000
"""Of a window: 2 s determine the shape half as well, 4 s are no better."""
_FILLED = 0.6
"""Share of it that the first window must cover."""
_EVERY_NS = 1_000_000_000 - INTERVAL_NS // 2
"""Between two adjustments: a second, less half a keyframe's interval."""
SIGMA = 0.003
"""Standard deviation of a landmark's depth, as a share of it, on rendered scenes."""


@dataclass
class _Keyframe:
    """T_world_camera, depths: (4, 4), and (N,) of the tracks, as a trusted window found them; NaN
    where it found none."""

    frame: int
    stamp_ns: int
    ids: I64
    points_px: F32
    T_world_camera: F64 | None
    depths: F64


@dataclass
class DeformingWindow:
    """Keyframes of the last seconds, the oldest first."""

    keyframes: list[_Keyframe] = field(default_factory=list[_Keyframe])
    adjusted_ns: int = -(1 << 62)

    def take(self, frame: int, stamp_ns: int, ids: I64, points_px: F32) -> bool:
        """Take in the tracks (N,), (N, 2) px of a frame; whether an adjustment is due."""
        if self.keyframes and stamp_ns - self.keyframes[-1].stamp_ns < INTERVAL_NS:
            return False
        unknown = np.full(len(ids), np.nan)
        self.keyframes.append(_Keyframe(frame, stamp_ns, ids, points_px, None, unknown))
        self.keyframes = [k for k in self.keyframes if stamp_ns - k.stamp_ns < SPAN_NS]
        covered_ns = stamp_ns - self.keyframes[0].stamp_ns
        return covered_ns >= _FILLED * SPAN_NS and stamp_ns - self.adjusted_ns >= _EVERY_NS

    def adjust(self, rigid: Mapping[int, F64], view: CorrectedView) -> WindowMap:
        """Adjust all keyframes that the rigid map has.

        rigid: T_world_camera (4, 4) by frame.    view: of the camera as the rigid map corrects it.
        """
        self.adjusted_ns = self.keyframes[-1].stamp_ns
        keyframes = [k for k in self.keyframes if k.frame in rigid]
        if not keyframes or keyframes[-1] is not self.keyframes[-1]:
            return WindowMap(problem="the rigid map has lost the camera")
        judged = judged_map(
            [k.ids for k in keyframes],
            [view.pixels(k.points_px).astype(np.float64) for k in keyframes],
            _start(keyframes, rigid),
            view.camera,
            deforms=keyframes[0].T_world_camera is not None,
        )
        if isinstance(judged, str) or judged.problem:
            for keyframe in keyframes:
                keyframe.T_world_camera = None
                keyframe.depths = np.full(len(keyframe.ids), np.nan)
            return WindowMap(problem=judged if isinstance(judged, str) else judged.problem)
        return _kept(judged, keyframes)


def _start(keyframes: list[_Keyframe], rigid: Mapping[int, F64]) -> F64:
    """(K, 4, 4) where the adjustment starts."""
    out: list[F64] = []
    for n, keyframe in enumerate(keyframes):
        here = rigid[keyframe.frame]
        if keyframe.T_world_camera is not None:
            here = keyframe.T_world_camera
        elif n and keyframes[0].T_world_camera is not None:
            here = out[-1] @ inverse(rigid[keyframes[n - 1].frame]) @ here
        out.append(here)
    return np.array(out)


def _kept(judged: JudgedMap, keyframes: list[_Keyframe]) -> WindowMap:
    """What the window found, in the unit of earlier windows, which is kept for later ones.

    Scaled about the first camera: no pixel changes.
    """
    found, tracks = judged.found, judged.tracks
    certain = found.reliable[tracks.landmarks]
    points_px = np.full((len(judged.ids), 2), np.nan, np.float32)
    depths, ratios = list[F64](), list[F64]()
    for k, keyframe in enumerate(keyframes):
        landmarks = tracks.landmarks[certain & (tracks.keyframes == k)]
        rows = np.searchsorted(keyframe.ids, judged.ids[landmarks])
        z = np.full(len(keyframe.ids), np.nan)
        there = transform(inverse(found.T_world_camera[k]), found.positions(k)[landmarks])
        z[rows] = there[:, 2]
        depths.append(z)
        both = np.isfinite(z) & np.isfinite(keyframe.depths)
        ratios.append(keyframe.depths[both] / z[both])
        if keyframe is keyframes[-1]:
            points_px[landmarks] = keyframe.points_px[rows]
    earlier = np.concatenate(ratios)
    unit = float(np.median(earlier)) if len(earlier) else 1.0
    centre, T = found.T_world_camera[0, :3, 3].copy(), found.T_world_camera.copy()

    def scaled(points: F64) -> F64:
        return centre + unit * (points - centre)

    T[:, :3, 3] = scaled(T[:, :3, 3])
    for k, keyframe in enumerate(keyframes):
        keyframe.T_world_camera, keyframe.depths = T[k], unit * depths[k]
    kept = np.flatnonzero(found.reliable)
    return WindowMap(
        frames=np.array([keyframe.frame for keyframe in keyframes], np.int64),
        T_world_camera=T,
        ids=judged.ids[kept],
        points_px=points_px[kept],
        rest=scaled(found.rest[kept]),
        displacements=unit * found.displacements,
        carriers=found.carriers[kept],
        weights=found.weights[kept],
    )

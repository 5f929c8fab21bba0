"""The map of the last seconds, while the scene deforms: a sliding adjustment.

Once a second cameras, rest shape and displacements of the last keyframes are adjusted together
(``adjustment.py``), and judged by tracks of their own (``judged_map.py``).  A few seconds determine
the shape as well as a whole run does.  They determine world and unit less well, as the rigid map
from which they start is wrong.  So keyframes that an earlier window had start where it left them.
Later ones start where it was followed to (``frame_camera.py``), or else by the rigid map's motion.
The unit is that in which landmarks keep the depths that the earlier window found.

A trusted window is followed until the next one.  One that is not trusted leaves it in force, as
long as the camera sees its landmarks.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from pliant.algorithms.arrays import F32, F64, I64
from pliant.algorithms.deformable.frame_camera import FrameCamera, frame_camera
from pliant.algorithms.deformable.judged_map import INTERVAL_NS, JudgedMap, judged_map
from pliant.algorithms.deformable.moving_landmarks import DeformingMap, WindowMap
from pliant.algorithms.geometry import inverse, transform
from pliant.algorithms.slam.calibration.corrected_view import CorrectedView

SPAN_NS = 3_000_000_000
"""Of a window: 2 s determine the shape half as well, 4 s are no better."""
_FILLED = 0.3
"""Share of it that the first window must cover: with 0.2 that of a camera which travels little is
refused."""
_EVERY_NS = 1_000_000_000 - INTERVAL_NS // 2
"""Between two adjustments: a second, less half a keyframe's interval."""
SIGMA = 0.003
"""Standard deviation of a landmark's depth, as a share of it, on rendered scenes."""


@dataclass
class _Keyframe:
    """T_world_camera, depths: (4, 4), and (N,) of the tracks, as a trusted window found them; NaN
    where it found none.  Of a later keyframe the pose to which that window was followed."""

    frame: int
    stamp_ns: int
    ids: I64
    points_px: F32
    T_world_camera: F64 | None
    depths: F64


@dataclass
class DeformingWindow:
    """Keyframes of the last seconds, the oldest first.

    between: keyframes of the rigid map between them, where surfels may have started, until a window
    is trusted.    followed: the last window, if it is trusted.
    """

    keyframes: list[_Keyframe] = field(default_factory=list[_Keyframe])
    between: list[_Keyframe] = field(default_factory=list[_Keyframe])
    adjusted_ns: int = -(1 << 62)
    followed: FrameCamera | None = None

    def follow(self, ids: I64, points_px: F32, view: CorrectedView) -> F64 | None:
        """T_world_camera (4, 4) of a frame by the last window, None where none is trusted.

        ids, points_px: its tracks (N,), (N, 2) px.    view: as of ``adjust``.
        """
        if self.followed is None:
            return None
        pixels = view.pixels(points_px).astype(np.float64)
        return self.followed.follow(ids, pixels, view.camera)

    def take(
        self,
        frame: int,
        stamp_ns: int,
        ids: I64,
        points_px: F32,
        T_world_camera: F64 | None = None,
        *,
        of_map: bool = False,
    ) -> bool:
        """Take in the tracks (N,), (N, 2) px of a frame; whether an adjustment is due.

        T_world_camera: (4, 4) by the last window.    of_map: whether it is a keyframe of the rigid
        map.
        """
        taken = _Keyframe(
            frame, stamp_ns, ids, points_px, T_world_camera, np.full(len(ids), np.nan)
        )
        if self.keyframes and stamp_ns - self.keyframes[-1].stamp_ns < INTERVAL_NS:
            if of_map and self.followed is None:
                self.between.append(taken)
            return False
        self.keyframes.append(taken)
        self.keyframes = [k for k in self.keyframes if stamp_ns - k.stamp_ns < SPAN_NS]
        self.between = [k for k in self.between if stamp_ns - k.stamp_ns < SPAN_NS]
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
        continues = keyframes[0].T_world_camera is not None
        judged = judged_map(
            [k.ids for k in keyframes],
            [view.pixels(k.points_px).astype(np.float64) for k in keyframes],
            _start(keyframes, rigid),
            view.camera,
            must_deform=not continues,
        )
        if isinstance(judged, str) or judged.problem:
            if keyframes[-1].T_world_camera is None:
                self._forget()
            return WindowMap(problem=judged if isinstance(judged, str) else judged.problem)
        out, whole = _kept(judged, keyframes)
        self.followed = frame_camera(whole, judged.ids)
        if not continues:
            out = _with_between(out, whole, judged.ids, self.between, view)
        self.between = []
        return out

    def _forget(self) -> None:
        """Start anew from the rigid map: no trusted window has the camera."""
        self.followed = None
        for keyframe in self.keyframes:
            keyframe.T_world_camera = None
            keyframe.depths = np.full(len(keyframe.ids), np.nan)


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


def _kept(judged: JudgedMap, keyframes: list[_Keyframe]) -> tuple[WindowMap, DeformingMap]:
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
    in_unit = replace(
        found,
        T_world_camera=T,
        depth=unit * found.depth,
        spacing=unit * found.spacing,
        rest=scaled(found.rest),
        nodes=scaled(found.nodes),
        displacements=unit * found.displacements,
    )
    return WindowMap(
        frames=np.array([keyframe.frame for keyframe in keyframes], np.int64),
        T_world_camera=T,
        ids=judged.ids[kept],
        points_px=points_px[kept],
        rest=in_unit.rest[kept],
        displacements=in_unit.displacements,
        carriers=found.carriers[kept],
        weights=found.weights[kept],
    ), in_unit


def _with_between(
    window: WindowMap, found: DeformingMap, ids: I64, between: list[_Keyframe], view: CorrectedView
) -> WindowMap:
    """Each followed from the nearest keyframe."""
    frames, poses = list[int](), list[F64]()
    for each in between:
        nearest = int(np.abs(window.frames - each.frame).argmin())
        here = frame_camera(found, ids, nearest)
        pixels = view.pixels(each.points_px).astype(np.float64)
        pose = here.follow(each.ids, pixels, view.camera)
        if pose is not None:
            frames.append(each.frame)
            poses.append(pose)
    T = np.array(poses).reshape(-1, 4, 4)
    return replace(window, between=np.array(frames, np.int64), T_between=T)

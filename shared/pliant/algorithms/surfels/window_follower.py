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
    """deforms: whether a trusted window has the frame.    segment: of the surfels.
    cameras: stamp, and T_world_camera (4, 4), of frames of that segment which a window may have.
    from_start: whether they are all of the segment.    placed: T_world_camera (4, 4) by keyframe of
    the last trusted window, and by frame since.    ratio, T_surfels_window: unit of the surfels by
    that of this window, and then the motion (4, 4) between their worlds."""

    deforms: bool = False
    segment: int = 0
    cameras: dict[int, tuple[int, F64]] = field(default_factory=dict[int, tuple[int, F64]])
    from_start: bool = True
    placed: dict[int, F64] = field(default_factory=dict[int, F64])
    ratio: float = 1.0
    T_surfels_window: F64 = field(default_factory=lambda: np.eye(4))

    def camera(self, frame: int, found: WindowMap) -> F64 | None:
        """T_world_camera (4, 4) of a frame in the world of the surfels, if the last trusted window
        has it."""
        if not self.placed or not len(found.T_frame):
            return None
        here = found.T_frame[0].copy()
        here[:3, 3] *= self.ratio
        self.placed[frame] = self.T_surfels_window @ here
        return self.placed[frame]

    def note(self, frame: int, stamp_ns: int, surfels: SurfelFrame) -> None:
        """Remember a frame, which must have pixels."""
        if surfels.lost or surfels.segment != self.segment:  # another segment is another world
            self.cameras, self.placed, self.segment = {}, {}, surfels.segment
            self.from_start = not surfels.lost and not surfels.age.any()
        if surfels.lost:
            return
        self.cameras[frame] = stamp_ns, surfels.T_world_camera.copy()
        for old in [n for n, (at, _) in self.cameras.items() if stamp_ns - at > SPAN_NS]:
            del self.cameras[old]
            self.from_start = False
        if not self.from_start:
            oldest = next(iter(self.cameras))
            self.placed = {n: T for n, T in self.placed.items() if n >= oldest}

    def judge(self, found: WindowMap) -> bool:
        """Whether a frame has a window that is trusted."""
        is_trusted = len(found.frames) > 0
        self.deforms = is_trusted or len(found.T_frame) > 0
        return is_trusted

    def place(self, tracker: SurfelTracker, surfels: SurfelFrame, found: WindowMap) -> float:
        """Place the camera by a window; returns units of the surfels by one of the window.

        surfels: in the newest keyframe, not lost.    A window that continues a trusted one stays in
        its world: it is laid on the mean of their common cameras, without the newest, the least
        certain.  Another is laid on the surfels' camera where they started, which is exact, or else
        on the mean of their later ones, whose errors go to and fro with the scene.
        """
        ratio = _ratio(found, surfels)
        cameras = found.T_world_camera.copy()
        cameras[:, :3, 3] *= ratio
        frames, same = found.frames.tolist(), surfels.segment == self.segment
        of_frame = dict(zip(frames, cameras, strict=True))
        between = found.T_between.copy()
        between[:, :3, 3] *= ratio
        every = of_frame | dict(zip(found.between.tolist(), between, strict=True))
        placed = [frame for frame in frames if same and frame in self.placed]
        noted = [frame for frame in sorted(every) if same and frame in self.cameras]
        if placed:
            pairs = [(self.placed[frame], of_frame[frame]) for frame in placed[:-1] or placed]
        elif noted:
            some = noted[:1] if self.from_start else noted
            pairs = [(self.cameras[frame][1], every[frame]) for frame in some]
        else:
            pairs = [(surfels.T_world_camera, cameras[-1])]
        motions = np.array([there @ inverse(here) for there, here in pairs])
        middle = ratio * found.rest.mean(axis=0)
        self.T_surfels_window = _mean_motion(motions, middle)
        self.ratio, cameras = ratio, self.T_surfels_window @ cameras
        self.placed = dict(zip(frames, cameras, strict=True))
        surfels = tracker.place(cameras[-1])
        _settle(tracker, surfels, found, ratio)
        return ratio


def _mean_motion(T: F64, middle: F64) -> F64:
    """Mean (4, 4) of rigid motions T (N, 4, 4) of what lies around ``middle`` (3,)."""
    U, _, Vt = np.linalg.svd(T[:, :3, :3].mean(axis=0))
    out = np.eye(4)
    out[:3, :3] = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    out[:3, 3] = transform(T.mean(axis=0), middle[None])[0] - out[:3, :3] @ middle
    return out


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

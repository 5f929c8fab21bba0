"""Later surfels compared with exact ground truth, and a scale that is not metric.

As in ``exact_surfels`` each is judged by the place of the material point that it was born on; the
world is that of the first frame's surfels.
"""

from dataclasses import dataclass, replace

import numpy as np

from pliant.algorithms.arrays import F64, I64
from pliant.algorithms.geometry import inverse, transform
from pliant.algorithms.surfels.surfel_frame import SurfelFrame, SurfelState
from pliant.evaluation.surface_truth import MaterialPoints, SurfaceTruth
from pliant.evaluation.surfel_truth import rmse


def true_scale(frame: int, surfels: SurfelFrame, truth: SurfaceTruth) -> float:
    """Metres by a unit of the surfels: the median of their depths in the frame of their birth."""
    points = truth.at_pixels(frame, surfels.points_px)
    exact = transform(inverse(truth.T_world_camera[frame]), truth.positions(points, frame))
    found = transform(inverse(surfels.T_world_camera), surfels.positions)
    return float(np.nanmedian(exact[:, 2] / found[:, 2]))


def scaled(surfels: SurfelFrame, scale: float) -> SurfelFrame:
    """The same surfels in units that are smaller by ``scale``."""
    T = surfels.T_world_camera.copy()
    T[:3, 3] *= scale
    return replace(
        surfels,
        T_world_camera=T,
        positions=scale * surfels.positions,
        tangents=scale * surfels.tangents,
        sigma=np.float32(scale) * surfels.sigma,
        tried=scale * surfels.tried,
    )


@dataclass(frozen=True)
class _Born:
    """Surfels of one frame."""

    frame: int
    ids: I64
    points: MaterialPoints


class LaterSurfels:
    """Takes the surfels frame by frame.  ``summary`` has the figures, shares of the depth."""

    def __init__(self, truth: SurfaceTruth) -> None:
        self._truth = truth
        self._segment = -1
        self._first = 0
        self._T_truth_world: F64 = np.eye(4)
        self._groups: list[_Born] = []
        self._at_birth: list[F64] = []
        self._in_camera: list[F64] = []
        self._in_world: list[F64] = []
        self._alive = 0

    def add(self, frame: int, surfels: SurfelFrame) -> None:
        """frame: of the sequence."""
        if not len(surfels.ids):
            return
        if surfels.segment != self._segment:
            # Another segment is another world, and its first surfels are its start.
            self._segment, self._first, self._groups = surfels.segment, frame, []
            T_true = self._truth.T_world_camera[frame]
            self._T_truth_world = T_true @ inverse(surfels.T_world_camera)
        new = surfels.age == 0
        if frame > self._first and new.any():
            points = self._truth.at_pixels(frame, surfels.points_px[new])
            self._groups.append(_Born(frame, surfels.ids[new].copy(), points))
        self._alive = 0
        for group in self._groups:
            self._judge(frame, surfels, group)

    def _judge(self, frame: int, surfels: SurfelFrame, group: _Born) -> None:
        row = np.minimum(np.searchsorted(surfels.ids, group.ids), len(surfels.ids) - 1)
        alive = surfels.ids[row] == group.ids
        alive &= surfels.state[row] == SurfelState.TRACKED
        exact = self._truth.positions(group.points, frame)
        T_true = self._truth.T_world_camera[frame]
        exact_camera = transform(inverse(T_true), exact)
        depth = exact_camera[:, 2:3]
        where = surfels.positions[row]
        in_camera = transform(inverse(surfels.T_world_camera), where) - exact_camera
        in_world = where - transform(inverse(self._T_truth_world), exact)
        known = alive & np.isfinite(exact).all(axis=1)
        if frame == group.frame:
            self._at_birth.append((in_camera / depth)[known])
            return
        self._alive += int(alive.sum())
        self._in_camera.append((in_camera / depth)[known])
        self._in_world.append((in_world / depth)[known])

    def summary(self) -> dict[str, float]:
        """``births`` and ``alive`` (of them, in the last frame); RMSE ``at_birth`` and then
        ``in_camera``, both in the frame of the camera, and ``whole`` in the world."""
        count = sum(len(errors) for errors in self._at_birth)
        return {
            "births": float(count),
            "alive": float(self._alive),
            "at_birth": _over_all(self._at_birth),
            "in_camera": _over_all(self._in_camera),
            "whole": _over_all(self._in_world),
        }


def format_later(later: LaterSurfels) -> str:
    """One line."""
    s = later.summary()
    return (
        f"born later: {s['births']:.0f}, {s['alive']:.0f} of them alive in the last frame; RMSE in "
        f"the frame of the camera {s['at_birth']:.2%} of the depth at birth, {s['in_camera']:.2%} "
        f"while alive, {s['whole']:.2%} in the world"
    )


def _over_all(errors: list[F64]) -> float:
    return rmse(np.concatenate(errors)) if errors else float("nan")

"""A depth map of another scale, brought to the surfels that are seen in it, where they agree.

The scene deforms, and a map of something rigid is wrong where it does: surfels say where.
"""

from dataclasses import dataclass

import numpy as np

from pliant.algorithms.arrays import F64, I64
from pliant.algorithms.geometry import inverse, transform
from pliant.algorithms.surfels.states import SurfelFrame, SurfelState

_CELL_PX = 16
"""The agreement is asked for once in a square of this side."""
_MIN_SURFELS = 30
"""So many surfels that agree, and half of those that the map shows, are needed."""
_MAX_DISAGREEMENT = 0.02
"""A surfel disagrees whose depth is off the map's by more than this share, after the median."""
_REACH = 2.0
"""Surfels within so many sides of a patch say whether a depth is right."""


@dataclass(frozen=True)
class Agreement:
    """What surfels say of a depth map.

    ratio: units of the surfels by one of the map.    depth: (H, W) in units of the surfels, 0 where
    it is unknown or where they disagree; None where they cannot tell, for the ``problem``.
    """

    ratio: float
    depth: F64 | None
    problem: str = ""


def agree(depth: F64, surfels: SurfelFrame, patch_px: int) -> Agreement:
    """Compare a depth map with the surfels that are tracked in its frame.

    depth: (H, W) along the optical axis in any unit, 0 where nothing is known.
    """
    pixels, ratios = _ratios(depth, surfels)
    if len(ratios) < _MIN_SURFELS:
        return Agreement(0.0, None, f"{len(ratios)} surfels lie on it, {_MIN_SURFELS} needed")
    ratio = float(np.median(ratios))
    agrees = np.abs(ratios - ratio) < _MAX_DISAGREEMENT * ratio
    count = int(agrees.sum())
    if count < max(_MIN_SURFELS, 0.5 * len(ratios)):
        return Agreement(ratio, None, f"{count} of the {len(ratios)} surfels on it agree with it")
    reach = _REACH * patch_px
    return Agreement(ratio, np.where(_doubted(depth, pixels, agrees, reach), 0.0, ratio * depth))


def _ratios(depth: F64, surfels: SurfelFrame) -> tuple[I64, F64]:
    """(N, 2) pixels of tracked surfels that the map shows, and (N,) their depths by the map's."""
    tracked = surfels.state == SurfelState.TRACKED
    z = transform(inverse(surfels.T_world_camera), surfels.positions[tracked])[:, 2]
    pixels = np.rint(surfels.points_px[tracked]).astype(np.int64)
    size = np.array([depth.shape[1], depth.shape[0]])
    inside = ((pixels >= 0) & (pixels < size)).all(axis=1) & (z > 0.0)
    pixels, z = pixels[inside], z[inside]
    there = depth[pixels[:, 1], pixels[:, 0]]
    known = there > 0.0
    return pixels[known], z[known] / there[known]


def _doubted(depth: F64, pixels: I64, agrees: np.ndarray, reach_px: float) -> np.ndarray:
    """(H, W) whether fewer than half of the surfels about a pixel agree; where there are none,
    nobody doubts."""
    height, width = depth.shape
    rows, columns = np.arange(0, height, _CELL_PX), np.arange(0, width, _CELL_PX)
    middle = 0.5 * (_CELL_PX - 1)
    dv = (rows[:, None] + middle - pixels[:, 1]) ** 2
    du = (columns[:, None] + middle - pixels[:, 0]) ** 2
    near = dv[:, None] + du[None] < reach_px**2
    doubted = 2 * (near & agrees).sum(axis=2) < near.sum(axis=2)
    return np.repeat(np.repeat(doubted, _CELL_PX, axis=0), _CELL_PX, axis=1)[:height, :width]

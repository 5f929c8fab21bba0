"""The quality of a pose: whether the static world supports it.

A few dozen inliers always agree with some motion, and those of a large moving object agree well.
The rest of the image contradicts it: areas where tracks survive without a landmark, or where no
depth makes tracks consistent with the pose.  Areas are counted, so the texture of an object does
not matter.
"""

from dataclasses import dataclass

import numpy as np

from pliant.algorithms.arrays import F32, F64, I64, BoolArray
from pliant.algorithms.camera import PinholeCamera
from pliant.compiler.kernel import kernel

_COLUMNS, _LINES = 8, 6
"""Cells of the image: each is for a pose, against it, or shows too little."""

_LEAST_SEEN = 5
"""Minimum tracks in a cell that counts."""

_AGAINST = 0.2
"""A cell contradicts a pose with a smaller share of inliers among its tracks."""

SETTLED_S = 0.5
"""Age at which a track in enough keyframes should have a landmark."""

_MAX_CONTRARY_SHARE = 0.12
"""Share of the image whose motion contradicts the pose: with more it is doubtful."""

_MIN_SHARE = 0.4
"""Share of the visible landmarks that fit the pose: with less it is doubtful."""

MIN_SPREAD = 0.06
"""Standard deviation of the fitting landmarks, share of the image width or height: with less the
pose is doubtful."""


@dataclass(frozen=True, kw_only=True)
class Support:
    """The support of a pose.

    inliers: landmarks at their projection.   tracked: those with tracks into the next frame.
    share: of the visible landmarks.   contrary: share of the cells with tracks in which hardly any
    landmark is at its projection.   spread: standard deviation of the inliers as a share of width
    or height, whichever is less.
    """

    inliers: int = 0
    tracked: int = 0
    share: float = 0.0
    contrary: float = 0.0
    spread: float = 0.0


def support_of(
    points_px: F32, inliers: BoolArray, tracked: int, settled_px: F32, camera: PinholeCamera
) -> Support:
    """points_px: (N, 2) of the visible landmarks, of which ``inliers`` (N,) fit.   tracked: number
    of them, the first ones, with tracks.   settled_px: (M, 2) of the tracks that have landmarks if
    the pose is right, or contradict it.
    """
    width, height = camera.width, camera.height
    supported, still_tracked, deviations = _fitting(points_px, inliers, tracked, width, height)
    tracks, count = _per_cell(settled_px, width, height), int(supported.sum())
    decided = tracks >= _LEAST_SEEN
    size = np.array([width, height])
    return Support(
        inliers=count,
        tracked=still_tracked,
        share=count / max(len(points_px), 1),
        contrary=float((supported < _AGAINST * tracks)[decided].mean()) if decided.any() else 0.0,
        spread=float(np.min(deviations / size)) if count else 0.0,
    )


def why_doubtful(support: Support) -> str:
    """Why the pose may be wrong; "" if it is well supported."""
    if support.contrary > _MAX_CONTRARY_SHARE:
        return f"doubtful: {support.contrary:.0%} of the image disagrees with the camera motion"
    if support.share < _MIN_SHARE:
        return f"doubtful: only {support.share:.0%} of the visible map points agree with the pose"
    if support.spread < MIN_SPREAD:
        return "doubtful: all visible map points lie in one place of the image"
    return ""


@kernel
def _per_cell(points_px: F32, width: int, height: int) -> I64:
    counts = np.zeros(_COLUMNS * _LINES, np.int64)
    for i in range(points_px.shape[0]):
        counts[_cell(points_px[i, 0], points_px[i, 1], width, height)] += 1
    return counts


@kernel
def _cell(u: float, v: float, width: int, height: int) -> int:
    column = min(max(int(u * _COLUMNS / width), 0), _COLUMNS - 1)
    line = min(max(int(v * _LINES / height), 0), _LINES - 1)
    return line * _COLUMNS + column


@kernel
def _fitting(
    points_px: F32, inliers: BoolArray, tracked: int, width: int, height: int
) -> tuple[I64, int, F64]:
    """Inliers in each cell, how many of the first ``tracked`` points, and standard deviations (2,)
    of all.
    """
    counts = np.zeros(_COLUMNS * _LINES, np.int64)
    count, still_tracked, mean, squares = 0, 0, np.zeros(2), np.zeros(2)
    for i in range(points_px.shape[0]):
        if not inliers[i]:
            continue
        counts[_cell(points_px[i, 0], points_px[i, 1], width, height)] += 1
        still_tracked += i < tracked
        count += 1
        for k in range(2):
            step = points_px[i, k] - mean[k]
            mean[k] += step / count
            squares[k] += step * (points_px[i, k] - mean[k])
    return counts, still_tracked, np.sqrt(squares / max(count, 1))

"""The quality of a pose: whether what supports it is the world.

A few dozen inliers always agree with some motion, and those of a large moving object agree well.
What does not belong to them shows it: parts of the image where tracks live on and no point of the
map is, or where no depth lets tracks be where the pose has them.  They are counted by area, so that
the texture of a thing does not decide how large it is.
"""

from dataclasses import dataclass

import numpy as np

from pliant.algorithms.arrays import F32, I64, BoolArray
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.mapping.parameters import SupportParameters
from pliant.compiler.kernel import kernel

_COLUMNS, _LINES = 8, 6
"""Cells of the image: each is for a pose, against it, or shows too little."""

_LEAST_SEEN = 5
"""Tracks without which a cell says nothing."""

_AGAINST = 0.2
"""A cell is against a pose with fewer inliers than this share of its tracks."""


@dataclass(frozen=True, kw_only=True)
class Support:
    """What there is for a pose.

    inliers: points where the pose shows them.   tracked: those that tracks lead on to the next
    frame.   share: of the points seen.   contrary: share of the
    cells with tracks in which hardly any point is where the pose shows it.   spread: standard
    deviation of the inliers as a share of width or height, whichever is less.
    """

    inliers: int = 0
    tracked: int = 0
    share: float = 0.0
    contrary: float = 0.0
    spread: float = 0.0


def support_of(
    points_px: F32, inliers: BoolArray, tracked: int, telling_px: F32, camera: PinholeCamera
) -> Support:
    """points_px: (N, 2) of the points seen, of which ``inliers`` (N,) fit.   tracked: so many, the
    first, have tracks.   telling_px: (M, 2) of the tracks that belong to points if the pose is
    right, or contradict it.
    """
    count = int(np.count_nonzero(inliers))
    fitting = points_px[inliers]
    width, height = camera.width, camera.height
    supported, tracks = _per_cell(fitting, width, height), _per_cell(telling_px, width, height)
    telling = tracks >= _LEAST_SEEN
    size = np.array([width, height])
    return Support(
        inliers=count,
        tracked=int(np.count_nonzero(inliers[:tracked])),
        share=count / max(len(points_px), 1),
        contrary=float((supported < _AGAINST * tracks)[telling].mean()) if telling.any() else 0.0,
        spread=float(np.min(fitting.std(axis=0) / size)) if count else 0.0,
    )


def why_doubtful(support: Support, parameters: SupportParameters) -> str:
    """Why the pose may not be that of the camera in the world; "" where nothing speaks for it."""
    if support.contrary > parameters.max_contrary_share:
        return f"doubtful: {support.contrary:.0%} of the image disagrees with the camera motion"
    if support.share < parameters.min_share:
        return f"doubtful: only {support.share:.0%} of the visible map points agree with the pose"
    if support.spread < parameters.min_spread:
        return "doubtful: all visible map points lie in one place of the image"
    return ""


@kernel
def _per_cell(points_px: F32, width: int, height: int) -> I64:
    counts = np.zeros(_COLUMNS * _LINES, np.int64)
    for i in range(points_px.shape[0]):
        column = min(max(int(points_px[i, 0] * _COLUMNS / width), 0), _COLUMNS - 1)
        line = min(max(int(points_px[i, 1] * _LINES / height), 0), _LINES - 1)
        counts[line * _COLUMNS + column] += 1
    return counts

"""The quality of a pose: whether the static world supports it.

A few dozen inliers always agree with some motion, and those of a large moving object agree well.
The rest of the image contradicts it: areas where tracks survive without a landmark, or where no
depth makes tracks consistent with the pose.  Areas are counted, so the texture of an object does
not matter.
"""

from dataclasses import dataclass

import numpy as np

from pliant.algorithms.arrays import F32, I64, BoolArray
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.slam.parameters import SupportParameters
from pliant.compiler.kernel import kernel

_COLUMNS, _LINES = 8, 6
"""Cells of the image: each is for a pose, against it, or shows too little."""

_LEAST_SEEN = 5
"""Minimum tracks in a cell that counts."""

_AGAINST = 0.2
"""A cell contradicts a pose with a smaller share of inliers among its tracks."""


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
    count = int(np.count_nonzero(inliers))
    fitting = points_px[inliers]
    width, height = camera.width, camera.height
    supported, tracks = _per_cell(fitting, width, height), _per_cell(settled_px, width, height)
    decided = tracks >= _LEAST_SEEN
    size = np.array([width, height])
    return Support(
        inliers=count,
        tracked=int(np.count_nonzero(inliers[:tracked])),
        share=count / max(len(points_px), 1),
        contrary=float((supported < _AGAINST * tracks)[decided].mean()) if decided.any() else 0.0,
        spread=float(np.min(fitting.std(axis=0) / size)) if count else 0.0,
    )


def why_doubtful(support: Support, parameters: SupportParameters) -> str:
    """Why the pose may be wrong; "" if it is well supported."""
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

"""The tracks that become landmarks: long ones, spread evenly over the image."""

import numpy as np

from pliant.algorithms.arrays import F64, I64
from pliant.algorithms.deformable.moving_landmarks import TrackedPoints
from pliant.compiler.kernel import kernel

_LANDMARKS = 600
"""Cells of the image; each keyframe has about one landmark in each."""
_LEAST = 4
"""Keyframes that must see a landmark."""


def choose_tracks(
    ids: list[I64], points_px: list[F64], width: int, height: int
) -> tuple[TrackedPoints, I64]:
    """Choose from the tracks of K keyframes, the longest first.

    ids, points_px: (N,) and (N, 2) of each keyframe.    Returns the observations, by keyframe, and
    the track (L,) of each landmark.
    """
    side = np.sqrt(width * height / _LANDMARKS)
    rows, columns = (int(np.ceil(extent / side)) for extent in (height, width))
    keyframes = np.repeat(np.arange(len(ids)), [len(each) for each in ids])
    pixels = np.concatenate(points_px)
    tracks, track, counts = np.unique(np.concatenate(ids), return_inverse=True, return_counts=True)
    at = np.clip((pixels + 0.5) // side, 0, (columns - 1, rows - 1)).astype(np.int64)
    cells = at[:, 1] * columns + at[:, 0]
    by_track = np.argsort(track, kind="stable")
    chosen = np.zeros(len(tracks), np.bool_)
    _choose(
        np.argsort(-counts, kind="stable"),
        np.concatenate([[0], np.cumsum(counts)]),
        keyframes[by_track],
        cells[by_track],
        np.zeros((len(ids), rows * columns), np.bool_),
        chosen,
    )
    of_chosen = np.flatnonzero(chosen[track])
    found = TrackedPoints(
        keyframes=keyframes[of_chosen],
        landmarks=(np.cumsum(chosen) - 1)[track[of_chosen]],
        points_px=pixels[of_chosen],
    )
    return found, tracks[chosen]


@kernel
def _choose(
    order: I64, bounds: I64, keyframes: I64, cells: I64, taken: np.ndarray, chosen: np.ndarray
) -> None:
    """Choose a track if half of the cells that it passes are free."""
    for i in range(order.size):
        first, end = bounds[order[i]], bounds[order[i] + 1]
        if end - first < _LEAST:
            continue
        free = 0
        for m in range(first, end):
            if not taken[keyframes[m], cells[m]]:
                free += 1
        if 2 * free >= end - first:
            chosen[order[i]] = True
            for m in range(first, end):
                taken[keyframes[m], cells[m]] = True

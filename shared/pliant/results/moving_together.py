"""Detection of surfels that all move like one rigid body, as in front of a moving camera."""

import numpy as np

from pliant.algorithms.arrays import F64, I64
from pliant.algorithms.geometry import align_umeyama
from pliant.algorithms.surfels.surfel_frame import SurfelFrame, SurfelState

_FAR = 0.02
"""Motion since the reference that is significant, as a share of the depth: what a surfel is
expected to move by itself (``surfels.expected_motion``)."""

_LEFT = 0.1
"""Share of the motion (both RMS) that no rigid motion explains, below which they move together.
Breathing tissue before a moving camera leaves 0.01 to 0.1, cloth and paper that deform before one
that stands still 0.1 to 0.4."""

_LEAST = 20
"""Surfels that are compared: few agree with a rigid motion whatever they do."""

_ROUNDS = 5
_OUTLIER = 2.5
"""Times the median residual beyond which a surfel does not count for the motion."""


class MovingTogether:
    """Looks at frame after frame; ``frames`` are those in which all move together.

    Positions are compared with those of a reference: the first frame, or the first that has had
    too few surfels in common with the one before.
    """

    def __init__(self) -> None:
        self.frames: list[int] = []
        self._segment = -1
        self._ids: I64 = np.zeros(0, np.int64)
        self._positions: F64 = np.zeros((0, 3))

    def take(self, frame: int, surfels: SurfelFrame) -> None:
        """A frame in which surfels were followed."""
        tracked = surfels.state == SurfelState.TRACKED
        ids, positions = surfels.ids[tracked], surfels.positions[tracked]
        _, a, b = np.intersect1d(self._ids, ids, assume_unique=True, return_indices=True)
        if surfels.segment != self._segment or len(a) < _LEAST:
            self._segment, self._ids, self._positions = surfels.segment, ids, positions
        elif _is_rigid(self._positions[a], positions[b]):
            self.frames.append(frame)


def _is_rigid(before: F64, now: F64) -> bool:
    """before, now: (N, 3) in the frame of the static camera."""
    moved = np.linalg.norm(now - before, axis=1)
    if np.median(moved) < _FAR * np.median(before[:, 2]):
        return False
    left, agree = moved, np.ones(len(moved), np.bool_)
    for _ in range(_ROUNDS):
        _, R, t = align_umeyama(before[agree], now[agree], with_scale=False)
        left = np.linalg.norm(before @ R.T + t - now, axis=1)
        agree = left <= _OUTLIER * np.median(left)
    return bool(left @ left < _LEFT**2 * (moved @ moved))

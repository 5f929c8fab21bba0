"""Whether an image shows the same again, a step aside: tiles, chequers, windows, bars.

Where what is seen at X is seen at X + d as well, a camera that stands a step d aside sees the same:
no pose is proved by it, whatever a map knows, for the pattern may go on where nothing is mapped.
The image itself tells, without noise, light or view between them.  Each two of its corners that
look alike propose a step (RANSAC by one pair); it holds for a corner where the image has one that
looks alike a step forth or back, which of the two are in view being chance.
"""

import numpy as np

from pliant.algorithms.arrays import F64, I64
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.places.features import Features, look_alike
from pliant.compiler.kernel import fast_kernel, kernel

_APART_SHARE = 0.025
"""Of the image's width: what looks alike within is one corner, found at two scales."""

_STEPS = 500
"""Tried at most: one that holds for a tenth is among these."""


def repeated_share(
    seen: Features,
    corners: I64,
    xyz: F64,
    camera: PinholeCamera,
    *,
    gate_px: float,
    least_step: float,
) -> float:
    """Share of the corners that are seen again after one step, of all steps the largest.

    corners: (n,) of those of an image, rows of ``seen``.   xyz: (n, 3) where they are before the
    camera.   gate_px: largest error.   least_step: shorter ones lead to the same place.
    """
    pairs = look_alike(seen, corners)
    apart = np.linalg.norm(
        seen.points_px[corners[pairs[:, 0]]] - seen.points_px[pairs[:, 1]], axis=1
    )
    pairs = pairs[apart > _APART_SHARE * camera.width]
    row = np.full(len(seen.points_px), -1, np.int64)
    row[corners] = np.arange(len(corners))
    ends = np.column_stack([pairs[:, 0], row[pairs[:, 1]]])
    ends = ends[ends[:, 1] >= 0]
    steps = xyz[ends[:, 1]] - xyz[ends[:, 0]]
    steps = steps[np.linalg.norm(steps, axis=1) > least_step]
    if not len(steps):
        return 0.0
    steps = steps[:: -(-len(steps) // _STEPS)]
    seen_at = camera.normalise(seen.points_px.astype(np.float64))
    return _most_repeated(steps, pairs, xyz, seen_at, gate_px / camera.fx) / len(corners)


@kernel
def _most_repeated(steps: F64, pairs: I64, xyz: F64, seen_at: F64, gate: float) -> int:
    """How many of the corners the best step explains."""
    most, holds = 0, np.empty(len(xyz), np.bool_)
    for s in range(len(steps)):
        holds[:] = False
        for p in range(len(pairs)):
            i, j = pairs[p, 0], pairs[p, 1]
            holds[i] |= _is_at(xyz[i], steps[s], 1.0, seen_at[j], gate)
            holds[i] |= _is_at(xyz[i], steps[s], -1.0, seen_at[j], gate)
        most = max(most, holds.sum())
    return most


@fast_kernel
def _is_at(X: F64, step: F64, sign: float, seen_at: F64, gate: float) -> bool:
    z = X[2] + sign * step[2]
    if z <= 0.0:
        return False
    u, v = (X[0] + sign * step[0]) / z, (X[1] + sign * step[1]) / z
    return (u - seen_at[0]) ** 2 + (v - seen_at[1]) ** 2 < gate * gate

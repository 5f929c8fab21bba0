"""Whether landmarks of two maps look alike, by their re-acquisition patches.

A patch shows the surroundings of a landmark in its last keyframe.  A camera that is closer, or
rotated about its axis, sees it larger or rotated.  So one patch is compared with the other as a
small plane that faces the first camera, where both have pixels.
"""

import numpy as np

from pliant.algorithms.arrays import F64, I32, U8, BoolArray
from pliant.algorithms.geometry import inverse, transform_each
from pliant.algorithms.image.patch_sums import PATCH_PIXELS, PATCH_SIZE
from pliant.algorithms.slam.locate.reacquisition import FLAT
from pliant.algorithms.slam.map.keyframe import Keyframe
from pliant.algorithms.slam.map.landmarks import PATCH_SIDE, Landmarks
from pliant.compiler.kernel import kernel


def look_alike(
    S_old_new: F64,
    rows: I32,
    old: list[Keyframe],
    new: list[Keyframe],
    points: Landmarks,
    min_zncc: float,
) -> BoolArray:
    """(n,) whether landmarks look alike.

    S_old_new: (4, 4) similarity between their worlds, ``X_old = S_old_new X_new``.   rows: (n, 2),
    old and new.   old, new: keyframes of their segments, oldest first.   min_zncc: minimum
    correlation of the patches.
    """
    T_old, T_new = (
        _seen_from(points.patch_keyframe[some], segment)
        for some, segment in ((rows[:, 0], old), (rows[:, 1], new))
    )
    X_old = transform_each(inverse(T_old), points.xyz[rows[:, 0]])
    # The old landmark before the new camera: with both cameras at one place the scale is
    # undetermined, and does not affect the image.
    into_new = inverse(T_new) @ np.linalg.inv(S_old_new) @ T_old
    X_new = transform_each(into_new, X_old)
    # The step in the new image for a step in the old one, at the depth of the landmark.
    seen = X_new[:, :2] / X_new[:, 2:]
    steps = into_new[:, :2, :2] - seen[:, :, None] * into_new[:, 2:3, :2]
    steps *= (X_old[:, 2] / X_new[:, 2])[:, None, None]
    patches = points.patches
    return _correlations(patches[rows[:, 0]], patches[rows[:, 1]], steps) >= min_zncc


def _seen_from(ids: I32, segment: list[Keyframe]) -> F64:
    """(n, 4, 4) poses of keyframes of a segment by their ids (n,); for a dropped keyframe that of
    the one before.
    """
    known = np.array([keyframe.id for keyframe in segment])
    unique, each = np.unique(ids, return_inverse=True)
    at = np.maximum(np.searchsorted(known, unique, side="right") - 1, 0)
    return np.array([segment[n].T_world_camera for n in at]).reshape(-1, 4, 4)[each]


@kernel
def _correlations(a: U8, b: U8, steps: F64) -> F64:
    """(n,) ZNCC of patches (n, PATCH_SIDE, PATCH_SIDE), 0 for flat ones.   steps: (n, 2, 2) from
    pixels of a to those of b.
    """
    found = np.zeros(len(a))
    reach = 0.5 * (PATCH_SIZE - 1)
    for i in range(len(a)):
        A = steps[i]
        farthest = max(abs(A[0, 0]) + abs(A[0, 1]), abs(A[1, 0]) + abs(A[1, 1]))
        if not farthest < np.inf:
            continue
        share = 1.0 / max(farthest, 1.0)
        sa = sb = saa = sbb = sab = 0.0
        for r in range(PATCH_SIZE):
            for c in range(PATCH_SIZE):
                u, v = share * (c - reach), share * (r - reach)
                x = _at(a[i], u, v)
                y = _at(b[i], A[0, 0] * u + A[0, 1] * v, A[1, 0] * u + A[1, 1] * v)
                sa, sb, saa, sbb, sab = sa + x, sb + y, saa + x * x, sbb + y * y, sab + x * y
        va, vb = saa - sa * sa / PATCH_PIXELS, sbb - sb * sb / PATCH_PIXELS
        if min(va, vb) > PATCH_PIXELS * FLAT * FLAT:
            found[i] = (sab - sa * sb / PATCH_PIXELS) / np.sqrt(va * vb)
    return found


@kernel
def _at(patch: U8, u: float, v: float) -> float:
    """A patch's grey level at an offset from its centre."""
    u, v = u + 0.5 * (PATCH_SIDE - 1), v + 0.5 * (PATCH_SIDE - 1)
    x, y = int(u), int(v)
    a, b = u - x, v - y
    above = (1.0 - a) * patch[y, x] + a * patch[y, x + 1]
    below = (1.0 - a) * patch[y + 1, x] + a * patch[y + 1, x + 1]
    return (1.0 - b) * above + b * below

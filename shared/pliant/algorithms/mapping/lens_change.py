"""A map goes on under another lens: the adjustment of the whole map has found that the one in use
is wrong.

Tracks come as pixels of the rectified image, and the mapper works on those of an ideal camera, see
``self_calibration``.  So what keyframes have seen is moved to where the new ideal camera sees it,
and a point to where the keyframe on which it hangs sees it, as far away as it was: how distances
change, the moves of ``whole_map`` say.  What is left, the adjustment of the window takes out.
"""

import numpy as np

from pliant.algorithms.arrays import F32, F64
from pliant.algorithms.corrected_view import CorrectedView
from pliant.algorithms.geometry import inverse
from pliant.algorithms.mapping.map_store import FREE
from pliant.algorithms.mapping.segment import Segment
from pliant.algorithms.mapping.self_calibration import SelfCalibration

_MIN_DEPTH = 1e-6


def see_by(segment: Segment, before: CorrectedView, known: SelfCalibration) -> None:
    """Let a segment that was made in one view be as another camera sees it.

    before: whose pixels its keyframes have.   known: of the camera by now.
    """
    _bend(segment, before, known.view)
    for keyframe in segment.keyframes:
        seen = moved(keyframe.points_px + keyframe.rolled_px, before, known.view)
        keyframe.points_px = moved(keyframe.points_px, before, known.view)
        keyframe.rolled_px = seen - keyframe.points_px
    segment.passed.seen_by(before, known.view)
    if known.readout:
        segment.unroll(segment.keyframes, known)


def moved(points_px: F32, before: CorrectedView, after: CorrectedView) -> F32:
    """(N, 2) pixels of one ideal camera in another one."""
    return after.pixels(before.seen(points_px))


def _bend(segment: Segment, before: CorrectedView, after: CorrectedView) -> None:
    """Move the points, candidates with their provisional places among them."""
    points, keyframes = segment.points, segment.keyframes
    used = slice(0, points.count)
    here = (points.state[used] != FREE) & (points.segment[used] == segment.id)
    rows = np.flatnonzero(here)
    ids = np.array([keyframe.id for keyframe in keyframes], np.int64)
    # What hung on a keyframe that the map has forgotten hangs on the one before it.
    slots = np.maximum(np.searchsorted(ids, points.first_keyframe[rows], side="right") - 1, 0)
    T_world_keyframe = np.array([keyframe.T_world_camera for keyframe in keyframes])
    T_world_host, T_host_world = T_world_keyframe[slots], inverse(T_world_keyframe)[slots]
    in_host = _each(T_host_world, points.xyz[rows])
    ahead = in_host[:, 2] > _MIN_DEPTH
    rows, in_host = rows[ahead], in_host[ahead]
    px = moved(before.camera.project(in_host).astype(np.float32), before, after)
    in_host[:, :2] = after.camera.normalise(px) * in_host[:, 2:]
    points.xyz[rows] = _each(T_world_host[ahead], in_host)


def _each(T: F64, points: F64) -> F64:
    """Transform points (N, 3), each by its own of (N, 4, 4)."""
    return np.einsum("nij,nj->ni", T[:, :3, :3], points) + T[:, :3, 3]

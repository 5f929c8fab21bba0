"""Backfill: frames before a start join it.

Two frames with enough parallax may come long after the first frame, and share few tracks with it.
So the frames before them are placed one by one, the newest first, by the known landmarks and by
those that the frames placed so far determine.  Some become keyframes, and all are adjusted
together.
"""

import numpy as np

from pliant.algorithms.arrays import F64, I64
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import inverse, transform
from pliant.algorithms.slam.estimate.pose import Correspondences
from pliant.algorithms.slam.estimate.triangulation import triangulate
from pliant.algorithms.slam.keyframe_rule import Overlap, is_due
from pliant.algorithms.slam.locate.localisation import refine
from pliant.algorithms.slam.parameters import MappingParameters, PointParameters
from pliant.algorithms.slam.start.first_map import BufferedFrame, Start, adjusted_start, table_of

_OVERLAP = 0.7
"""Minimum share of a frame's tracks with the next frame that have landmarks: below it, more
landmarks are triangulated; below it with the last keyframe, the frame becomes a keyframe.
"""

_VIEWS, _FEW = 8, 30
"""Frames from which landmarks are triangulated at most, and landmarks that each of them sees."""


def backfill(
    start: Start,
    waiting: list[BufferedFrame],
    camera: PinholeCamera,
    parameters: MappingParameters,
) -> Start:
    """Return the start with the earlier frames that could be placed."""
    limits = parameters.localisation
    rule = parameters.keyframe.model_copy(update={"min_shared_share": _OVERLAP})
    frames = {each.frame: each for each in waiting}
    poses = zip(start.frames.tolist(), start.T_world_camera, strict=True)
    keyframes = [(frames[frame], T) for frame, T in poses][::-1]
    placed, known = list(keyframes), (start.ids, start.points_world)
    for frame in reversed([each for each in waiting if each.frame < start.frames[0]]):
        newer, T_world_camera = placed[-1]
        shared = np.intersect1d(frame.ids, newer.ids, assume_unique=True)
        if len(shared) < limits.min_inliers:
            break
        if np.isin(shared, known[0], assume_unique=True).mean() < _OVERLAP:
            known = _more_points(*known, shared, placed, camera, parameters.point)
        _, i, j = np.intersect1d(frame.ids, known[0], assume_unique=True, return_indices=True)
        if len(i) < limits.min_inliers:
            break
        seen = Correspondences(known[1][j], frame.points_px[i])
        located = refine(T_world_camera, seen, camera, limits)
        if located.inliers.sum() < limits.min_inliers:
            break
        placed.append((frame, located.T_world_camera))
        last = keyframes[-1][0]
        share = float(np.isin(last.ids, frame.ids, assume_unique=True).mean())
        if is_due(Overlap(share, share, 0.0, 1e-9 * (last.stamp_ns - frame.stamp_ns)), rule):
            keyframes.append(placed[-1])
    if len(known[0]) == len(start.ids):
        return start
    if keyframes[-1] is not placed[-1]:
        keyframes.append(placed[-1])
    first = inverse(placed[-1][1])
    chosen = [frame for frame, _ in keyframes[::-1]]
    T_world_camera = first @ np.stack([T for _, T in keyframes[::-1]])
    points_world = transform(first, known[1])
    reached = adjusted_start(chosen, T_world_camera, known[0], points_world, camera, parameters)
    return start if isinstance(reached, str) else reached


def _more_points(
    ids: I64,
    points_world: F64,
    shared: I64,
    placed: list[tuple[BufferedFrame, F64]],
    camera: PinholeCamera,
    parameters: PointParameters,
) -> tuple[I64, F64]:
    """Return the start with landmarks of the tracks in ``shared`` that the placed frames
    determine.
    """
    other = np.setdiff1d(shared, ids, assume_unique=True)
    lasting = 0  # placed frames, counted from the last, that observe some of them
    for frame, _ in reversed(placed):
        if np.isin(other, frame.ids, assume_unique=True).sum() < _FEW:
            break
        lasting += 1
    spread = np.linspace(len(placed) - lasting, len(placed) - 1, min(lasting, _VIEWS))
    views = [placed[i] for i in np.unique(np.round(spread).astype(int)).tolist()]
    if len(views) < parameters.min_observations:
        return ids, points_world
    u, v, seen = table_of([frame for frame, _ in views], other)
    several = np.flatnonzero(seen.sum(axis=0) >= parameters.min_observations)
    poses = np.stack([T for _, T in views])
    xyz, errors, parallax, _ = triangulate(poses, u, v, seen, several, camera)
    good = errors < parameters.max_error_px
    good &= parallax > np.radians(parameters.min_parallax_deg)
    ids = np.concatenate([ids, other[several[good]]])
    order = np.argsort(ids, kind="stable")
    return ids[order], np.concatenate([points_world, xyz[good]])[order]

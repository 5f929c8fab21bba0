"""Covisibility: which keyframes look at the same place, and which landmarks a frame may see.

Landmarks are searched only if keyframes of the window, or near it, observe them.  So the work for a
frame does not grow with the length of the run.
"""

import numpy as np

from pliant.algorithms.arrays import F64, I32, I64, U8, BoolArray
from pliant.algorithms.slam.map.keyframe import Keyframe
from pliant.algorithms.slam.map.landmarks import CANDIDATE, MAPPED, MERGED, Landmarks
from pliant.compiler.kernel import kernel

MAX_MISSES = 8
"""Failed searches after which a landmark waits."""

_RETRY_FRAMES = 8
"""Frames between two searches for a waiting landmark."""


def focus_of(keyframe: Keyframe, points: Landmarks) -> F64:
    """(3,) point on the axis of a keyframe at the median depth of its landmarks, or NaN."""
    rows = keyframe.rows[points.state[keyframe.rows] == MAPPED]
    centre, axis = keyframe.T_world_camera[:3, 3], keyframe.T_world_camera[:3, 2]
    if len(rows) == 0:
        return np.full(3, np.nan)
    return centre + axis * float(np.median((points.xyz[rows] - centre) @ axis))


def near_keyframes(keyframes: list[Keyframe], T_world_camera: F64, count: int) -> list[Keyframe]:
    """Return at most ``count`` of the keyframes that look at the camera's place, in their order.

    Their distance is that of the observed places plus half of that of the cameras.
    """
    if len(keyframes) <= count:
        return keyframes
    last = keyframes[-1]
    centre = T_world_camera[:3, 3]
    depth = 0.0
    if last.focus is not None:
        depth = float(np.linalg.norm(last.focus - last.T_world_camera[:3, 3]))
    focus = centre + T_world_camera[:3, 2] * depth
    places = np.array([np.zeros(3) if k.focus is None else k.focus for k in keyframes])
    centres = np.array([k.T_world_camera[:3, 3] for k in keyframes])
    apart = np.linalg.norm(places - focus, axis=1) + 0.5 * np.linalg.norm(centres - centre, axis=1)
    order = np.argsort(np.where(np.isfinite(apart), apart, np.inf), kind="stable")[:count]
    return [keyframes[i] for i in np.sort(order).tolist()]


def most_shared(older: list[Keyframe], moving: list[Keyframe], points: Landmarks) -> list[Keyframe]:
    """Return older keyframes by the number of landmarks that they share with the moving ones."""
    marked = np.zeros(len(points.state), np.bool_)
    for keyframe in moving:
        marked[keyframe.rows] = True
    marked &= points.state == MAPPED
    shared = [int(np.count_nonzero(marked[keyframe.rows])) for keyframe in older]
    order = np.argsort(-np.array(shared), kind="stable").tolist()
    return [older[i] for i in order if shared[i] > 0]


def rows_of(keyframes: list[Keyframe], rows: I32, capacity: int) -> I32:
    """Return in ascending order the rows that any of the keyframes observes, and the given rows."""
    marked = np.zeros(capacity, np.bool_)
    marked[rows] = True
    for keyframe in keyframes:
        marked[keyframe.rows] = True
    return np.flatnonzero(marked).astype(np.int32)


@kernel
def marks_fewer(marked: BoolArray, rows: I32, least: int) -> bool:
    """Whether fewer than ``least`` of the rows are marked (capacity,)."""
    count = 0
    for i in range(rows.size):
        count += int(marked[rows[i]])
        if count >= least:
            return False
    return count < least


@kernel
def missing_rows(rows: I32, linked: I32, state: U8, misses: U8, marks: I64, frame: int) -> I32:
    """Return the given rows that are mapped, due for a search, and without a track.

    linked: row of each track, negative where it has none.   marks: (capacity,) written: the last
    frame in which a row had a track.
    """
    for i in range(linked.size):
        if linked[i] >= 0:
            marks[linked[i]] = frame
    wanted = np.empty(rows.size, np.int32)
    count = 0
    for i in range(rows.size):
        row = rows[i]
        due = misses[row] < MAX_MISSES or (row + frame) % _RETRY_FRAMES == 0
        if due and state[row] == MAPPED and marks[row] != frame:
            wanted[count] = row
            count += 1
    return wanted[:count].copy()


def collect_garbage(
    points: Landmarks, keyframes: list[Keyframe], linked: I32, segment: int
) -> None:
    """Free the rows of dead candidates and of merged landmarks.

    linked: row of each living track, negative where it has none.    keyframes: of the segment.
    """
    used = points.state[: points.count]
    dead = (used == CANDIDATE) & (points.segment[: points.count] == segment)
    dead[linked[linked >= 0]] = False
    merged = used == MERGED
    gone = np.flatnonzero(dead | merged).astype(np.int32)
    # Merges may be chained.
    while (points.alias[points.alias[gone]] != points.alias[gone]).any():
        points.alias[gone] = points.alias[points.alias[gone]]
    first = points.first_keyframe[: points.count]
    never = np.iinfo(np.int32).max
    first_dead = int(first[dead].min()) if dead.any() else never
    first_merged = int(first[merged].min()) if merged.any() else never
    for keyframe in keyframes:
        if keyframe.id >= first_merged:
            keyframe.follow_aliases(points)
        if keyframe.id >= first_dead:
            keyframe.keep(~dead[keyframe.rows])
    points.free(gone)

"""What leaves the active map for good, so that its memory does not grow with the length of a run.

Keyframes and the points that only they see have been told; what is told is the product, and the
active map only keeps what a camera may come back to.  Where a place is visited again and again that
is one view of it, not one of each visit.
"""

import numpy as np

from pliant.algorithms.arrays import F64, I32, BoolArray
from pliant.algorithms.kernel import kernel
from pliant.algorithms.mapping.map_store import (
    CANDIDATE,
    MAPPED,
    MERGED,
    Keyframe,
    PointRows,
)


def most_redundant(keyframes: list[Keyframe]) -> int:
    """Index of the newer one of the two keyframes that look most alike.

    Alike: as in ``near_keyframes``, by the places looked at and half of how far the cameras are
    apart.  The older one stays: the map as it was first seen drifted least.  At least two.
    """
    centres = np.array([k.T_world_camera[:3, 3] for k in keyframes])
    places = np.array([_place(k) for k in keyframes])
    return int(_newer_of_nearest(places, centres))


def _place(keyframe: Keyframe) -> F64:
    focus = keyframe.focus
    if focus is None or not np.isfinite(focus).all():
        return keyframe.T_world_camera[:3, 3]
    return focus


@kernel
def _newer_of_nearest(places: F64, centres: F64) -> int:
    newer, least = 1, np.inf
    for j in range(1, len(places)):
        for i in range(j):
            focus2, centre2 = 0.0, 0.0
            for k in range(3):
                focus2 += (places[i, k] - places[j, k]) ** 2
                centre2 += (centres[i, k] - centres[j, k]) ** 2
            apart = np.sqrt(focus2) + 0.5 * np.sqrt(centre2)
            if apart < least:
                newer, least = j, apart
    return newer


def seen_by_none(rows: I32, keyframes: list[Keyframe], linked: I32, points: PointRows) -> I32:
    """Those of the rows that are points which no keyframe sees and no living track belongs to.

    linked: row of each track, negative where it has none.
    """
    held: BoolArray = np.zeros(len(points.state), np.bool_)
    for keyframe in keyframes:
        held[keyframe.rows] = True
    held[linked[linked >= 0]] = True
    return rows[~held[rows] & (points.state[rows] == MAPPED)]


def collect_garbage(
    points: PointRows, keyframes: list[Keyframe], linked: I32, segment: int
) -> None:
    """Give back the rows of dead candidates and of merged points.

    linked: row of each living track, negative where it has none.    keyframes: of the segment.
    """
    used = points.state[: points.count]
    dead = (used == CANDIDATE) & (points.segment[: points.count] == segment)
    dead[linked[linked >= 0]] = False
    merged = used == MERGED
    gone = np.flatnonzero(dead | merged).astype(np.int32)
    # A point may have been merged into one that was merged in its turn.
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

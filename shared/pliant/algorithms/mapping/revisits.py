"""Places of a segment that the camera comes back to: found at keyframes, believed when told twice.

Where the map has not drifted by more than a few pixels, points are found again by where they are,
and the keyframes share them.  A place that looks like a new keyframe without sharing points with it
has drifted away, or only looks alike.  One that is the same goes on being so: keyframes that follow
each other must tell of the same drift.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import islice

import numpy as np

from pliant.algorithms.arrays import F64
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import so3_log
from pliant.algorithms.mapping.loops import Loop
from pliant.algorithms.mapping.map_store import MAPPED, PointRows
from pliant.algorithms.mapping.parameters import MappingParameters
from pliant.algorithms.mapping.relocalisation import Place
from pliant.algorithms.mapping.same_place import same_place

_WITHIN = 3
"""Keyframes within which another one must tell the same."""

_SAME_TURN_RAD = np.radians(2.0)
_SAME_SHIFT = 0.05
"""Drifts are the same within this turn, and this share of the depth: of scale, too."""


@dataclass(kw_only=True)
class Revisits:
    """waiting: what one keyframe has told, until another one tells the same."""

    waiting: list[Loop] = field(default_factory=list[Loop])

    def look(
        self,
        new: Place,
        places: Iterable[Place],
        points: PointRows,
        camera: PinholeCamera,
        parameters: MappingParameters,
        tries: int = 1,
        elsewhere: Iterable[Place] = (),
    ) -> list[Loop]:
        """The loops that a new keyframe proves: with a place that looks like it, if any.

        places: of one segment that look like it, the most alike first.   tries: how many of them
        are asked; if they contradict each other, what is alike in both proves neither.
        elsewhere: others, which are asked as well where one of these is proved.
        """
        keyframe = new.keyframe
        mine = np.zeros(len(points.state), np.bool_)
        mine[keyframe.rows] = True
        mine &= points.state == MAPPED
        self.waiting = [loop for loop in self.waiting if keyframe.id - loop.new <= _WITHIN]
        window = {k.id for k in new.segment[-parameters.window.keyframes :]}
        # Its own, so that no frame is located otherwise because something was looked at here.
        generator = np.random.default_rng(keyframe.id)
        least, told = parameters.localisation.min_inliers, list[Loop]()

        def ask(some: Iterable[Place]) -> None:
            for old in some:
                found = same_place(old, new, points, camera, parameters, generator)
                if isinstance(found, str):
                    continue
                rows, S_old_new = found.rows[found.rows[:, 0] != found.rows[:, 1]], found.S_old_new
                ids = points.ids[rows]
                told.append(Loop(old.keyframe.id, keyframe.id, S_old_new, rows, ids))

        ask(
            islice(
                (
                    old
                    for old in places
                    if old.keyframe.id not in window and mine[old.keyframe.rows].sum() < least
                ),
                tries,
            )
        )
        if told:
            ask(elsewhere)
        loop = max(told, key=lambda each: len(each.rows), default=None)
        if loop is None or not all(_agree(each, loop, new, points) for each in told):
            return []
        others = [each for each in self.waiting if each.new != keyframe.id]
        agreeing = [each for each in others if _agree(each, loop, new, points)]
        self.waiting = [] if agreeing else [*self.waiting, loop]
        return [*agreeing, loop] if agreeing else []


def _agree(one: Loop, other: Loop, new: Place, points: PointRows) -> bool:
    """Whether two loops take what the new keyframe sees to the same place."""
    keyframe = new.keyframe
    between: F64 = np.linalg.inv(other.S_old_new) @ one.S_old_new
    scale = float(np.cbrt(np.linalg.det(between[:3, :3])))
    turn = float(np.linalg.norm(so3_log(between[:3, :3] / scale)))
    centre = keyframe.T_world_camera[:3, 3]
    rows = keyframe.rows[points.state[keyframe.rows] == MAPPED]
    if len(rows) == 0:
        return False
    depth = float(np.median((points.xyz[rows] - centre) @ keyframe.T_world_camera[:3, 2]))
    shift = float(np.linalg.norm(between[:3, :3] @ centre + between[:3, 3] - centre))
    close = shift < _SAME_SHIFT * depth and abs(np.log(scale)) < _SAME_SHIFT
    return close and turn < _SAME_TURN_RAD

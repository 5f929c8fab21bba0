"""Segments that see the same place: found at keyframes as loops are, and made one.

A segment begins where the camera was lost for long.  Where it comes to a place of an earlier one,
keyframes tell how the two worlds lie to each other; one is moved into the other, and what is left
between them the loops take out that told so.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import numpy as np

from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import matrix_to_pose
from pliant.algorithms.map_delta import MapMoves
from pliant.algorithms.mapping.active_map import ActiveMap
from pliant.algorithms.mapping.loops import Loop
from pliant.algorithms.mapping.map_store import PointRows
from pliant.algorithms.mapping.parameters import MappingParameters
from pliant.algorithms.mapping.relocalisation import Place
from pliant.algorithms.mapping.revisits import Revisits
from pliant.algorithms.mapping.segment import Moved, Segment
from pliant.algorithms.mapping.self_calibration import SelfCalibration
from pliant.algorithms.mapping.whole_map import held

_TRIES = 3
"""Places of a segment that are compared with a keyframe: none of them may contradict."""


@dataclass(kw_only=True)
class Meetings:
    """Of the segment that the camera is in with earlier ones.

    told: by each of those, what awaits a second keyframe.   proved: loops that have been confirmed,
    from places of earlier segments to keyframes of this one, until the segments are joined.
    """

    told: dict[int, Revisits] = field(default_factory=dict[int, Revisits])
    proved: list[Loop] = field(default_factory=list[Loop])

    def look(
        self,
        new: Place,
        places: Iterable[Place],
        elsewhere: Callable[[int], Iterable[Place]],
        points: PointRows,
        camera: PinholeCamera,
        parameters: MappingParameters,
        contradicts: Callable[[Loop], bool],
    ) -> None:
        """Compare a new keyframe with places of earlier segments, the most alike first.

        elsewhere: others of a segment, which must not tell otherwise.   contradicts: whether the
        keyframe's image does, to what is proved.
        """
        by_segment: dict[int, list[Place]] = {}
        for place in places:
            by_segment.setdefault(place.keyframe.segment, []).append(place)
        for segment, some in by_segment.items():
            told = self.told.setdefault(segment, Revisits())
            proved = told.look(
                new, some, points, camera, parameters, tries=_TRIES, elsewhere=elsewhere(segment)
            )
            if not any(contradicts(loop) for loop in proved if loop.new == new.keyframe.id):
                self.proved += proved


def join(
    active: ActiveMap,
    earlier: Segment,
    loops: list[Loop],
    spans: list[tuple[int, int]],
    calibration: SelfCalibration,
) -> Moved:
    """Make two segments one, in the world of the older one: its first keyframe goes on holding it.

    loops: from the earlier one to the one that goes on.   spans: as of ``held``.   calibration: of
    the segment that goes on.
    """
    goes_on = active.segment
    to_earlier = max(loops, key=lambda loop: len(loop.rows)).S_old_new
    active_moves = goes_on.id > earlier.id
    moving, staying = (goes_on, earlier) if active_moves else (earlier, goes_on)
    gone, id = moving.id, staying.id
    S = to_earlier if active_moves else np.asarray(np.linalg.inv(to_earlier), np.float64)
    scale = float(np.cbrt(np.linalg.det(S[:3, :3])))
    turned = S.copy()
    turned[:3, :3] /= scale
    first = min(number for number, of in spans if of == gone)
    move = MapMoves(
        keyframe_ids=np.array([first], np.int64),
        moves=np.concatenate([matrix_to_pose(turned), [scale]])[None],
    )
    moves = held(move, spans, gone)
    (active if active_moves else earlier).move(moves)
    moving.inverse_distance /= scale
    goes_on.take_in(earlier, id)
    if calibration.readout:
        goes_on.unroll(earlier.keyframes, calibration)
    told = tuple((loop.old, loop.new) for loop in loops)
    return Moved(S if active_moves else np.eye(4), moves, gone, told)

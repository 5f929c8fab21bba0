"""Two saved maps that show the same places become one.

The second map is treated as a session whose segments are all complete: its keyframes are compared
with the places of the first map as those of a new segment are (``known_places``).  A verified match
moves a segment into the world frame of the first map; loops and global bundle adjustment correct
the remaining error (``loops``, ``global_adjustment``).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from pliant.algorithms.slam.active.active_map import ActiveMap
from pliant.algorithms.slam.adjust.global_adjustment import GlobalAdjustment, held
from pliant.algorithms.slam.adjust.loops import Loop
from pliant.algorithms.slam.adjust.segment import Segment, bend
from pliant.algorithms.slam.atlas.known_places import KnownPlaces, join
from pliant.algorithms.slam.calibration.self_calibration import SelfCalibration
from pliant.algorithms.slam.map.kept_keyframe import KeptKeyframe
from pliant.algorithms.slam.map.keyframe import Keyframe
from pliant.algorithms.slam.map.landmarks import Landmarks
from pliant.algorithms.slam.parameters import MappingParameters
from pliant.algorithms.slam.store.kept_map import (
    Origin,
    corrected_as,
    keep,
    known_camera,
    numbered_after,
    spans_of,
    take_in,
    view_of,
)


@dataclass(frozen=True, kw_only=True)
class Merged:
    """joined: (segment of the second map, segment of the first map in whose world it is now).
    apart: (unmatched segment of the second map, its new number).   proofs: matched pairs of
    keyframes.
    keyframes: of the merged map, oldest first.
    """

    joined: list[tuple[int, int]]
    apart: list[tuple[int, int]]
    proofs: int
    keyframes: list[KeptKeyframe]


def merge(
    first: Sequence[KeptKeyframe], second: Sequence[KeptKeyframe], parameters: MappingParameters
) -> Merged | None:
    """Merge two maps, each with its keyframes oldest first; None if no place of the first one is
    verified in the second.

    World frames, scales and the camera are those of the first map; numbers of the second continue
    them.  Raises ValueError if a landmark occurs twice in a map.
    """
    camera = known_camera(first, first[-1].given_camera)
    assert camera is not None, "of its own last session"
    return _Merging(first, numbered_after(second, first), camera, parameters).result()


class _Merging:
    """worlds: segments of the first map, with those merged into them.   rest: segments of the
    second one that are not matched yet.   proved: matched keyframes.
    """

    def __init__(
        self,
        first: Sequence[KeptKeyframe],
        second: list[KeptKeyframe],
        calibration: SelfCalibration,
        parameters: MappingParameters,
    ) -> None:
        self._given = [*first, *second]
        both = [corrected_as(each, calibration) for each in self._given]
        self._calibration = replace(calibration, uncertainty=parameters.calibration)
        self._parameters = parameters
        numbers = {each.segment for each in first}
        self._shift = 1 + max(numbers)
        self._spans = spans_of(both)
        self._places = KnownPlaces()
        self._places.know(both, calibration)
        segments = take_in(both, Landmarks(), calibration)
        corrected = (n for n, each in enumerate(both) if each is not self._given[n])
        before = {both[n].segment: view_of(self._given[n]) for n in corrected}
        for each in segments:
            if each.id in before:
                bend(each, before[each.id], calibration.view)
        self._worlds = [each for each in segments if each.id in numbers]
        self._rest = [each for each in segments if each.id not in numbers]
        self._proved = GlobalAdjustment()

    def result(self) -> Merged | None:
        """Return the merged map."""
        joined: dict[int, Keyframe] = {}  # a keyframe of each segment number
        while found := self._next_joined():
            joined |= found
        if not joined:
            return None
        proofs = len(self._proved.loops)
        kept = sorted(self._kept(), key=lambda keyframe: keyframe.id)
        return Merged(
            joined=[(number - self._shift, joined[number].segment) for number in sorted(joined)],
            apart=[(each.id - self._shift, each.id) for each in self._rest],
            proofs=proofs,
            keyframes=kept,
        )

    def _next_joined(self) -> dict[int, Keyframe]:
        """Merge the next segment with a matched place."""
        for each in self._rest:
            number = each.id
            proved = self._met(each)
            if proved:
                self._rest.remove(each)
                self._join(each, proved)
                return {number: each.keyframes[-1]}
        return {}

    def _met(self, segment: Segment) -> list[Loop]:
        """Matches of a segment's keyframes with places of the worlds."""
        self._places.enter()
        view = self._calibration.view
        for keyframe in segment.keyframes:
            corners = self._places.index.features.get(keyframe.id)
            if corners is not None:
                seen = replace(corners, points_px=view.pixels(corners.points_px))
                self._places.compare(
                    keyframe, seen, segment, self._worlds, view, self._parameters, loops=False
                )
        return self._places.meetings.proved

    def _join(self, segment: Segment, proved: list[Loop]) -> None:
        """Merge with all worlds that have a matched place."""
        self._proved.loops += proved
        seen = {loop.old for loop in proved}
        for world in [w for w in self._worlds if any(k.id in seen for k in w.keyframes)]:
            there = {keyframe.id for keyframe in world.keyframes}
            here = {keyframe.id for keyframe in segment.keyframes}
            met = [e for e in self._proved.loops if e.old in there and e.new in here]
            moved = join(self._active(segment), world, met, self._spans, self._calibration)
            self._spans = [(k, segment.id if of == moved.gone else of) for k, of in self._spans]
            assert moved.moves is not None
            self._proved.move(moved.moves)
            self._worlds.remove(world)
        self._worlds.append(segment)

    def _active(self, segment: Segment) -> ActiveMap:
        return ActiveMap(segment, 0, self._calibration, self._parameters)

    def _kept(self) -> Iterator[KeptKeyframe]:
        """Keyframes of all segments: unmatched ones are unchanged."""
        features, changed = self._places.index.features, set[int]()
        origins = {each.id: Origin(each.session, each.source_frame) for each in self._given}
        for each in self._worlds:
            ids = {keyframe.id for keyframe in each.keyframes}
            loops = [loop for loop in self._proved.loops if loop.new in ids]
            if loops:
                yield from keep(each, self._close(each, loops), features, origins)
                changed |= ids
        yield from (each for each in self._given if each.id not in changed)

    def _close(self, segment: Segment, loops: list[Loop]) -> SelfCalibration:
        """Correct the remaining error between merged maps.  Returns the calibration afterwards."""
        active, closing = self._active(segment), GlobalAdjustment(loops=loops)
        closing.request(0, segment, self._calibration, self._parameters)
        result = closing.settle()
        if result is not None and result.moves is not None:
            segment.move(held(result.moves, self._spans, segment.id))
            for loop in result.loops:
                active.join(loop)
        active.collect_garbage()
        return segment.adjust(self._calibration, self._parameters)[0]

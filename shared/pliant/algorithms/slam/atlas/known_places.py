"""The keyframes of all segments as places: which of them an image shows, or a new keyframe
revisits.

Within a segment.  If the map has drifted by no more than a few pixels, landmarks are reacquired by
position, and the keyframes share them.  A place that looks like a new keyframe without sharing
landmarks with it has drifted, or only looks alike.  A true revisit lasts: consecutive keyframes
must show the same drift, so a loop candidate of one keyframe counts when a second one confirms it.

Between segments.  A segment begins after a long loss of the camera.  When it reaches a place of an
earlier segment, keyframes determine the similarity between the two world frames, as they do for
loops. One segment is moved into the other, and the remaining error is corrected as a loop.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from itertools import islice

import numpy as np

from pliant.algorithms.arrays import F32, F64, U8
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import matrix_to_similarity, move_by_similarity, so3_log
from pliant.algorithms.map_delta import MapMoves
from pliant.algorithms.slam.active.active_map import ActiveMap
from pliant.algorithms.slam.adjust.global_adjustment import held
from pliant.algorithms.slam.adjust.loops import Loop
from pliant.algorithms.slam.adjust.segment import Moved, Segment
from pliant.algorithms.slam.calibration.corrected_view import CorrectedView
from pliant.algorithms.slam.calibration.self_calibration import SelfCalibration
from pliant.algorithms.slam.locate.landmark_search import LandmarkSearch
from pliant.algorithms.slam.map.covisibility import marks_fewer
from pliant.algorithms.slam.map.kept_keyframe import KeptKeyframe
from pliant.algorithms.slam.map.keyframe import Keyframe
from pliant.algorithms.slam.map.landmarks import MAPPED, Landmarks
from pliant.algorithms.slam.parameters import MappingParameters
from pliant.algorithms.slam.places.place_index import Features, PlaceIndex, describe
from pliant.algorithms.slam.places.place_match import Refusal, match_places
from pliant.algorithms.slam.places.relocalisation import (
    Place,
    Recognised,
    relocalise,
    rest_is_elsewhere,
)
from pliant.algorithms.slam.store.kept_map import features_for

_WITHIN = 3
"""Keyframes within which another one must confirm a candidate."""

_SAME_TURN_RAD = np.radians(2.0)
_SAME_SHIFT = 0.05
"""Two drifts agree within this rotation, and this share of the depth and of the scale."""

_TRIES = 3
"""Places of a segment that are compared with a keyframe: none of them may contradict."""

_PLACES = 5
"""Number of most similar places that are verified for a frame."""

_LOOKED_AT = 64
"""Number of most similar places in which one without shared landmarks is searched.  If more places
are as similar and all share landmarks, the map has not drifted there.
"""

_ELSEWHERE = 2
"""Further places that are compared after a verified one: many keyframes may see the same room."""


@dataclass(kw_only=True)
class Comparisons:
    """Counts of comparisons between keyframes and places, and their results.

    compared: pairs of keyframes.   few_corners, few_points, one_spot, repeated: rejected, see
    ``place_match``.   contradicted: matches that another place or the image contradicts.
    unconfirmed: loop candidates of one keyframe, of which the best counts, not confirmed yet.
    confirmed: by another keyframe.   refused: of these, by the pose graph.   closed: applied.
    """

    compared: int = 0
    few_corners: int = 0
    few_points: int = 0
    one_spot: int = 0
    repeated: int = 0
    contradicted: int = 0
    unconfirmed: int = 0
    confirmed: int = 0
    refused: int = 0
    closed: int = 0

    def refuse(self, why: Refusal) -> None:
        """Count a rejected pair."""
        setattr(self, why, getattr(self, why) + 1)

    @property
    def counters(self) -> dict[str, int]:
        """The counts by their names in ``report.json``."""
        return {f"places_{name}": count for name, count in vars(self).items()}


@dataclass(kw_only=True)
class LoopCandidates:
    """waiting: loop candidates of one keyframe, until another one confirms them."""

    waiting: list[Loop] = field(default_factory=list[Loop])

    def search(
        self,
        new: Place,
        places: Iterable[Place],
        points: Landmarks,
        camera: PinholeCamera,
        parameters: MappingParameters,
        comparisons: Comparisons,
        tries: int = 1,
        elsewhere: Iterable[Place] = (),
    ) -> list[Loop]:
        """Return the loops that a new keyframe confirms.

        places: of one segment, the most similar first.   comparisons: counted there.   tries: how
        many of them are compared; if they contradict each other, none counts.   elsewhere: others,
        which are compared as well after a match.
        """
        keyframe = new.keyframe
        mine = np.zeros(len(points.state), np.bool_)
        mine[keyframe.rows] = True
        mine &= points.state == MAPPED
        self.waiting = [loop for loop in self.waiting if keyframe.id - loop.new <= _WITHIN]
        window = {k.id for k in new.segment[-parameters.window.keyframes :]}
        # Its own generator: a comparison must not change the pose of a frame.
        generator = np.random.default_rng(keyframe.id)
        least, found_loops = parameters.localisation.min_inliers, list[Loop]()

        def match_with(some: Iterable[Place]) -> None:
            for old in some:
                found = match_places(old, new, points, camera, parameters, generator)
                comparisons.compared += 1
                if isinstance(found, str):
                    comparisons.refuse(found)
                    continue
                rows, S_old_new = found.rows[found.rows[:, 0] != found.rows[:, 1]], found.S_old_new
                ids = points.ids[rows]
                found_loops.append(Loop(old.keyframe.id, keyframe.id, S_old_new, rows, ids))

        match_with(
            islice(
                (
                    old
                    for old in islice(places, _LOOKED_AT)
                    if old.keyframe.id not in window and marks_fewer(mine, old.keyframe.rows, least)
                ),
                tries,
            )
        )
        if found_loops:
            match_with(elsewhere)
        loop = max(found_loops, key=lambda each: len(each.rows), default=None)
        if loop is None or not all(_agree(each, loop, new, points) for each in found_loops):
            comparisons.contradicted += len(found_loops)
            return []
        others = [each for each in self.waiting if each.new != keyframe.id]
        agreeing = [each for each in others if _agree(each, loop, new, points)]
        if not agreeing:
            comparisons.unconfirmed += 1
            self.waiting = [*self.waiting, loop]
            return []
        comparisons.unconfirmed -= len(agreeing)
        comparisons.confirmed += len(agreeing) + 1
        self.waiting = []
        return [*agreeing, loop]


def _agree(one: Loop, other: Loop, new: Place, points: Landmarks) -> bool:
    """Whether two loops move the view of the new keyframe to the same place."""
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


@dataclass(kw_only=True)
class SegmentMerges:
    """Merges of the active segment with earlier ones.

    revisits: candidates of each of those, waiting for a second keyframe.   proved: confirmed loops,
    from places of earlier segments to keyframes of this one, until the segments are merged.
    """

    revisits: dict[int, LoopCandidates] = field(default_factory=dict[int, LoopCandidates])
    proved: list[Loop] = field(default_factory=list[Loop])

    def search(
        self,
        new: Place,
        places: Iterable[Place],
        elsewhere: Callable[[int], Iterable[Place]],
        points: Landmarks,
        camera: PinholeCamera,
        parameters: MappingParameters,
        comparisons: Comparisons,
        contradicts: Callable[[Loop], bool],
    ) -> None:
        """Compare a new keyframe with places of earlier segments, the most similar first.

        elsewhere: other places of a segment, which must not contradict.   comparisons: counted
        there.
        contradicts: whether the keyframe's image contradicts a match.
        """
        by_segment: dict[int, list[Place]] = {}
        for place in places:
            by_segment.setdefault(place.keyframe.segment, []).append(place)
        for segment, some in by_segment.items():
            revisits = self.revisits.setdefault(segment, LoopCandidates())
            proved = revisits.search(
                new, some, points, camera, parameters, comparisons, tries=_TRIES,
                elsewhere=elsewhere(segment),
            )  # fmt: skip
            if any(contradicts(loop) for loop in proved if loop.new == new.keyframe.id):
                comparisons.confirmed -= len(proved)
                comparisons.contradicted += len(proved)
                continue
            self.proved += proved


def join(
    active: ActiveMap,
    earlier: Segment,
    loops: list[Loop],
    spans: list[tuple[int, int]],
    calibration: SelfCalibration,
) -> Moved:
    """Merge two segments in the world frame of the older one, which its first keyframe defines.

    loops: from the earlier one to the active one.   spans: as of ``held``.   calibration: of the
    active segment.
    """
    goes_on = active.segment
    to_earlier = max(loops, key=lambda loop: len(loop.rows)).S_old_new
    active_moves = goes_on.id > earlier.id
    moving, staying = (goes_on, earlier) if active_moves else (earlier, goes_on)
    gone, id = moving.id, staying.id
    S = to_earlier if active_moves else np.asarray(np.linalg.inv(to_earlier), np.float64)
    similarity = matrix_to_similarity(S)
    first = np.array([min(number for number, of in spans if of == gone)], np.int64)
    moves = held(MapMoves(keyframe_ids=first, moves=similarity[None]), spans, gone)
    (active if active_moves else earlier).move(moves)
    moving.inverse_distance /= float(similarity[7])
    goes_on.strayed = staying.strayed
    goes_on.take_in(earlier, id)
    if calibration.readout:
        goes_on.to_global_shutter(earlier.keyframes, calibration)
    same_places = tuple((loop.old, loop.new) for loop in loops)
    return Moved(S if active_moves else np.eye(4), moves, gone, same_places)


@dataclass(kw_only=True)
class KnownPlaces:
    """index: of their corners, at the pixels of the rectified image.   revisits: of the active
    segment with itself.   meetings: with earlier ones.   comparisons: all so far.
    """

    index: PlaceIndex = field(default_factory=PlaceIndex)
    revisits: LoopCandidates = field(default_factory=LoopCandidates)
    meetings: SegmentMerges = field(default_factory=SegmentMerges)
    comparisons: Comparisons = field(default_factory=Comparisons)

    def know(self, kept: Iterable[KeptKeyframe], calibration: SelfCalibration) -> None:
        """Add the places of a loaded map.   calibration: of the current camera."""
        for each in kept:
            if len(each.descriptors):
                self.index.add(each.id, features_for(each, calibration))

    def enter(self) -> None:
        """The camera is in another segment than before."""
        self.revisits, self.meetings = LoopCandidates(), SegmentMerges()

    def recognise(
        self, search: LandmarkSearch, segments: list[Segment], view: CorrectedView
    ) -> Recognised | None:
        """Return the keyframe whose place an image shows, and the pose of the image; None unless
        exactly one place is verified.   search: in the image.   view: of its camera.
        """
        seen = describe(search.grey)
        ranked = self._like(seen, segments, view)
        places = list(islice(ranked, _PLACES))
        least = search.parameters.localisation.min_inliers
        elsewhere = islice(_showing_else(ranked, places, search.points, least), _ELSEWHERE)
        return relocalise(seen, places, elsewhere, search)

    def compare(
        self,
        keyframe: Keyframe,
        seen: Features,
        segment: Segment,
        earlier: list[Segment],
        view: CorrectedView,
        parameters: MappingParameters,
        *,
        loops: bool,
        image: tuple[F32, U8] | None = None,
    ) -> list[Loop]:
        """Compare a new keyframe, with these corners, with earlier places.

        Returns the loops that it confirms in its own segment, if requested; matches with earlier
        segments wait in ``meetings``.   image: its maxima (M, 3), and the image (H, W).
        """
        new = Place(keyframe=keyframe, corners=seen, segment=segment.keyframes)
        rest = segment.points, view.camera, parameters, self.comparisons
        found = self.revisits.search(new, self._like(seen, [segment], view), *rest) if loops else []
        if earlier:
            least = parameters.localisation.min_inliers
            near = list(islice(self._like(seen, earlier, view), _PLACES))

            def elsewhere(number: int) -> Iterator[Place]:
                of = [each for each in earlier if each.id == number]
                others = _showing_else(self._like(seen, of, view), near, segment.points, least)
                yield from islice(others, _ELSEWHERE)

            def contradicts(loop: Loop) -> bool:
                if image is None:
                    return False
                known = ((k, each.keyframes) for each in earlier for k in each.keyframes)
                old, among = next(each for each in known if each[0].id == loop.old)
                pose = move_by_similarity(loop.S_old_new, keyframe.T_world_camera)
                # Its own generator: a comparison must not change the pose of a frame.
                generator = np.random.default_rng(keyframe.id)
                search = LandmarkSearch(segment.points, *image, view.camera, parameters, generator)
                return rest_is_elsewhere(pose, old, among, search)

            self.meetings.search(new, near, elsewhere, *rest, contradicts)
        return found

    def remember(
        self, keyframe: Keyframe, seen: Features, segments: list[Segment], view: CorrectedView
    ) -> None:
        """Add a keyframe as a place; remove keyframes that the segments have dropped."""
        self.index.add(keyframe.id, replace(seen, points_px=view.seen(seen.points_px)))
        known = {k.id for segment in segments for k in segment.keyframes}
        self.index.forget(self.index.features.keys() - known)

    def _like(
        self, seen: Features, segments: list[Segment], view: CorrectedView
    ) -> Iterator[Place]:
        """Keyframes of the segments that look like an image, the most similar first."""
        known = {k.id: (k, each.keyframes) for each in segments for k in each.keyframes}
        for keyframe, segment in (known[i] for i in self.index.query(seen) if i in known):
            corners = self.index.features[keyframe.id]
            yield Place(keyframe=keyframe, corners=corners, segment=segment, view=view)


def _showing_else(
    ranked: Iterable[Place], places: list[Place], points: Landmarks, least: int
) -> Iterator[Place]:
    """The next places that share fewer than ``least`` landmarks with the former."""
    shown = np.zeros(len(points.state), np.bool_)
    for place in places:
        shown[place.keyframe.rows] = True
    for place in ranked:
        if marks_fewer(shown, place.keyframe.rows, least):
            shown[place.keyframe.rows] = True
            yield place

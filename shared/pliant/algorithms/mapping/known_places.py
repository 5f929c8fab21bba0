"""The keyframes of all segments as places: which of them an image shows, or a keyframe comes to."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from itertools import islice

import numpy as np

from pliant.algorithms.arrays import F32, U8
from pliant.algorithms.corrected_view import CorrectedView
from pliant.algorithms.geometry import move_by_similarity
from pliant.algorithms.kept_keyframe import KeptKeyframe
from pliant.algorithms.mapping.kept_map import features_for
from pliant.algorithms.mapping.loops import Loop
from pliant.algorithms.mapping.map_store import Keyframe, PointRows
from pliant.algorithms.mapping.meetings import Meetings
from pliant.algorithms.mapping.parameters import MappingParameters
from pliant.algorithms.mapping.relocalisation import (
    Place,
    Recognised,
    relocalise,
    rest_is_elsewhere,
)
from pliant.algorithms.mapping.revisits import Revisits
from pliant.algorithms.mapping.segment import Segment
from pliant.algorithms.mapping.self_calibration import SelfCalibration
from pliant.algorithms.places.features import Features, describe
from pliant.algorithms.places.index import PlaceIndex

_PLACES = 5
"""That look most like a frame are looked at more closely."""

_ELSEWHERE = 2
"""Places more where one of these is proved: what looks the same is often seen by many keyframes."""


@dataclass(kw_only=True)
class KnownPlaces:
    """index: of their corners, at the pixels of the rectified image.   revisits: of the segment
    that the camera is in with itself.   meetings: with earlier ones.
    """

    index: PlaceIndex = field(default_factory=PlaceIndex)
    revisits: Revisits = field(default_factory=Revisits)
    meetings: Meetings = field(default_factory=Meetings)

    def know(self, kept: Iterable[KeptKeyframe], calibration: SelfCalibration) -> None:
        """Take in the places of a map that was kept.   calibration: of the camera that has come."""
        for each in kept:
            if len(each.descriptors):
                self.index.add(each.id, features_for(each, calibration))

    def enter(self) -> None:
        """The camera is in a segment that it was not in before."""
        self.revisits, self.meetings = Revisits(), Meetings()

    def recognise(
        self,
        grey: U8,
        maxima: F32,
        segments: list[Segment],
        points: PointRows,
        calibration: SelfCalibration,
        parameters: MappingParameters,
        generator: np.random.Generator,
    ) -> Recognised | None:
        """Which keyframe of the segments saw what an image shows, and where that was taken; None
        where no single one is proved.   grey: (H, W).   maxima: (M, 3) of its curvature.
        """
        seen, view = describe(grey), calibration.view
        ranked = self._like(seen, segments, view)
        places = list(islice(ranked, _PLACES))
        least = parameters.localisation.min_inliers
        elsewhere = islice(_showing_else(ranked, places, points, least), _ELSEWHERE)
        return relocalise(
            seen, places, elsewhere, points, maxima, grey, view.camera, parameters, generator
        )

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
        """What a new keyframe, which sees these corners, shows again: returns the loops that it
        proves in its own segment, where these are asked for; what it has in common with earlier
        ones waits in ``meetings``.   image: its maxima (M, 3), and itself (H, W).
        """
        new = Place(keyframe=keyframe, features=seen, segment=segment.keyframes)
        rest = segment.points, view.camera, parameters
        found = self.revisits.look(new, self._like(seen, [segment], view), *rest) if loops else []
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
                # Its own, so that no frame is located otherwise because something was looked at.
                generator = np.random.default_rng(keyframe.id)
                return rest_is_elsewhere(
                    pose, old, among, segment.points, *image, view.camera, parameters, generator
                )

            self.meetings.look(new, near, elsewhere, *rest, contradicts)
        return found

    def remember(
        self, keyframe: Keyframe, seen: Features, segments: list[Segment], view: CorrectedView
    ) -> None:
        """A keyframe is a place to come back to; those that the segments have forgotten are not."""
        self.index.add(keyframe.id, replace(seen, points_px=view.seen(seen.points_px)))
        known = {k.id for segment in segments for k in segment.keyframes}
        self.index.forget(self.index.features.keys() - known)

    def _like(
        self, seen: Features, segments: list[Segment], view: CorrectedView
    ) -> Iterator[Place]:
        """Keyframes of the segments that look like an image, the most alike first."""
        known = {k.id: (k, each.keyframes) for each in segments for k in each.keyframes}
        for keyframe, segment in (known[i] for i in self.index.query(seen) if i in known):
            features = self.index.features[keyframe.id]
            there = replace(features, points_px=view.pixels(features.points_px))
            yield Place(keyframe=keyframe, features=there, segment=segment)


def _showing_else(
    ranked: Iterable[Place], places: list[Place], points: PointRows, least: int
) -> Iterator[Place]:
    """The next places that show hardly a point, fewer than ``least``, of those before."""
    shown = np.zeros(len(points.state), np.bool_)
    for place in places:
        shown[place.keyframe.rows] = True
    for place in ranked:
        if np.count_nonzero(shown[place.keyframe.rows]) < least:
            shown[place.keyframe.rows] = True
            yield place

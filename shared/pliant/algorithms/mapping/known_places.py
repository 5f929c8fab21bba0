"""The keyframes of all segments as places: which of them look like an image."""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

from pliant.algorithms.corrected_view import CorrectedView
from pliant.algorithms.mapping.active_map import ActiveMap
from pliant.algorithms.mapping.map_store import Keyframe
from pliant.algorithms.mapping.relocalisation import Place
from pliant.algorithms.places.features import Features
from pliant.algorithms.places.index import PlaceIndex


@dataclass(kw_only=True)
class KnownPlaces:
    """index: of their corners, at the pixels of the rectified image."""

    index: PlaceIndex = field(default_factory=PlaceIndex)

    def like(self, seen: Features, maps: list[ActiveMap], view: CorrectedView) -> Iterator[Place]:
        """Keyframes of the maps that look like an image, the most alike first."""
        segments = {k.id: (k, active.keyframes) for active in maps for k in active.keyframes}
        for keyframe, segment in (segments[i] for i in self.index.query(seen) if i in segments):
            features = self.index.features[keyframe.id]
            there = replace(features, points_px=view.pixels(features.points_px))
            yield Place(keyframe=keyframe, features=there, segment=segment)

    def remember(
        self, keyframe: Keyframe, seen: Features, maps: list[ActiveMap], view: CorrectedView
    ) -> None:
        """A keyframe is a place to come back to; those that the maps have forgotten are not."""
        self.index.add(keyframe.id, replace(seen, points_px=view.seen(seen.points_px)))
        known = {k.id for active in maps for k in active.keyframes}
        self.index.forget(self.index.features.keys() - known)

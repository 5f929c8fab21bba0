"""What readers get after each frame: the differences of the map, and at times a snapshot."""

from dataclasses import dataclass, replace

import numpy as np

from pliant.algorithms.map_delta import KeyframeDelta, MapDelta
from pliant.algorithms.slam.atlas.atlas import Atlas
from pliant.algorithms.slam.journal import Journal, Outcome
from pliant.algorithms.slam.parameters import MappingParameters


@dataclass
class Publisher:
    """Publishes the changes of an atlas by its journal.

    frames: number of outcomes so far.   has_focals: whether the last snapshot had focal lengths.
    """

    atlas: Atlas
    journal: Journal
    parameters: MappingParameters
    frames: int = 0
    has_focals: bool = False

    def outcome(
        self, state: int, reason: str, inliers: int, *, is_keyframe: bool, is_last: bool = False
    ) -> Outcome:
        """Return what came of a frame, or of the end of the stream."""
        self.frames += 1
        # Now and then everything active is published, for late readers.
        snapshot = is_last or self.frames % self.parameters.snapshot_frames == 0
        # Between keyframes only new landmarks are published; moves follow with the next keyframe.
        self.atlas.note_changed(self.journal, everything=snapshot or is_keyframe)
        centre = np.zeros(3)
        if self.atlas.active is not None:
            centre = self.atlas.active.keyframes[-1].T_world_camera[:3, 3].copy()
        return Outcome(state, reason, inliers, self.atlas.segment, centre, snapshot)

    def publish(self, outcome: Outcome) -> MapDelta:
        """Return the changes since the last call.   outcome: of the last frame."""
        calibration = self.atlas.calibration
        delta = calibration.published_with(self.journal.publish(outcome))
        if outcome.snapshot and (calibration.changes or self.has_focals):
            self.has_focals = calibration.changes  # else they are withdrawn
            made = [k for segment, _ in self.atlas.everything() for k in segment.keyframes]
            delta = replace(
                delta,
                focal_keyframes=np.array([keyframe.id for keyframe in made], np.int64),
                log_focals=np.array([keyframe.log_focal for keyframe in made]),
            )
        return delta

    def publish_keyframes(self) -> KeyframeDelta:
        """Return the keyframe changes since the last call."""
        active, calibration = self.atlas.active, self.atlas.calibration
        if active is None:
            return self.journal.publish_keyframes(None, calibration)
        self.journal.settle(active.keyframes[: -self.parameters.window.keyframes])
        return self.journal.publish_keyframes(active.keyframes[-1], calibration)

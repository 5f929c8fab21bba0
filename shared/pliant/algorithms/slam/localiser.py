"""Localises frames in a loaded map, which does not change.

A frame is recognised by its appearance.  Later frames are localised by landmarks: tracked ones, and
those reacquired at the maxima of curvature, as during mapping.  Nothing is triangulated or
adjusted.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pliant.algorithms.arrays import F32, F64, U8
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import inverse, so3_log, transform
from pliant.algorithms.inertial.samples import ImuSamples
from pliant.algorithms.map_delta import LOST, TRACKING, WAITING, KeyframeDelta, MapDelta
from pliant.algorithms.slam.active.active_map import ActiveMap
from pliant.algorithms.slam.active.frame_pose import (
    judge_tracks,
    locate_in_map,
    reacquire_points,
    with_support,
)
from pliant.algorithms.slam.active.tracked_pose import pose_by_tracks
from pliant.algorithms.slam.adjust.global_adjustment import GlobalAdjustment
from pliant.algorithms.slam.atlas.known_places import KnownPlaces
from pliant.algorithms.slam.calibration.self_calibration import SelfCalibration
from pliant.algorithms.slam.frame import Frame, IdealFrame, PlacedFrame
from pliant.algorithms.slam.frame_mapper import FrameMapper
from pliant.algorithms.slam.journal import Journal, Outcome
from pliant.algorithms.slam.locate.landmark_search import LandmarkSearch
from pliant.algorithms.slam.locate.localisation import Motion
from pliant.algorithms.slam.locate.pose_quality import SETTLED_S, why_doubtful
from pliant.algorithms.slam.map.kept_keyframe import KeptKeyframe
from pliant.algorithms.slam.map.keyframe import Keyframe
from pliant.algorithms.slam.map.landmarks import MAPPED, Landmarks
from pliant.algorithms.slam.parameters import MappingParameters
from pliant.algorithms.slam.places.relocalisation import Recognised
from pliant.algorithms.slam.store.kept_map import known_camera, take_in
from pliant.algorithms.stages import StageTimer, no_stages

_LOOK_TURN_RAD = np.radians(5.0)
_LOOK_SHIFT = 0.05
"""Share of the depth: after a larger motion or rotation, other keyframes may be covisible."""


class Localiser(FrameMapper):
    """A ``FrameMapper`` that never extends its map.

    A pure function of camera, map, parameters, seed and the frames in their order.
    """

    def __init__(
        self,
        camera: PinholeCamera,
        parameters: MappingParameters,
        seed: int,
        known: Sequence[KeptKeyframe] = (),
    ) -> None:
        """known: the map; if it is of the same camera, its calibration is used."""
        self._parameters = parameters
        given = SelfCalibration.of(camera, parameters.calibration)
        found = known_camera(known, camera) or given
        self.calibration = replace(found, uncertainty=given.uncertainty)
        self._no_adjustment = GlobalAdjustment()
        self._generator = np.random.default_rng(seed)
        self._points = Landmarks()
        self._journal = Journal(self._points)
        self._places = KnownPlaces()
        self._segments = take_in(known, self._points, self.calibration)
        self._places.know(known, self.calibration)
        self._map: ActiveMap | None = None
        self._reference: Keyframe | None = None
        self._motion: Motion | None = None
        self._activated_from: F64 = np.eye(4)

    def process(self, frame: Frame, timer: StageTimer = no_stages) -> MapDelta:
        """Localise a frame in the map."""
        ideal = IdealFrame.of(frame, self.calibration)
        if self._map is not None:
            self._map.links.follow(frame.extrema.ids, self._points)
        located = self._locate(ideal, timer)
        if located is None or self._map is None or self._reference is None:
            return self._publish(LOST if self._map else WAITING, "not recognised in the map", 0)
        with timer("reacquisition"):
            has_activated = self._activate_near(self._map, located)
            placed = self._find(self._map, ideal, located)
        inliers = placed.support.inliers
        if inliers < self._parameters.localisation.min_inliers:
            return self._publish(LOST, f"lost: {inliers} points of the map are seen", 0)
        if self._motion is None:
            self._motion = Motion.at(frame.number, frame.stamp_ns, placed.T_world_camera)
            self._journal.add_same_places([(self._reference.id, -1)])
        else:
            tracked = placed.support.tracked
            self._motion = self._motion.then(
                frame.number, frame.stamp_ns, placed.T_world_camera, tracked, tracked
            )
        return self._publish_placed(self._reference, placed, has_activated=has_activated)

    def only_localise(self, frame: Frame, otherwise: str) -> MapDelta:
        """As ``Mapper.only_localise``."""
        active, reference, motion, found = self._map, self._reference, self._motion, None
        if active is not None and motion is not None:
            active.links.follow(frame.extrema.ids, active.points)
            found = pose_by_tracks(active, self.calibration, motion, frame, self._generator)
        if found is None or reference is None or motion is None:
            return self.skip(frame.number, otherwise)
        tracked = found.support.tracked
        self._motion = motion.then_unmapped(
            frame.number, frame.stamp_ns, found.T_world_camera, tracked, tracked
        )
        return self._publish_placed(reference, found)

    def recognise(self, maxima: F32, grey: U8, generator: np.random.Generator) -> Recognised | None:
        """Return the pose of an image (H, W) of the ideal camera, with its maxima (M, 3) of
        curvature, by its appearance alone.
        """
        view = self.calibration.view
        search = LandmarkSearch(
            self._points, maxima, grey, view.camera, self._parameters, generator
        )
        return self._places.recognise(search, self._segments, view)

    def skip(self, frame: int, reason: str = "the frame has no pixels") -> MapDelta:
        """As ``Mapper.skip``."""
        return self._publish(WAITING if self._map is None else TRACKING, reason, 0)

    @property
    def global_adjustment(self) -> GlobalAdjustment:
        """One without a job, because the map is unchanged."""
        return self._no_adjustment

    @property
    def point_count(self) -> int:
        """Number of landmarks in the map."""
        return int(np.count_nonzero(self._points.state == MAPPED))

    def add_samples(self, samples: ImuSamples) -> None:
        """As ``Mapper.add_samples``; they do not change a loaded map."""

    def finish(self, timer: StageTimer = no_stages) -> MapDelta:
        """As ``Mapper.finish``."""
        return self._publish(WAITING if self._map is None else TRACKING, "", 0)

    def publish_keyframes(self) -> KeyframeDelta:
        """There are no new keyframes."""
        return self._journal.publish_keyframes(None, self.calibration)

    def _locate(self, frame: IdealFrame, timer: StageTimer) -> F64 | None:
        """T_world_camera of the frame, by continuing or by recognition."""
        located, place = locate_in_map(
            self._map, self._motion, frame, self._generator, self._recognise, timer
        )
        if place is not None:
            self._reference, self._motion = place.keyframe, None
            segment = next(each for each in self._segments if each.id == place.keyframe.segment)
            self._map = ActiveMap(segment, 0, self.calibration, self._parameters)
            self._map.links.follow(frame.tracks.ids, self._points)
            self._map.activate_near(place.T_world_camera)
            self._activated_from = place.T_world_camera
        return located

    def _recognise(self, frame: IdealFrame) -> Recognised | None:
        return self.recognise(frame.tracks.maxima, frame.image, self._generator)

    def _activate_near(self, active: ActiveMap, T_world_camera: F64) -> bool:
        """Whether the camera has moved so far that other keyframes may be covisible."""
        rows = active.links.rows[active.linked(MAPPED)]
        moved = inverse(self._activated_from) @ T_world_camera
        turn = float(np.linalg.norm(so3_log(moved[:3, :3])))
        shift, depth = float(np.linalg.norm(moved[:3, 3])), 0.0
        if len(rows):
            seen = transform(inverse(T_world_camera), self._points.xyz[rows])
            depth = float(np.median(seen[:, 2]))
        if turn < _LOOK_TURN_RAD and shift < _LOOK_SHIFT * depth:
            return False
        if depth > 0.0:
            active.segment.inverse_distance = 1.0 / depth
        active.activate_near(T_world_camera)
        self._activated_from = T_world_camera
        return True

    def _find(self, active: ActiveMap, frame: IdealFrame, T_world_camera: F64) -> PlacedFrame:
        """The pose by all reacquired landmarks, and its quality."""
        placed = reacquire_points(active, self._motion, frame, T_world_camera)
        interval_s = 0.0 if self._motion is None else self._motion.interval_s()
        settled = frame.tracks.ages * interval_s >= SETTLED_S
        placed = with_support(active, placed, placed.frame.tracks.points_px[settled])
        judge_tracks(active, placed)
        return placed

    def _publish_placed(
        self, reference: Keyframe, placed: PlacedFrame, *, has_activated: bool = False
    ) -> MapDelta:
        support = placed.support
        self._journal.add_pose(
            placed.frame.number, reference, placed.T_world_camera, support.inliers
        )
        why = why_doubtful(support)
        return self._publish(TRACKING, why, support.inliers, has_activated=has_activated)

    def _publish(
        self, state: int, reason: str, inliers: int, *, has_activated: bool = False
    ) -> MapDelta:
        active, reference = self._map, self._reference
        self._journal.add_changed(
            [] if reference is None else [reference],
            active.nearby() if active is not None and has_activated else np.zeros(0, np.int32),
        )
        self._points.take_removed()  # readers keep merged landmarks: the map does not change
        segment = -1 if active is None else active.segment.id
        centre = self._activated_from[:3, 3].copy()
        outcome = Outcome(state, reason, inliers, segment, centre)
        return self.calibration.published_with(self._journal.publish(outcome))

"""The mapper: from the tracks of each frame to its pose and a dense map.

VITAMIN-E section 3: start by essential matrix, poses by P3P and RANSAC, landmarks by triangulation,
and bundle adjustment on every frame by the subspace Gauss-Newton method.  In addition, Schur LM
over the window at keyframes, and reacquisition of landmarks that lost their track.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from pliant.algorithms.arrays import F64
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.image.exposure import flaw_of
from pliant.algorithms.inertial.samples import ImuSamples
from pliant.algorithms.map_delta import LOST, TRACKING, WAITING, KeyframeDelta, MapDelta
from pliant.algorithms.slam.active.active_map import ActiveMap
from pliant.algorithms.slam.active.frame_pose import (
    adjust,
    check_pure_rotation,
    limits_of_points,
    locate_in_map,
    reacquire_points,
    tracks_to_points,
)
from pliant.algorithms.slam.active.frame_turns import FrameTurns
from pliant.algorithms.slam.active.tracked_pose import pose_by_tracks
from pliant.algorithms.slam.adjust.carried_frames import carried_poses
from pliant.algorithms.slam.adjust.global_adjustment import GlobalAdjustment
from pliant.algorithms.slam.adjust.ordinary_frames import (
    STANDING_ROOMS,
    OrdinaryFrame,
    refined_poses,
    smoothed_poses,
)
from pliant.algorithms.slam.adjust.segment import InertialSource, Moved, Segment
from pliant.algorithms.slam.atlas.atlas import Atlas
from pliant.algorithms.slam.calibration.self_calibration import SelfCalibration
from pliant.algorithms.slam.frame import Frame, IdealFrame, PlacedFrame
from pliant.algorithms.slam.journal import Journal, Outcome
from pliant.algorithms.slam.keyframe_rule import is_due
from pliant.algorithms.slam.locate.localisation import Motion
from pliant.algorithms.slam.locate.pose_quality import why_doubtful
from pliant.algorithms.slam.map.kept_keyframe import KeptKeyframe
from pliant.algorithms.slam.map.keyframe import Keyframe
from pliant.algorithms.slam.map.landmarks import MAPPED
from pliant.algorithms.slam.parameters import MappingParameters
from pliant.algorithms.slam.places.relocalisation import Recognised
from pliant.algorithms.slam.start.first_map import Start
from pliant.algorithms.slam.start.focal_hypotheses import find_start_of
from pliant.algorithms.slam.start.initialisation_buffer import (
    InitialisationBuffer,
    earlier_poses,
    returned_poses,
)
from pliant.algorithms.slam.start.start import with_minimum_parallax
from pliant.algorithms.slam.store.kept_map import known_camera
from pliant.algorithms.stages import StageTimer, no_stages

_LEAST_LOST = 3
"""Minimum frames without a pose before a segment is closed, however long that takes: for time
lapses.
"""


class Mapper:
    """A ``FrameMapper`` that builds the map and localises every frame in it.

    A pure function of camera, parameters, seed and the frames in their order.
    """

    def __init__(
        self,
        camera: PinholeCamera,
        parameters: MappingParameters,
        seed: int,
        calibration: SelfCalibration | None = None,
        known: Sequence[KeptKeyframe] = (),
        samples: ImuSamples | None = None,
    ) -> None:
        """calibration: estimated so far; None: that of the map, or of the parameters.   known: a
        loaded map in which the camera may be recognised.   samples: inertial, of the whole source.
        """
        calibration = (
            calibration
            or known_camera(known, camera)
            or SelfCalibration.of(camera, parameters.calibration)
        )
        calibration = replace(calibration, uncertainty=parameters.calibration)
        self.atlas = Atlas(calibration, parameters, known)
        self._parameters = parameters
        self._generator = np.random.default_rng(seed)
        self.journal = Journal(self.atlas.points, after=known[-1].id if known else -1)
        self._waiting = InitialisationBuffer()
        self._stamps_ns: dict[int, int] = {}  # capture time of each frame
        self._motion = Motion.at(0, 0, np.eye(4))  # in the active segment
        self._turns = FrameTurns.of(samples)
        self._samples = samples
        self._without_pose: dict[int, None] = {}  # lost frames, in their order
        self._lost_frames = 0
        self._keyframe_ns = 0
        self._keyframe_is_new = False
        self._recognised: int | None = None  # the keyframe, until this frame becomes one
        self._published_frames = 0
        self._focals_published = False

    def process(self, frame: Frame, timer: StageTimer = no_stages) -> MapDelta:
        """Localise a frame, extend the map, and return what readers need."""
        return self.publish(self.take(frame, timer))

    def take(self, frame: Frame, timer: StageTimer = no_stages) -> Outcome:
        """Localise a frame and extend the map."""
        self._stamps_ns[frame.number] = frame.stamp_ns
        ideal = self._catch_up(frame, timer)
        located = self._locate(ideal, timer)
        active = self.atlas.active
        if active is None:
            return self._wait(ideal, timer)
        if located is None:
            return self._lost(active, ideal)
        with timer("reacquisition"):
            placed = reacquire_points(active, self._motion, ideal, located)
            self._turns.look(active, self._motion, placed)
        placed = self._adjust(active, placed, timer)
        placed = self._attach(active, placed, timer)
        self._refine_passed(active.segment, timer)
        self._go_on_from(active, placed, self._motion.then)
        if self._keyframe_is_new:
            self.atlas.request(frame.number)
        return self._tracked(placed)

    def _catch_up(self, frame: Frame, timer: StageTimer) -> IdealFrame:
        """Apply finished corrections of map and calibration, and correct the frame by them."""
        if self.atlas.active is not None:
            with timer("whole map"):
                before = self.calibration
                self.follow(self.atlas.catch_up(frame.number))
                if not self.calibration.sees_like(before):
                    self._waiting = self._waiting.seen_by(before.view, self.calibration.view)
            self._predict(self.atlas.active, frame)
        with timer("corrected view"):
            return IdealFrame.of(frame, self.calibration)

    def _predict(self, active: ActiveMap, frame: Frame) -> None:
        """Continue the tracks and the focal length, and predict the rotation by the gyro."""
        active.links.follow(frame.extrema.ids, active.points)
        self.atlas.focus(self._motion, frame.stamp_ns, frame.extrema)
        self._motion = self._turns.predict(self._motion, frame.stamp_ns)

    def _adjust(self, active: ActiveMap, placed: PlacedFrame, timer: StageTimer) -> PlacedFrame:
        """Adjust the frame with its landmarks, and triangulate others."""
        with timer("subspace adjustment"):
            placed = adjust(active, self._motion, placed)
        with timer("triangulation"):
            limits = limits_of_points(placed.support.inliers, self._parameters)
            active.window.triangulate(limits)
        return placed

    def _attach(self, active: ActiveMap, placed: PlacedFrame, timer: StageTimer) -> PlacedFrame:
        """Make the frame a keyframe if one is due, or attach it to the last one."""
        self._lost_frames = 0
        self._keyframe_is_new = self._keyframe_is_due(active, placed.frame.stamp_ns)
        if self._keyframe_is_new:
            return self._insert_keyframe(active, placed, timer)
        active.add_ordinary(placed)
        return placed

    def _refine_passed(self, segment: Segment, timer: StageTimer) -> None:
        """Refine earlier frames that are no keyframes."""
        with timer("passed frames"):
            rooms = 1 if self._keyframe_is_new else STANDING_ROOMS
            surplus = segment.ordinary.take_surplus(self._parameters, rooms)
            self._correct(segment, surplus, self.calibration)

    def _keyframe_is_due(self, active: ActiveMap, stamp_ns: int) -> bool:
        if active.segment.resumes:
            return True  # the camera has been recognised
        age_s = 1e-9 * (stamp_ns - self._keyframe_ns)
        interval_s = self._motion.unmapped_s + self._motion.lost_s(stamp_ns)
        return is_due(active.overlap(age_s, interval_s), self._parameters.keyframe)

    def _insert_keyframe(
        self, active: ActiveMap, placed: PlacedFrame, timer: StageTimer
    ) -> PlacedFrame:
        """Make the frame a keyframe.  Returns it if the window has moved it."""
        frame = placed.frame
        with timer("keyframe"):
            placed = check_pure_rotation(active, placed)
            if frame.rolled is not None:
                active.segment.to_global_shutter(active.window.keyframes, self.calibration)
            keyframe = active.insert_keyframe(placed)
        self.follow(self.atlas.calibrate())
        self._keyframe_ns = frame.stamp_ns
        if self._recognised is not None:
            self.journal.add_same_places([(self._recognised, keyframe.id)])
            self._recognised = None
        with timer("places"):
            self.atlas.remember(keyframe, frame)
        return replace(placed, T_world_camera=keyframe.T_world_camera)

    def _go_on_from(
        self, active: ActiveMap, placed: PlacedFrame, then: Callable[..., Motion]
    ) -> None:
        """The frame has a pose: place the frames that waited for it, and predict from it."""
        keyframe, number = active.keyframes[-1], placed.frame.number
        T_world_camera, support = placed.T_world_camera, placed.support
        self._place_waiting(active, keyframe, T_world_camera)
        self._waiting = InitialisationBuffer()
        to_points = tracks_to_points(active, placed)
        self._turns.see(self._motion, placed)
        self._motion = then(
            number, placed.frame.stamp_ns, T_world_camera, support.tracked, to_points
        )
        self._add_pose(number, keyframe, T_world_camera, support.inliers)

    def _tracked(self, placed: PlacedFrame) -> Outcome:
        why = why_doubtful(placed.support, self._parameters.support)
        return self._outcome(TRACKING, why, placed.support.inliers)

    def follow(self, moved: list[Moved]) -> None:
        """Move the motion model with the map, and publish the move."""
        for each in moved:
            self._motion = self._motion.moved(each.S)
            self._turns.follow(each.S)
            if each.moves is not None:
                self.journal.move(each.moves)
            if each.gone is not None:
                self.journal.join(each.gone, self.atlas.segment)
            self.journal.add_same_places(each.same_places)

    def skip(self, frame: int, reason: str = "the frame has no pixels") -> MapDelta:
        """Skip a frame without pixels (dropped or broken) or without time: it gets no pose.

        Only mapped frames decide whether the camera is lost: the state is unchanged.  Surviving
        tracks continue in the next frame.
        """
        return self.publish(self._passed_over(reason))

    def _passed_over(self, reason: str) -> Outcome:
        state = LOST if self._lost_frames else TRACKING
        return self._outcome(WAITING if self.atlas.active is None else state, reason, 0)

    def only_localise(self, frame: Frame, otherwise: str) -> MapDelta:
        """Localise a frame by its tracks in the map as it is, when there is no time to map it.

        A frame without a pose waits until the next mapped frame has one.  otherwise: the reason
        that it is published with.
        """
        return self.publish(self.take_tracks(frame, otherwise))

    def take_tracks(self, frame: Frame, otherwise: str) -> Outcome:
        """Localise a frame as ``only_localise`` does."""
        active, found = self.atlas.active, None
        self._stamps_ns[frame.number] = frame.stamp_ns
        self._keyframe_is_new = False
        if active is not None and not self._lost_frames:
            self._predict(active, frame)
            found = pose_by_tracks(active, self.calibration, self._motion, frame, self._generator)
        if active is None or found is None:
            ideal = IdealFrame.of(frame, self.calibration)
            self._waiting = self._waiting.then(ideal, self._parameters)
            return self._passed_over(otherwise)
        self._turns.look(active, self._motion, found)
        active.add_ordinary(found)
        self._go_on_from(active, found, self._motion.then_unmapped)
        return self._tracked(found)

    def finish(self, timer: StageTimer = no_stages) -> MapDelta:
        """Apply the remaining corrections at the end of the stream."""
        self.start_at_last()
        samples = self._samples
        inertial = None if samples is None else InertialSource(samples, self._stamps_ns)
        self.follow(self.atlas.finish(timer, inertial))
        with timer("skipped frames"):
            for segment, seen_by in self.atlas.everything():
                self._correct(segment, segment.ordinary.take_all(), seen_by)
                self._smooth(segment, seen_by)
        if self.atlas.active is None:
            return self.publish(self._outcome(WAITING, "the stream has ended", 0, snapshot=True))
        self.journal.settle(self.atlas.active.keyframes)
        return self.publish(self._outcome(TRACKING, "", 0, snapshot=True))

    def _add_pose(self, frame: int, keyframe: Keyframe, T_world_camera: F64, inliers: int) -> None:
        self._without_pose.pop(frame, None)
        self.journal.add_pose(frame, keyframe, T_world_camera, inliers)
        self.atlas.add_pose(frame, keyframe, T_world_camera, inliers)

    def _correct(
        self, segment: Segment, frames: list[OrdinaryFrame], seen_by: SelfCalibration
    ) -> None:
        """Place frames again in the current map.   seen_by: the calibration of their pixels."""
        for each in refined_poses(frames, segment.points, seen_by, self._parameters):
            pose = each.frame, each.keyframe, each.T_world_camera, each.inliers
            self.journal.add_pose(*pose)
            segment.path.refine(*pose, each.information)

    def _smooth(self, segment: Segment, seen_by: SelfCalibration) -> None:
        """Smooth the poses of a segment that is final."""
        smoothed = smoothed_poses(
            segment.keyframes, segment.path, self._stamps_ns, segment.points, seen_by,
            self._parameters,
        )  # fmt: skip
        if self._turns.gyro is not None:
            lost = list(self._without_pose)
            smoothed += carried_poses(smoothed, self._stamps_ns, lost, self._turns.gyro)
        for each in smoothed:
            self.journal.add_pose(each.frame, each.keyframe, each.T_world_camera, each.inliers)

    def publish_keyframes(self) -> KeyframeDelta:
        """Return the keyframe changes after the last frame, or after ``finish``."""
        active = self.atlas.active
        if active is None:
            return self.journal.publish_keyframes(None, self.calibration)
        self.journal.settle(active.keyframes[: -self._parameters.window.keyframes])
        return self.journal.publish_keyframes(active.keyframes[-1], self.calibration)

    @property
    def waiting_frames(self) -> list[int]:
        """Numbers of the frames from which a map may still start."""
        return [waiting.frame for waiting in self._waiting.frames]

    def _wait(self, frame: IdealFrame, timer: StageTimer) -> Outcome:
        self._waiting = self._waiting.then(frame, self._parameters)
        with timer("start"):
            begun = self._begin_where_possible(self._parameters)
        if isinstance(begun, str):
            return self._outcome(WAITING, self._flaw(frame) or begun, 0)
        return self._outcome(TRACKING, "", begun)

    def _flaw(self, frame: IdealFrame) -> str:
        """Why the image has fewer tracks than a start needs, if it is visible."""
        few = len(frame.tracks.ids) < self._parameters.start.min_tracks
        return flaw_of(frame.given.grey) if frame.given.grey is not None and few else ""

    def start_at_last(self) -> bool:
        """Begin a map with the existing frames, at the end of the stream.  Whether there is
        a map.
        """
        if self.atlas.active is None and self._waiting.frames:
            self._begin_where_possible(with_minimum_parallax(self._parameters))
        return self.atlas.active is not None

    def _begin_where_possible(self, parameters: MappingParameters) -> int | str:
        """Return the inliers of the newest frame if a map starts, or else the reason why not."""
        found = find_start_of(self._waiting.frames, self.calibration, parameters)
        return found if isinstance(found, str) else self._begin(*found)

    def _begin(self, start: Start, calibration: SelfCalibration) -> int:
        """Start the map, and give poses to the waiting frames, backwards."""
        waiting, self._waiting = self._waiting, InitialisationBuffer()
        assert waiting.newest is not None
        latest = IdealFrame.of(waiting.newest, self.calibration)
        active = self.atlas.begin(start, calibration, waiting.frames, latest)
        placed = list(
            earlier_poses(
                start, active.keyframes, waiting, self._camera, self._parameters.localisation
            )
        )
        for each in placed:
            self._add_pose(each.frame, each.keyframe, each.T_world_camera, each.inliers)
        stamps_ns = {each.frame: each.stamp_ns for each in waiting.frames}
        newest, before = placed[0], placed[min(1, len(placed) - 1)]
        self._motion = Motion(
            frames=(before.frame, newest.frame),
            stamps_ns=(stamps_ns[before.frame], stamps_ns[newest.frame]),
            poses=(before.T_world_camera, newest.T_world_camera),
            tracked=newest.inliers,
            to_points=newest.inliers,
        )
        self.follow(self.atlas.begin_global_shutter())
        self._keyframe_ns = waiting.frames[-1].stamp_ns
        self._keyframe_is_new = True
        return newest.inliers

    def _locate(self, frame: IdealFrame, timer: StageTimer) -> F64 | None:
        """T_world_camera of the frame, by continuing or by recognition, whose segment becomes the
        active one.
        """
        located, place = locate_in_map(
            self.atlas.active, self._motion, frame, self._generator, self._recognise, timer
        )
        if place is not None:
            if self.atlas.active is not None:
                self.journal.settle(self.atlas.active.keyframes)
            self.atlas.go_on(place.keyframe, frame.tracks.ids)
            self._motion = Motion.at(frame.number, frame.stamp_ns, place.T_world_camera)
            self._recognised = place.keyframe.id
        return located

    def _recognise(self, frame: IdealFrame) -> Recognised | None:
        return self.atlas.recognise(frame.image, frame.tracks.maxima, self._generator)

    def _place_waiting(self, active: ActiveMap, keyframe: Keyframe, T_world_camera: F64) -> None:
        """Place the frames between a loss and the recognition, if their tracks lead to landmarks in
        the current view.
        """
        if not self._waiting.frames:
            return
        linked = active.linked(MAPPED)
        placed = returned_poses(
            T_world_camera, active.links.ids[linked],
            active.points.xyz[active.links.rows[linked]], self._waiting, keyframe, self._camera,
            self._parameters.localisation,
        )  # fmt: skip
        for each in placed:
            self._add_pose(each.frame, keyframe, each.T_world_camera, each.inliers)

    def _lost(self, active: ActiveMap, frame: IdealFrame) -> Outcome:
        """The frame has no pose.  After some time without one the segment is closed.

        Frames are stored meanwhile, so that a new segment has the poses of its own frames.
        """
        seen = len(active.linked(MAPPED))
        reason = f"lost: the pose of frame {frame.number} is not supported, {seen} mapped tracks"
        self._lost_frames += 1
        self._without_pose[frame.number] = None
        self._waiting = self._waiting.then(frame, self._parameters)
        outcome = self._outcome(LOST, self._flaw(frame) or reason, 0)
        long = self._motion.lost_s(frame.stamp_ns) > self._parameters.localisation.max_lost_s
        if long and self._lost_frames >= _LEAST_LOST:
            self.journal.settle(active.keyframes)
            self.atlas.leave()
            self._lost_frames = 0
        return outcome

    def _outcome(self, state: int, reason: str, inliers: int, snapshot: bool = False) -> Outcome:
        # Now and then everything active is published, for those who came late.
        self._published_frames += 1
        snapshot = snapshot or self._published_frames % self._parameters.snapshot_frames == 0
        # Between keyframes only new landmarks are published; moves follow with the next keyframe.
        self.atlas.note_changed(self.journal, everything=snapshot or self._keyframe_is_new)
        centre = np.zeros(3)
        if self.atlas.active is not None:
            centre = self.atlas.active.keyframes[-1].T_world_camera[:3, 3].copy()
        return Outcome(state, reason, inliers, self.atlas.segment, centre, snapshot)

    def publish(self, outcome: Outcome) -> MapDelta:
        """Return the changes since the last call.   outcome: of the last frame."""
        delta = self.calibration.published_with(self.journal.publish(outcome))
        if outcome.snapshot and (self.calibration.changes or self._focals_published):
            self._focals_published = self.calibration.changes  # else they are withdrawn
            made = [k for segment, _ in self.atlas.everything() for k in segment.keyframes]
            delta = replace(
                delta,
                focal_keyframes=np.array([keyframe.id for keyframe in made], np.int64),
                log_focals=np.array([keyframe.log_focal for keyframe in made]),
            )
        return delta

    @property
    def calibration(self) -> SelfCalibration:
        """The current calibration."""
        return self.atlas.calibration

    @property
    def _camera(self) -> PinholeCamera:
        """The ideal camera in whose pixels the mapper works."""
        return self.calibration.view.camera

    @property
    def global_adjustment(self) -> GlobalAdjustment:
        """Global bundle adjustment of the active segment."""
        return self.atlas.global_adjustment

    @property
    def point_count(self) -> int:
        """Number of landmarks in all segments."""
        return self.atlas.point_count

    @property
    def counters(self) -> dict[str, int]:
        """Results of place comparisons, and numbers of dropped keyframes and landmarks."""
        atlas = self.atlas
        return atlas.places.comparisons.counters | atlas.dropped | self._turns.counters

    def kept(self) -> Iterator[KeptKeyframe]:
        """Yield the keyframes of the map to be saved."""
        return self.atlas.kept()

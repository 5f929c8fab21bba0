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
from pliant.algorithms.inertial.samples import ImuSamples, append, joined
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
from pliant.algorithms.slam.adjust.global_adjustment import GlobalAdjustment
from pliant.algorithms.slam.adjust.inertial_adjustment import Coupling
from pliant.algorithms.slam.adjust.ordinary_frames import STANDING_ROOMS
from pliant.algorithms.slam.adjust.segment import InertialSource, Moved, PlacedFrames, Segment
from pliant.algorithms.slam.adjust.track_sample import TrackSample
from pliant.algorithms.slam.atlas.atlas import Atlas
from pliant.algorithms.slam.atlas.pose_history import PoseHistory
from pliant.algorithms.slam.atlas.publisher import Publisher
from pliant.algorithms.slam.atlas.waiting_frames import WaitingFrames
from pliant.algorithms.slam.calibration.self_calibration import SelfCalibration
from pliant.algorithms.slam.frame import Frame, IdealFrame, PlacedFrame
from pliant.algorithms.slam.journal import Journal, Outcome
from pliant.algorithms.slam.keyframe_rule import is_due
from pliant.algorithms.slam.locate.localisation import Motion
from pliant.algorithms.slam.locate.pose_quality import why_doubtful
from pliant.algorithms.slam.map.kept_keyframe import KeptKeyframe
from pliant.algorithms.slam.map.landmarks import MAPPED
from pliant.algorithms.slam.parameters import MappingParameters
from pliant.algorithms.slam.places.relocalisation import Recognised
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
    ) -> None:
        """calibration: estimated so far; None: that of the map, or of the parameters.   known: a
        loaded map in which the camera may be recognised.
        """
        calibration = (
            calibration
            or known_camera(known, camera)
            or SelfCalibration.of(camera, parameters.calibration)
        )
        calibration = replace(calibration, uncertainty=parameters.calibration)
        self.atlas = Atlas(calibration, parameters, known)
        self.journal = Journal(self.atlas.points, after=known[-1].id if known else -1)
        self._publisher = Publisher(self.atlas, self.journal, parameters)
        self._poses = PoseHistory(self.atlas, self.journal, parameters)
        self._waiting = WaitingFrames(self.atlas, self._poses, parameters)
        self._parameters = parameters
        self._generator = np.random.default_rng(seed)
        self._motion = Motion.at(0, 0, np.eye(4))  # in the active segment
        self._turns = FrameTurns()
        self._sample = TrackSample()  # of the active segment, or of the one that may start
        self._samples: list[ImuSamples] = []
        self._couplings: list[Coupling] = []
        self._lost_frames = 0
        self._keyframe_ns = 0
        self._keyframe_is_new = False
        self._recognised: int | None = None  # the keyframe, until this frame becomes one

    def add_samples(self, samples: ImuSamples) -> None:
        """Take in the next inertial samples of the source."""
        if len(samples.stamps_ns):
            append(self._samples, samples)
            self._turns.add_samples(samples, self._samples)

    def process(self, frame: Frame, timer: StageTimer = no_stages) -> MapDelta:
        """Localise a frame, extend the map, and return what readers need."""
        return self.publish(self.take(frame, timer))

    def take(self, frame: Frame, timer: StageTimer = no_stages) -> Outcome:
        """Localise a frame and extend the map."""
        self._poses.expect(frame)
        self._sample.add(frame.number, frame.extrema)
        ideal = self._catch_up(frame, timer)
        located = self._locate(ideal, timer)
        active = self.atlas.active
        if active is None:
            return self._start(ideal, timer)
        if located is None:
            return self._lose(active, ideal)
        placed = self._reacquire(active, ideal, located, timer)
        placed = self._adjust(active, placed, timer)
        placed = self._attach(active, placed, timer)
        self._refine_passed(active.segment, timer)
        self._continue_from(active, placed, self._motion.then)
        if self._keyframe_is_new:
            self.atlas.request(frame.number)
        return self._tracked(placed)

    def only_localise(self, frame: Frame, otherwise: str) -> MapDelta:
        """Localise a frame by its tracks in the map as it is, when there is no time to map it.

        A frame without a pose waits until the next mapped frame has one.  otherwise: the reason
        that it is published with.
        """
        return self.publish(self.take_tracks(frame, otherwise))

    def take_tracks(self, frame: Frame, otherwise: str) -> Outcome:
        """Localise a frame as ``only_localise`` does."""
        active, found = self.atlas.active, None
        self._poses.expect(frame)
        self._sample.add(frame.number, frame.extrema)
        self._keyframe_is_new = False
        if active is not None and not self._lost_frames:
            self._predict(active, frame)
            found = pose_by_tracks(active, self.calibration, self._motion, frame, self._generator)
        if active is None or found is None:
            self._waiting.add(IdealFrame.of(frame, self.calibration))
            return self._skipped(otherwise)
        self._turns.look(active, self._motion, found)
        active.add_ordinary(found)
        self._continue_from(active, found, self._motion.then_unmapped)
        return self._tracked(found)

    def skip(self, frame: int, reason: str = "the frame has no pixels") -> MapDelta:
        """Skip a frame without pixels (dropped or broken) or without time: it gets no pose.

        Only mapped frames decide whether the camera is lost: the state is unchanged.  Surviving
        tracks continue in the next frame.
        """
        return self.publish(self._skipped(reason))

    def finish(self, timer: StageTimer = no_stages, placed: PlacedFrames | None = None) -> MapDelta:
        """Apply the remaining corrections at the end of the stream.

        placed: frames that inertial samples are compared with; None: those of this mapper.
        """
        self.start_at_last()
        self._couplings, inertial = [], None
        if self._samples:
            samples, stamps_ns = joined(self._samples), self._poses.stamps_ns
            inertial = InertialSource(samples, stamps_ns, self._couplings, placed)
        self.follow(self.atlas.finish(timer, inertial, self._sample))
        with timer("skipped frames"):
            for segment, seen_by in self.atlas.everything():
                self._poses.refine(segment, segment.ordinary.take_all(), seen_by)
                self._poses.smooth(segment, seen_by, self._turns.gyro)
        if self.atlas.active is None:
            return self.publish(self._outcome(WAITING, "the stream has ended", 0, is_last=True))
        self.journal.settle(self.atlas.active.keyframes)
        return self.publish(self._outcome(TRACKING, "", 0, is_last=True))

    def _catch_up(self, frame: Frame, timer: StageTimer) -> IdealFrame:
        """Apply finished corrections of map and calibration, and correct the frame by them."""
        if self.atlas.active is not None:
            with timer("whole map"):
                before = self.calibration
                self.follow(self.atlas.catch_up(frame.number))
                if not self.calibration.sees_like(before):
                    self._waiting.see_by(before.view, self.calibration.view)
            self._predict(self.atlas.active, frame)
        with timer("corrected view"):
            return IdealFrame.of(frame, self.calibration)

    def _predict(self, active: ActiveMap, frame: Frame) -> None:
        """Continue the tracks and the focal length, and predict the rotation by the gyro."""
        active.links.follow(frame.extrema.ids, active.points)
        self.atlas.focus(self._motion, frame.stamp_ns, frame.extrema)
        self._motion = self._turns.predict(self._motion, frame.stamp_ns)

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
            if self.atlas.active is None or self.atlas.segment != place.keyframe.segment:
                self._sample.drop()  # earlier frames of the segment are not in it
            self.atlas.resume(place.keyframe, frame.tracks.ids)
            self._motion = Motion.at(frame.number, frame.stamp_ns, place.T_world_camera)
            self._recognised = place.keyframe.id
        return located

    def _recognise(self, frame: IdealFrame) -> Recognised | None:
        return self.atlas.recognise(frame.image, frame.tracks.maxima, self._generator)

    def _start(self, frame: IdealFrame, timer: StageTimer) -> Outcome:
        """There is no map: start one, if the frames so far allow it."""
        self._waiting.add(frame)
        self._sample.begin_at(self._waiting.numbers[0])
        with timer("start"):
            started = self._waiting.start_map()
        if isinstance(started, str):
            return self._outcome(WAITING, self._flaw(frame) or started, 0)
        self._continue_start(started)
        return self._outcome(TRACKING, "", started.tracked)

    def _continue_start(self, started: Motion) -> None:
        self._motion = started
        self.follow(self.atlas.begin_global_shutter())
        self._keyframe_ns = started.stamps_ns[1]
        self._keyframe_is_new = True

    def _lose(self, active: ActiveMap, frame: IdealFrame) -> Outcome:
        """The frame has no pose.  After some time without one the segment is closed.

        Frames are stored meanwhile, so that a new segment has the poses of its own frames.
        """
        seen = len(active.linked(MAPPED))
        reason = f"lost: the pose of frame {frame.number} is not supported, {seen} mapped tracks"
        self._lost_frames += 1
        self._poses.lose(frame.number)
        self._waiting.add(frame)
        outcome = self._outcome(LOST, self._flaw(frame) or reason, 0)
        long = self._motion.lost_s(frame.stamp_ns) > self._parameters.localisation.max_lost_s
        if long and self._lost_frames >= _LEAST_LOST:
            self.journal.settle(active.keyframes)
            self.atlas.leave()
            self._lost_frames, self._sample = 0, TrackSample()
        return outcome

    def _flaw(self, frame: IdealFrame) -> str:
        """Why the image has fewer tracks than a start needs, if it is visible."""
        few = len(frame.tracks.ids) < self._parameters.start.min_tracks
        return flaw_of(frame.given.grey) if frame.given.grey is not None and few else ""

    def _reacquire(
        self, active: ActiveMap, frame: IdealFrame, T_world_camera: F64, timer: StageTimer
    ) -> PlacedFrame:
        """Find landmarks without a track at the maxima of the frame."""
        with timer("reacquisition"):
            placed = reacquire_points(active, self._motion, frame, T_world_camera)
            self._turns.look(active, self._motion, placed)
        return placed

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
            self._sample.follow(active.keyframes)
        self.follow(self.atlas.calibrate())
        self._keyframe_ns = frame.stamp_ns
        if self._recognised is not None:
            self.journal.add_same_places([(self._recognised, keyframe.id)])
            self._recognised = None
        with timer("places"):
            self.atlas.remember(keyframe, frame)
        return replace(placed, T_world_camera=keyframe.T_world_camera)

    def _refine_passed(self, segment: Segment, timer: StageTimer) -> None:
        """Refine earlier frames that are no keyframes."""
        with timer("passed frames"):
            rooms = 1 if self._keyframe_is_new else STANDING_ROOMS
            surplus = segment.ordinary.take_surplus(self._parameters, rooms)
            self._poses.refine(segment, surplus, self.calibration)

    def _continue_from(
        self, active: ActiveMap, placed: PlacedFrame, then: Callable[..., Motion]
    ) -> None:
        """The frame has a pose: place the frames that waited for it, and predict from it."""
        keyframe, number = active.keyframes[-1], placed.frame.number
        T_world_camera, support = placed.T_world_camera, placed.support
        self._waiting.place(active, keyframe, T_world_camera)
        to_points = tracks_to_points(active, placed)
        self._turns.see(self._motion, placed)
        self._motion = then(
            number, placed.frame.stamp_ns, T_world_camera, support.tracked, to_points
        )
        self._poses.add(number, keyframe, T_world_camera, support.inliers)

    def _tracked(self, placed: PlacedFrame) -> Outcome:
        why = why_doubtful(placed.support)
        return self._outcome(TRACKING, why, placed.support.inliers)

    def _skipped(self, reason: str) -> Outcome:
        state = LOST if self._lost_frames else TRACKING
        return self._outcome(WAITING if self.atlas.active is None else state, reason, 0)

    def _outcome(self, state: int, reason: str, inliers: int, *, is_last: bool = False) -> Outcome:
        return self._publisher.outcome(
            state, reason, inliers, is_keyframe=self._keyframe_is_new, is_last=is_last
        )

    def follow(self, moved: list[Moved]) -> None:
        """Move the motion model with the map, and publish the move."""
        for each in moved:
            self._motion = self._motion.moved(each.S)
            self._turns.follow(each.S)
            if each.moves is not None:
                self.journal.move(each.moves)
            if each.gone is not None:
                self.journal.join(each.gone, self.atlas.segment)
                self._sample.drop()
            self.journal.add_same_places(each.same_places)

    def start_at_last(self) -> bool:
        """Start a map from the existing frames, at the end of the stream; whether there is one."""
        if self.atlas.active is None and self._waiting.numbers:
            started = self._waiting.start_map(at_last=True)
            if not isinstance(started, str):
                self._continue_start(started)
        return self.atlas.active is not None

    def publish(self, outcome: Outcome) -> MapDelta:
        """Return the changes since the last call.   outcome: of the last frame."""
        return self._publisher.publish(outcome)

    def publish_keyframes(self) -> KeyframeDelta:
        """Return the keyframe changes after the last frame, or after ``finish``."""
        return self._publisher.publish_keyframes()

    def kept(self) -> Iterator[KeptKeyframe]:
        """Yield the keyframes of the map to be saved."""
        return self.atlas.kept()

    @property
    def waiting_frames(self) -> list[int]:
        """Numbers of the frames from which a map may still start."""
        return self._waiting.numbers

    @property
    def calibration(self) -> SelfCalibration:
        """The current calibration."""
        return self.atlas.calibration

    @property
    def global_adjustment(self) -> GlobalAdjustment:
        """Global bundle adjustment of the active segment."""
        return self.atlas.global_adjustment

    @property
    def point_count(self) -> int:
        """Number of landmarks in all segments."""
        return self.atlas.point_count

    @property
    def counters(self) -> dict[str, float]:
        """Results of place comparisons, numbers of dropped keyframes and landmarks, and what
        inertial samples did.
        """
        atlas, coupled = self.atlas, dict[str, float]()
        if self._couplings:  # of the largest segment
            most = max(self._couplings, key=lambda each: each.keyframes)
            coupled = {f"coupling_{name}": float(value) for name, value in vars(most).items()}
        return {
            **atlas.places.comparisons.counters, **atlas.dropped, **self._turns.counters, **coupled
        }  # fmt: skip

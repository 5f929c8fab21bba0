"""The mapper: from the tracks of each frame to its pose and a dense map.

VITAMIN-E section 3: start by essential matrix, poses by P3P and RANSAC, points by triangulation,
and bundle adjustment on every frame by the subspace Gauss-Newton method; on top of it, Schur LM
over the window at keyframes and re-acquisition of points that lost their track.
"""

import dataclasses
import heapq
from collections.abc import Iterator, Sequence

import numpy as np

from pliant.algorithms.arrays import F64, U8
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import inverse
from pliant.algorithms.kept_keyframe import KeptKeyframe
from pliant.algorithms.map_delta import LOST, TRACKING, WAITING, KeyframeDelta, MapDelta
from pliant.algorithms.mapping.active_map import ActiveMap
from pliant.algorithms.mapping.earlier_segments import EarlierSegments
from pliant.algorithms.mapping.frame_pose import (
    adjust,
    directions_of,
    find_again,
    localise,
    stand,
)
from pliant.algorithms.mapping.kept_map import Origin, keep, known_camera, take_in
from pliant.algorithms.mapping.known_places import KnownPlaces
from pliant.algorithms.mapping.map_store import CANDIDATE, MAPPED, Keyframe, PointRows
from pliant.algorithms.mapping.meetings import Meetings, join
from pliant.algorithms.mapping.parameters import MappingParameters
from pliant.algorithms.mapping.publication import KeyframeChanges, MapChanges
from pliant.algorithms.mapping.recovery import Motion
from pliant.algorithms.mapping.rolling_shutter import Path, RolledFrame
from pliant.algorithms.mapping.self_calibration import SelfCalibration, find_start_of, is_guess
from pliant.algorithms.mapping.start import Start
from pliant.algorithms.mapping.support import doubt
from pliant.algorithms.mapping.waiting import Waiting, earlier_poses, returned_poses
from pliant.algorithms.mapping.whole_map import Answer, WholeMap, held, move_map
from pliant.algorithms.places.features import describe
from pliant.algorithms.stages import StageTimer, no_stages
from pliant.algorithms.tracks import FrameTracks

_LEAST_LOST = 3
"""Frames without a pose before a map is given up, however long that takes: of a time lapse."""


class Mapper:
    """Builds the map and localises every frame in it.

    A pure function of camera, parameters, seed and the frames given, one after the other.
    """

    def __init__(
        self,
        camera: PinholeCamera,
        parameters: MappingParameters,
        seed: int,
        calibration: SelfCalibration | None = None,
        known: Sequence[KeptKeyframe] = (),
    ) -> None:
        """calibration: what is known of the camera already; None: what the map or else the
        parameters say.   known: a map of earlier sessions, in which the camera may be recognised.
        """
        self._parameters = parameters
        self.calibration = (
            calibration
            or known_camera(known, camera)
            or SelfCalibration.of(camera, parameters.calibration)
        )
        self._generator = np.random.default_rng(seed)
        self._timer: StageTimer = no_stages
        self._points = PointRows()
        self._changes = MapChanges()
        self._path = Path()
        self.whole_map = WholeMap()
        self._keyframe_changes = KeyframeChanges(self._points)
        self._waiting = Waiting()
        self._map: ActiveMap | None = None
        self._earlier = EarlierSegments()
        self._places = KnownPlaces()
        self._spans: list[tuple[int, int]] = []
        self._segments = 0
        self._segment = -1  # that the camera is in, or was in last
        self._keyframes = 0
        self._motion: Motion | None = None
        self._lost_frames = 0
        self._keyframe_ns = 0
        self._keyframe_is_new = False
        self._published_frames = 0
        self._whole = False
        self._origins = {each.id: Origin(each.session, each.source_frame) for each in known}
        if known:
            self._know(list(known))

    def _know(self, known: list[KeptKeyframe]) -> None:
        """Begin with a map of earlier sessions: what is new is numbered on."""
        for each in take_in(known, self._points, self.calibration, self._parameters):
            self._earlier.know(each.map, each.path, self.calibration)
        for each in known:
            if not self._spans or self._spans[-1][1] != each.segment:
                self._spans.append((each.id, each.segment))
        self._places.know(known, self.calibration)
        self._segments = max(each.segment for each in known) + 1
        self._keyframes = known[-1].id + 1
        self._keyframe_changes = KeyframeChanges(self._points, after=known[-1].id)

    def kept(self) -> Iterator[KeptKeyframe]:
        """The map as it is to be kept, oldest keyframe first.  Once the stream has ended."""
        segments = self._earlier.everything()
        if self._map is not None:
            segments = [*segments, (self._map, self._path, self.calibration)]
        session = 1 + max((origin.session for origin in self._origins.values()), default=-1)
        made = (keyframe for active, _, _ in segments for keyframe in active.keyframes)
        origins = {k.id: Origin(session, k.frame) for k in made} | self._origins
        features = self._places.index.features
        each = [keep(*segment, features, origins) for segment in segments]
        yield from heapq.merge(*each, key=lambda keyframe: keyframe.id)

    def process(
        self,
        frame: int,
        stamp_ns: int,
        tracks: FrameTracks,
        grey: U8 | None,
        colour: U8 | None,
        timer: StageTimer = no_stages,
    ) -> MapDelta:
        """Localise a frame and let the map grow.

        stamp_ns: when it was taken, increasing.    grey: (H, W).    colour: (H, W, 3) RGB.
        """
        self._timer = timer
        tracks, grey, colour = self.calibration.ideal(tracks, grey, colour)
        if self._map is not None and self._motion is not None:
            with self._timer("whole map"):
                self._join_met(self._map, self._motion, frame)
                if (answer := self.whole_map.take(frame)) is not None:
                    self._take_over(self._map, self._motion, answer)
            self._map.links.follow(tracks.ids)
        seen, rolled = tracks, None
        located = self._locate(frame, stamp_ns, seen, grey)
        if self._map is None or self._motion is None:
            return self._wait(frame, stamp_ns, tracks, grey, colour)
        if located is None:
            return self._lost(self._map, frame, stamp_ns, seen)
        with self._timer("reacquisition"):
            if self.calibration.readout:
                velocity = self._motion.velocity_at(frame, located)
                tracks, rolled = self._at_once(self._map, located, velocity, seen)
                grey = grey if grey is None else rolled.image(grey)
            T_world_camera, found = find_again(self._map, frame, located, tracks, grey, rolled)
        with self._timer("subspace adjustment"):
            T_world_camera, support = adjust(self._map, self._motion, T_world_camera, found, tracks)
        with self._timer("triangulation"):
            self._map.triangulate()
        hanging = self._map.keyframes[-1]
        self._keyframe_is_new = self._keyframe_is_due(self._map, stamp_ns)
        if self._keyframe_is_new:
            with self._timer("keyframe"):
                T_world_camera, turned = stand(self._map, T_world_camera, found, tracks)
                if rolled is not None:
                    colour = colour if colour is None else rolled.image(colour)
                    self._map.unroll(self._map.window.keyframes, self._path, rolled.readout)
                hanging = self._map.insert_keyframe(
                    frame, T_world_camera, tracks.points_px, seen.points_px - tracks.points_px,
                    found, grey, colour, turned,
                )  # fmt: skip
            self._motion = self._motion.moved(self._calibrate(self._map))
            T_world_camera = hanging.T_world_camera
            self._keyframe_ns = stamp_ns
            with self._timer("places"):
                self._remember(self._map, hanging, grey)
        self._place_waiting(self._map, hanging, T_world_camera)
        self._lost_frames, self._waiting = 0, Waiting()
        self._motion = self._motion.then(frame, stamp_ns, T_world_camera)
        self._add_pose(self._map, frame, hanging, T_world_camera, support.inliers)
        if hanging.frame == frame and self._finishes(self._map):
            self.whole_map.ask(frame, self._map, self._path, self.calibration.readout)
        return self._publish(TRACKING, doubt(support, self._parameters.support), support.inliers)

    def skip(self, frame: int, reason: str = "the frame has no pixels") -> MapDelta:
        """Pass over a frame, without pixels (dropped or broken) or without time: it gets no pose.

        Whether the camera is lost is for frames with pixels to decide: the state stays as it was.
        The tracks that live on are taken up again by the next frame.
        """
        state = LOST if self._lost_frames else TRACKING
        return self._publish(WAITING if self._map is None else state, reason, 0)

    def stay(self) -> None:
        """Forget what is about to move the map: nobody has it yet."""
        self.whole_map, self._places.meetings = WholeMap(), Meetings()

    @property
    def _camera(self) -> PinholeCamera:
        """Whose pixels are worked on."""
        return self.calibration.view.camera

    def _join_met(self, active: ActiveMap, motion: Motion, frame: int) -> None:
        """Become one with an earlier segment that has been met."""
        proved = self._places.meetings.proved
        if not proved:
            return
        segments = [self._earlier.segment_of(loop.old) for loop in proved]
        met = [loop for loop, of in zip(proved, segments, strict=True) if of == segments[0]]
        earlier, path = self._earlier.take(segments[0])
        self.whole_map.withdraw()
        self.whole_map.loops += met
        joined = join(active, self._path, earlier, path, met, self._spans, self.calibration.readout)
        self._changes.move(joined.moves)
        self._changes.join(joined.gone, active.segment)
        self._motion = motion.moved(joined.S)
        self._segment = active.segment
        self._spans = [(k, active.segment if of == joined.gone else of) for k, of in self._spans]
        self._places.enter()
        self.whole_map.move(joined.moves)
        self.whole_map.ask(frame, active, self._path, self.calibration.readout)

    def _take_over(self, active: ActiveMap, motion: Motion, answer: Answer) -> None:
        """Go on with what the adjustment of the whole map has found."""
        if answer.moves is not None:
            moves = held(answer.moves, self._spans, active.segment)
            motion = motion.moved(move_map(active, moves, self._path))
            for loop in answer.loops:
                active.join(loop)
            self._changes.move(moves)
        before = self.calibration.readout
        self.calibration = self.calibration.with_readout(answer.readout, answer.sigma)
        if before:
            active.unroll(active.keyframes, self._path, self.calibration.readout)
        self._motion = motion if before else self._begin_to_unroll(active, motion)

    def _begin_to_unroll(self, active: ActiveMap, motion: Motion) -> Motion:
        """Map with the readout, where it is known, what was mapped without.  Returns the motion
        with what that did to the end of the map."""
        if not self.calibration.readout:
            return motion
        newest = active.keyframes[-1]
        before = newest.T_world_camera
        active.begin_to_unroll(self._path, self.calibration.readout)
        return motion.moved(newest.T_world_camera @ inverse(before))

    def _at_once(
        self, active: ActiveMap, T_world_camera: F64, motion: F64, seen: FrameTracks
    ) -> tuple[FrameTracks, RolledFrame]:
        """The tracks of a frame with this pose and motion (6,), had it been taken at once."""
        rolled = active.rolled(self.calibration.readout, motion)
        depths = active.inverse_depths(active.links.rows, T_world_camera)
        maxima = seen.maxima.copy()
        maxima[:, :2] -= rolled.shifts(np.ascontiguousarray(maxima[:, :2]))
        points_px = seen.points_px - rolled.shifts(seen.points_px, depths)
        return dataclasses.replace(seen, points_px=points_px, maxima=maxima), rolled

    def _calibrate(self, active: ActiveMap) -> F64:
        """Adjust the whole map with its calibration where that is due: (4, 4) what its end made."""
        known, newest = self.calibration, active.keyframes[-1]
        due = len(active.keyframes) >= known.next_keyframes and self._finishes(active)
        if not (due and is_guess(self._parameters.calibration)):
            return np.eye(4)
        before = newest.T_world_camera
        self.calibration = active.adjust_all(self._path, known)
        self.whole_map = WholeMap()  # what was asked is of another map
        self._whole = True
        return newest.T_world_camera @ inverse(before)

    @property
    def point_count(self) -> int:
        """Points of the map now, of all segments."""
        return self._points.culled + int(np.count_nonzero(self._points.state == MAPPED))

    def finish(self) -> MapDelta:
        """What is still to be corrected at the end of the stream."""
        if self._map is not None and self._motion is not None:
            self._join_met(self._map, self._motion, 0)
        self._earlier.adjust()
        if self._map is None or self._motion is None:
            return self._publish(WAITING, "the stream has ended", 0, snapshot=True)
        self._whole = self._finishes(self._map)
        while self.whole_map.loops or self.whole_map.closing:
            self.whole_map.ask(0, self._map, self._path, self.calibration.readout)
            if (answer := self.whole_map.settle()) is not None:
                self._take_over(self._map, self._motion, answer)
        if self._whole:
            self._map.collect_garbage()
            self.calibration = self._map.adjust_all(self._path, self.calibration)
        self._keyframe_changes.settle(self._map.keyframes)
        return self._publish(TRACKING, "", 0, snapshot=True)

    def _finishes(self, *maps: ActiveMap) -> bool:
        limits = self._parameters.window
        few = sum(len(m.keyframes) + m.culled for m in maps) <= limits.final_max_keyframes
        return limits.final_adjustment and few

    def _add_pose(
        self, active: ActiveMap, frame: int, keyframe: Keyframe, T_world_camera: F64, inliers: int
    ) -> None:
        self._changes.add_pose(frame, keyframe, T_world_camera, inliers)
        if self._finishes(active):
            self._path.add(frame, keyframe, T_world_camera)
        else:
            self._path.forget()

    def publish_keyframes(self) -> KeyframeDelta:
        """What is to be published of keyframes after the last frame, or after ``finish``."""
        if self._map is None:
            return self._keyframe_changes.publish(None)
        self._keyframe_changes.settle(self._map.keyframes[: -self._parameters.window.keyframes])
        delta = self._keyframe_changes.publish(self._map.keyframes[-1])
        seen = self.calibration.view.seen(delta.points_px)
        return dataclasses.replace(delta, points_px=seen)

    @property
    def waiting_frames(self) -> list[int]:
        """Numbers of the frames from which a map may yet start."""
        return [waiting.frame for waiting in self._waiting.frames]

    def _wait(
        self,
        frame: int,
        stamp_ns: int,
        tracks: FrameTracks,
        grey: U8 | None,
        colour: U8 | None,
    ) -> MapDelta:
        self._waiting = self._waiting.then(frame, stamp_ns, tracks, self._camera, self._parameters)
        with self._timer("start"):
            found = find_start_of(self._waiting.frames, self.calibration, self._parameters)
        if isinstance(found, str):
            return self._publish(WAITING, found, 0)
        start, self.calibration = found
        with self._timer("start"):
            inliers = self._begin(start, grey, colour)
        return self._publish(TRACKING, "", inliers)

    def _begin(self, start: Start, grey: U8 | None, colour: U8 | None) -> int:
        """Let the map start, and give poses to the frames that waited, backwards."""
        limits = self._parameters.window
        kept = limits.final_max_keyframes if limits.final_adjustment else 0
        self._earlier.make_room(self._points, kept)
        self._map = ActiveMap(
            self._segments, self._points, self._keyframes, self._camera, self._parameters
        )
        self._segment, self._segments = self._segments, self._segments + 1
        self._path = Path()
        self.whole_map = WholeMap()
        self._places.enter()
        self._map.begin(start, self._waiting.frames, grey, colour)
        self._calibrate(self._map)
        placed = list(
            earlier_poses(
                start, self._map.keyframes, self._waiting, self._camera,
                self._parameters.localisation,
            )
        )  # fmt: skip
        for each in placed:
            self._add_pose(self._map, each.frame, each.keyframe, each.T_world_camera, each.inliers)
        stamps_ns = {waiting.frame: waiting.stamp_ns for waiting in self._waiting.frames}
        self._spans.append((self._keyframes, self._map.segment))
        self._remember(self._map, self._map.keyframes[-1], grey)
        newest, before = placed[0], placed[min(1, len(placed) - 1)]
        frames = before.frame, newest.frame
        self._motion = Motion(
            frames=frames,
            stamps_ns=(stamps_ns[frames[0]], stamps_ns[frames[1]]),
            poses=(before.T_world_camera, newest.T_world_camera),
        )
        self._motion = self._begin_to_unroll(self._map, self._motion)
        self._keyframe_ns = self._waiting.frames[-1].stamp_ns
        self._keyframe_is_new = True
        self._waiting = Waiting()
        return newest.inliers

    def _locate(
        self, frame: int, stamp_ns: int, tracks: FrameTracks, grey: U8 | None
    ) -> F64 | None:
        """T_world_camera of the frame where it goes on, or else where it was seen before."""
        if self._map is not None and self._motion is not None:
            with self._timer("localisation"):
                at_once = tracks
                if self.calibration.readout:
                    predicted = self._motion.predictions(stamp_ns)[0]
                    velocity = self._motion.velocity()
                    at_once, _ = self._at_once(self._map, predicted, velocity, tracks)
                located = localise(
                    self._map, self._motion, stamp_ns, at_once, tracks.maxima, grey,
                    self._generator,
                )  # fmt: skip
            if located is not None:
                return located
        with self._timer("places"):
            maps = [self._map] if self._map is not None else []
            maps += self._earlier.maps(self.calibration)
            return self._recognise(maps, frame, stamp_ns, tracks, grey)

    def _recognise(
        self,
        maps: list[ActiveMap],
        frame: int,
        stamp_ns: int,
        tracks: FrameTracks,
        grey: U8 | None,
    ) -> F64 | None:
        """T_world_camera in the one of the maps that the image shows, which then goes on."""
        if grey is None or not maps:
            return None
        found = self._places.recognise(
            grey, tracks.maxima, maps, self._points, self.calibration, self._parameters,
            self._generator,
        )  # fmt: skip
        if found is None:
            return None
        self._go_on(found.keyframe, tracks)
        stamps, poses = (stamp_ns, stamp_ns), (found.T_world_camera, found.T_world_camera)
        self._motion = Motion(frames=(frame, frame), stamps_ns=stamps, poses=poses)
        return found.T_world_camera

    def _go_on(self, seen: Keyframe, tracks: FrameTracks) -> None:
        """Go on in the segment of a keyframe, at the place that it saw."""
        active = self._map
        if active is not None:
            self._settle(active)
        if active is None or active.segment != seen.segment:
            if active is not None:
                self._earlier.keep(active, self._path, self.calibration)
            active, self._path = self._earlier.take(seen.segment)
            self._map, self.whole_map = active, WholeMap()
            self._places.enter()
        self.whole_map.withdraw()  # nobody knows how what is new would move
        self._segment = active.segment
        active.resume(seen, self._keyframes)
        active.links.follow(tracks.ids)
        self._spans.append((self._keyframes, active.segment))

    def _settle(self, active: ActiveMap) -> None:
        """What has been mapped so far is told of, and the next keyframe follows on it."""
        self._keyframe_changes.settle(active.keyframes)
        self._keyframes = active.next_keyframe_id

    def _remember(self, active: ActiveMap, keyframe: Keyframe, grey: U8 | None) -> None:
        """A keyframe is a place to come back to, and may be one that was seen before."""
        if grey is None:
            return
        seen, view = describe(grey), self.calibration.view
        earlier = self._earlier.maps(self.calibration)
        self.whole_map.loops += self._places.compare(
            keyframe, seen, active, [each for each in earlier if self._finishes(active, each)],
            view, loops=self._finishes(active) and not self.whole_map.closing,
        )  # fmt: skip
        self._places.remember(keyframe, seen, [active, *earlier], view)

    def _place_waiting(self, active: ActiveMap, keyframe: Keyframe, T_world_camera: F64) -> None:
        """The camera was lost, and has been found: so are the frames between that follow what it
        sees now."""
        if not self._waiting.frames:
            return
        linked = active.linked(MAPPED)
        placed = returned_poses(
            T_world_camera, active.links.ids[linked],
            self._points.xyz[active.links.rows[linked]], self._waiting, keyframe, self._camera,
            self._parameters.localisation,
        )  # fmt: skip
        for each in placed:
            self._add_pose(active, each.frame, keyframe, each.T_world_camera, each.inliers)

    def _lost(self, active: ActiveMap, frame: int, stamp_ns: int, tracks: FrameTracks) -> MapDelta:
        """The frame has no pose.  After some time without one the segment is closed.

        Frames are kept meanwhile, so that a new segment has the poses of those that are its own.
        """
        assert self._motion is not None
        seen = len(active.linked(MAPPED))
        reason = f"lost: the pose of frame {frame} is not supported, {seen} mapped tracks"
        self._lost_frames += 1
        self._waiting = self._waiting.then(frame, stamp_ns, tracks, self._camera, self._parameters)
        delta = self._publish(LOST, reason, 0)
        long = self._motion.lost_s(stamp_ns) > self._parameters.localisation.max_lost_s
        if long and self._lost_frames >= _LEAST_LOST:
            self._settle(active)
            self._earlier.keep(active, self._path, self.calibration)
            self._map, self._lost_frames = None, 0
        return delta

    def _keyframe_is_due(self, active: ActiveMap, stamp_ns: int) -> bool:
        if active.since == len(active.keyframes):
            return True  # the camera has been recognised
        limits = self._parameters.keyframe
        least = CANDIDATE if len(directions_of(active)) else MAPPED
        share, flow = active.window.flow_since_keyframe(least)
        unit = self._camera.width / 640.0
        if share < limits.min_shared_share or flow > limits.max_flow_px * unit:
            return True
        late = stamp_ns - self._keyframe_ns > 1e9 * limits.max_s
        return late and flow > limits.min_flow_px * unit

    def _publish(self, state: int, reason: str, inliers: int, snapshot: bool = False) -> MapDelta:
        # Now and then everything active is published, for those who came late.
        self._timer = no_stages  # the frame is done: nothing of its caller stays with the map
        whole, self._whole = self._whole, False
        self._published_frames += 1
        snapshot = snapshot or self._published_frames % self._parameters.snapshot_frames == 0
        active = self._map
        if active is None:
            keyframes: list[Keyframe] = []
            rows, centre = np.zeros(0, np.int32), np.zeros(3)
        else:
            keyframes = active.keyframes if whole else active.window.keyframes
            # Between keyframes only points that the frame sees can move or be new.
            everything = snapshot or self._keyframe_is_new
            rows = active.window.rows if everything else active.window.current_rows()
            if whole:
                rows = active.mapped_rows()
            centre = active.keyframes[-1].T_world_camera[:3, 3].copy()
            self._changes.remove_points(active.take_removed())
        for earlier in self._earlier.adjusted:
            keyframes = [*keyframes, *earlier.keyframes]
            rows = np.concatenate([rows, earlier.mapped_rows()])
            self._changes.remove_points(earlier.take_removed())
        delta = self._changes.publish(
            state=state,
            reason=reason,
            segment=self._segment,
            inliers=inliers,
            keyframes=keyframes,
            points=self._points,
            rows=rows,
            centre=centre,
            snapshot=snapshot,
        )
        return self.calibration.told_with(delta)

"""The atlas: all segments of the map, the active one and earlier ones.

A segment begins where a map starts.  It becomes an earlier segment when the camera is lost for long
or is recognised in another segment.  It becomes active again when the camera is recognised in it.
Two segments that see the same place are merged.  The active segment is adjusted as a whole in
parallel with tracking.  Every other correction is reported as the motion of the segment's end,
which later frames follow.
"""

import heapq
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from pliant.algorithms.arrays import F32, F64, I64, U8
from pliant.algorithms.geometry import inverse
from pliant.algorithms.map_delta import MapMoves
from pliant.algorithms.slam.active.active_map import ActiveMap
from pliant.algorithms.slam.active.frame_focal import refocused
from pliant.algorithms.slam.adjust.global_adjustment import AdjustmentResult, GlobalAdjustment, held
from pliant.algorithms.slam.adjust.segment import InertialSource, Moved, Segment, see_by
from pliant.algorithms.slam.adjust.track_sample import TrackSample
from pliant.algorithms.slam.atlas.known_places import KnownPlaces, SegmentMerges, join
from pliant.algorithms.slam.calibration.self_calibration import SelfCalibration, is_guess
from pliant.algorithms.slam.frame import IdealFrame
from pliant.algorithms.slam.journal import Journal
from pliant.algorithms.slam.locate.landmark_search import LandmarkSearch
from pliant.algorithms.slam.locate.localisation import Motion
from pliant.algorithms.slam.map.kept_keyframe import KeptKeyframe
from pliant.algorithms.slam.map.keyframe import Keyframe
from pliant.algorithms.slam.map.landmarks import MAPPED, Landmarks
from pliant.algorithms.slam.parameters import MappingParameters
from pliant.algorithms.slam.places.place_index import describe
from pliant.algorithms.slam.places.relocalisation import Recognised
from pliant.algorithms.slam.start.first_map import BufferedFrame, Start
from pliant.algorithms.slam.store.earlier_segments import EarlierSegments
from pliant.algorithms.slam.store.kept_map import Origin, keep, spans_of, take_in
from pliant.algorithms.stages import StageTimer, no_stages
from pliant.algorithms.tracks import FrameTracks


class Atlas:
    """All segments of the map.

    points: of all segments.   calibration: of the camera.   active: the segment that the camera is
    in, or None.   segment: its number, or that of the last one; -1 before the first.
    global_adjustment: of the active segment.   places: where the camera may be recognised.
    """

    def __init__(
        self,
        calibration: SelfCalibration,
        parameters: MappingParameters,
        known: Sequence[KeptKeyframe] = (),
    ) -> None:
        """known: a loaded map; new keyframes and segments continue its numbers."""
        self.points = Landmarks()
        self.calibration = calibration
        self.active: ActiveMap | None = None
        self.segment = -1
        self.global_adjustment = GlobalAdjustment()
        self.places = KnownPlaces()
        self._parameters = parameters
        self._earlier = EarlierSegments()
        self._origins = {each.id: Origin(each.session, each.source_frame) for each in known}
        self._spans = spans_of(known)
        self._next_segment = 1 + max((each.segment for each in known), default=-1)
        self._next_keyframe = known[-1].id + 1 if known else 0
        self._adjusted = False  # the whole active segment, not published yet
        for segment in take_in(known, self.points, calibration):
            self._earlier.keep(segment, calibration, known=True)
        self.places.know(known, calibration)

    def kept(self) -> Iterator[KeptKeyframe]:
        """Yield the keyframes of the map to be saved, oldest first, once the stream has ended."""
        segments = self.everything()
        session = 1 + max((origin.session for origin in self._origins.values()), default=-1)
        made = (keyframe for segment, _ in segments for keyframe in segment.keyframes)
        origins = {k.id: Origin(session, k.frame) for k in made} | self._origins
        features = self.places.index.features
        each = [keep(*segment, features, origins) for segment in segments]
        yield from heapq.merge(*each, key=lambda keyframe: keyframe.id)

    def everything(self) -> list[tuple[Segment, SelfCalibration]]:
        """Return all segments, each with the calibration whose pixels it has."""
        segments = self._earlier.everything()
        if self.active is not None:
            segments.append((self.active.segment, self.calibration))
        return segments

    @property
    def point_count(self) -> int:
        """Number of landmarks in all segments."""
        return self.points.culled + int(np.count_nonzero(self.points.state == MAPPED))

    @property
    def dropped(self) -> dict[str, int]:
        """Counts of dropped keyframes and landmarks; empty if nothing was dropped."""
        keyframes = self._earlier.dropped_keyframes
        keyframes += sum(len(segment.dropped) for segment, _ in self.everything())
        counts = {"dropped_keyframes": keyframes, "dropped_points": self.points.culled}
        return counts if self.points.culled or keyframes else {}

    def begin(
        self,
        start: Start,
        calibration: SelfCalibration,
        waiting: list[BufferedFrame],
        latest: IdealFrame,
    ) -> ActiveMap:
        """Begin a segment.   calibration: that of the start.   latest: the newest waiting frame,
        with its image.
        """
        self.calibration = calibration
        active = self._enter(Segment(id=self._next_segment, points=self.points))
        self._next_segment += 1
        self._forget_jobs()
        active.begin(start, waiting, latest)
        self._adjusted = True  # not all of its keyframes are in the window
        self.calibrate()
        self.remember(active.keyframes[-1], latest, is_confirmed=False)
        return active

    def _enter(self, segment: Segment) -> ActiveMap:
        """Make a segment the active one."""
        self.active = ActiveMap(segment, self._next_keyframe, self.calibration, self._parameters)
        self.active.room = self._earlier.share_room(self.points, self._parameters.window)
        self.segment = segment.id
        self._spans.append((self._next_keyframe, segment.id))
        return self.active

    def _forget_jobs(self) -> None:
        """Drop the jobs of the segment that the camera was in before."""
        self.global_adjustment = GlobalAdjustment()
        self.places.enter()

    def recognise(self, grey: U8, maxima: F32, generator: np.random.Generator) -> Recognised | None:
        """Recognise the place in an image (H, W) with curvature maxima (M, 3), in any segment."""
        segments = self._earlier.like(self.calibration)
        if self.active is not None:
            segments = [self.active.segment, *segments]
        if not segments:
            return None
        view = self.calibration.view
        search = LandmarkSearch(self.points, maxima, grey, view.camera, self._parameters, generator)
        return self.places.recognise(search, segments, view)

    def resume(self, seen: Keyframe, ids: I64) -> None:
        """Continue the segment of a recognised keyframe at its place.

        ids: of the tracks.
        """
        stays = self.active is not None and self.active.segment.id == seen.segment
        self.leave()
        active = self._enter(self._earlier.take(seen.segment))
        if stays:
            self.global_adjustment.withdraw()  # its result would not apply to the new frames
        else:
            self._forget_jobs()
        active.activate_near_keyframe(seen)
        active.links.follow(ids, self.points)

    def leave(self) -> None:
        """Close the active segment, which becomes an earlier one."""
        if self.active is None:
            return
        self.active.close()
        self._next_keyframe = self.active.next_keyframe_id
        self._earlier.keep(self.active.segment, self.calibration)
        self.active = None

    def add_pose(self, frame: int, keyframe: Keyframe, T_world_camera: F64, inliers: int) -> None:
        """Store the pose of a frame relative to a keyframe of the active segment."""
        assert self.active is not None
        self.active.segment.path.add(frame, keyframe, T_world_camera, inliers)

    def remember(self, keyframe: Keyframe, frame: IdealFrame, *, is_confirmed: bool = True) -> None:
        """Store a new keyframe as a place, and compare it with earlier places.

        is_confirmed: not at a start.
        """
        if not frame.has_image or self.active is None:
            return
        segment, view = self.active.segment, self.calibration.view
        seen, earlier = describe(frame.image), self._earlier.like(self.calibration)
        self.global_adjustment.loops += self.places.compare(
            keyframe, seen, segment, earlier, view, self._parameters,
            loops=not self.global_adjustment.closing,
            image=(frame.tracks.maxima, frame.image) if is_confirmed else None,
        )  # fmt: skip
        self.places.remember(keyframe, seen, [segment, *earlier], view)

    def request(self, frame: int) -> None:
        """Request a global bundle adjustment of the map after a frame, if one is due."""
        if self.active is not None:
            self._request(frame, self.active)

    def _request(self, frame: int, active: ActiveMap) -> None:
        self.global_adjustment.request(frame, active.segment, self.calibration, self._parameters)

    def catch_up(self, frame: int) -> list[Moved]:
        """Apply, before a frame, finished merges and adjustments."""
        moved = self._join_met(frame)
        result = self.global_adjustment.take(frame)
        return moved if result is None else [*moved, *self.take_over(result)]

    def _join_met(self, frame: int) -> list[Moved]:
        """Merge the active segment with an earlier one if the merge is verified."""
        proved = self.places.meetings.proved
        if self.active is None or not proved:
            return []
        segments = [self._earlier.segment_of(loop.old) for loop in proved]
        met = [loop for loop, of in zip(proved, segments, strict=True) if of == segments[0]]
        earlier = self._earlier.take(segments[0])
        self.global_adjustment.withdraw()
        self.global_adjustment.loops += met
        moved = join(self.active, earlier, met, self._spans, self.calibration)
        self.segment = self.active.segment.id
        spans = [(k, self.segment if of == moved.gone else of) for k, of in self._spans]
        self._spans = spans
        self.places.enter()
        self.active.room = self._earlier.share_room(self.points, self._parameters.window)
        assert moved.moves is not None
        self.global_adjustment.move(moved.moves)
        self._request(frame, self.active)
        return [moved]

    def take_over(self, result: AdjustmentResult) -> list[Moved]:
        """Apply the result of a global bundle adjustment."""
        assert self.active is not None
        self.places.comparisons.refused += result.refused
        self.places.comparisons.closed += len(result.loops)
        moved: list[Moved] = []
        if result.moves is not None:
            same_places = tuple((loop.old, loop.new) for loop in result.loops)
            moves = self.active.segment.dropped.together_with(result.moves)
            at_end = self.move(held(moves, self._spans, self.segment))
            self.active.segment.adjusted = int(result.moves.keyframe_ids[-1])
            moved = [at_end._replace(same_places=same_places)]
            for loop in result.loops:
                self.active.join(loop)
        before, self.calibration = self.calibration, result.calibration
        if len(result.refocus):
            refocus = self._refocus(result)
            log_focal = before.log_focal + float(refocus[-1]) if result.calibration.changes else 0.0
            self.calibration = replace(self.calibration, log_focal=log_focal)
            return [*moved, self._change_lens(self.active, before, refocus)]
        if not self.calibration.sees_like(before):
            return [*moved, self._change_lens(self.active, before)]
        if not before.readout:
            return [*moved, *self.begin_global_shutter()]
        self.active.segment.to_global_shutter(self.active.keyframes, self.calibration)
        return moved

    def _refocus(self, result: AdjustmentResult) -> F64:
        """(K,) change of each keyframe's log focal length.

        Keyframes newer than the job follow its last one.  All changes are undone if the focal
        length turns out to be constant.
        """
        assert self.active is not None
        assert result.moves is not None
        if not result.calibration.changes:
            return -np.array([keyframe.log_focal for keyframe in self.active.keyframes])
        ids = [keyframe.id for keyframe in self.active.keyframes]
        return np.interp(ids, result.moves.keyframe_ids, result.refocus)

    def _change_lens(
        self, active: ActiveMap, before: SelfCalibration, refocus: F64 | None = None
    ) -> Moved:
        """Continue with the new calibration.   refocus: as of ``see_by``."""
        newest = active.keyframes[-1]
        pose = newest.T_world_camera
        see_by(active.segment, before.view, self.calibration, refocus)
        active.use_calibration(self.calibration)
        self._earlier.see_by(before, self.calibration)
        self._adjusted = True  # readers have the landmarks of the previous calibration
        return Moved(newest.T_world_camera @ inverse(pose))

    def move(self, moves: MapMoves) -> Moved:
        """Move the active segment."""
        assert self.active is not None
        return Moved(self.active.move(moves), moves)

    def begin_global_shutter(self) -> list[Moved]:
        """Convert what was mapped without the readout, once the readout is estimated."""
        if self.active is None or not self.calibration.readout:
            return []
        newest = self.active.keyframes[-1]
        before = newest.T_world_camera
        self.active.begin_global_shutter(self.calibration)
        return [Moved(newest.T_world_camera @ inverse(before))]

    def focus(self, motion: Motion, stamp_ns: int, tracks: FrameTracks) -> None:
        """Estimate the focal length of a frame from its tracks, if it changes during the clip."""
        if self.active is None or not self._parameters.calibration.focal:
            return
        before = self.calibration
        self.calibration = refocused(self.active, before, motion, stamp_ns, tracks)
        if self.calibration.changes and not before.changes:
            self.global_adjustment.due = 0.0  # correct the map immediately

    def calibrate(self) -> list[Moved]:
        """Adjust the whole segment with its calibration if that is a guess and due."""
        active = self.active
        if active is None or not is_guess(self._parameters.calibration):
            return []
        if len(active.keyframes) < self.calibration.next_keyframes:
            return []
        self.global_adjustment = GlobalAdjustment()  # the running job is of the map before
        return [self._adjust(active)]

    def _adjust(
        self, active: ActiveMap, inertial: InertialSource | None = None,
        sample: TrackSample | None = None,
    ) -> Moved:  # fmt: skip
        newest = active.keyframes[-1]
        before = newest.T_world_camera
        self.calibration, moves = active.adjust_all(self.calibration, inertial, sample)
        self._adjusted = True
        published = None if moves is None else held(moves, self._spans, self.segment)
        return Moved(newest.T_world_camera @ inverse(before), published)

    def stay(self) -> None:
        """Drop corrections that are under way and not published."""
        self.global_adjustment, self.places.meetings = GlobalAdjustment(), SegmentMerges()

    def finish(
        self, timer: StageTimer = no_stages, inertial: InertialSource | None = None,
        sample: TrackSample | None = None,
    ) -> list[Moved]:  # fmt: skip
        """Apply the remaining corrections at the end of the stream.

        inertial: samples that the poses are to agree with.   sample: of the tracks in the frames of
        the active segment.
        """
        with timer("merging"):
            moved = self._join_met(0)
        if moved:
            sample = None  # frames of the other segment are not in it
        active = self.active
        with timer("final adjustment"):
            moves = self._earlier.adjust(self._parameters, inertial)
        moved += [Moved(np.eye(4), held(each, self._spans, of)) for of, each in moves]
        if active is None:
            return moved
        with timer("merging"):
            moved += self._close_at_last(active)
        with timer("final adjustment"):
            return [*moved, *self._adjust_at_last(active, inertial, sample)]

    def _close_at_last(self, active: ActiveMap) -> list[Moved]:
        """Close the loops that are still open."""
        self.global_adjustment.withdraw()  # the final adjustment replaces it
        if not self.global_adjustment.loops:
            return []
        self._request(0, active)
        result = self.global_adjustment.settle()
        return [] if result is None else self.take_over(result)

    def _adjust_at_last(
        self, active: ActiveMap, inertial: InertialSource | None, sample: TrackSample | None
    ) -> list[Moved]:
        """Adjust the last active segment in the frame of its beginning."""
        back = active.segment.back()
        moved = [] if back is None else [self.move(held(back, self._spans, self.segment))]
        active.collect_garbage()
        return [*moved, self._adjust(active, inertial, sample)]

    def note_changed(self, journal: Journal, *, everything: bool) -> None:
        """Tell the journal which keyframes and landmarks may need to be published.

        everything: all landmarks of the window, not only the new ones of the last frame.
        """
        adjusted, self._adjusted = self._adjusted, False
        if self.active is not None and adjusted:
            journal.add_changed(self.active.keyframes, self.active.segment.mapped_rows())
        elif self.active is not None:
            window = self.active.window
            rows = window.rows if everything else journal.unpublished(window.current_rows())
            journal.add_changed(window.keyframes, rows)
        for earlier in self._earlier.adjusted:
            journal.add_changed(earlier.keyframes, earlier.mapped_rows())

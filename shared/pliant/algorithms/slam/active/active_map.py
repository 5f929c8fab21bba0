"""The segment that the camera is in: tracks linked to its landmarks, and a window of keyframes."""

import bisect

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, I64, BoolArray
from pliant.algorithms.camera import PinholeCamera, size_unit
from pliant.algorithms.geometry import lengths
from pliant.algorithms.map_delta import MapMoves
from pliant.algorithms.slam.adjust.loops import Loop
from pliant.algorithms.slam.adjust.segment import InertialSource, Segment
from pliant.algorithms.slam.adjust.track_sample import TrackSample
from pliant.algorithms.slam.adjust.window import Window
from pliant.algorithms.slam.calibration.self_calibration import SelfCalibration
from pliant.algorithms.slam.frame import IdealFrame, PlacedFrame
from pliant.algorithms.slam.keyframe_rule import Overlap
from pliant.algorithms.slam.locate.inverse_depth import helping_candidates
from pliant.algorithms.slam.locate.landmark_search import LandmarkSearch
from pliant.algorithms.slam.locate.reacquisition import MaximaGrid, Reacquired, cut_patches
from pliant.algorithms.slam.map.covisibility import (
    MAX_MISSES,
    collect_garbage,
    missing_rows,
    most_shared,
    near_keyframes,
    rows_of,
)
from pliant.algorithms.slam.map.keyframe import Keyframe, Observations
from pliant.algorithms.slam.map.landmarks import CANDIDATE, MAPPED
from pliant.algorithms.slam.map.track_links import UNLINKED, TrackLinks
from pliant.algorithms.slam.parameters import MappingParameters
from pliant.algorithms.slam.start.first_map import BufferedFrame, Start
from pliant.algorithms.slam.store.sparsification import sparsify
from pliant.algorithms.tracks import FrameExtrema

_TRACK_AT_MAXIMUM_PX = 1.5
"""A track this close to a maximum is the track of that maximum."""

_SAME_DEPTH_SHARE = 0.05
"""Points found at one place of the image are the same when their distances differ by less."""

_NEAR_KEYFRAMES = 24
"""Keyframes older than the window whose points are looked for: bounds the work of long runs."""

_MOST_UNADJUSTED = 1.5
"""Times the room that is taken before what has not been adjusted with the whole map goes."""

_MAX_STRIKES = 3
"""Bad frames in a row after which a track is taken from its point."""


class ActiveMap:
    """A segment while the camera is tracked in it.

    points: rows shared by all segments.   next_keyframe_id: of the keyframe to come.
    links: rows of the living tracks.   window: the keyframes under adjustment.
    room: maximum number of observations.   seen_by: the calibration whose pixels it has.
    """

    def __init__(
        self,
        segment: Segment,
        next_keyframe_id: int,
        seen_by: SelfCalibration,
        parameters: MappingParameters,
    ) -> None:
        self.segment = segment
        self.points = segment.points
        self.next_keyframe_id = next_keyframe_id
        self.seen_by = seen_by
        self.parameters = parameters
        self.room = parameters.window.kept_observations
        self.links = TrackLinks()
        self.window = self._window([], fixed=0, outside=0)
        self.candidates_agree = True  # with the landmarks, in the current frame
        self.magnification = 0.0  # log, of the last frame where it was clear, else 0
        self._nearby: I32 = np.zeros(0, np.int32)
        self._marks: I64 = np.zeros(0, np.int64)

    def _window(self, keyframes: list[Keyframe], *, fixed: int, outside: int) -> Window:
        return Window(
            keyframes,
            fixed=fixed,
            outside=outside,
            points=self.points,
            calibration=self.seen_by,
        )

    @property
    def camera(self) -> PinholeCamera:
        """The ideal camera whose pixels the segment has."""
        return self.seen_by.view.camera

    @property
    def keyframes(self) -> list[Keyframe]:
        """The keyframes of the segment, oldest first."""
        return self.segment.keyframes

    def begin(self, start: Start, waiting: list[BufferedFrame], latest: IdealFrame) -> None:
        """Initialise from a start.   latest: the newest waiting frame, with its image."""
        newest = waiting[-1]
        rows = self._allocate(len(start.ids))
        self.points.kappas[rows] = start.kappas
        self.points.place(rows, start.points_world)
        self.links.ids, self.links.rows = start.ids, rows
        self.links.follow(newest.ids, self.points)
        self._link_new_tracks()
        self._paint(rows, start.newest_px, latest)
        self._paint(self.links.rows, newest.points_px, latest)
        self.points.kappas[self.links.rows] = newest.kappas
        frames = {frame.frame: frame for frame in waiting}
        for k, number in enumerate(start.frames.tolist()):
            supported = start.keyframe_index == k
            _, i, j = np.intersect1d(
                frames[number].ids, newest.ids, assume_unique=True, return_indices=True
            )
            others = self.points.state[self.links.rows[j]] == CANDIDATE
            self._append_keyframe(
                number, frames[number].stamp_ns, start.T_world_camera[k],
                np.concatenate([rows[start.point_index[supported]], self.links.rows[j[others]]]),
                np.concatenate([start.points_px[supported], frames[number].points_px[i[others]]]),
                None,
            )  # fmt: skip
        for keyframe in self.keyframes[: -self.parameters.window.keyframes - 1]:
            self.segment.leave_window(keyframe)  # rebuild_window removes one more
        self._settle(self.keyframes[-1], latest)

    def linked(self, state: int) -> I64:
        """Return the indices of the living tracks whose row has this state."""
        return self.links.in_state(self.points.state, state)

    def nearby(self) -> I32:
        """Rows of the mapped points of the window and of the keyframes near it."""
        return self._nearby[self.points.state[self._nearby] == MAPPED]

    def search_in(self, frame: IdealFrame, generator: np.random.Generator) -> LandmarkSearch:
        """Return the search for landmarks in the image of a frame."""
        return LandmarkSearch(
            self.points, frame.tracks.maxima, frame.image, self.camera, self.parameters, generator
        )

    def missing(self, frame: int) -> I32:
        """Rows of mapped points without a track that are worth looking for in this frame.

        Points looked for in vain many times, for instance occluded ones, wait their turn.
        """
        points = self.points
        if len(self._marks) < len(points.state):
            self._marks = np.full(len(points.state), -1, np.int64)
        return missing_rows(
            self._nearby, self.links.rows, points.state, points.misses, self._marks, frame
        )

    def judge_tracks(self, tracks: I64, errors: F32) -> None:
        """Take tracks from points that they missed in several frames in a row."""
        rows = self.links.rows.take(tracks)
        bad = errors > 2.0 * self.parameters.localisation.inlier_px
        strikes = np.where(bad, self.points.strikes.take(rows) + 1, 0).astype(np.uint8)
        self.points.strikes[rows] = strikes
        lost = strikes >= _MAX_STRIKES
        self.points.strikes[rows[lost]] = 0
        self.links.rows[tracks[lost]] = UNLINKED

    def take_over(self, reacquired: Reacquired, tracks: FrameExtrema) -> Observations:
        """Let tracks at the maxima of points found again belong to those points.

        What such a track belonged to merges into the point, where both can be the same.  Returns
        the points found where no track is.
        """
        misses, visible = self.points.misses, reacquired.visible
        misses[visible] = np.minimum(misses[visible], MAX_MISSES - 1) + 1
        misses[reacquired.rows] = 0
        camera = self.camera
        nearby = MaximaGrid.build(
            tracks.points_px, camera.width, camera.height, _TRACK_AT_MAXIMUM_PX
        )
        track = nearby.nearest(tracks.maxima[reacquired.maxima, :2], _TRACK_AT_MAXIMUM_PX)
        alone = track < 0
        new = reacquired.rows[~alone]
        track = track[~alone]
        former = self.links.rows[track]
        differ = former != new
        mapped = (former != UNLINKED) & (self.points.state[former] == MAPPED)
        near = self._same_depth(former, new)
        taken = differ & (~mapped | near)
        self.links.rows[track[taken]] = new[taken]
        taken &= former != UNLINKED
        self.points.merge(former[taken], new[taken])
        points_px = reacquired.points_px.compress(alone, 0)
        return Observations(
            rows=reacquired.rows[alone], points_px=points_px, rolled_px=np.zeros_like(points_px)
        )

    def _same_depth(self, a: I32, b: I32) -> BoolArray:
        """Whether points that lie on nearly the same ray are as far from the newest keyframe."""
        centre = self.keyframes[-1].T_world_camera[:3, 3]
        distance_a = lengths(self.points.xyz.take(a, 0) - centre)
        distance_b = lengths(self.points.xyz.take(b, 0) - centre)
        return np.abs(distance_a - distance_b) < _SAME_DEPTH_SHARE * distance_b

    def helping_candidates(self) -> I64:
        """Indices of the tracks of candidates that help to place the current frame."""
        candidates = helping_candidates(self.points, self.links.rows)
        return candidates if self.candidates_agree else candidates[:0]

    def overlap(self, age_s: float, interval_s: float) -> Overlap:
        """Overlap of the current frame with the last keyframe.   age_s, interval_s: of it."""
        shared, before, flow_px = self.window.flow_since_keyframe(MAPPED)
        if shared < self.parameters.start.min_points and len(self.helping_candidates()):
            shared, before, flow_px = self.window.flow_since_keyframe(CANDIDATE)
            in_view = shared  # candidates without a depth have no predicted position
        else:
            in_view = max(shared, self.window.in_view_since_keyframe())
        unit = size_unit(self.camera.width, self.camera.height)
        before = max(before, 1)
        return Overlap(shared / before, in_view / before, flow_px / unit, age_s, interval_s)

    def observed(self, placed: PlacedFrame, candidates: I64) -> tuple[I32, F32]:
        """Return rows and pixels of the landmarks and candidates that determine the current
        pose.
        """
        return self._observed(placed, np.concatenate([self.linked(MAPPED), candidates]))

    def see(self, placed: PlacedFrame) -> None:
        """Put the current frame into the window."""
        self.window.see(placed.T_world_camera, *self._seen(placed))

    def add_ordinary(self, placed: PlacedFrame) -> None:
        """Attach the current frame, which is no keyframe, to the last keyframe."""
        self.segment.ordinary.add(
            placed.frame.number, self.keyframes[-1], placed.T_world_camera, *self._seen(placed),
            self.seen_by.log_focal,
        )  # fmt: skip

    def _seen(self, placed: PlacedFrame) -> tuple[I32, F32]:
        """Rows and pixels of all landmarks and candidates in the current frame."""
        return self._observed(placed, np.flatnonzero(self.links.rows != UNLINKED))

    def _observed(self, placed: PlacedFrame, tracks: I64) -> tuple[I32, F32]:
        found, points_px = placed.found, placed.frame.tracks.points_px
        rows = np.concatenate([self.links.rows.take(tracks), found.rows])
        return rows, np.concatenate([points_px.take(tracks, 0), found.points_px])

    def join(self, loop: Loop) -> None:
        """Merge the landmarks that a loop has shown to be the same, if they still exist."""
        points = self.points
        for old, new in loop.living(points).rows[:, :, None]:
            if points.state[old] == MAPPED and points.state[new] == MAPPED and old != new:
                points.merge(new, old)
        linked = self.links.rows != UNLINKED
        rows = points.alias[self.links.rows[linked]]
        # A point with two tracks keeps the older one.
        _, first = np.unique(rows, return_index=True)
        once = np.full(len(rows), UNLINKED, np.int32)
        once[first] = rows[first]
        self.links.rows[linked] = once

    def insert_keyframe(self, placed: PlacedFrame) -> Keyframe:
        """Make the current frame a keyframe and adjust the window."""
        frame, found = placed.frame, placed.found
        points_px = frame.tracks.points_px
        new = self._link_new_tracks()
        self._paint(self.links.rows.take(new), points_px.take(new, 0), frame)
        keyframe = self._append_keyframe(
            frame.number,
            frame.stamp_ns,
            placed.T_world_camera,
            np.concatenate([self.links.rows, found.rows]),
            np.concatenate([points_px, found.points_px]),
            np.concatenate([frame.rolled_px, found.rolled_px]),
        )
        keyframe.is_pure_rotation = placed.is_pure_rotation
        self._settle(keyframe, frame)
        return keyframe

    def _settle(self, newest: Keyframe, frame: IdealFrame) -> None:
        """Adjust the window after a new keyframe."""
        self.collect_garbage()
        self.rebuild_window()
        self.window.triangulate(self.parameters.point)
        self._adjust_window()
        self._place_candidates()
        if frame.has_image:
            mapped = self.points.state[newest.rows] == MAPPED
            rows, points_px = newest.rows.compress(mapped), newest.points_px.compress(mapped, 0)
            cut_patches(frame.image, points_px, rows, self.points.patches)
            self.points.patch_keyframe[rows] = newest.id

    def _adjust_window(self) -> None:
        self.window.adjust(self.parameters)
        self.window.remove_outliers(self.parameters.window.outlier_px)
        self.window.update_statistics()

    def _place_candidates(self) -> None:
        segment = self.segment
        segment.inverse_distance = self.window.place_candidates(segment.inverse_distance)

    def _link_new_tracks(self) -> I64:
        """Give candidate rows to tracks without one.  Returns the indices of those tracks."""
        new = np.flatnonzero(self.links.rows == UNLINKED)
        self.links.rows[new] = self._allocate(len(new))
        return new

    def _allocate(self, count: int) -> I32:
        keyframe = self.next_keyframe_id
        return self.points.allocate(count, segment=self.segment.id, keyframe=keyframe)

    def _paint(self, rows: I32, points_px: F32, frame: IdealFrame) -> None:
        image = frame.colours
        if image is not None and image.pixels.size:
            self.points.colours[rows] = image.colours(points_px)

    def _append_keyframe(
        self, frame: int, stamp_ns: int, T_world_camera: F64, rows: I32, points_px: F32,
        rolled_px: F32 | None,
    ) -> Keyframe:  # fmt: skip
        rows, first = np.unique(rows, return_index=True)
        keyframe = Keyframe(
            id=self.next_keyframe_id,
            frame=frame,
            stamp_ns=stamp_ns,
            log_focal=self.seen_by.log_focal,
            segment=self.segment.id,
            T_world_camera=T_world_camera.copy(),
            rows=rows,
            points_px=points_px.take(first, 0),
            rolled_px=np.zeros((len(first), 2), np.float32)
            if rolled_px is None
            else rolled_px.take(first, 0),
        )
        self.next_keyframe_id += 1
        self.keyframes.append(keyframe)
        return keyframe

    def begin_global_shutter(self, calibration: SelfCalibration) -> None:
        """Convert the segment to a global shutter once the readout is estimated, and adjust the
        window.
        """
        self.segment.to_global_shutter(self.keyframes, calibration)
        self.segment.ordinary.forget()
        self.window.observe_again()
        self._adjust_window()

    def use_calibration(self, seen_by: SelfCalibration) -> None:
        """Use another calibration, in whose pixels the keyframes already are."""
        self.seen_by, before = seen_by, self.window
        self.window = self._window(before.keyframes, fixed=before.fixed, outside=before.outside)
        self.window.T_world_camera[-1] = before.T_world_camera[-1]
        if before.keyframes:
            self._adjust_window()
            self._place_candidates()

    def collect_garbage(self) -> None:
        """Free the rows of dead candidates and of merged landmarks.

        Candidates live while their tracks may come back: after a blurred frame, a pose depends
        mostly on them.
        """
        living = np.concatenate([self.links.rows, self.links.awaited()])
        collect_garbage(self.points, self.keyframes, living, self.segment.id)

    def rebuild_window(self) -> None:
        """The newest keyframes are free; older covisible ones are fixed."""
        sizes, segment = self.parameters.window, self.segment
        first = segment.first_of_window(sizes.keyframes)
        moving = self.keyframes[first:]
        if first > segment.since:
            segment.leave_window(self.keyframes[first - 1])
        self._make_room(first)
        outside = self.keyframes[: len(self.keyframes) - len(moving)]
        older = near_keyframes(outside, moving[-1].T_world_camera, _NEAR_KEYFRAMES)
        # After recognition, keyframes of the earlier visit fill the window until new ones do.
        count = max(sizes.fixed, sizes.keyframes - len(moving))
        fixed = most_shared(older, moving, self.points)[:count] if older else []
        self._activate(older, fixed, moving)

    def _make_room(self, first: int) -> None:
        """Sparsify what has left the window and was adjusted globally: its state is then final.

        first: index of the first keyframe of the window.
        """
        segment, room, adjusted = self.segment, self.room, self.segment.adjusted >= 0
        settled = first - 1  # the keyframe that has just left is not published yet
        if adjusted:
            ids = [keyframe.id for keyframe in self.keyframes]
            newest = min(segment.adjusted, segment.ordinary.first_keyframe - 1)
            settled = min(settled, bisect.bisect_right(ids, newest))
        else:
            room = int(_MOST_UNADJUSTED * room)
        whole = len(self.keyframes) - max(settled, 0)
        sparsify(
            segment, room, self.parameters.window, self.links.rows, whole=whole, settled=adjusted
        )
        segment.adjusted = -1

    def _activate(
        self, older: list[Keyframe], fixed: list[Keyframe], moving: list[Keyframe]
    ) -> None:
        chosen = sorted(fixed, key=lambda keyframe: keyframe.id) + moving
        prior = max(len(fixed), min(2, len(moving) - 1))
        self.window = self._window(chosen, fixed=prior, outside=len(fixed))
        self._nearby = rows_of(older, self.window.rows, len(self.points.state))

    def activate_near_keyframe(self, seen: Keyframe) -> None:
        """After recognition: the next frame becomes a keyframe, and the landmarks near ``seen`` are
        fixed.
        """
        older = most_shared(self.keyframes, [seen], self.points)[:_NEAR_KEYFRAMES]
        self._activate(older, older[: self.parameters.window.keyframes], [])

    def activate_near(self, T_world_camera: F64) -> None:
        """From now on search for the landmarks of keyframes that look at the same place as the
        camera.
        """
        self._activate(near_keyframes(self.keyframes, T_world_camera, _NEAR_KEYFRAMES), [], [])

    def move(self, moves: MapMoves) -> F64:
        """As ``Segment.move``."""
        S = self.segment.move(moves)
        self.window.move(S)
        return S

    def adjust_all(
        self, known: SelfCalibration, inertial: InertialSource | None = None,
        sample: TrackSample | None = None,
    ) -> tuple[SelfCalibration, MapMoves | None]:  # fmt: skip
        """As ``Segment.adjust``."""
        known, moves = self.segment.adjust(known, self.parameters, inertial, sample)
        self.seen_by = known
        self.rebuild_window()
        self._place_candidates()  # their positions are those before the adjustment
        return known, moves

    def close(self) -> None:
        """The camera has left the segment: free the candidates, which only tracking could have
        mapped.
        """
        self.links = TrackLinks()
        self.collect_garbage()
        self.segment.rest(self.parameters.window.keyframes)

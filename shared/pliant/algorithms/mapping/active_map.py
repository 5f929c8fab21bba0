"""The map segment that is being built: its points, keyframes, window and linked tracks."""

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, I64, U8, BoolArray
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.mapping.covisibility import (
    MAX_MISSES,
    collect_garbage,
    focus_of,
    missing_rows,
    most_redundant,
    most_shared,
    near_keyframes,
    rows_of,
    seen_by_none,
)
from pliant.algorithms.mapping.final_adjustment import adjust_keyframes
from pliant.algorithms.mapping.loops import Loop
from pliant.algorithms.mapping.map_store import (
    CANDIDATE,
    MAPPED,
    MERGED,
    UNLINKED,
    Keyframe,
    Observations,
    PointRows,
    TrackLinks,
    sample_colours,
)
from pliant.algorithms.mapping.observation_table import (
    columns_in_state,
    count_cameras,
    has_parallax,
    seen_in_state,
)
from pliant.algorithms.mapping.parameters import MappingParameters
from pliant.algorithms.mapping.reacquisition import MaximaGrid, Reacquired, cut_patches
from pliant.algorithms.mapping.rolling_shutter import Path, RolledFrame
from pliant.algorithms.mapping.self_calibration import SelfCalibration
from pliant.algorithms.mapping.start import Start, WaitingFrame
from pliant.algorithms.mapping.window import Window
from pliant.algorithms.tracks import FrameTracks
from pliant.algorithms.triangulation import triangulate

_TRACK_AT_MAXIMUM_PX = 1.5
"""A track this close to a maximum is the track of that maximum."""

_SAME_DEPTH_SHARE = 0.05
"""Points found at one place of the image are the same when their distances differ by less."""

_NEAR_KEYFRAMES = 24
"""Keyframes older than the window whose points are looked for: bounds the work of long runs."""

_CLEAR_SHARE = 0.7
"""Share of the least parallax under which noise does not make rays differ enough."""

_MIN_DEPTH = 1e-6

_MAX_STRIKES = 3
"""Bad frames in a row after which a track is taken from its point."""


class ActiveMap:
    """One segment of the map.

    points: rows shared by all segments.    keyframes: of this segment, oldest first.
    window: those under adjustment.    links: rows of the living tracks.
    culled: keyframes that it has forgotten.   since: index of the first keyframe after the camera
    was last recognised: older ones do not move any more.   removed_ids: points removed since the
    last call of ``take_removed``.
    """

    def __init__(
        self,
        segment: int,
        points: PointRows,
        first_keyframe_id: int,
        camera: PinholeCamera,
        parameters: MappingParameters,
    ) -> None:
        self.segment = segment
        self.points = points
        self.camera = camera
        self.parameters = parameters
        self.keyframes: list[Keyframe] = []
        self.culled = 0
        self.since = 0
        self.links = TrackLinks()
        self.window = self._window([], fixed=0, outside=0)
        self._next_keyframe_id = first_keyframe_id
        self._removed: list[I64] = []
        self._inverse_distance = 1.0
        self._nearby: I32 = np.zeros(0, np.int32)
        self._marks: I64 = np.zeros(0, np.int64)

    def _window(self, keyframes: list[Keyframe], *, fixed: int, outside: int) -> Window:
        return Window(
            keyframes,
            fixed=fixed,
            outside=outside,
            points=self.points,
            camera=self.camera,
            lens_radius=self.parameters.window.lens_radius,
        )

    @property
    def next_keyframe_id(self) -> int:
        return self._next_keyframe_id

    def begin(
        self, start: Start, waiting: list[WaitingFrame], grey: U8 | None, colour: U8 | None
    ) -> None:
        """Take over a start.  The images are those of the newest of the waiting frames."""
        newest = waiting[-1]
        rows = self.points.allocate(len(start.ids))
        self.points.segment[rows] = self.segment
        self.points.first_keyframe[rows] = self._next_keyframe_id
        self.points.xyz[rows] = start.points_world
        self.points.promote(rows)
        self.links.ids, self.links.rows = start.ids, rows
        self.links.follow(newest.ids)
        self._link_new_tracks(newest.points_px)
        self._paint(self.links.rows, newest.points_px, colour if colour is not None else grey)
        self.points.kappas[self.links.rows] = newest.kappas
        frames = {frame.frame: frame for frame in waiting}
        for k, number in enumerate(start.frames.tolist()):
            supported = start.keyframe_index == k
            _, i, j = np.intersect1d(
                frames[number].ids, newest.ids, assume_unique=True, return_indices=True
            )
            others = self.points.state[self.links.rows[j]] == CANDIDATE
            self._append_keyframe(
                number,
                start.T_world_camera[k],
                np.concatenate([rows[start.point_index[supported]], self.links.rows[j[others]]]),
                np.concatenate([start.points_px[supported], frames[number].points_px[i[others]]]),
                None,
            )
        self._settle(self.keyframes[-1], grey)

    def know(self, keyframes: list[Keyframe]) -> None:
        """Take over what an earlier session has mapped, oldest first."""
        self.keyframes = keyframes
        self.since = len(keyframes)
        for keyframe in keyframes:
            keyframe.focus = focus_of(keyframe, self.points)

    def linked(self, state: int) -> I64:
        """Indices of the living tracks whose row has the given state."""
        return self.links.in_state(self.points.state, state)

    def nearby(self) -> I32:
        """Rows of the mapped points of the window and of the keyframes near it."""
        return self._nearby[self.points.state[self._nearby] == MAPPED]

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
        rows = self.links.rows[tracks]
        bad = errors > 2.0 * self.parameters.localisation.inlier_px
        strikes = np.where(bad, self.points.strikes[rows] + 1, 0).astype(np.uint8)
        self.points.strikes[rows] = strikes
        lost = strikes >= _MAX_STRIKES
        self.points.strikes[rows[lost]] = 0
        self.links.rows[tracks[lost]] = UNLINKED

    def take_over(self, reacquired: Reacquired, tracks: FrameTracks) -> Observations:
        """Let tracks at the maxima of points found again belong to those points.

        What such a track belonged to merges into the point, where both can be the same.  Returns
        the points found where no track is.
        """
        misses, visible = self.points.misses, reacquired.visible
        misses[visible] = np.minimum(misses[visible], MAX_MISSES - 1) + 1
        misses[reacquired.rows] = 0
        camera = self.camera
        places = np.column_stack([tracks.points_px, tracks.kappas])
        nearby = MaximaGrid.build(places, camera.width, camera.height, _TRACK_AT_MAXIMUM_PX)
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
        for old, to in zip(former[taken].tolist(), new[taken].tolist(), strict=True):
            if old != UNLINKED:
                self._merge(old, to)
        points_px = reacquired.points_px[alone]
        return Observations(
            rows=reacquired.rows[alone], points_px=points_px, rolled_px=np.zeros_like(points_px)
        )

    def _same_depth(self, a: I32, b: I32) -> BoolArray:
        """Whether points that lie on nearly the same ray are as far from the newest keyframe."""
        centre = self.keyframes[-1].T_world_camera[:3, 3]
        distance_a = np.linalg.norm(self.points.xyz[a] - centre, axis=1)
        distance_b = np.linalg.norm(self.points.xyz[b] - centre, axis=1)
        return np.abs(distance_a - distance_b) < _SAME_DEPTH_SHARE * distance_b

    def observed(self, points_px: F32, found: Observations, directions: I64) -> tuple[I32, F32]:
        """Rows and pixels of the points that place the current frame."""
        linked = np.concatenate([self.linked(MAPPED), directions])
        rows = np.concatenate([self.links.rows[linked], found.rows])
        return rows, np.concatenate([points_px[linked], found.points_px])

    def see(self, T_world_camera: F64, points_px: F32, found: Observations) -> None:
        """Put the current frame into the window."""
        linked = self.links.rows != UNLINKED
        self.window.see(
            T_world_camera,
            np.concatenate([self.links.rows[linked], found.rows]),
            np.concatenate([points_px[linked], found.points_px]),
        )

    def _merge(self, old: int, new: int) -> None:
        points = self.points
        if points.state[old] == MAPPED:
            self._note_removed(np.array([old], np.int32))
        points.state[old] = MERGED
        points.alias[old] = new
        points.first_keyframe[new] = min(points.first_keyframe[old], points.first_keyframe[new])
        points.published_keyframes[new] = -1  # others are told on what it hangs

    def join(self, loop: Loop) -> None:
        """Points that a loop has shown to be the same become one, as far as they still exist."""
        points = self.points
        alive = points.ids[loop.rows] == loop.ids
        alive &= points.state[loop.rows] == MAPPED
        for old, new in loop.rows[alive.all(axis=1)].tolist():
            if points.state[old] == MAPPED and points.state[new] == MAPPED and old != new:
                self._merge(new, old)
        linked = self.links.rows != UNLINKED
        rows = points.alias[self.links.rows[linked]]
        # A point with two tracks keeps the older one.
        _, first = np.unique(rows, return_index=True)
        once = np.full(len(rows), UNLINKED, np.int32)
        once[first] = rows[first]
        self.links.rows[linked] = once

    def _note_removed(self, rows: I32) -> None:
        """Points go that have been published; nobody knows of the others."""
        published = np.isfinite(self.points.published_xyz[rows, 0])
        self._removed.append(self.points.ids[rows[published]])

    def take_removed(self) -> I64:
        """Ids of the points removed since the last call."""
        removed, self._removed = self._removed, []
        return np.concatenate([*removed, np.zeros(0, np.int64)])

    def triangulate(self) -> None:
        """Make points of the candidates whose rays now meet under enough parallax."""
        window, limits = self.window, self.parameters.point
        if window.seen[-1].any():
            candidates = seen_in_state(
                window.rows, self.points.state, CANDIDATE, window.seen, len(window.keyframes),
                limits.min_observations,
            )  # fmt: skip
            # Rays that hardly differ need no triangulation to be turned down.
            columns = has_parallax(
                candidates, len(window.keyframes), window.T_world_camera[:, :3, :3], window.u,
                window.v, window.seen, window.lens,
                float(np.cos(_CLEAR_SHARE * np.radians(limits.min_parallax_deg))),
            )  # fmt: skip
        else:
            candidates = columns_in_state(window.rows, self.points.state, CANDIDATE)
            seen = count_cameras(candidates, window.seen, 0, len(window.seen))
            columns = candidates[seen >= limits.min_observations].astype(np.int64)
        xyz, errors, parallax, sigmas = triangulate(
            window.T_world_camera, window.u, window.v, window.seen, columns, self.camera
        )
        good = (parallax >= np.radians(limits.min_parallax_deg)) & (errors < limits.max_error_px)
        rows = window.rows[columns[good]]
        self.points.xyz[rows] = xyz[good]
        self.points.parallax_rad[rows] = parallax[good]
        self.points.sigmas[rows] = sigmas[good]
        self.points.promote(rows)

    def insert_keyframe(
        self,
        frame: int,
        T_world_camera: F64,
        points_px: F32,
        rolled_px: F32,
        found: Observations,
        grey: U8 | None,
        colour: U8 | None,
        turned: bool,
    ) -> Keyframe:
        """Make the frame a keyframe and adjust the window.

        points_px, rolled_px: of all living tracks.   found: points that it sees without a track.
        turned: whether it stands where the last one does.
        """
        new = self._link_new_tracks(points_px)
        image = colour if colour is not None else grey
        self._paint(self.links.rows[new], points_px[new], image)
        keyframe = self._append_keyframe(
            frame,
            T_world_camera,
            np.concatenate([self.links.rows, found.rows]),
            np.concatenate([points_px, found.points_px]),
            np.concatenate([rolled_px, found.rolled_px]),
        )
        keyframe.turned = turned
        self._settle(keyframe, grey)
        return keyframe

    def _settle(self, newest: Keyframe, grey: U8 | None) -> None:
        """Adjust the window after a keyframe has come to it."""
        self.collect_garbage()
        self.rebuild_window()
        self.triangulate()
        self._adjust_window()
        self._inverse_distance = self.window.place_directions(self.camera, self._inverse_distance)
        if grey is not None:
            mapped = self.points.state[newest.rows] == MAPPED
            rows, points_px = newest.rows[mapped], newest.points_px[mapped]
            cut_patches(grey, points_px, rows, self.points.patches)

    def _adjust_window(self) -> None:
        self.window.adjust(self.camera, self.parameters)
        self.remove_outliers()
        self.window.update_statistics(self.camera)

    def _link_new_tracks(self, points_px: F32) -> I64:
        """Give candidate rows to tracks that have none.  Returns the indices of those tracks."""
        new = np.flatnonzero(self.links.rows == UNLINKED)
        rows = self.points.allocate(len(new))
        self.links.rows[new] = rows
        self.points.segment[rows] = self.segment
        self.points.first_keyframe[rows] = self._next_keyframe_id
        return new

    def _paint(self, rows: I32, points_px: F32, image: U8 | None) -> None:
        if image is not None and image.size:
            image = image if image.ndim == 3 else image[:, :, None]
            self.points.colours[rows] = sample_colours(image, points_px)

    def _append_keyframe(
        self, frame: int, T_world_camera: F64, rows: I32, points_px: F32, rolled_px: F32 | None
    ) -> Keyframe:
        rows, first = np.unique(rows, return_index=True)
        keyframe = Keyframe(
            id=self._next_keyframe_id,
            frame=frame,
            segment=self.segment,
            T_world_camera=T_world_camera.copy(),
            rows=rows,
            points_px=points_px[first],
            rolled_px=np.zeros((len(first), 2), np.float32)
            if rolled_px is None
            else rolled_px[first],
        )
        self._next_keyframe_id += 1
        self.keyframes.append(keyframe)
        return keyframe

    def rolled(self, readout: float, motion: F64) -> RolledFrame:
        """What the readout does to a frame that moves so."""
        return RolledFrame(self.camera, readout, motion, self._inverse_distance)

    def inverse_depths(self, rows: I32, T_world_camera: F64) -> F64:
        """(n,) of the rows (UNLINKED among them) in a camera; the map's where they are unknown."""
        mapped = (rows != UNLINKED) & (self.points.state[rows] == MAPPED)
        z = (self.points.xyz[rows] - T_world_camera[:3, 3]) @ T_world_camera[:3, 2]
        known = mapped & (z > _MIN_DEPTH)
        return np.divide(1.0, z, out=np.full(len(rows), self._inverse_distance), where=known)

    def unroll(self, keyframes: list[Keyframe], path: Path, readout: float) -> None:
        """Let keyframes see as if they had been taken at once, as is now known of readout, motion
        and depths; those of which no motion is known any more stay."""
        for keyframe, motion in zip(keyframes, path.motions(keyframes), strict=True):
            if not motion.any():
                continue
            seen = keyframe.points_px + keyframe.rolled_px
            depths = self.inverse_depths(keyframe.rows, keyframe.T_world_camera)
            keyframe.rolled_px = self.rolled(readout, motion).shifts(seen, depths)
            keyframe.points_px = seen - keyframe.rolled_px

    def begin_to_unroll(self, path: Path, readout: float) -> None:
        """The readout has become known: the map is bent until its window is adjusted with it."""
        self.unroll(self.keyframes, path, readout)
        self.window.see_anew()
        self._adjust_window()

    def collect_garbage(self) -> None:
        """Give back the rows of dead candidates and of merged points."""
        collect_garbage(self.points, self.keyframes, self.links.rows, self.segment)

    def rebuild_window(self) -> None:
        """The newest keyframes move; older ones that see the same points are fixed."""
        sizes = self.parameters.window
        first = self._first_of_window()
        moving = self.keyframes[first:]
        outside = self.keyframes[:first]
        if first > self.since:
            self._leave_window(outside[-1])
        if len(self.keyframes) > max(sizes.kept_keyframes, sizes.final_max_keyframes):
            # Not the one that has just left: it is not published yet.
            redundant = most_redundant(outside[:-1])
            self._cull(self.keyframes.pop(redundant))
            self.since -= redundant < self.since
            outside = self.keyframes[: -len(moving)]
        older = near_keyframes(outside, moving[-1].T_world_camera, _NEAR_KEYFRAMES)
        # What was there before the camera was recognised takes the place of what will be.
        count = max(sizes.fixed, sizes.keyframes - len(moving))
        fixed = most_shared(older, moving, self.points)[:count] if older else []
        self._look_at(older, fixed, moving)

    def _look_at(
        self, older: list[Keyframe], fixed: list[Keyframe], moving: list[Keyframe]
    ) -> None:
        chosen = sorted(fixed, key=lambda keyframe: keyframe.id) + moving
        prior = max(len(fixed), min(2, len(moving) - 1))
        self.window = self._window(chosen, fixed=prior, outside=len(fixed))
        self._nearby = rows_of(older, self.window.rows, len(self.points.state))

    def resume(self, seen: Keyframe, next_keyframe_id: int) -> None:
        """The camera has been recognised, and sees what a keyframe saw: the map goes on from there.

        What has been mapped stays where it is; the next frame is a keyframe.
        """
        self.links = TrackLinks()
        self.collect_garbage()
        for keyframe in self.keyframes[self._first_of_window() :]:
            self._leave_window(keyframe)
        self.since, self._next_keyframe_id = len(self.keyframes), next_keyframe_id
        older = most_shared(self.keyframes, [seen], self.points)[:_NEAR_KEYFRAMES]
        self._look_at(older, older[: self.parameters.window.keyframes], [])

    def look_around(self, T_world_camera: F64) -> None:
        """What keyframes see that look where a camera does is looked for from now on."""
        self._look_at(near_keyframes(self.keyframes, T_world_camera, _NEAR_KEYFRAMES), [], [])

    def take_in(self, earlier: "ActiveMap", segment: int) -> None:
        """Become one with a segment that lost its camera before, in whose world this one lies by
        now, or the other way round.

        segment: of both, from now on.  What was mapped there does not move with the window.
        """
        for keyframe in earlier.keyframes[earlier._first_of_window() :]:
            earlier._leave_window(keyframe)
        older = [*earlier.keyframes, *self.keyframes[: self.since]]
        older.sort(key=lambda keyframe: keyframe.id)
        self.keyframes = [*older, *self.keyframes[self.since :]]
        self.since = len(older)
        self.culled += earlier.culled
        self._removed += earlier._removed
        both = np.isin(self.points.segment, (self.segment, earlier.segment))
        self.points.segment[both] = segment
        for keyframe in self.keyframes:
            keyframe.segment = segment
        self.segment = segment

    def scaled(self, scale: float) -> None:
        """The world has become larger."""
        self._inverse_distance /= scale

    def _first_of_window(self) -> int:
        """Index of the first keyframe that may move."""
        return max(self.since, len(self.keyframes) - self.parameters.window.keyframes)

    def adjust_all(self, path: Path, known: SelfCalibration) -> SelfCalibration:
        """Adjust all but the first keyframe and the calibration, from what is known of it."""
        motions = path.motions(self.keyframes)
        known, gone = adjust_keyframes(self.keyframes, self.points, known, self.parameters, motions)
        self._remove(gone)
        self.camera = known.view.camera
        self.unroll(self.keyframes, path, known.readout)
        self.rebuild_window()
        return known

    def close(self) -> None:
        """The segment does not go on: what could only have become a part of it is given back."""
        self.links = TrackLinks()
        self.collect_garbage()
        self.window = self._window([], fixed=0, outside=0)

    def mapped_rows(self) -> I32:
        """Rows of all points of the segment, oldest first."""
        rows = self.points.mapped(self.segment)
        return rows[np.argsort(self.points.first_keyframe[rows], kind="stable")]

    def _cull(self, keyframe: Keyframe) -> None:
        """The map forgets a keyframe, and the points that only this one saw."""
        self.culled += 1
        rows = seen_by_none(keyframe.rows, self.keyframes, self.links.rows, self.points)
        self.points.cull(rows)

    def _leave_window(self, keyframe: Keyframe) -> None:
        self.points.base_keyframes[keyframe.rows] += 1
        self.points.base_parallax_rad[keyframe.rows] = self.points.parallax_rad[keyframe.rows]
        keyframe.focus = focus_of(keyframe, self.points)

    def remove_outliers(self) -> None:
        """Forget observations that miss their point, and points with too few observations."""
        window = self.window
        columns = window.mapped_columns()
        bad = window.errors(columns, self.camera) > self.parameters.window.outlier_px
        window.forget(columns, bad)
        rows = window.rows[columns]
        remaining = count_cameras(columns, window.seen, 0, len(window.seen))
        remaining += self.points.base_keyframes[rows]
        self._remove(rows[remaining < 2])

    def _remove(self, rows: I32) -> None:
        """Points go.  As candidates they may come back while their track lives."""
        self._note_removed(rows)
        self.points.state[rows] = CANDIDATE
        self.points.ids[rows] = -1
        self.points.published_xyz[rows] = np.nan

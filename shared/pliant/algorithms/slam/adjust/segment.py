"""A segment of the map: keyframes and landmarks in one world frame.

A segment begins where a map starts, and rests while the camera is lost.  The camera may return to
it, other segments may be merged into it, and at the end all of it is adjusted.

Dropped keyframes have been published with their frames and landmarks, and move with the kept ones.
One on a path moves as the map between its neighbours, interpolated by the distance travelled.  If
keyframes of another time share more of its view, it moves as the one that shares most.

The segment continues with another calibration if a global bundle adjustment refutes the one in use.
Tracks have pixels of the rectified image, and the mapper works on those of an ideal camera, see
``self_calibration``.  So the observations of keyframes are converted to the new ideal camera.  A
landmark moves to where its reference keyframe then sees it, at the same distance; the moves of
``global_adjustment`` contain the change of distances.  The adjustment of the window corrects the
rest.
"""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from pliant.algorithms.arrays import F64, I32, I64, U8, BoolArray
from pliant.algorithms.geometry import (
    inverse,
    matrix_to_pose,
    matrix_to_similarity,
    move_by_similarity,
    so3_exp,
    so3_log,
    transform_each,
)
from pliant.algorithms.inertial.samples import ImuSamples
from pliant.algorithms.map_delta import MapMoves
from pliant.algorithms.slam.adjust.final_adjustment import adjust_keyframes
from pliant.algorithms.slam.adjust.inertial_adjustment import Coupling, TimedSamples
from pliant.algorithms.slam.adjust.ordinary_frames import OrdinaryFrames
from pliant.algorithms.slam.adjust.sampled_frames import place_frames, sampled_frames
from pliant.algorithms.slam.adjust.track_sample import TrackSample
from pliant.algorithms.slam.calibration.corrected_view import CorrectedView, moved_px
from pliant.algorithms.slam.calibration.rolling_shutter import FramePoses, RolledFrame
from pliant.algorithms.slam.calibration.self_calibration import SelfCalibration
from pliant.algorithms.slam.map.covisibility import focus_of
from pliant.algorithms.slam.map.keyframe import Keyframe
from pliant.algorithms.slam.map.landmarks import MAPPED, Landmarks
from pliant.algorithms.slam.map.track_links import UNLINKED
from pliant.algorithms.slam.parameters import MappingParameters
from pliant.compiler.kernel import kernel

_MIN_DEPTH = 1e-6


@dataclass(kw_only=True)
class DroppedKeyframes:
    """ids: (G,) of the keyframes, ascending.   hosts: (G,) the keyframe that each moves with, by
    id; itself if it is interpolated between others.   centres: (G, 3) their positions.
    """

    ids: I64 = field(default_factory=lambda: np.zeros(0, np.int64))
    hosts: I64 = field(default_factory=lambda: np.zeros(0, np.int64))
    centres: F64 = field(default_factory=lambda: np.zeros((0, 3)))

    def __len__(self) -> int:
        return len(self.ids)

    def take_in(self, other: "DroppedKeyframes") -> None:
        """Add dropped keyframes of this or of another segment."""
        ids = np.concatenate([self.ids, other.ids])
        order = np.argsort(ids)
        self.ids = ids[order]
        self.centres = np.concatenate([self.centres, other.centres])[order]
        hosts, before = np.concatenate([self.hosts, other.hosts])[order], None
        while before is None or (hosts != before).any():  # a host may have been dropped since
            before = hosts
            gone = np.isin(hosts, self.ids)
            hosts = hosts.copy()
            hosts[gone] = before[np.searchsorted(self.ids, before[gone])]
        self.hosts = hosts

    def host_of(self, keyframe: int, kept: I64) -> int:
        """Return the id of a keyframe, or of a kept one near it if it was dropped.

        kept: (M,) all of these, ascending.
        """
        if keyframe in self.ids:
            keyframe = int(self.hosts[np.searchsorted(self.ids, keyframe)])
        if keyframe in self.ids:
            keyframe = int(kept[max(np.searchsorted(kept, keyframe) - 1, 0)])
        return keyframe

    def together_with(self, moves: MapMoves) -> MapMoves:
        """Extend the moves of the kept keyframes to all keyframes of the segment."""
        new = ~np.isin(self.ids, moves.keyframe_ids)
        if not new.any():
            return moves
        ids = np.concatenate([moves.keyframe_ids, self.ids[new]])
        rows = np.concatenate([moves.moves, self._between(moves, new)])
        order = np.argsort(ids)
        ids, rows = ids[order], rows[order]
        hosted = new & (self.hosts != self.ids)
        # A newer host moves as the last of these.
        host = np.searchsorted(ids, self.hosts[hosted], side="right") - 1
        rows[np.searchsorted(ids, self.ids[hosted])] = rows[host]
        return MapMoves(keyframe_ids=ids, moves=rows)

    def _between(self, moves: MapMoves, some: BoolArray) -> F64:
        """(S, 8) moves of some of them, as of ``MapMoves``, interpolated between those of kept
        ones.
        """
        ids, kept = self.ids[some], moves.keyframe_ids
        b = np.clip(np.searchsorted(kept, ids), 1, len(kept) - 1) if len(kept) > 1 else 0 * ids
        a = np.maximum(b - 1, 0)
        share = np.clip((ids - kept[a]) / np.maximum(kept[b] - kept[a], 1), 0.0, 1.0)[:, None]
        first, last = moves.matrices(kept[a]), moves.matrices(kept[b])
        scale_a, scale_b = moves.moves[a, 7:], moves.moves[b, 7:]
        R_a, R_b = first[:, :3, :3] / scale_a[:, None], last[:, :3, :3] / scale_b[:, None]
        T = np.tile(np.eye(4), (len(ids), 1, 1))
        T[:, :3, :3] = R_a @ so3_exp(share * so3_log(np.swapaxes(R_a, 1, 2) @ R_b))
        scales = scale_a ** (1.0 - share) * scale_b**share
        # Its own position is interpolated; R and scale apply around it.
        at = self.centres[some]
        moved = (1.0 - share) * transform_each(first, at) + share * transform_each(last, at)
        T[:, :3, 3] = moved - scales * (T[:, :3, :3] @ at[:, :, None])[:, :, 0]
        return np.column_stack([matrix_to_pose(T), scales])

    def move(self, moves: MapMoves) -> None:
        """Move the positions with the map."""
        self.centres = moves.points(self.centres, self.ids)


class Moved(NamedTuple):
    """A motion of the end of a segment, by a similarity S (4, 4).

    moves: of all published content; None if its publication includes them anyway.
    gone: the segment that was merged into this one.   same_places: pairs of keyframes, the older
    one first, that are the reason.
    """

    S: F64
    moves: MapMoves | None = None
    gone: int | None = None
    same_places: tuple[tuple[int, int], ...] = ()


class PlacedFrames(NamedTuple):
    """Frames that several passes have placed, on the clock of the samples.

    keyframes_ns: capture times of keyframes by their ids.   stamps_ns: (F,) of frames, ascending.
    hosts: (F,) ids of their keyframes, and T_host_frame (F, 4, 4) their poses relative to these.
    """

    keyframes_ns: dict[int, int]
    stamps_ns: I64
    hosts: I64
    T_host_frame: F64

    def on(self, keyframes: list[Keyframe]) -> "PlacedFrames":
        """Return those of these keyframes."""
        of = np.isin(self.hosts, [keyframe.id for keyframe in keyframes])
        return self._replace(
            stamps_ns=self.stamps_ns[of], hosts=self.hosts[of], T_host_frame=self.T_host_frame[of]
        )


class InertialSource(NamedTuple):
    """Inertial samples of a whole source, and the capture times of its frames.

    placed: instead of the frames and times of the segment.   outcomes: receives what came of them.
    """

    samples: ImuSamples
    stamps_ns: dict[int, int]
    outcomes: list[Coupling]
    placed: PlacedFrames | None = None


@dataclass(kw_only=True)
class Segment:
    """points: rows shared by all segments.    keyframes: oldest first.   path: of its frames.
    ordinary: those of them that are no keyframes.
    since: index of the first keyframe after the last recognition: older ones do not move with the
    window.   adjusted: id of the newest keyframe in a global adjustment applied since the last
    keyframe, or -1.   sparsified: whether keyframes or landmarks were dropped (``sparsification``).
    dropped: those keyframes.   inverse_distance: median of its landmarks from the newest keyframe.
    strayed: similarity (4, 4) by which its beginning has moved.
    """

    id: int
    points: Landmarks
    keyframes: list[Keyframe] = field(default_factory=list[Keyframe])
    path: FramePoses = field(default_factory=FramePoses)
    ordinary: OrdinaryFrames = field(default_factory=OrdinaryFrames)
    since: int = 0
    adjusted: int = -1
    sparsified: bool = False
    dropped: DroppedKeyframes = field(default_factory=DroppedKeyframes)
    inverse_distance: float = 1.0
    strayed: F64 = field(default_factory=lambda: np.eye(4))

    @property
    def resumes(self) -> bool:
        """Whether there is no keyframe since the camera was recognised."""
        return self.since == len(self.keyframes)

    def first_of_window(self, size: int) -> int:
        """Index of the first free keyframe in a window of this size."""
        return max(self.since, len(self.keyframes) - size)

    def leave_window(self, keyframe: Keyframe) -> None:
        """A keyframe leaves the window and is no longer free."""
        self.points.base_keyframes[keyframe.rows] += 1
        self.points.base_parallax_rad[keyframe.rows] = self.points.parallax_rad[keyframe.rows]
        keyframe.focus = focus_of(keyframe, self.points)

    def rest(self, window: int) -> None:
        """The camera leaves the segment: the keyframes of a window of this size leave it too."""
        for keyframe in self.keyframes[self.first_of_window(window) :]:
            self.leave_window(keyframe)
        self.since = len(self.keyframes)

    def mapped_rows(self) -> I32:
        """Rows of all its landmarks, oldest first."""
        rows = self.points.mapped(self.id)
        return rows[np.argsort(self.points.first_keyframe[rows], kind="stable")]

    def inverse_depths(self, rows: I32, T_world_camera: F64) -> F64:
        """(n,) of the rows (UNLINKED among them) in a camera; the median of the map where
        unknown.
        """
        depths = np.full(len(rows), self.inverse_distance)
        _inverse_depths(rows, self.points.state, self.points.xyz, T_world_camera, depths)
        return depths

    def rolled(
        self, calibration: SelfCalibration, motion: F64, log_focal: float | None = None
    ) -> RolledFrame:
        """Return the effect of the readout on a frame with this motion.

        log_focal: None: that of the newest frame.
        """
        log_focal = calibration.log_focal if log_focal is None else log_focal
        readout = calibration.readout
        if log_focal:  # a magnified image shows fewer rows
            readout *= float(np.exp(log_focal))
        view = calibration.view_at(log_focal)
        return RolledFrame(view, readout, motion, self.inverse_distance)

    def to_global_shutter(self, keyframes: list[Keyframe], calibration: SelfCalibration) -> None:
        """Convert keyframes to a global shutter by the current readout, motion and depths;
        keyframes without a known motion are unchanged.
        """
        for keyframe, motion in zip(keyframes, self.path.motions(keyframes), strict=True):
            if not motion.any():
                continue
            seen = keyframe.points_px + keyframe.rolled_px
            depths = self.inverse_depths(keyframe.rows, keyframe.T_world_camera)
            rolled = self.rolled(calibration, motion, keyframe.log_focal)
            keyframe.rolled_px = rolled.shifts(seen, depths)
            keyframe.points_px = seen - keyframe.rolled_px

    def _timed(self, inertial: InertialSource | None) -> TimedSamples | None:
        if inertial is None:
            return None
        placed = inertial.placed
        placed = self._placed(inertial) if placed is None else placed.on(self.keyframes)
        ids = np.array([keyframe.id for keyframe in self.keyframes], np.int64)
        times_ns = [placed.keyframes_ns.get(each, -1) for each in ids.tolist()]
        order = np.argsort(ids)
        return TimedSamples(
            samples=inertial.samples,
            keyframes_ns=np.array(times_ns, np.int64),
            frames_ns=placed.stamps_ns,
            hosts=order[np.searchsorted(ids[order], placed.hosts)],
            T_host_frame=placed.T_host_frame,
            outcomes=inertial.outcomes,
        )

    def _placed(self, inertial: InertialSource) -> PlacedFrames:
        frames, T_world_camera, _ = self.path.frames_on(self.keyframes)
        T_world_host = np.array([each.keyframe.T_world_camera for each in frames])
        return PlacedFrames(
            keyframes_ns={keyframe.id: keyframe.stamp_ns for keyframe in self.keyframes},
            stamps_ns=np.array([inertial.stamps_ns[each.frame] for each in frames], np.int64),
            hosts=np.array([each.keyframe.id for each in frames], np.int64),
            T_host_frame=inverse(T_world_host.reshape(-1, 4, 4)) @ T_world_camera,
        )

    def move(self, moves: MapMoves) -> F64:
        """Move keyframes, landmarks and frames.  Returns the similarity (4, 4) of the newest
        keyframe.
        """
        keyframes = self.keyframes
        S = moves.matrices(np.array([keyframe.id for keyframe in keyframes], np.int64))
        poses = move_by_similarity(S, np.array([keyframe.T_world_camera for keyframe in keyframes]))
        for keyframe, move, T_world_camera in zip(keyframes, S, poses, strict=True):
            keyframe.T_world_camera = T_world_camera
            if keyframe.focus is not None:
                keyframe.focus = move[:3, :3] @ keyframe.focus + move[:3, 3]
        self.points.move(self.id, moves)
        self.path.scale(moves)
        self.dropped.move(moves)
        self.strayed = S[0] @ self.strayed
        return S[-1]

    def back(self) -> MapMoves | None:
        """Return the moves that bring its beginning, and all of it, back; None if it has
        not moved.
        """
        if np.array_equal(self.strayed, np.eye(4)):
            return None
        first = np.array([self.keyframes[0].id], np.int64)
        move = matrix_to_similarity(np.asarray(np.linalg.inv(self.strayed), np.float64))
        return self.dropped.together_with(MapMoves(keyframe_ids=first, moves=move[None]))

    def take_in(self, earlier: "Segment", id: int) -> None:
        """Merge with a resting segment, in whose world frame this one already is, or the reverse.

        id: of both, from now on.  The content mapped there does not move with the window.
        """
        both = np.isin(self.points.segment, (self.id, earlier.id))
        self.points.segment[both] = self.id = id
        older = [*earlier.keyframes, *self.keyframes[: self.since]]
        older.sort(key=lambda keyframe: keyframe.id)
        self.keyframes = [*older, *self.keyframes[self.since :]]
        for keyframe in self.keyframes:
            keyframe.segment = id
        self.since = len(older)
        self.adjusted = -1  # not as a whole
        self.sparsified |= earlier.sparsified
        self.dropped.take_in(earlier.dropped)
        self.path.take_in(earlier.path)
        self.ordinary.take_in(earlier.ordinary)

    def adjust(
        self, known: SelfCalibration, parameters: MappingParameters,
        inertial: InertialSource | None = None, sample: TrackSample | None = None,
    ) -> tuple[SelfCalibration, MapMoves | None]:  # fmt: skip
        """Adjust all but the first keyframe and the calibration, from the current estimate.

        inertial: samples that the poses are to agree with.   sample: of the tracks in its frames.

        Returns the new calibration, and how dropped content moves, or None.
        """
        motions = self.path.motions(self.keyframes)
        before = np.array([keyframe.log_focal for keyframe in self.keyframes])
        sampled = None
        if sample is not None and not self.sparsified:
            sampled = sampled_frames(sample, self.path, self.keyframes)
        found, gone, moves, frames = adjust_keyframes(
            self.keyframes, self.points, known, parameters, motions, self._timed(inertial), sampled
        )
        self.points.remove(gone)
        if frames:
            placed = place_frames(frames, self.path, self.keyframes, found, parameters)
            self.ordinary.forget(placed)  # what they observe has the earlier readout
        self.to_global_shutter(self.keyframes, found)
        self.ordinary.seen_by(known.view, found.view)
        if found.changes:
            after = np.array([keyframe.log_focal for keyframe in self.keyframes])
            self.ordinary.focus(found.view, self.keyframes, after - before)
        if found.readout and not known.readout:
            self.ordinary.forget()
        if not self.sparsified:
            return found, None
        moves = self.dropped.together_with(moves)
        self.dropped.move(moves)
        return found, moves


@kernel
def _inverse_depths(rows: I32, state: U8, xyz: F64, T_world_camera: F64, depths: F64) -> None:
    T = T_world_camera
    for i in range(rows.size):
        row = rows[i]
        if row != UNLINKED and state[row] == MAPPED:
            x, y, z = xyz[row, 0] - T[0, 3], xyz[row, 1] - T[1, 3], xyz[row, 2] - T[2, 3]
            depth = x * T[0, 2] + y * T[1, 2] + z * T[2, 2]
            if depth > _MIN_DEPTH:
                depths[i] = 1.0 / depth


def see_by(
    segment: Segment, before: CorrectedView, known: SelfCalibration, refocus: F64 | None = None
) -> None:
    """Convert a segment made with one view to another camera.

    before: whose pixels its keyframes have.   known: the new calibration.   refocus: (K,) change of
    the log focal length of each keyframe; None: no changes.
    """
    bend(segment, before, known.view, refocus)
    changes = np.zeros(len(segment.keyframes)) if refocus is None else refocus
    for keyframe, change in zip(segment.keyframes, changes.tolist(), strict=True):
        factors = np.full(len(keyframe.rows), change)
        seen = moved_px(keyframe.points_px + keyframe.rolled_px, before, known.view, factors)
        keyframe.points_px = moved_px(keyframe.points_px, before, known.view, factors)
        keyframe.rolled_px = seen - keyframe.points_px
        keyframe.log_focal += change
    segment.ordinary.seen_by(before, known.view)
    if refocus is not None:
        segment.ordinary.focus(known.view, segment.keyframes, refocus)
    if known.readout:
        segment.to_global_shutter(segment.keyframes, known)


def bend(
    segment: Segment, before: CorrectedView, after: CorrectedView, refocus: F64 | None = None
) -> None:
    """Move landmarks and candidates to where another camera would have mapped the same pixels.

    refocus: as of ``see_by``.
    """
    points, keyframes = segment.points, segment.keyframes
    rows = points.used(segment.id)
    ids = np.array([keyframe.id for keyframe in keyframes], np.int64)
    # The reference of a dropped keyframe's landmarks is the keyframe before it.
    slots = np.maximum(np.searchsorted(ids, points.first_keyframe[rows], side="right") - 1, 0)
    T_world_keyframe = np.array([keyframe.T_world_camera for keyframe in keyframes])
    T_world_host, T_host_world = (
        T_world_keyframe.take(slots, 0),
        inverse(T_world_keyframe).take(slots, 0),
    )
    in_host = _each(T_host_world, points.xyz.take(rows, 0))
    ahead = in_host[:, 2] > _MIN_DEPTH
    rows, in_host = rows.compress(ahead), in_host.compress(ahead, 0)
    px = before.camera.project(in_host).astype(np.float32)
    px = moved_px(px, before, after, None if refocus is None else refocus[slots[ahead]])
    in_host[:, :2] = after.camera.normalise(px) * in_host[:, 2:]
    points.move_to(rows, _each(T_world_host.compress(ahead, 0), in_host))


def _each(T: F64, points: F64) -> F64:
    """Transform points (N, 3), each by its own of (N, 4, 4)."""
    return np.einsum("nij,nj->ni", T[:, :3, :3], points) + T[:, :3, 3]

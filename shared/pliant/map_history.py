"""Folds map updates into what a run leaves: trajectories, keyframes and points."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pliant.algorithms.arrays import F64, I64
from pliant.algorithms.geometry import matrix_to_pose, move_by_similarity, pose_to_matrix
from pliant.algorithms.map_delta import BY_GYRO, MapDelta, MapMoves
from pliant.algorithms.slam.map.kept_keyframe import KeptKeyframe
from pliant.trajectory import Trajectory

MIN_INLIERS = 30
"""A pose counts only if at least this many points of the image support it."""


@dataclass(frozen=True)
class FramePose:
    """A frame's pose relative to its keyframe, as last published."""

    segment: int
    keyframe: int
    pose_keyframe_camera: F64
    inliers: int


@dataclass(frozen=True)
class Keyframe:
    """A keyframe as last published.  frame: -1 where an earlier session made it."""

    frame: int
    segment: int
    pose_world_camera: F64


class _PointTable:
    """Rows by point id (ids are dense, so an array is the map)."""

    def __init__(self) -> None:
        self._columns: dict[str, np.ndarray[Any, Any]] = {}
        self._alive = np.zeros(0, np.bool_)
        self._first_frame = np.zeros(0, np.int64)

    def update(
        self, ids: np.ndarray[Any, Any], frame: int, columns: dict[str, np.ndarray[Any, Any]]
    ) -> None:
        if len(ids) == 0:
            return
        size = int(ids.max()) + 1
        if size > len(self._alive):
            size = max(size, 2 * len(self._alive))
            self._alive = _grown(self._alive, size)
            self._first_frame = _grown(self._first_frame, size)
            self._columns = {name: _grown(column, size) for name, column in self._columns.items()}
        for name, values in columns.items():
            if name not in self._columns:
                shape = (len(self._alive), *values.shape[1:])
                self._columns[name] = np.zeros(shape, values.dtype)
            self._columns[name][ids] = values
        fresh = ids[~self._alive[ids]]
        self._first_frame[fresh] = frame
        self._alive[ids] = True

    def remove(self, ids: np.ndarray[Any, Any]) -> None:
        self._alive[ids[ids < len(self._alive)]] = False

    def move(self, moves: MapMoves) -> None:
        """Points move with the keyframes on which they hang."""
        if not self._columns:
            return
        ids = self.alive()
        xyz = self._columns["positions"]
        xyz[ids] = moves.points(xyz[ids], self._columns["hosts"][ids])

    def join(self, gone: int, segment: int) -> None:
        """The points of a segment belong to another one."""
        if self._columns:
            of = self._columns["segments"]
            of[of == gone] = segment

    def alive(self) -> I64:
        """Ids of the points that exist."""
        return np.flatnonzero(self._alive)

    def of(self, ids: I64) -> "tuple[I64, Points]":
        """Places in ``ids`` of the points that exist, and those points."""
        if not self._columns:
            none = np.zeros(0, np.int64)
            xyz, rgb = np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
            return none, Points(none, none, xyz, rgb, none, np.zeros(0), np.zeros(0), none, none)
        known = (ids >= 0) & (ids < len(self._alive))
        known[known] = self._alive[ids[known]]
        ids = ids[known]
        columns = {name: column[ids] for name, column in self._columns.items()}
        found = Points(ids=ids, frames=self._first_frame[ids], **columns)
        return np.flatnonzero(known), found


def _grown(array: np.ndarray[Any, Any], size: int) -> np.ndarray[Any, Any]:
    grown = np.zeros((size, *array.shape[1:]), array.dtype)
    grown[: len(array)] = array
    return grown


@dataclass(frozen=True)
class Points:
    """The map's points.  Arrays as in MapDelta, one row for each point that exists.

    hosts: the reference keyframe of each.
    frames: the frame whose update first had the point, which observed it.
    """

    ids: Any
    segments: Any
    positions: Any
    colours: Any
    keyframes: Any
    parallax_rad: Any
    sigmas: Any
    hosts: Any
    frames: Any

    def select(self, rows: Any) -> "Points":
        """Some of the points."""
        return Points(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))

    def __len__(self) -> int:
        return len(self.ids)


class CurrentMap:
    """Keyframes and points as last published: they grow with the scene, not with time."""

    def __init__(self) -> None:
        self.keyframes: dict[int, Keyframe] = {}
        self._points = _PointTable()

    def know(self, kept: KeptKeyframe) -> None:
        """Take in a keyframe of an earlier session, before all updates."""
        pose = matrix_to_pose(kept.T_world_camera)
        self.keyframes[kept.id] = Keyframe(-1, kept.segment, pose)
        count = len(kept.point_ids)
        columns = {
            "segments": np.full(count, kept.segment, np.int32),
            "positions": kept.points_world,
            "colours": kept.point_colours,
            "keyframes": kept.point_keyframes,
            "parallax_rad": kept.point_parallax_rad,
            "sigmas": kept.point_sigmas,
            "hosts": np.full(count, kept.id, np.int64),
        }
        self._points.update(kept.point_ids, -1, columns)

    def take(self, delta: MapDelta, frame: int) -> None:
        """Take in the keyframes and points of one update."""
        if len(delta.moved_keyframes):
            self._move(delta.map_moves())
        for gone, segment in delta.joined.tolist():
            self._points.join(gone, segment)
            for number, keyframe in self.keyframes.items():
                if keyframe.segment == gone:
                    self.keyframes[number] = replace(keyframe, segment=segment)
        for row in range(len(delta.keyframe_ids)):
            self.keyframes[int(delta.keyframe_ids[row])] = Keyframe(
                int(delta.keyframe_frames[row]),
                int(delta.keyframe_segments[row]),
                delta.keyframe_poses[row],
            )
        self._points.update(
            delta.point_ids,
            frame,
            {
                "segments": delta.point_segments,
                "positions": delta.points_world,
                "colours": delta.point_colours,
                "keyframes": delta.point_keyframes,
                "parallax_rad": delta.point_parallax_rad,
                "sigmas": delta.point_sigmas,
                "hosts": delta.hosts(),
            },
        )
        self._points.remove(delta.removed_point_ids)

    def _move(self, moves: MapMoves) -> None:
        """The whole map moves."""
        ids = np.array(list(self.keyframes), np.int64)
        poses = np.array([k.pose_world_camera for k in self.keyframes.values()])
        moved = move_by_similarity(moves.matrices(ids), pose_to_matrix(poses))
        for keyframe, pose in zip(ids.tolist(), matrix_to_pose(moved), strict=True):
            self.keyframes[keyframe] = replace(self.keyframes[keyframe], pose_world_camera=pose)
        self._points.move(moves)

    def points_of(self, ids: I64) -> tuple[I64, Points]:
        """The existing points of ids (N,): their indices in ``ids``, and the points."""
        return self._points.of(ids)

    def points(self) -> Points:
        """Every point that exists now."""
        return self._points.of(self._points.alive())[1]

    def points_in(self, segment: int) -> Points:
        """The points of a segment, which is a world of its own."""
        points = self.points()
        return points.select(points.segments == segment)


class MapHistory(CurrentMap):
    """Applies updates in order of frame; needs only the messages of the mapper."""

    def __init__(self) -> None:
        super().__init__()
        self.stamps_ns: dict[int, int] = {}
        self.online: dict[int, tuple[int, F64]] = {}
        """Segment and T_world_camera of each frame as estimated at frame time, without later
        changes of the segment."""
        self.frames: dict[int, FramePose] = {}
        self.states: dict[int, tuple[int, str]] = {}
        self.same_places: list[tuple[int, int]] = []
        """Keyframes that were found to show one place, as ``MapDelta.same_places``."""

    def apply(self, delta: MapDelta, *, frame: int, stamp_ns: int, final: bool = False) -> None:
        """Take in one update.  ``final``: the one after the last frame."""
        self.take(delta, frame)
        if len(delta.moved_keyframes):
            self._scale(delta.map_moves())
        for gone, segment in delta.joined.tolist():
            for number, pose in self.frames.items():
                if pose.segment == gone:
                    self.frames[number] = replace(pose, segment=segment)
        for row in range(len(delta.pose_frames)):
            self.frames[int(delta.pose_frames[row])] = FramePose(
                int(delta.pose_segments[row]),
                int(delta.pose_keyframes[row]),
                delta.poses_keyframe_camera[row],
                int(delta.pose_inliers[row]),
            )
        pairs = [(old, new) for old, new in delta.same_places.tolist() if new >= 0]
        self.same_places += [pair for pair in pairs if pair not in self.same_places]
        if final:
            return
        self.stamps_ns[frame] = stamp_ns
        self.states[frame] = (delta.state, delta.reason)
        known = self.frames.get(frame)
        if known is not None and known.inliers >= MIN_INLIERS:
            self.online[frame] = (known.segment, matrix_to_pose(self._world(known))[0])

    def forget_before(self, frame: int) -> None:
        """Drop earlier frames; the map stays."""
        for table in (self.stamps_ns, self.online, self.frames, self.states):
            for old in [number for number in table if number < frame]:
                del table[old]

    def _scale(self, moves: MapMoves) -> None:
        """Distances of frames to their keyframes scale as the whole map moves."""
        hanging = np.array([pose.keyframe for pose in self.frames.values()], np.int64)
        scales = np.cbrt(np.linalg.det(moves.matrices(hanging)[:, :3, :3]))
        for (frame, pose), scale in zip(list(self.frames.items()), scales, strict=True):
            scaled = pose.pose_keyframe_camera * np.repeat([scale, 1.0], [3, 4])
            self.frames[frame] = replace(pose, pose_keyframe_camera=scaled)

    def final(self) -> dict[int, tuple[int, F64]]:
        """Segment and T_world_camera of every supported frame, after all corrections."""
        return self._placed(lambda pose: pose.inliers >= MIN_INLIERS)

    def by_gyro(self) -> dict[int, tuple[int, F64]]:
        """The same of frames that no image supports, between others."""
        return self._placed(lambda pose: pose.inliers == BY_GYRO)

    def placed(self) -> dict[int, tuple[int, F64]]:
        """The same of both."""
        return self._placed(lambda pose: pose.inliers >= MIN_INLIERS or pose.inliers == BY_GYRO)

    def _placed(self, chosen: Callable[[FramePose], bool]) -> dict[int, tuple[int, F64]]:
        placed = {
            frame: pose
            for frame, pose in sorted(self.frames.items(), key=lambda item: item[0])
            if chosen(pose) and pose.keyframe in self.keyframes
        }
        poses = matrix_to_pose(self._world(*placed.values())) if placed else ()
        return {
            frame: (pose.segment, T_world_camera)
            for (frame, pose), T_world_camera in zip(placed.items(), poses, strict=True)
        }

    def same_places_in(self, segment: int) -> F64:
        """(L, 2, 3) positions of pairs of keyframes of a segment that show one place."""
        at = {n: k.pose_world_camera[:3] for n, k in self.keyframes.items() if k.segment == segment}
        lines = [(at[a], at[b]) for a, b in self.same_places if {a, b} <= at.keys()]
        return np.array(lines, np.float64).reshape(-1, 2, 3)

    def longest_segment(self) -> int:
        """The segment with the most supported frames (the earliest of equals); -1 without any."""
        counts: dict[int, int] = {}
        for _, pose in sorted(self.frames.items(), key=lambda item: item[0]):
            if pose.inliers >= MIN_INLIERS and pose.keyframe in self.keyframes:
                counts[pose.segment] = counts.get(pose.segment, 0) + 1
        return max(counts, key=counts.__getitem__, default=-1)

    def trajectory_in(self, segment: int, poses: dict[int, tuple[int, F64]]) -> Trajectory:
        """The poses in a segment, as ``trajectory``."""
        return self.trajectory({f: pose for f, pose in poses.items() if pose[0] == segment})

    def trajectory(self, poses: dict[int, tuple[int, F64]]) -> Trajectory:
        """Poses by frame as a trajectory, in order of time."""
        frames = sorted(poses)
        if not frames:
            return Trajectory.empty()
        stamps = np.array([self.stamps_ns[frame] for frame in frames], np.int64)
        return Trajectory.from_poses(stamps, np.array([poses[frame][1] for frame in frames]))

    def keyframe_poses(self) -> dict[int, tuple[int, F64]]:
        """Segment and T_world_camera of each keyframe of this session, by frame."""
        own = (keyframe for keyframe in self.keyframes.values() if keyframe.frame >= 0)
        ordered = sorted(own, key=lambda keyframe: keyframe.frame)
        return {k.frame: (k.segment, k.pose_world_camera) for k in ordered}

    def _world(self, *frames: FramePose) -> F64:
        """(N, 4, 4) T_world_camera of N frames whose keyframes exist."""
        keyframes = [self.keyframes[frame.keyframe].pose_world_camera for frame in frames]
        relative = [frame.pose_keyframe_camera for frame in frames]
        return pose_to_matrix(np.array(keyframes)) @ pose_to_matrix(np.array(relative))

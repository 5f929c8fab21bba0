"""The map as its readers have it, and all events since: from these come the next deltas."""

import bisect
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, I64, U8, BoolArray, with_bits
from pliant.algorithms.geometry import inverse, matrix_to_pose, move_by_similarity
from pliant.algorithms.map_delta import KeyframeDelta, MapDelta, MapMoves
from pliant.algorithms.slam.calibration.self_calibration import SelfCalibration
from pliant.algorithms.slam.map.keyframe import Keyframe
from pliant.algorithms.slam.map.landmarks import MAPPED, Landmarks
from pliant.compiler.kernel import kernel

_MOVED_SHARE = 2e-3
"""A landmark is published again when it moved across the ray by this share of its distance, about a
px of an image with 640 columns.
"""

_MOVED_SIGMAS = 0.25
"""Along the ray, if that is less certain: by this share of its standard deviation, for a noise of 1
px.
"""

_KNOWN_SHARE = 0.8
"""Or when its standard deviation has become this share of the published one, or the reverse."""

_TINY = 1e-300

_BITS = 12
"""Significant bits of the uncertainty of a landmark."""


class Outcome(NamedTuple):
    """The result of a frame.   state, reason, inliers, segment: as of ``MapDelta``.

    centre: (3,) of the newest keyframe.   snapshot: publish the whole window.
    """

    state: int
    reason: str
    inliers: int
    segment: int
    centre: F64
    snapshot: bool = False


class Journal:
    """Collects events, and makes each MapDelta and KeyframeDelta from them.

    It keeps a copy of what readers have, with the rows of the landmarks and the ids of keyframes.
    A row with another id than the landmark's is stale.
    """

    def __init__(self, points: Landmarks, after: int = -1) -> None:
        """after: id of the last keyframe of earlier sessions, which is not published."""
        self._points = points
        self._ids: I64 = np.full(len(points.state), -1, np.int64)
        self._hosts: I32 = np.full(len(points.state), -1, np.int32)
        self._xyz: F64 = np.full((len(points.state), 3), np.nan)
        self._sigmas: F32 = np.full(len(points.state), np.nan, np.float32)
        known = points.state == MAPPED
        self._ids[known] = points.ids[known]  # published again when observed
        self._poses: F64 = np.full((after + 1, 4, 4), np.nan)
        self._frames: dict[int, tuple[int, int, int, F64, int]] = {}
        self._keyframes: dict[int, Keyframe] = {}
        self._rows: list[I32] = []
        self._moves: MapMoves | None = None
        self._joined: list[tuple[int, int]] = []
        self._same_places: list[tuple[int, int]] = []
        self._newest = self._settled = after
        self._final: list[Keyframe] = []

    def move(self, moves: MapMoves) -> None:
        """Move the whole map, before anything else of the frame, as its readers will."""
        self._moves = moves if self._moves is None else self._moves.then(moves)
        has = np.flatnonzero(self._ids >= 0)
        self._xyz[has] = moves.points(self._xyz[has], self._hosts[has].astype(np.int64))
        ids = np.flatnonzero(np.isfinite(self._poses[:, 0, 0]))
        self._poses[ids] = move_by_similarity(moves.matrices(ids), self._poses[ids])

    def join(self, gone: int, segment: int) -> None:
        """Assign the content of a merged segment to another one, after all moves."""
        self._joined.append((gone, segment))

    def add_same_places(self, pairs: Iterable[tuple[int, int]]) -> None:
        """Add pairs of keyframes at the same place, the older one first; -1: this frame, no
        keyframe.
        """
        self._same_places += pairs

    def add_pose(self, frame: int, keyframe: Keyframe, T_world_camera: F64, inliers: int) -> None:
        """Add a pose with its reference keyframe.  The last one of a frame counts."""
        T_keyframe_camera = inverse(keyframe.T_world_camera) @ T_world_camera
        pose = matrix_to_pose(T_keyframe_camera)
        self._frames[frame] = frame, keyframe.segment, keyframe.id, pose, inliers

    def add_changed(self, keyframes: Iterable[Keyframe], rows: I32) -> None:
        """Add keyframes and rows of landmarks that may be new or have changed."""
        self._keyframes |= {keyframe.id: keyframe for keyframe in keyframes}
        self._rows.append(rows)

    def settle(self, keyframes: Sequence[Keyframe]) -> None:
        """These keyframes, in the order of their ids, are final."""
        first = bisect.bisect_right(keyframes, self._settled, key=lambda keyframe: keyframe.id)
        self._final += keyframes[first:]
        self._settled = max([self._settled, *(keyframe.id for keyframe in keyframes[first:])])

    @property
    def first_frame(self) -> int | None:
        """The oldest frame with an unpublished pose."""
        return min(self._frames, default=None)

    def unpublished(self, rows: I32) -> I32:
        """Return rows whose landmarks readers lack or have with another reference keyframe."""
        self._grow()
        points = self._points
        return _unpublished(
            rows, points.ids, self._ids, points.first_keyframe, self._hosts, self._sigmas
        )

    def publish(self, outcome: Outcome) -> MapDelta:
        """Return all changes since the last call."""
        self._grow()
        points, snapshot = self._points, outcome.snapshot
        poses = [pose for _, pose in sorted(self._frames.items())]
        gone, ids = points.take_removed()
        moves = self._moves
        changed = self._changed_keyframes(snapshot)
        rows = np.concatenate([np.zeros(0, np.int32), *self._rows])
        if len(self._rows) > 1:
            rows = rows[np.sort(np.unique(rows, return_index=True)[1])]
        rows = _changed(
            rows, points.state, self._is_current(rows), points.xyz, self._xyz, points.sigmas,
            self._sigmas, outcome.centre, snapshot,
        )  # fmt: skip
        removed = np.sort(ids[self._ids[gone] == ids])
        self._ids[rows], self._hosts[rows] = points.ids[rows], points.first_keyframe[rows]
        delta = MapDelta(
            state=outcome.state,
            reason=outcome.reason,
            segment=outcome.segment,
            inliers=outcome.inliers,
            pose_frames=np.array([pose[0] for pose in poses], np.int64),
            pose_segments=np.array([pose[1] for pose in poses], np.int32),
            pose_keyframes=np.array([pose[2] for pose in poses], np.int64),
            poses_keyframe_camera=np.array([pose[3] for pose in poses]).reshape(-1, 7),
            pose_inliers=np.array([pose[4] for pose in poses], np.int32),
            keyframe_ids=np.array([k.id for k in changed], np.int64),
            keyframe_frames=np.array([k.frame for k in changed], np.int64),
            keyframe_segments=np.array([k.segment for k in changed], np.int32),
            keyframe_poses=matrix_to_pose(np.array([k.T_world_camera for k in changed]))
            if changed
            else np.zeros((0, 7)),
            point_ids=points.ids[rows],
            point_segments=points.segment[rows],
            # float32 is far below the uncertainty; files and viewers have it, too.
            points_world=points.xyz.take(rows, 0).astype(np.float32).astype(np.float64),
            point_colours=points.colours.take(rows, 0),
            point_keyframes=points.keyframes[rows],
            point_parallax_rad=with_bits(points.parallax_rad[rows], _BITS),
            point_sigmas=with_bits(points.sigmas[rows], _BITS),
            point_hosts=points.first_keyframe[rows].astype(np.int64),
            snapshot=snapshot,
            removed_point_ids=removed,
            joined=np.array(self._joined, np.int32).reshape(-1, 2),
            same_places=np.array(self._same_places, np.int64).reshape(-1, 2),
        )
        self._frames, self._keyframes, self._rows = {}, {}, []
        self._moves, self._joined, self._same_places = None, [], []
        if moves is None:
            return delta
        return replace(delta, moved_keyframes=moves.keyframe_ids, moves=moves.moves)

    def _grow(self) -> None:
        """Make room for all landmarks and keyframes."""
        more = len(self._points.state) - len(self._ids)
        if more:
            self._ids = np.append(self._ids, np.full(more, -1, np.int64))
            self._hosts = np.append(self._hosts, np.full(more, -1, np.int32))
            self._xyz = np.append(self._xyz, np.full((more, 3), np.nan), axis=0)
            self._sigmas = np.append(self._sigmas, np.full(more, np.nan, np.float32))
        more = max(self._keyframes, default=-1) + 1 - len(self._poses)
        if more > 0:
            self._poses = np.append(self._poses, np.full((more, 4, 4), np.nan), axis=0)

    def _is_current(self, rows: I32) -> BoolArray:
        same = self._ids.take(rows) == self._points.ids.take(rows)
        return same & (self._hosts.take(rows) == self._points.first_keyframe.take(rows))

    def _changed_keyframes(self, snapshot: bool) -> list[Keyframe]:
        """Return the keyframes to publish, and record them as published."""
        changed = [
            each
            for each in self._keyframes.values()
            if snapshot or (self._poses[each.id] != each.T_world_camera).any()
        ]
        for each in changed:
            self._poses[each.id] = each.T_world_camera
        return changed

    def publish_keyframes(self, newest: Keyframe | None, known: SelfCalibration) -> KeyframeDelta:
        """Return what has not been published yet, in pixels of the rectified image.

        newest: the last keyframe that was made, if any.   known: the calibration whose pixels they
        have.
        """
        new = -1
        changed = [(keyframe, True) for keyframe in self._final]
        self._final = []
        if newest is not None and newest.id > self._newest:
            new = self._newest = newest.id
            changed.append((newest, False))
        ids, pixels = [np.zeros(0, np.int64)], [np.zeros((0, 2), np.float32)]
        for keyframe, _ in changed:
            mapped = np.flatnonzero(self._points.state[keyframe.rows] == MAPPED)
            point_ids = self._points.ids[keyframe.rows[mapped]]
            order = np.argsort(point_ids)
            ids.append(point_ids[order])
            points_px = (keyframe.points_px + keyframe.rolled_px).take(mapped[order], 0)
            pixels.append(known.view_at(keyframe.log_focal).seen(points_px))
        return KeyframeDelta(
            new=new,
            keyframe_ids=np.array([keyframe.id for keyframe, _ in changed], np.int64),
            settled=np.array([settled for _, settled in changed], np.bool_),
            counts=np.array([len(some) for some in ids[1:]], np.int32),
            point_ids=np.concatenate(ids),
            points_px=np.concatenate(pixels),
        )


@kernel
def _unpublished(
    rows: I32, ids: I64, published: I64, first_keyframe: I32, hosts: I32, sigmas: F32
) -> I32:
    """As ``Journal.unpublished``; published, hosts, sigmas: as readers have them."""
    chosen = np.empty(rows.size, np.int32)
    count = 0
    for i in range(rows.size):
        row = rows[i]
        current = published[row] == ids[row] and hosts[row] == first_keyframe[row]
        chosen[count] = row
        count += not current or np.isnan(sigmas[row])
    return chosen[:count].copy()


@kernel
def _changed(
    rows: I32,
    state: U8,
    is_current: BoolArray,
    xyz: F64,
    published_xyz: F64,
    sigmas: F32,
    published_sigmas: F32,
    centre: F64,
    snapshot: bool,
) -> I32:
    """Return the mapped rows that must be published, and record them as published.

    Each keyframe moves every landmark of the window a little, mostly along its ray and by far less
    than its uncertainty: published each time, such moves would be most of the map's data.  So a
    move m of a landmark at distance d along the unit ray r is insignificant if

        |m - (r^T m) r|^2 / s^2 + (r^T m)^2 / max(s, k sigma)^2  <=  d^2

    with s the smallest significant share, sigma the deviation along the ray as a share of d.
    """
    chosen = np.empty(rows.size, np.int32)
    count = 0
    for i in range(rows.size):
        row = rows[i]
        if state[row] != MAPPED:
            continue
        distance2, moved2, along = 0.0, 0.0, 0.0
        for k in range(3):
            ray, moved = xyz[row, k] - centre[k], xyz[row, k] - published_xyz[row, k]
            distance2 += ray * ray
            moved2 += moved * moved
            along += ray * moved
        deep2 = along * along / max(distance2, _TINY)
        sigma, before = sigmas[row], published_sigmas[row]
        deep = _MOVED_SHARE / max(_MOVED_SHARE, _MOVED_SIGMAS * sigma)
        # Unpublished values are NaN, which compares as significant.
        still = moved2 - (1.0 - deep * deep) * deep2 <= _MOVED_SHARE * _MOVED_SHARE * distance2
        known = before * _KNOWN_SHARE <= sigma and sigma * _KNOWN_SHARE <= before
        if snapshot or not (is_current[i] and still and known):
            for k in range(3):
                published_xyz[row, k] = xyz[row, k]
            published_sigmas[row] = sigma
            chosen[count] = row
            count += 1
    return chosen[:count].copy()

"""What has been published of the map, and therefore the next MapDelta and KeyframeDelta."""

import bisect
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, I64, U8, with_bits
from pliant.algorithms.geometry import inverse, matrix_to_pose
from pliant.algorithms.map_delta import KeyframeDelta, MapDelta, MapMoves
from pliant.algorithms.mapping.keyframe import Keyframe
from pliant.algorithms.mapping.landmarks import MAPPED, Landmarks
from pliant.algorithms.mapping.self_calibration import SelfCalibration
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


class MapChanges:
    """Collects the changes of one frame and makes its MapDelta."""

    def __init__(self) -> None:
        self._poses: dict[int, tuple[int, int, int, F64, int]] = {}
        self._removed: list[I64] = []
        self._moves: MapMoves | None = None
        self._joined: list[tuple[int, int]] = []
        self._same_places: list[tuple[int, int]] = []

    def move(self, moves: MapMoves) -> None:
        """Move the whole map, before anything else of the frame."""
        self._moves = moves if self._moves is None else self._moves.then(moves)

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
        self._poses[frame] = frame, keyframe.segment, keyframe.id, pose, inliers

    def remove_points(self, ids: I64) -> None:
        """Remove landmarks; those that were never published are left out later."""
        self._removed.append(ids)

    def publish(
        self,
        *,
        state: int,
        reason: str,
        segment: int,
        inliers: int,
        keyframes: list[Keyframe],
        points: Landmarks,
        rows: I32,
        centre: F64,
        snapshot: bool,
    ) -> MapDelta:
        """Return the differences of ``keyframes`` and the landmarks in ``rows`` from what was
        published.

        centre: (3,) camera position, which determines the significance of a motion.  snapshot: all.
        """
        poses = [pose for _, pose in sorted(self._poses.items())]
        self._poses = {}
        removed, self._removed = self._removed, []
        moves, self._moves = self._moves, None
        joined, self._joined = self._joined, []
        same_places, self._same_places = self._same_places, []
        moved = [k for k in keyframes if snapshot or _differs(k)]
        for keyframe in moved:
            keyframe.published_pose = keyframe.T_world_camera.copy()
        rows = _unpublished(
            rows, points.state, points.xyz, points.published_xyz, points.sigmas,
            points.published_sigmas, centre, snapshot,
        )  # fmt: skip
        delta = MapDelta(
            state=state,
            reason=reason,
            segment=segment,
            inliers=inliers,
            pose_frames=np.array([pose[0] for pose in poses], np.int64),
            pose_segments=np.array([pose[1] for pose in poses], np.int32),
            pose_keyframes=np.array([pose[2] for pose in poses], np.int64),
            poses_keyframe_camera=np.array([pose[3] for pose in poses]).reshape(-1, 7),
            pose_inliers=np.array([pose[4] for pose in poses], np.int32),
            keyframe_ids=np.array([k.id for k in moved], np.int64),
            keyframe_frames=np.array([k.frame for k in moved], np.int64),
            keyframe_segments=np.array([k.segment for k in moved], np.int32),
            keyframe_poses=matrix_to_pose(np.array([k.T_world_camera for k in moved]))
            if moved
            else np.zeros((0, 7)),
            point_ids=points.ids[rows],
            point_segments=points.segment[rows],
            # float32 is far below the uncertainty; files and viewers have it, too.
            points_world=points.xyz[rows].astype(np.float32).astype(np.float64),
            point_colours=points.colours[rows],
            point_keyframes=points.keyframes[rows],
            point_parallax_rad=with_bits(points.parallax_rad[rows], _BITS),
            point_sigmas=with_bits(points.sigmas[rows], _BITS),
            point_hosts=points.first_keyframe[rows].astype(np.int64),
            snapshot=snapshot,
            removed_point_ids=np.sort(np.concatenate([*removed, np.zeros(0, np.int64)])),
            joined=np.array(joined, np.int32).reshape(-1, 2),
            same_places=np.array(same_places, np.int64).reshape(-1, 2),
        )
        if moves is None:
            return delta
        return replace(delta, moved_keyframes=moves.keyframe_ids, moves=moves.moves)


@kernel
def _unpublished(
    rows: I32,
    state: U8,
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
        if snapshot or not (still and known):
            for k in range(3):
                published_xyz[row, k] = xyz[row, k]
            published_sigmas[row] = sigma
            chosen[count] = row
            count += 1
    return chosen[:count].copy()


def _differs(keyframe: Keyframe) -> bool:
    published = keyframe.published_pose
    return published is None or bool((published != keyframe.T_world_camera).any())


class KeyframeChanges:
    """Records what has been published, and makes each KeyframeDelta."""

    def __init__(self, points: Landmarks, after: int = -1) -> None:
        """after: id of the last keyframe of the loaded map, which is not published."""
        self._points = points
        self._newest = after
        self._settled = after
        self._final: list[Keyframe] = []

    def settle(self, keyframes: Sequence[Keyframe]) -> None:
        """These keyframes, in the order of their ids, are final."""
        first = bisect.bisect_right(keyframes, self._settled, key=lambda keyframe: keyframe.id)
        self._final += keyframes[first:]
        self._settled = max([self._settled, *(keyframe.id for keyframe in keyframes[first:])])

    def publish(self, newest: Keyframe | None, known: SelfCalibration) -> KeyframeDelta:
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
            points_px = (keyframe.points_px + keyframe.rolled_px)[mapped[order]]
            pixels.append(known.view_at(keyframe.log_focal).seen(points_px))
        return KeyframeDelta(
            new=new,
            keyframe_ids=np.array([keyframe.id for keyframe, _ in changed], np.int64),
            settled=np.array([settled for _, settled in changed], np.bool_),
            counts=np.array([len(some) for some in ids[1:]], np.int32),
            point_ids=np.concatenate(ids),
            points_px=np.concatenate(pixels),
        )

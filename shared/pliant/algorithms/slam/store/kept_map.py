"""A saved map: its keyframes as places, each with the landmarks of which it is the reference.

It stores what relocalisation needs: poses, observations, corners, and landmarks with their
re-acquisition patches.  Pixels are those of the ideal camera of the calibration stored with them,
so another camera with its own calibration can use the map.  Each keyframe is independent: no part
grows with the map.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import cv2
import numpy as np

from pliant.algorithms.arrays import F32, I32, I64, U8, check_arrays
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.slam.adjust.segment import Segment
from pliant.algorithms.slam.calibration.corrected_view import (
    CorrectedView,
    corrected_view,
    moved_px,
)
from pliant.algorithms.slam.calibration.rolling_shutter import FramePoses
from pliant.algorithms.slam.calibration.self_calibration import SelfCalibration
from pliant.algorithms.slam.estimate.problem import SHARED
from pliant.algorithms.slam.map.covisibility import focus_of
from pliant.algorithms.slam.map.kept_keyframe import KeptKeyframe
from pliant.algorithms.slam.map.keyframe import Keyframe
from pliant.algorithms.slam.map.landmarks import MAPPED, PATCH_SIDE, Landmarks
from pliant.algorithms.slam.places.place_index import Features


class Origin(NamedTuple):
    """The origin of a keyframe: the number of the run, and the frame in its source."""

    session: int
    frame: int


def view_of(kept: KeptKeyframe) -> CorrectedView:
    """Return the camera view whose pixels a keyframe has."""
    return corrected_view(kept.given_camera, tuple(kept.correction.tolist()))


_MOST, _MOST_POINTS, _LONGEST_SIDE_PX = 1 << 30, 1 << 62, 32767
"""Limits for numbers of keyframes and landmarks, with room for later ones, and for pixels."""


def check(kept: KeptKeyframe) -> None:
    """Raise ValueError if this module cannot have written the keyframe."""
    check_arrays(kept)
    if kept.point_patches.shape[1:] != (PATCH_SIDE, PATCH_SIDE):
        raise ValueError(f"patches of {kept.point_patches.shape[1]} pixels")
    numbers = (kept.id, kept.segment, kept.session, kept.source_frame)
    if not all(0 <= number < _MOST for number in numbers) or kept.given[:4].min() <= 0.0:
        raise ValueError("invalid numbers or camera")
    real = (kept.given, kept.correction, kept.T_world_camera, kept.motion, kept.points_world)
    if not all(np.isfinite(each).all() for each in (*real, kept.seen_px, kept.corners_px)):
        raise ValueError("non-finite values")
    if kept.correction.shape != (SHARED,):
        raise ValueError(f"a correction of {len(kept.correction)} values")
    if kept.given[:2].max() > _LONGEST_SIDE_PX:
        raise ValueError("an invalid camera")
    R, last = kept.T_world_camera[:3, :3], kept.T_world_camera[3]
    if np.abs(R @ R.T - np.eye(3)).max() > 1e-6 or last.tolist() != [0.0, 0.0, 0.0, 1.0]:
        raise ValueError("an invalid pose")
    for ids in (kept.seen_ids, kept.point_ids):
        if len(ids) and (ids[0] < 0 or ids[-1] >= _MOST_POINTS or (np.diff(ids) <= 0).any()):
            raise ValueError("points out of order")


def keep(
    segment: Segment,
    calibration: SelfCalibration,
    features: dict[int, Features],
    origins: dict[int, Origin],
) -> Iterator[KeptKeyframe]:
    """Yield the keyframes of a segment, oldest first.

    features: of keyframes by their ids, at the pixels of the rectified image.   origins: of all.
    """
    points, given, view = segment.points, calibration.given, calibration.view
    ids = np.array([keyframe.id for keyframe in segment.keyframes], np.int64)
    rows = points.mapped(segment.id)
    # Landmarks of a dropped keyframe move with the keyframe before it.
    hosts = np.maximum(np.searchsorted(ids, points.first_keyframe[rows], side="right") - 1, 0)
    rows = rows[np.lexsort([points.ids[rows], hosts])]
    ends = np.cumsum(np.bincount(hosts, minlength=len(ids)))
    motions = segment.path.motions(segment.keyframes)
    for slot, keyframe in enumerate(segment.keyframes):
        mine = rows[ends[slot - 1] if slot else 0 : ends[slot]]
        mapped = np.flatnonzero(points.state[keyframe.rows] == MAPPED)
        mapped = mapped[np.argsort(points.ids[keyframe.rows[mapped]])]
        corners = features.get(keyframe.id)
        none = Features(points_px=np.zeros((0, 2), np.float32), descriptors=np.zeros((0, 32), "u1"))
        corners = none if corners is None else corners
        origin = origins[keyframe.id]
        size = given.width, given.height
        yield KeptKeyframe(
            id=keyframe.id,
            segment=keyframe.segment,
            session=origin.session,
            source_frame=origin.frame,
            turned=keyframe.is_pure_rotation,
            given=np.array([*size, *given.intrinsics]),
            correction=calibration.correction.copy(),
            sigmas=calibration.sigmas,
            T_world_camera=keyframe.T_world_camera.copy(),
            motion=motions[slot],
            seen_ids=points.ids[keyframe.rows[mapped]],
            seen_px=keyframe.points_px[mapped],
            rolled_px=keyframe.rolled_px[mapped],
            corners_px=view.pixels(corners.points_px),
            descriptors=corners.descriptors,
            point_ids=points.ids[mine],
            points_world=points.xyz[mine],
            point_colours=points.colours[mine],
            point_keyframes=points.keyframes[mine],
            point_parallax_rad=points.parallax_rad[mine],
            point_sigmas=points.sigmas[mine],
            point_kappas=points.kappas[mine],
            point_patches=points.patches[mine],
        )


def take_in(
    kept: Sequence[KeptKeyframe], points: Landmarks, calibration: SelfCalibration
) -> list[Segment]:
    """Return the segments of a saved map, with their landmarks in new rows; segments without
    landmarks are left out.

    calibration: of the camera that continues the map.   Raises ValueError if a landmark occurs
    twice.
    """
    rows = points.allocate(sum(len(each.point_ids) for each in kept))
    first = 0
    for each in kept:
        mine = rows[first : first + len(each.point_ids)]
        first += len(mine)
        zoom = calibration.view.camera.fx / view_of(each).camera.fx
        points.restore(mine, each, _zoomed(each.point_patches, zoom))
    order = np.argsort(points.ids[rows], kind="stable").astype(np.int32)
    ids, rows = points.ids[rows][order], rows[order]
    if (np.diff(ids) == 0).any():
        raise ValueError("a repeated point")
    points.continue_after(int(ids[-1]) if len(ids) else -1)
    segments: list[Segment] = []
    for number in sorted({each.segment for each in kept}):
        mine = [each for each in kept if each.segment == number]
        if not any(len(each.point_ids) for each in mine):
            continue
        keyframes = [_keyframe(each, ids, rows, calibration) for each in mine]
        for keyframe in keyframes:
            keyframe.focus = focus_of(keyframe, points)
            points.patch_keyframe[keyframe.rows] = keyframe.id
        path = FramePoses({each.id: each.motion for each in mine if each.motion.any()})
        segment = Segment(
            id=number, points=points, keyframes=keyframes, path=path, since=len(keyframes)
        )
        segment.inverse_distance = _inverse_distance(keyframes)
        segments.append(segment)
    return segments


def spans_of(kept: Sequence[KeptKeyframe]) -> list[tuple[int, int]]:
    """Return (first keyframe id, segment) of each stretch of keyframes of one segment, see
    ``held``.
    """
    spans: list[tuple[int, int]] = []
    for each in kept:
        if not spans or spans[-1][1] != each.segment:
            spans.append((each.id, each.segment))
    return spans


def numbered_after(
    kept: Sequence[KeptKeyframe], known: Sequence[KeptKeyframe]
) -> list[KeptKeyframe]:
    """Return a map's keyframes with numbers that continue those of another map: keyframes,
    segments, sessions and landmarks.
    """
    ids = [ids for each in known for ids in (each.seen_ids, each.point_ids) if len(ids)]
    points = 1 + max((int(each[-1]) for each in ids), default=-1)
    segments = 1 + max(each.segment for each in known)
    sessions = 1 + max(each.session for each in known)
    first = 1 + known[-1].id
    return [
        replace(
            each, id=first + each.id, segment=segments + each.segment,
            session=sessions + each.session, seen_ids=points + each.seen_ids,
            point_ids=points + each.point_ids,
        )
        for each in kept
    ]  # fmt: skip


def corrected_as(kept: KeptKeyframe, calibration: SelfCalibration) -> KeptKeyframe:
    """Return the keyframe with the calibration that another session estimated for the same camera.

    Observations keep their position in the image.  A keyframe of another camera, or with the same
    calibration, is unchanged.  Two sessions differ by a thousandth in the focal length, and rays by
    as
    much: as rays the same image would be seen from two places.
    """
    same = np.array_equal(kept.correction, calibration.correction)
    if same or kept.given_camera != calibration.given:
        return kept
    moved = partial(moved_px, before=view_of(kept), after=calibration.view)
    seen_px = moved(kept.seen_px)
    return replace(
        kept, correction=calibration.correction.copy(), sigmas=calibration.sigmas,
        seen_px=seen_px, rolled_px=moved(kept.seen_px + kept.rolled_px) - seen_px,
        corners_px=moved(kept.corners_px),
    )  # fmt: skip


def features_for(kept: KeptKeyframe, calibration: SelfCalibration) -> Features:
    """Return the corners at the pixels of the rectified image of a camera."""
    moved = _moved(kept.corners_px, view_of(kept).camera, calibration.view.camera)
    return Features(points_px=calibration.view.seen(moved), descriptors=kept.descriptors)


def known_camera(kept: Sequence[KeptKeyframe], camera: PinholeCamera) -> SelfCalibration | None:
    """Return the last session's calibration for a camera with the same description, or None for
    another camera.
    """
    for each in reversed(kept):
        if each.given_camera == camera:
            found = SelfCalibration(camera, each.correction.copy(), np.diag(each.sigmas**2))
            return replace(found, next_keyframes=np.iinfo(np.int32).max)
    return None


def _inverse_distance(keyframes: list[Keyframe]) -> float:
    """Inverse distance of the landmarks from the newest keyframe with landmarks, as of
    ``Segment``.
    """
    for keyframe in reversed(keyframes):
        if keyframe.focus is not None and np.isfinite(keyframe.focus).all():
            distance = np.linalg.norm(keyframe.focus - keyframe.T_world_camera[:3, 3])
            return 1.0 / max(float(distance), 1e-9)
    return 1.0


def _keyframe(kept: KeptKeyframe, ids: I64, rows: I32, calibration: SelfCalibration) -> Keyframe:
    at = np.minimum(np.searchsorted(ids, kept.seen_ids), max(len(ids) - 1, 0))
    there = np.flatnonzero(ids[at] == kept.seen_ids) if len(ids) else np.zeros(0, np.int64)
    seen = rows[at[there]] if len(ids) else np.zeros(0, np.int32)
    there = there[np.argsort(seen)]
    old, new = view_of(kept).camera, calibration.view.camera
    points_px = _moved(kept.seen_px[there], old, new)
    return Keyframe(
        id=kept.id,
        frame=-1,
        segment=kept.segment,
        T_world_camera=kept.T_world_camera.copy(),
        rows=np.sort(seen),
        points_px=points_px,
        rolled_px=_moved(kept.seen_px[there] + kept.rolled_px[there], old, new) - points_px
        if old != new
        else kept.rolled_px[there],
        is_pure_rotation=kept.turned,
    )


def _moved(points_px: F32, old: PinholeCamera, new: PinholeCamera) -> F32:
    """Convert pixels of one pinhole camera to another one at the same pose."""
    if old == new:
        return points_px
    seen = old.normalise(points_px)
    return (seen * (new.fx, new.fy) + (new.cx, new.cy)).astype(np.float32)


def _zoomed(patches: U8, zoom: float) -> U8:
    """Return patches as a camera with this multiple of the focal length sees them, the border
    repeated.
    """
    if zoom == 1.0 or not len(patches):
        return patches
    middle = 0.5 * (PATCH_SIDE - 1)
    side = ((np.arange(PATCH_SIDE) - middle) / zoom + middle).astype(np.float32)
    u, v = np.meshgrid(side, side)
    moved = [cv2.remap(p, u, v, cv2.INTER_LINEAR, None, cv2.BORDER_REPLICATE) for p in patches]
    return np.array(moved, np.uint8)

"""A map that is kept: its keyframes as places, each with the points that hang on it, and back.

What is kept is what a camera may come back to: poses, what they saw, corners, points with the
patches by which they are found again.  Pixels are those of the ideal camera of the calibration that
is kept with them, so that another camera, with a calibration of its own, can use the map.  Each
keyframe stands for itself: no part grows with the map.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import cv2
import numpy as np

from pliant.algorithms.arrays import F32, I32, I64, U8, check_arrays
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.corrected_view import CorrectedView, corrected_view, moved_px
from pliant.algorithms.kept_keyframe import KeptKeyframe
from pliant.algorithms.mapping.covisibility import focus_of
from pliant.algorithms.mapping.keyframe import Keyframe
from pliant.algorithms.mapping.landmarks import MAPPED, PATCH_SIDE, Landmarks
from pliant.algorithms.mapping.rolling_shutter import FramePoses
from pliant.algorithms.mapping.segment import Segment
from pliant.algorithms.mapping.self_calibration import SelfCalibration
from pliant.algorithms.places import Features


class Origin(NamedTuple):
    """Where a keyframe comes from: the number of the run, and the frame there."""

    session: int
    frame: int


def view_of(kept: KeptKeyframe) -> CorrectedView:
    """Whose pixels a keyframe has."""
    return corrected_view(kept.given_camera, tuple(kept.correction.tolist()))


_MOST, _MOST_POINTS, _LONGEST_SIDE_PX = 1 << 30, 1 << 62, 32767
"""What numbers of keyframes, of points and of pixels may be, so that what comes later fits, too."""


def check(kept: KeptKeyframe) -> None:
    """Raise ValueError where a keyframe is none that this module has made."""
    check_arrays(kept)
    if kept.point_patches.shape[1:] != (PATCH_SIDE, PATCH_SIDE):
        raise ValueError(f"patches of {kept.point_patches.shape[1]} pixels")
    numbers = (kept.id, kept.segment, kept.session, kept.source_frame)
    if not all(0 <= number < _MOST for number in numbers) or kept.given[:4].min() <= 0.0:
        raise ValueError("numbers or a camera that cannot be")
    real = (kept.given, kept.correction, kept.T_world_camera, kept.motion, kept.points_world)
    if not all(np.isfinite(each).all() for each in (*real, kept.seen_px, kept.corners_px)):
        raise ValueError("values that are not finite")
    if kept.given[:2].max() > _LONGEST_SIDE_PX:
        raise ValueError("a camera that cannot be")
    R, last = kept.T_world_camera[:3, :3], kept.T_world_camera[3]
    if np.abs(R @ R.T - np.eye(3)).max() > 1e-6 or last.tolist() != [0.0, 0.0, 0.0, 1.0]:
        raise ValueError("a pose that is none")
    for ids in (kept.seen_ids, kept.point_ids):
        if len(ids) and (ids[0] < 0 or ids[-1] >= _MOST_POINTS or (np.diff(ids) <= 0).any()):
            raise ValueError("points that are not in order")


def keep(
    segment: Segment,
    calibration: SelfCalibration,
    features: dict[int, Features],
    origins: dict[int, Origin],
) -> Iterator[KeptKeyframe]:
    """The keyframes of a segment, oldest first.

    features: of keyframes by their ids, at the pixels of the rectified image.   origins: of all.
    """
    points, given, view = segment.points, calibration.given, calibration.view
    ids = np.array([keyframe.id for keyframe in segment.keyframes], np.int64)
    rows = points.mapped(segment.id)
    # What hung on a keyframe that the map has forgotten moves with the one before it.
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
    """The segments of a kept map, their points in rows that are new; those without a point are
    left out.

    calibration: of the camera that goes on in it.   Raises ValueError where a point comes twice.
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
        raise ValueError("a point that comes twice")
    points.go_on_after(int(ids[-1]) if len(ids) else -1)
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
    """(first keyframe id, segment) of each stretch of keyframes of one segment, see ``held``."""
    spans: list[tuple[int, int]] = []
    for each in kept:
        if not spans or spans[-1][1] != each.segment:
            spans.append((each.id, each.segment))
    return spans


def numbered_after(
    kept: Sequence[KeptKeyframe], known: Sequence[KeptKeyframe]
) -> list[KeptKeyframe]:
    """The keyframes of a map under numbers that follow on those of another one: of keyframes,
    segments, sessions and points."""
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
    """The keyframe with what another session has found wrong with the same camera: what was seen
    stays where it was in the image.  One of another camera stays as it is, and one with the same.

    Two sessions differ by a thousandth in the focal length, and rays by as much: as rays the same
    image would be seen from two places.
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
    """Its corners at the pixels of the rectified image of a camera."""
    moved = _moved(kept.corners_px, view_of(kept).camera, calibration.view.camera)
    return Features(points_px=calibration.view.seen(moved), descriptors=kept.descriptors)


def known_camera(kept: Sequence[KeptKeyframe], camera: PinholeCamera) -> SelfCalibration | None:
    """What the last session of a map knew of a camera that was given in the same words; None where
    it is another one."""
    for each in reversed(kept):
        if each.given_camera == camera:
            found = SelfCalibration(camera, each.correction.copy(), np.diag(each.sigmas**2))
            return replace(found, next_keyframes=np.iinfo(np.int32).max)
    return None


def _inverse_distance(keyframes: list[Keyframe]) -> float:
    """Of the points from the newest keyframe that sees some, as of ``Segment``."""
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
    """Pixels of one pinhole camera in another one that stands where it stood."""
    if old == new:
        return points_px
    seen = old.normalise(points_px)
    return (seen * (new.fx, new.fy) + (new.cx, new.cy)).astype(np.float32)


def _zoomed(patches: U8, zoom: float) -> U8:
    """Patches as a camera with so many times the focal length sees them, their border repeated."""
    if zoom == 1.0 or not len(patches):
        return patches
    middle = 0.5 * (PATCH_SIDE - 1)
    side = ((np.arange(PATCH_SIDE) - middle) / zoom + middle).astype(np.float32)
    u, v = np.meshgrid(side, side)
    moved = [cv2.remap(p, u, v, cv2.INTER_LINEAR, None, cv2.BORDER_REPLICATE) for p in patches]
    return np.array(moved, np.uint8)

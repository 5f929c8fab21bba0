"""Relocalisation of a camera without a predicted pose, by the appearance of its image.

Keyframes are stored as places.  One that looks like the frame proposes a pose by P3P and RANSAC
over similar corners.  The pose counts only if the map's landmarks verify it, as after any loss, and
no other place is verified nearly as well: an image that fits two places identifies neither.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain
from typing import NamedTuple

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, I64, BoolArray
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import inverse, so3_log, transform
from pliant.algorithms.slam.calibration.corrected_view import CorrectedView
from pliant.algorithms.slam.estimate.absolute_pose import pose_by_ransac
from pliant.algorithms.slam.estimate.pose import Correspondences
from pliant.algorithms.slam.locate.landmark_search import (
    MAX_RADIUS_SHARE,
    MIN_AGREEING,
    MIN_AGREEMENT,
    NEAR,
    RANSAC_SAMPLES,
    LandmarkSearch,
    are_enough,
)
from pliant.algorithms.slam.locate.localisation import RANSAC_GATE_PX, refine
from pliant.algorithms.slam.locate.pose_quality import MIN_SPREAD
from pliant.algorithms.slam.locate.reacquisition import MaximaGrid
from pliant.algorithms.slam.map.covisibility import most_shared, rows_of
from pliant.algorithms.slam.map.keyframe import Keyframe
from pliant.algorithms.slam.map.landmarks import MAPPED, Landmarks
from pliant.algorithms.slam.parameters import MappingParameters
from pliant.algorithms.slam.places.place_index import Features, match, repeated_share

_NEAR_SHARE = 0.0125
"""Share of the image's width: a corner has the depth of the nearest landmark within it."""

_NEAR_KEYFRAMES = 16
"""Number of keyframes whose landmarks verify a pose."""

_SAME_TURN_RAD = np.radians(5.0)
_SAME_SHIFT = 0.1
"""Poses closer than this, as a share of the depth, are the same."""

_AS_GOOD = 0.5
"""A place with this share of another one's inliers or corners is as good."""

_MOST = 0.5
"""Minimum share of the similar corners: in a wrong place a tenth agrees on a pose."""


class _Proposed(NamedTuple):
    """A pose, the place that proposes it, the frame's agreeing corners (n,), their pixels and world
    positions, and their share of the similar ones.
    """

    T_world_camera: F64
    place: "Place"
    corners: I64
    corners_px: F32
    xyz: F64
    share: float


@dataclass(frozen=True, kw_only=True)
class Place:
    """A keyframe that the camera may see, the corners of its image, and all keyframes of its
    segment, oldest first.

    view: whose pixels the keyframe has; the corners are at those of the rectified image.  None: the
    corners are at the keyframe's.
    """

    keyframe: Keyframe
    corners: Features
    segment: list[Keyframe]
    view: CorrectedView | None = None

    @cached_property
    def features(self) -> Features:
        """The corners at the keyframe's pixels."""
        if self.view is None:
            return self.corners
        return replace(self.corners, points_px=self.view.pixels(self.corners.points_px))


@dataclass(frozen=True, kw_only=True)
class Recognised:
    """T_world_camera of a frame in a keyframe's place, and the numbers of landmarks and of the
    keyframe's corners that verify it.
    """

    keyframe: Keyframe
    T_world_camera: F64
    inliers: int
    corners: int


def relocalise(
    seen: Features,
    places: Sequence[Place],
    elsewhere: Iterable[Place],
    search: LandmarkSearch,
) -> Recognised | None:
    """Return the pose of a frame from similar places, or None unless exactly one is verified.

    seen: of the frame.   elsewhere: places that are compared as well after a verified one.
    search: in the frame's image.
    """
    points, parameters, camera = search.points, search.parameters, search.camera
    best: Recognised | None = None
    rivals: list[Recognised] = []
    proof: _Proposed | None = None
    for number, place in enumerate(chain(places, elsewhere)):
        if number >= len(places) and best is None:
            break
        rows = _rows_near(place.keyframe, place.segment, points)
        for proposed in _propose(seen, place, points, camera, parameters, search.generator):
            alone = _speaks_for_itself(proposed, camera, parameters)
            least = 0.0 if alone else MIN_AGREEMENT
            proved = search.verify(proposed.T_world_camera, rows, least)
            if proved is None:
                continue
            found = Recognised(
                keyframe=place.keyframe,
                T_world_camera=proved.T_world_camera,
                inliers=len(proved.rows),
                corners=len(proposed.corners),
            )
            if best is None:
                best, proof = found, proposed
                continue
            same = _is_same(best, found, place, points)
            if found.inliers > best.inliers:
                best, proof, found = found, proposed, best
            if not same:
                rivals.append(found)
    if best is None or proof is None:
        return None
    if not are_enough(max(best.inliers, best.corners), parameters):
        return None
    if any(_is_as_good(rival, best, points, parameters) for rival in rivals):
        return None
    here = transform(inverse(proof.T_world_camera), proof.xyz)
    if repeats(seen, proof.corners, here, camera):
        return None
    place = proof.place
    best = _looked_about(best, place, search)
    moved = rest_is_elsewhere(best.T_world_camera, place.keyframe, place.segment, search)
    return None if moved else best


def _looked_about(
    found: Recognised,
    place: Place,
    search: LandmarkSearch,
) -> Recognised:
    """Return the better verified of two poses: that of the corners, and that of landmarks searched
    around it.

    A few blurred corners on one wall leave a rotation open that a step aside compensates, and
    landmarks on the wall are within their radius then, too.
    """
    rows = _rows_near(place.keyframe, place.segment, search.points)
    radius_px = NEAR * MAX_RADIUS_SHARE * search.camera.width
    proved = search.near(found.T_world_camera, rows, radius_px)
    if proved is None or len(proved.rows) <= found.inliers:
        return found
    return replace(found, T_world_camera=proved.T_world_camera, inliers=len(proved.rows))


def _rows_near(keyframe: Keyframe, segment: list[Keyframe], points: Landmarks) -> I32:
    """Rows of the landmarks that may be visible from near a keyframe of a segment."""
    near = most_shared(segment, [keyframe], points)[:_NEAR_KEYFRAMES]
    rows = rows_of(near, np.zeros(0, np.int32), len(points.state))
    return rows[points.state[rows] == MAPPED]


def rest_is_elsewhere(
    T_world_camera: F64,
    keyframe: Keyframe,
    segment: list[Keyframe],
    search: LandmarkSearch,
) -> bool:
    """Whether the landmarks that this pose leaves over verify another pose nearby, with half as
    many.

    keyframe: of a segment, which sees the place.   search: in the frame's image.  The recognised
    object may have been moved in its place, and have nearly all corners; everything else is then a
    step aside of its projection.
    """
    rows = _rows_near(keyframe, segment, search.points)
    seen = search.verify(T_world_camera, rows, 0.0)
    if seen is None:
        return False
    radius_px = search.camera.width * MAX_RADIUS_SHARE
    rest = np.setdiff1d(rows, seen.rows)
    other = search.near(seen.T_world_camera, rest, radius_px)
    return (
        other is not None
        and len(other.rows) > _AS_GOOD * len(seen.rows)
        and not is_same_pose(seen.T_world_camera, other.T_world_camera, keyframe, search.points)
    )


def repeats(seen: Features, corners: I64, xyz: F64, camera: PinholeCamera) -> bool:
    """Whether the evidence is as good for a pose a step aside, because the image repeats itself
    there.

    corners, xyz: the evidence for a pose, as of ``repeated_share``.
    """
    share = repeated_share(
        seen, corners, xyz, camera, gate_px=RANSAC_GATE_PX,
        least_step=_SAME_SHIFT * float(np.median(xyz[:, 2])),
    )  # fmt: skip
    return share > _AS_GOOD


def corners_in_map(
    keyframe: Keyframe, features: Features, points: Landmarks, camera: PinholeCamera
) -> tuple[F64, BoolArray]:
    """(n, 3) world positions of a keyframe's corners, and whether they are known: with the depth of
    the nearby landmark.
    """
    seen = points.state[keyframe.rows] == MAPPED
    rows, points_px = keyframe.rows[seen], keyframe.points_px[seen]
    radius_px = _NEAR_SHARE * camera.width
    beside = np.column_stack([points_px, np.zeros(len(rows), np.float32)])
    grid = MaximaGrid.build(beside, camera.width, camera.height, radius_px)
    nearest = grid.nearest(features.points_px, radius_px)
    depth = np.zeros(len(nearest))
    known = nearest >= 0
    T_camera_world = inverse(keyframe.T_world_camera)
    depth[known] = transform(T_camera_world, points.xyz[rows[nearest[known]]])[:, 2]
    known &= depth > 0.0
    seen_at = camera.normalise(features.points_px.astype(np.float64))
    rays = np.column_stack([seen_at, np.ones(len(depth))])
    return transform(keyframe.T_world_camera, rays * depth[:, None]), known


def _propose(
    seen: Features,
    place: Place,
    points: Landmarks,
    camera: PinholeCamera,
    parameters: MappingParameters,
    generator: np.random.Generator,
) -> Iterator[_Proposed]:
    """Yield the pose on which most similar corners of a place agree, then that of the remaining
    ones, while enough agree.

    Moved objects take their corners along, which may be the majority.
    """
    limits = parameters.localisation
    pairs = match(seen, place.features)
    world, known = corners_in_map(place.keyframe, place.features, points, camera)
    pairs = pairs[known[pairs[:, 1]]]
    alike = len(pairs)
    while len(pairs) >= MIN_AGREEING:
        xyz, points_px = world[pairs[:, 1]], seen.points_px[pairs[:, 0]]
        found = pose_by_ransac(
            xyz, camera.normalise(points_px.astype(np.float64)), generator,
            gate=RANSAC_GATE_PX / camera.fx, samples=RANSAC_SAMPLES,
        )  # fmt: skip
        if found is None or found[1].sum() < MIN_AGREEING:
            return
        agree = found[1]
        located = refine(found[0], Correspondences(xyz, points_px), camera, limits)
        yield _Proposed(
            located.T_world_camera, place, pairs[agree, 0], points_px[agree], xyz[agree],
            agree.sum() / alike,
        )  # fmt: skip
        pairs = pairs[~agree]


def _speaks_for_itself(
    proposed: _Proposed, camera: PinholeCamera, parameters: MappingParameters
) -> bool:
    """Whether the corners are conclusive: many, most of the similar ones, all over the image.

    Landmarks agree less if a rolling shutter or motion blurs the frame.
    """
    size = np.array([camera.width, camera.height])
    spread = (proposed.corners_px.std(axis=0) / size).min()
    return (
        len(proposed.corners_px) >= parameters.localisation.min_inliers
        and proposed.share >= _MOST
        and spread >= MIN_SPREAD
    )


def _is_as_good(
    rival: Recognised, best: Recognised, points: Landmarks, parameters: MappingParameters
) -> bool:
    """Whether the evidence for another pose is as good.

    Places mapped from nearby, and slowly, have far more landmarks than others, but not more
    corners. So corners reveal when two places look the same.
    """
    if rival.inliers > _AS_GOOD * best.inliers:
        return True
    shared = np.intersect1d(rival.keyframe.rows, best.keyframe.rows)
    shared = int(np.count_nonzero(points.state[shared] == MAPPED))
    elsewhere = shared < parameters.localisation.min_inliers
    return elsewhere and rival.corners > _AS_GOOD * best.corners


def _is_same(a: Recognised, b: Recognised, place: Place, points: Landmarks) -> bool:
    same = a.keyframe.segment == b.keyframe.segment
    return same and is_same_pose(a.T_world_camera, b.T_world_camera, place.keyframe, points)


def is_same_pose(a: F64, b: F64, keyframe: Keyframe, points: Landmarks) -> bool:
    """Whether two poses of a frame are the same, relative to the depth of a keyframe."""
    between = inverse(a) @ b
    rows = keyframe.rows[points.state[keyframe.rows] == MAPPED]
    depth = np.median(transform(inverse(b), points.xyz[rows])[:, 2])
    turn = float(np.linalg.norm(so3_log(between[:3, :3])))
    return turn < _SAME_TURN_RAD and float(np.linalg.norm(between[:3, 3])) < _SAME_SHIFT * depth

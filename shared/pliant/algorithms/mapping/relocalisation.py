"""A camera that nobody can predict: recognised by what its image looks like.

Keyframes are remembered as places.  One that looks like the frame proposes a pose by P3P and RANSAC
over corners that look alike; it counts only where the map's own points prove it, as after any loss,
and where no other place is proved nearly as well: what looks the same in two places shows neither.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain
from typing import NamedTuple

import numpy as np

from pliant.algorithms.absolute_pose import pose_by_ransac
from pliant.algorithms.arrays import F32, F64, I32, I64, U8, BoolArray
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.corrected_view import CorrectedView
from pliant.algorithms.geometry import inverse, so3_log, transform
from pliant.algorithms.mapping.covisibility import most_shared, rows_of
from pliant.algorithms.mapping.keyframe import Keyframe
from pliant.algorithms.mapping.landmarks import MAPPED, Landmarks
from pliant.algorithms.mapping.localisation import (
    NEAR,
    are_enough,
    refine,
    search_near,
    verify_pose,
)
from pliant.algorithms.mapping.parameters import MappingParameters
from pliant.algorithms.mapping.reacquisition import MaximaGrid
from pliant.algorithms.places import Features, match, repeated_share

_NEAR_SHARE = 0.0125
"""Of the image's width: a corner is as far as the nearest point of the map within."""

_NEAR_KEYFRAMES = 16
"""Whose points prove a pose."""

_SAME_TURN_RAD = np.radians(5.0)
_SAME_SHIFT = 0.1
"""Poses closer than this, as a share of the depth, are one."""

_AS_GOOD = 0.5
"""A place with this share of the inliers of another one, or of its corners, is as good."""

_MOST = 0.5
"""Of the corners that look alike: in another place a tenth agrees on a pose."""


class _Proposed(NamedTuple):
    """A pose, the place that proposes it, the corners (n,) of the frame that agree on it, their
    pixels, where in the world they are, and their share of those that look alike."""

    T_world_camera: F64
    place: "Place"
    corners: I64
    corners_px: F32
    xyz: F64
    share: float


@dataclass(frozen=True, kw_only=True)
class Place:
    """A keyframe that may be what the camera sees, the corners of its image, and all keyframes of
    its segment, oldest first.

    view: whose pixels the keyframe has; the corners are at those of the rectified image.  None: the
    corners are at the keyframe's.
    """

    keyframe: Keyframe
    corners: Features
    segment: list[Keyframe]
    view: CorrectedView | None = None

    @cached_property
    def features(self) -> Features:
        """The corners at the pixels that the keyframe has."""
        if self.view is None:
            return self.corners
        return replace(self.corners, points_px=self.view.pixels(self.corners.points_px))


@dataclass(frozen=True, kw_only=True)
class Recognised:
    """T_world_camera of a frame that sees what a keyframe saw, and how many points of the map and
    corners of that keyframe prove it."""

    keyframe: Keyframe
    T_world_camera: F64
    inliers: int
    corners: int


def relocalise(
    seen: Features,
    places: Sequence[Place],
    elsewhere: Iterable[Place],
    points: Landmarks,
    maxima: F32,
    grey: U8,
    camera: PinholeCamera,
    parameters: MappingParameters,
    generator: np.random.Generator,
) -> Recognised | None:
    """The pose of a frame from the places that look like it, None where no single one is proved.

    seen, maxima (M, 3), grey (H, W): of the frame.   elsewhere: places that are asked as well
    where one of the others is proved.
    """
    own = parameters.recovery
    best: Recognised | None = None
    rivals: list[Recognised] = []
    proof: _Proposed | None = None
    for number, place in enumerate(chain(places, elsewhere)):
        if number >= len(places) and best is None:
            break
        rows = _rows_near(place.keyframe, place.segment, points)
        for proposed in _propose(seen, place, points, camera, parameters, generator):
            proved = verify_pose(
                proposed.T_world_camera, rows, points, maxima, grey, camera, parameters,
                0.0 if _speaks_for_itself(proposed, camera, parameters) else own.min_agreement,
            )  # fmt: skip
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
    if repeats(seen, proof.corners, here, camera, parameters):
        return None
    place = proof.place
    best = _looked_about(best, place, points, maxima, grey, camera, parameters, generator)
    moved = rest_is_elsewhere(
        best.T_world_camera, place.keyframe, place.segment, points, maxima, grey, camera,
        parameters, generator,
    )  # fmt: skip
    return None if moved else best


def _looked_about(
    found: Recognised,
    place: Place,
    points: Landmarks,
    maxima: F32,
    grey: U8,
    camera: PinholeCamera,
    parameters: MappingParameters,
    generator: np.random.Generator,
) -> Recognised:
    """The pose that most of the map's points prove, of the one that corners tell and of one that
    points tell which are looked for about it.

    A few blurred corners on one wall leave a turn open that a step aside makes up for, and points
    on it are found within their radius then, too.
    """
    rows = _rows_near(place.keyframe, place.segment, points)
    radius_px = NEAR * parameters.recovery.max_radius_share * camera.width
    grid = MaximaGrid.build(maxima, camera.width, camera.height, radius_px)
    proved = search_near(
        found.T_world_camera, rows, points, grid, grey, radius_px, camera, parameters, generator
    )
    if proved is None or len(proved.rows) <= found.inliers:
        return found
    return replace(found, T_world_camera=proved.T_world_camera, inliers=len(proved.rows))


def _rows_near(keyframe: Keyframe, segment: list[Keyframe], points: Landmarks) -> I32:
    """Rows of the points that may be seen from about a keyframe of a segment."""
    near = most_shared(segment, [keyframe], points)[:_NEAR_KEYFRAMES]
    rows = rows_of(near, np.zeros(0, np.int32), len(points.state))
    return rows[points.state[rows] == MAPPED]


def rest_is_elsewhere(
    T_world_camera: F64,
    keyframe: Keyframe,
    segment: list[Keyframe],
    points: Landmarks,
    maxima: F32,
    grey: U8,
    camera: PinholeCamera,
    parameters: MappingParameters,
    generator: np.random.Generator,
) -> bool:
    """Whether half as many points prove another pose nearby, of those that this one leaves over.

    keyframe: of a segment, which sees the place.   maxima (M, 3), grey (H, W): of the frame.
    What shows a place may have been moved in it, and be nearly all that has corners; what stands
    about it then is not where the pose shows it, but all a step aside.
    """
    rows, own = _rows_near(keyframe, segment, points), parameters.recovery
    seen = verify_pose(T_world_camera, rows, points, maxima, grey, camera, parameters, 0.0)
    if seen is None:
        return False
    radius_px = camera.width * own.max_radius_share
    grid = MaximaGrid.build(maxima, camera.width, camera.height, radius_px)
    rest = np.setdiff1d(rows, seen.rows)
    other = search_near(
        seen.T_world_camera, rest, points, grid, grey, radius_px, camera, parameters, generator
    )
    return (
        other is not None
        and len(other.rows) > _AS_GOOD * len(seen.rows)
        and not is_same_pose(seen.T_world_camera, other.T_world_camera, keyframe, points)
    )


def repeats(
    seen: Features, corners: I64, xyz: F64, camera: PinholeCamera, parameters: MappingParameters
) -> bool:
    """Whether as much speaks for a pose a step aside, for the image shows the same again there.

    corners, xyz: what speaks for a pose, as of ``repeated_share``.
    """
    share = repeated_share(
        seen, corners, xyz, camera, gate_px=parameters.localisation.ransac_gate_px,
        least_step=_SAME_SHIFT * float(np.median(xyz[:, 2])),
    )  # fmt: skip
    return share > _AS_GOOD


def corners_in_map(
    keyframe: Keyframe, features: Features, points: Landmarks, camera: PinholeCamera
) -> tuple[F64, BoolArray]:
    """(n, 3) where in the world the corners of a keyframe are, and whether that is known: as deep
    as the point of the map beside them."""
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
    """The pose that most corners agree on which look like those of a place, and then that of the
    rest of them, as long as enough agree.

    What has been moved takes its corners along, which may be the most.
    """
    limits, own = parameters.localisation, parameters.recovery
    pairs = match(seen, place.features)
    world, known = corners_in_map(place.keyframe, place.features, points, camera)
    pairs = pairs[known[pairs[:, 1]]]
    alike = len(pairs)
    while len(pairs) >= own.min_agreeing:
        xyz, points_px = world[pairs[:, 1]], seen.points_px[pairs[:, 0]]
        found = pose_by_ransac(
            xyz, camera.normalise(points_px.astype(np.float64)), generator,
            gate=limits.ransac_gate_px / camera.fx, samples=own.ransac_samples,
        )  # fmt: skip
        if found is None or found[1].sum() < own.min_agreeing:
            return
        agree = found[1]
        T_world_camera = refine(found[0], xyz, points_px, camera, limits).T_world_camera
        yield _Proposed(
            T_world_camera, place, pairs[agree, 0], points_px[agree], xyz[agree],
            agree.sum() / alike,
        )  # fmt: skip
        pairs = pairs[~agree]


def _speaks_for_itself(
    proposed: _Proposed, camera: PinholeCamera, parameters: MappingParameters
) -> bool:
    """Whether the corners leave no doubt: many, most of those that look alike, all over the image.

    The map's points agree less where a shutter that rolls or motion blurs the frame.
    """
    size = np.array([camera.width, camera.height])
    spread = (proposed.corners_px.std(axis=0) / size).min()
    return (
        len(proposed.corners_px) >= parameters.localisation.min_inliers
        and proposed.share >= _MOST
        and spread >= parameters.support.min_spread
    )


def _is_as_good(
    rival: Recognised, best: Recognised, points: Landmarks, parameters: MappingParameters
) -> bool:
    """Whether as much speaks for another pose.

    Of points some places have far more than others: those that were mapped from nearby, and slowly.
    Of corners each has as many, so that they tell, too, what is the same in two places.
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
    """Whether two poses of a frame are one, before what a keyframe sees."""
    between = inverse(a) @ b
    rows = keyframe.rows[points.state[keyframe.rows] == MAPPED]
    depth = np.median(transform(inverse(b), points.xyz[rows])[:, 2])
    turn = float(np.linalg.norm(so3_log(between[:3, :3])))
    return turn < _SAME_TURN_RAD and float(np.linalg.norm(between[:3, 3])) < _SAME_SHIFT * depth

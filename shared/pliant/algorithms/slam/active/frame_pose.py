"""The pose of a frame in the map.

It is estimated from the tracks of landmarks, refined by reacquired landmarks, and adjusted together
with the window (VITAMIN-E section 3.2, Eq. 6).
"""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, I64, BoolArray
from pliant.algorithms.slam.active.active_map import ActiveMap
from pliant.algorithms.slam.estimate.observation_table import reprojection_errors
from pliant.algorithms.slam.estimate.pose import Correspondences, refine_pose
from pliant.algorithms.slam.estimate.pose_prior import NO_PRIOR, PosePrior
from pliant.algorithms.slam.estimate.problem import BundleParameters
from pliant.algorithms.slam.frame import IdealFrame, PlacedFrame
from pliant.algorithms.slam.locate.inverse_depth import (
    off_epipolar_line,
    placed_candidates,
    spread_of,
)
from pliant.algorithms.slam.locate.landmark_search import MIN_AGREEMENT
from pliant.algorithms.slam.locate.localisation import (
    KERNEL_SIGMA_PX,
    Localisation,
    Motion,
    locate,
    refine,
)
from pliant.algorithms.slam.locate.pose_quality import SETTLED_S, support_of
from pliant.algorithms.slam.locate.reacquisition import reacquire
from pliant.algorithms.slam.map.keyframe import Observations
from pliant.algorithms.slam.map.landmarks import MAPPED
from pliant.algorithms.slam.map.track_links import UNLINKED
from pliant.algorithms.slam.parameters import MappingParameters, PointParameters
from pliant.algorithms.slam.places.relocalisation import Recognised, is_same_pose
from pliant.algorithms.stages import StageTimer
from pliant.algorithms.tracks import FrameTracks

_AGREEING = 0.5
"""Minimum share of the inlying landmarks that still fit once candidates help; with fewer, the
landmarks are on a moving object.
"""

_OF_CANDIDATE = 0.5
"""Inliers that a fitting candidate counts as: any depth will do, so it constrains one coordinate of
its pixel, not two.
"""

_OFF = 2.0
"""In errors of an inlier: a track farther from its epipolar line contradicts a pose."""

_DECIDING = 500
"""Minimum tracks that decide whether a camera stands still."""

_REGULAR = 1e-9
"""Share of its diagonal by which a singular matrix becomes regular."""

_FEW, _FIRM = 0.05, 0.2
"""Minimum shares of the last frame's tracks that fit a pose: after a cut, 0.3 to 2 % fit by chance,
and 9 % where the views overlap; the fastest rotations with blur leave 11 to 20 %.
"""


def locate_in_map(
    active: ActiveMap | None,
    motion: Motion | None,
    frame: IdealFrame,
    generator: np.random.Generator,
    recognise: Callable[[IdealFrame], Recognised | None],
    timer: StageTimer,
) -> tuple[F64 | None, Recognised | None]:
    """Return T_world_camera of a frame, and the place if its image shows another one than its
    tracks.

    active, motion: None if the camera is not in the map yet.   recognise: the place by the
    image.   Firm tracks need no image; the pose of a few counts if the image shows no other place.
    """
    there = None
    if active is not None and motion is not None:
        with timer("localisation"):
            located = localise(active, motion, frame, generator)
        if located is not None:
            there = located.T_world_camera
            if located.is_firm:
                return there, None
    if not frame.has_image:
        return there, None
    with timer("places"):
        found = recognise(frame)
    if found is None:
        return there, None
    pose, keyframe = found.T_world_camera, found.keyframe
    if (
        there is not None
        and active is not None
        and keyframe.segment == active.segment.id
        and is_same_pose(there, pose, keyframe, active.points)
    ):
        return there, None
    return pose, found


class Located(NamedTuple):
    """T_world_camera of a frame.   is_firm: it has enough tracks to exclude a cut of the view."""

    T_world_camera: F64
    is_firm: bool


def localise(
    active: ActiveMap, motion: Motion, frame: IdealFrame, generator: np.random.Generator
) -> Located | None:
    """Return a frame's pose from the tracks of landmarks, or by searching landmarks in the image;
    None if both fail.

    Few tracks are no evidence by themselves: after a cut, those that continue on some extremum have
    all moved alike, as if by a camera.
    """
    parameters, tracks = active.parameters, frame.tracks
    predictions = motion.predictions(frame.stamp_ns)
    active.candidates_agree = True
    candidates = active.helping_candidates()
    linked = np.concatenate([active.linked(MAPPED), candidates])
    limits = parameters.localisation
    if len(linked) >= limits.min_inliers:
        rows, points_px = active.links.rows.take(linked), tracks.points_px.take(linked, 0)
        if frame.calibration.readout:
            rolled = active.segment.rolled(frame.calibration, motion.velocity)
            depths = active.segment.inverse_depths(rows, predictions[0])
            points_px = rolled.removed(points_px, depths)
        prior = motion.prior(active.camera)
        located = _by_tracks(active, predictions, prior, rows, points_px, candidates, generator)
        inliers = int(located.inliers.sum())
        of_points = int(located.inliers[: len(linked) - len(candidates)].sum())
        if of_points + _OF_CANDIDATE * (inliers - of_points) >= limits.min_inliers:
            # Candidates that help in one frame and not in the next were not lost in between.
            helped = len(candidates) and active.candidates_agree
            before = motion.tracked if helped else motion.to_points
            if not frame.has_image or inliers >= _FEW * before:
                return Located(located.T_world_camera, inliers >= _FIRM * before)
            proved = active.search_in(frame, generator).verify(
                located.T_world_camera, active.nearby(), MIN_AGREEMENT
            )
            if proved is not None:
                return Located(proved.T_world_camera, True)
    if not frame.has_image:
        return None
    search = active.search_in(frame, generator)
    recovered = search.recover(motion, frame.stamp_ns, active.nearby())
    return None if recovered is None else Located(recovered, True)


def _by_tracks(
    active: ActiveMap,
    predictions: list[F64],
    prior: PosePrior,
    rows: I32,
    points_px: F32,
    candidates: I64,
    generator: np.random.Generator,
) -> Localisation:
    """Return the pose that fits the tracks: landmarks come first and decide."""
    limits, mapped = active.parameters.localisation, len(rows) - len(candidates)

    def located(seen: Correspondences) -> Localisation:
        return locate(predictions, seen, active.camera, limits, generator)

    together = located(_correspondences(active, prior, rows, points_px, len(candidates)))
    still = together.inliers[:mapped].sum()
    if len(candidates) and mapped >= limits.min_inliers and still < _AGREEING * mapped:
        alone = located(_correspondences(active, prior, rows[:mapped], points_px[:mapped], 0))
        fitting = alone.inliers.sum()
        if fitting >= limits.min_inliers and still < _AGREEING * fitting:
            active.candidates_agree = False
            return alone
    return together


def to_global_shutter(
    active: ActiveMap, motion: Motion, frame: IdealFrame, T_world_camera: F64
) -> IdealFrame:
    """Return the frame at this pose with a global shutter.  motion: before it."""
    if not frame.calibration.readout:
        return frame
    velocity = motion.velocity_at(frame.number, T_world_camera)
    rolled = active.segment.rolled(frame.calibration, velocity)
    depths = active.segment.inverse_depths(active.links.rows, T_world_camera)
    return frame.to_global_shutter(rolled, depths)


def reacquire_points(
    active: ActiveMap, motion: Motion | None, frame: IdealFrame, T_world_camera: F64
) -> PlacedFrame:
    """Find landmarks without a track among the maxima, and refine the pose with them.

    motion: before the frame, which it converts to a global shutter.
    """
    prior = NO_PRIOR
    if motion is not None:
        frame = to_global_shutter(active, motion, frame, T_world_camera)
        prior = motion.prior(active.camera).unless_contradicted(T_world_camera)
    placed = PlacedFrame(frame=frame, T_world_camera=T_world_camera, prior=prior)
    points, parameters, tracks = active.points, active.parameters, frame.tracks
    reacquired = reacquire(
        T_world_camera, active.missing(frame.number), points, tracks.maxima,
        frame.given.extrema.maxima, frame.given.grey, active.camera, parameters.reacquisition,
    )  # fmt: skip
    found = active.take_over(reacquired, tracks)
    if frame.rolled is not None:
        depths = active.segment.inverse_depths(found.rows, T_world_camera)
        points_px, rolled_px = frame.rolled.found(found.points_px, depths)
        found = Observations(rows=found.rows, points_px=points_px, rolled_px=rolled_px)
    placed = refine_by_all(active, replace(placed, found=found))
    linked = active.linked(MAPPED)
    points.kappas[active.links.rows.take(linked)] = tracks.kappas.take(linked)
    return placed


def refine_by_all(active: ActiveMap, placed: PlacedFrame) -> PlacedFrame:
    """Refine the pose by its tracks and the landmarks found without one."""
    candidates = active.helping_candidates()
    rows, points_px = active.observed(placed, candidates)
    seen = _correspondences(active, placed.prior, rows, points_px, len(candidates))
    limits = active.parameters.localisation
    located = refine(placed.T_world_camera, seen, active.camera, limits, near=True)
    return replace(placed, T_world_camera=located.T_world_camera)


def rotation_by_image(active: ActiveMap, placed: PlacedFrame) -> tuple[F64, float]:
    """R_world_camera (3, 3) of a frame by its image, without the prior of its pose; and the
    variance of its largest error, rad^2."""
    candidates = active.helping_candidates()
    rows, points_px = active.observed(placed, candidates)
    some = np.arange(0, len(rows), max(1, len(rows) // _DECIDING))
    seen = _correspondences(
        active, NO_PRIOR, rows.take(some), points_px.take(some, 0), len(candidates)
    )
    bundle = BundleParameters(kernel_sigma_px=KERNEL_SIGMA_PX)
    found = refine_pose(placed.T_world_camera, seen, active.camera, bundle)
    H = found.information
    # Without any points nothing is known: the inverse is as large as numbers allow.
    covariance = np.linalg.inv(H + np.diag(_REGULAR * np.diag(H) + _REGULAR))
    return found.T_world_camera[:3, :3].copy(), float(np.linalg.norm(covariance[3:, 3:], 2))


def adjust(active: ActiveMap, motion: Motion, placed: PlacedFrame) -> PlacedFrame:
    """Adjust the window and this frame (Eq. 6).  motion: before it."""
    judge_tracks(active, placed)
    active.see(placed)
    if active.parameters.window.sweeps > 0 and not len(active.helping_candidates()):
        swept = active.window.sweep_current(active.parameters, placed.prior)
        placed = replace(placed, T_world_camera=swept)
    return supported(active, motion, placed)


def judge_tracks(active: ActiveMap, placed: PlacedFrame) -> None:
    """Unlink tracks from landmarks that they miss repeatedly."""
    linked, errors = _track_errors(active, placed)
    active.judge_tracks(linked, errors)


def _track_errors(active: ActiveMap, placed: PlacedFrame) -> tuple[I64, F32]:
    """Indices of the tracks of landmarks, and their reprojection errors in px."""
    linked = active.linked(MAPPED)
    xyz = active.points.xyz.take(active.links.rows.take(linked), 0)
    points_px = placed.frame.tracks.points_px.take(linked, 0)
    return linked, reprojection_errors(placed.T_world_camera, xyz, points_px, active.camera)


def supported(active: ActiveMap, motion: Motion, placed: PlacedFrame) -> PlacedFrame:
    """Return the frame with the quality of its pose.  motion: before it."""
    tracks = placed.frame.tracks
    settled = _settled(active, motion, tracks)
    settled[_contradicting(active, placed.T_world_camera, tracks.points_px)] = True
    return with_support(active, placed, tracks.points_px.compress(settled, 0))


def with_support(active: ActiveMap, placed: PlacedFrame, settled_px: F32) -> PlacedFrame:
    """Return the frame with its support.   settled_px: (N, 2) of tracks that should support it."""
    T_world_camera = placed.T_world_camera
    rows, points_px = active.observed(placed, active.helping_candidates())
    xyz = active.points.xyz.take(rows, 0)
    errors = reprojection_errors(T_world_camera, xyz, points_px, active.camera)
    inliers = errors < active.parameters.localisation.inlier_px
    tracked = len(rows) - len(placed.found.rows)
    support = support_of(points_px, inliers, tracked, settled_px, active.camera)
    return replace(placed, support=support)


def tracks_to_points(active: ActiveMap, placed: PlacedFrame) -> int:
    """Number of tracks that lead to landmarks at their predicted position."""
    _, errors = _track_errors(active, placed)
    return int(np.count_nonzero(errors < active.parameters.localisation.inlier_px))


def _settled(active: ActiveMap, motion: Motion, tracks: FrameTracks) -> BoolArray:
    """Which tracks (N,) had enough time and keyframes to become landmarks."""
    points, parameters = active.points, active.parameters
    rows = active.links.rows
    newest = active.keyframes[-1].id
    seen_by = np.where(rows != UNLINKED, newest + 1 - points.first_keyframe.take(rows), 0)
    old = tracks.ages * motion.interval_s() >= SETTLED_S
    return old & (seen_by >= parameters.point.min_observations)


def _contradicting(active: ActiveMap, T_world_camera: F64, points_px: F32) -> I64:
    """Indices of the tracks of candidates that no depth makes consistent with the pose."""
    points = active.points
    candidates = placed_candidates(points, active.links.rows)
    rows = active.links.rows.take(candidates)
    off = off_epipolar_line(
        T_world_camera, points.xyz.take(rows, 0), points.spread.take(rows, 0),
        points_px.take(candidates, 0), active.camera,
    )  # fmt: skip
    return candidates[off > _OFF * active.parameters.localisation.inlier_px]


def check_pure_rotation(active: ActiveMap, placed: PlacedFrame) -> PlacedFrame:
    """Whether the camera has only rotated since the last keyframe, with its pose in that case."""
    if active.segment.resumes:
        return placed  # its previous pose is unknown
    points, parameters = active.points, active.parameters
    candidates = placed_candidates(points, active.links.rows)
    rows, points_px = active.observed(placed, candidates)
    T_standing = placed.T_world_camera
    for every in (max(1, len(rows) // _DECIDING), 1):  # a few tracks reveal most motions
        some = np.arange(0, len(rows), every)
        seen = _correspondences(
            active, placed.prior, rows.take(some), points_px.take(some, 0), len(rows)
        )
        located = refine(
            placed.T_world_camera, seen, active.camera, parameters.localisation, near=True
        )
        if not located.is_pure_rotation:
            return placed
        T_standing = located.T_world_camera
    return replace(placed, T_world_camera=T_standing, is_pure_rotation=True)


def _correspondences(
    active: ActiveMap, prior: PosePrior, rows: I32, points_px: F32, candidates: int
) -> Correspondences:
    """Rows (N,) at points_px (N, 2).   candidates: how many of the rows are provisional."""
    spread = spread_of(active.points, rows, active.keyframes[-1]) if candidates else None
    return Correspondences(active.points.xyz.take(rows, 0), points_px, spread=spread, prior=prior)


def limits_of_points(inliers: int, parameters: MappingParameters) -> PointParameters:
    """Return the limits for new landmarks.

    In a frame with fewer landmarks than a start needs, two observations are enough: its few tracks
    may not survive to a third, and then the map ends.
    """
    if inliers >= parameters.start.min_points:
        return parameters.point
    return parameters.point.model_copy(update={"min_observations": 2})

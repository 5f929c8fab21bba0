"""The pose of a frame in the map, and whether what supports it is the world.

The pose comes from the tracks that the frame shares with the map, then from points that are found
again, then it is adjusted together with the window (VITAMIN-E section 3.2, Eq. 6).

A few dozen inliers always agree with some motion, and those of a large moving object agree well.
What does not belong to them shows it: parts of the image where tracks live on and no point of the
map is, or where no depth lets tracks be where the pose has them.  They are counted by area, so that
the texture of a thing does not decide how large it is.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, I64, U8, BoolArray
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.image.moved_image import MovedImage
from pliant.algorithms.mapping.active_map import ActiveMap
from pliant.algorithms.mapping.directions import (
    Spread,
    helping_candidates,
    off_epipolar_line,
    placed_candidates,
    spread_of,
)
from pliant.algorithms.mapping.localisation import (
    Localisation,
    Motion,
    locate,
    prove,
    recover,
    refine,
)
from pliant.algorithms.mapping.map_store import MAPPED, UNLINKED, Observations
from pliant.algorithms.mapping.observation_table import reprojection_errors
from pliant.algorithms.mapping.parameters import (
    MappingParameters,
    PointParameters,
    SupportParameters,
)
from pliant.algorithms.mapping.reacquisition import reacquire
from pliant.algorithms.mapping.rolling_shutter import RolledFrame
from pliant.algorithms.mapping.self_calibration import SelfCalibration
from pliant.algorithms.tracks import FrameExtrema, FrameTracks
from pliant.compiler.kernel import kernel

_AGREEING = 0.5
"""Share of the points of the map that place a frame alone and still fit once candidates help: with
fewer, what these are on moves by itself."""

_OF_DIRECTION = 0.5
"""Inliers that a direction which fits counts as: any depth will do, so it tells one coordinate of
its pixel, not two."""

_OFF = 2.0
"""Of the error of an inlier: a track that is farther from its epipolar line contradicts a pose."""

_TELLING = 500
"""Points at the least that tell whether a camera stands where it stood."""

_FEW, _FIRM = 0.05, 0.2
"""Of the tracks that led to the last frame: where a film is cut, 0.3 to 2 % agree on a pose by
chance, and 9 % where the views overlap; the fastest turns with blur leave 11 to 20 %."""

_COLUMNS, _LINES = 8, 6
"""Cells of the image: each is for a pose, against it, or shows too little."""

_LEAST_SEEN = 5
"""Tracks without which a cell says nothing."""

_AGAINST = 0.2
"""A cell is against a pose with fewer inliers than this share of its tracks."""


class Located(NamedTuple):
    """T_world_camera of a frame.   is_firm: so much leads there that the view has not been cut."""

    T_world_camera: F64
    is_firm: bool


@dataclass(frozen=True, kw_only=True)
class Support:
    """What there is for a pose.

    inliers: points where the pose shows them.   tracked: those that tracks lead on to the next
    frame.   share: of the points seen.   contrary: share of the
    cells with tracks in which hardly any point is where the pose shows it.   spread: standard
    deviation of the inliers as a share of width or height, whichever is less.
    """

    inliers: int
    tracked: int
    share: float
    contrary: float
    spread: float


def directions_of(active: ActiveMap) -> I64:
    """Indices of the tracks of candidates that help to place the frame."""
    directions = helping_candidates(active.points, active.links.rows)
    return directions if active.candidates_agree else directions[:0]


def localise(
    active: ActiveMap,
    calibration: SelfCalibration,
    motion: Motion,
    stamp_ns: int,
    seen: FrameExtrema,
    image: MovedImage | None,
    generator: np.random.Generator,
) -> Located | None:
    """The frame from the tracks of mapped points, or else from the map's points in the image; None
    where both fail.

    Few tracks prove nothing by themselves: where the view changes at once, those that some extremum
    carries on have all been moved alike, as if by a camera.
    """
    points, parameters = active.points, active.parameters
    predictions = motion.predictions(stamp_ns)
    active.candidates_agree = True
    directions = directions_of(active)
    linked = np.concatenate([active.linked(MAPPED), directions])
    limits = parameters.localisation
    if len(linked) >= limits.min_inliers:
        rows, points_px = active.links.rows[linked], seen.points_px[linked]
        if calibration.readout:
            rolled = active.segment.rolled(calibration, motion.velocity())
            depths = active.segment.inverse_depths(rows, predictions[0])
            points_px = points_px - rolled.shifts(points_px, depths)
        located = _by_tracks(active, predictions, rows, points_px, directions, generator)
        inliers = int(located.inliers.sum())
        of_points = int(located.inliers[: len(linked) - len(directions)].sum())
        if of_points + _OF_DIRECTION * (inliers - of_points) >= limits.min_inliers:
            # What helps in one frame and not in the next has not been lost in between.
            helped = len(directions) and active.candidates_agree
            before = motion.tracked if helped else motion.to_points
            if image is None or inliers >= _FEW * before:
                return Located(located.T_world_camera, inliers >= _FIRM * before)
            proved = prove(
                located.T_world_camera, active.nearby(), points, seen.maxima, image.whole,
                active.camera, parameters, parameters.recovery.min_agreement,
            )  # fmt: skip
            if proved is not None:
                return Located(proved.T_world_camera, True)
    if image is None:
        return None
    recovered = recover(
        motion, stamp_ns, active.nearby(), points, seen.maxima, image.whole, active.camera,
        parameters, generator,
    )  # fmt: skip
    return None if recovered is None else Located(recovered, True)


def _by_tracks(
    active: ActiveMap,
    predictions: list[F64],
    rows: I32,
    points_px: F32,
    directions: I64,
    generator: np.random.Generator,
) -> Localisation:
    """The pose that tracks tell: those of points, which come first, have the last word."""
    limits, mapped = active.parameters.localisation, len(rows) - len(directions)

    def located(count: int, spread: Spread | None) -> Localisation:
        return locate(
            predictions, active.points.xyz[rows[:count]], points_px[:count], active.camera, limits,
            generator, spread,
        )  # fmt: skip

    together = located(len(rows), _spread(active, rows, directions))
    still = together.inliers[:mapped].sum()
    if len(directions) and mapped >= limits.min_inliers and still < _AGREEING * mapped:
        alone = located(mapped, None)
        fitting = alone.inliers.sum()
        if fitting >= limits.min_inliers and still < _AGREEING * fitting:
            active.candidates_agree = False
            return alone
    return together


def at_once(
    active: ActiveMap,
    calibration: SelfCalibration,
    T_world_camera: F64,
    motion: F64,
    seen: FrameExtrema,
) -> tuple[FrameExtrema, RolledFrame]:
    """The tracks of a frame with this pose and motion (6,), had it been taken at once."""
    rolled = active.segment.rolled(calibration, motion)
    depths = active.segment.inverse_depths(active.links.rows, T_world_camera)
    maxima = seen.maxima.copy()
    maxima[:, :2] -= rolled.shifts(np.ascontiguousarray(maxima[:, :2]))
    points_px = seen.points_px - rolled.shifts(seen.points_px, depths)
    return replace(seen, points_px=points_px, maxima=maxima), rolled


def reacquire_points(
    active: ActiveMap,
    frame: int,
    T_world_camera: F64,
    tracks: FrameExtrema,
    seen: F32,
    grey: U8 | None,
    rolled: RolledFrame | None,
) -> tuple[F64, Observations]:
    """Find points without a track among the maxima, and refine the pose with them.

    seen: (M, 3) maxima of the tracks where grey shows them, see ``reacquire``.
    """
    points, parameters = active.points, active.parameters
    if not parameters.reacquisition.enabled:
        return T_world_camera, Observations.none()
    reacquired = reacquire(
        T_world_camera, active.missing(frame), points, tracks.maxima, seen, grey, active.camera,
        parameters.reacquisition,
    )  # fmt: skip
    found = active.take_over(reacquired, tracks)
    if rolled is not None:
        depths = active.segment.inverse_depths(found.rows, T_world_camera)
        points_px, rolled_px = rolled.found(found.points_px, depths)
        found = Observations(rows=found.rows, points_px=points_px, rolled_px=rolled_px)
    T_world_camera = refine_by_all(active, T_world_camera, tracks, found)
    linked = active.linked(MAPPED)
    points.kappas[active.links.rows[linked]] = tracks.kappas[linked]
    return T_world_camera, found


def refine_by_all(
    active: ActiveMap, T_world_camera: F64, tracks: FrameTracks, found: Observations
) -> F64:
    """The pose by its tracks and the points found without one, from close by."""
    directions = directions_of(active)
    rows, points_px = active.observed(tracks.points_px, found, directions)
    return refine(
        T_world_camera, active.points.xyz[rows], points_px, active.camera,
        active.parameters.localisation, near=True, spread=_spread(active, rows, directions),
    ).T_world_camera  # fmt: skip


def adjust(
    active: ActiveMap,
    motion: Motion,
    T_world_camera: F64,
    found: Observations,
    tracks: FrameTracks,
) -> tuple[F64, Support]:
    """Eq. 6 over the window and this frame.  Returns its pose, and what there is for it."""
    points, parameters, camera = active.points, active.parameters, active.camera
    linked = active.linked(MAPPED)
    xyz = points.xyz[active.links.rows[linked]]
    errors = reprojection_errors(T_world_camera, xyz, tracks.points_px[linked], camera)
    active.judge_tracks(linked, errors)
    active.see(T_world_camera, tracks.points_px, found)
    if parameters.window.sweeps > 0 and not len(directions_of(active)):
        T_world_camera = active.window.sweep_current(parameters)
    return T_world_camera, support_at(active, motion, T_world_camera, found, tracks)


def support_at(
    active: ActiveMap,
    motion: Motion,
    T_world_camera: F64,
    found: Observations,
    tracks: FrameTracks,
) -> Support:
    """What there is for a pose of the frame.  motion: before it."""
    rows, points_px = active.observed(tracks.points_px, found, directions_of(active))
    errors = reprojection_errors(T_world_camera, active.points.xyz[rows], points_px, active.camera)
    inliers = errors < active.parameters.localisation.inlier_px
    telling = _settled(active, motion, tracks)
    telling[_contradicting(active, T_world_camera, tracks.points_px)] = True
    tracked = len(rows) - len(found.rows)
    return support_of(points_px, inliers, tracked, tracks.points_px[telling], active.camera)


def tracks_to_points(active: ActiveMap, T_world_camera: F64, tracks: FrameTracks) -> int:
    """How many tracks lead on to points of the map that are where the pose has them."""
    linked = active.linked(MAPPED)
    xyz = active.points.xyz[active.links.rows[linked]]
    errors = reprojection_errors(T_world_camera, xyz, tracks.points_px[linked], active.camera)
    return int(np.count_nonzero(errors < active.parameters.localisation.inlier_px))


def _settled(active: ActiveMap, motion: Motion, tracks: FrameTracks) -> BoolArray:
    """Which tracks (N,) had time to become points, and keyframes enough that saw them."""
    points, parameters = active.points, active.parameters
    rows = active.links.rows
    newest = active.keyframes[-1].id
    seen_by = np.where(rows != UNLINKED, newest + 1 - points.first_keyframe[rows], 0)
    old = tracks.ages * motion.interval_s() >= parameters.support.settled_s
    return old & (seen_by >= parameters.point.min_observations)


def _contradicting(active: ActiveMap, T_world_camera: F64, points_px: F32) -> I64:
    """Indices of the tracks of candidates that are where the pose has them at no depth."""
    points = active.points
    candidates = placed_candidates(points, active.links.rows)
    rows = active.links.rows[candidates]
    off = off_epipolar_line(
        T_world_camera, points.xyz[rows], points.spread[rows], points_px[candidates], active.camera
    )
    return candidates[off > _OFF * active.parameters.localisation.inlier_px]


def image_of_tracks(
    calibration: SelfCalibration, rolled: RolledFrame | None, pixels: U8 | None
) -> MovedImage | None:
    """A rectified image (H, W) or (H, W, 3) with all of it where the tracks of the frame are, which
    are of the camera found so far.   rolled: and have been taken ``at_once``."""
    if pixels is None:
        return None
    return MovedImage(pixels, calibration.frame_view.move if rolled is None else rolled.places)


def stand(
    active: ActiveMap, T_world_camera: F64, found: Observations, tracks: FrameTracks
) -> tuple[F64, bool]:
    """Whether the frame stands where the last keyframe does, and its pose then."""
    if active.segment.resumes:
        return T_world_camera, False  # nobody knows where it was before
    points, parameters = active.points, active.parameters
    candidates = placed_candidates(points, active.links.rows)
    rows, points_px = active.observed(tracks.points_px, found, candidates)
    T_standing = T_world_camera
    for every in (max(1, len(rows) // _TELLING), 1):  # a few tell of most that they moved
        some = np.arange(0, len(rows), every)
        located = refine(
            T_world_camera, points.xyz[rows[some]], points_px[some], active.camera,
            parameters.localisation, near=True,
            spread=spread_of(points, rows[some], active.keyframes[-1]),
        )  # fmt: skip
        if not located.stands:
            return T_world_camera, False
        T_standing = located.T_world_camera
    return T_standing, True


def _spread(active: ActiveMap, rows: I32, directions: I64) -> Spread | None:
    return spread_of(active.points, rows, active.keyframes[-1]) if len(directions) else None


def limits_of_points(inliers: int, parameters: MappingParameters) -> PointParameters:
    """Of a frame that sees fewer points than a map starts with, two observations make one: what few
    tracks there are may not live to a third, and then the map ends."""
    if inliers >= parameters.start.min_points:
        return parameters.point
    return parameters.point.model_copy(update={"min_observations": 2})


def support_of(
    points_px: F32, inliers: BoolArray, tracked: int, telling_px: F32, camera: PinholeCamera
) -> Support:
    """points_px: (N, 2) of the points seen, of which ``inliers`` (N,) fit.   tracked: so many, the
    first, have tracks.   telling_px: (M, 2) of the tracks that belong to points if the pose is
    right, or contradict it.
    """
    count = int(np.count_nonzero(inliers))
    fitting = points_px[inliers]
    width, height = camera.width, camera.height
    supported, tracks = _per_cell(fitting, width, height), _per_cell(telling_px, width, height)
    telling = tracks >= _LEAST_SEEN
    size = np.array([width, height])
    return Support(
        inliers=count,
        tracked=int(np.count_nonzero(inliers[:tracked])),
        share=count / max(len(points_px), 1),
        contrary=float((supported < _AGAINST * tracks)[telling].mean()) if telling.any() else 0.0,
        spread=float(np.min(fitting.std(axis=0) / size)) if count else 0.0,
    )


def doubt(support: Support, parameters: SupportParameters) -> str:
    """Why the pose may not be that of the camera in the world; "" where nothing speaks for it."""
    if support.contrary > parameters.max_contrary_share:
        return f"doubtful: {support.contrary:.0%} of the image moves otherwise"
    if support.share < parameters.min_share:
        return f"doubtful: {support.share:.0%} of the points seen are where the pose has them"
    if support.spread < parameters.min_spread:
        return "doubtful: all that is seen of the map lies in one place of the image"
    return ""


@kernel
def _per_cell(points_px: F32, width: int, height: int) -> I64:
    counts = np.zeros(_COLUMNS * _LINES, np.int64)
    for i in range(points_px.shape[0]):
        column = min(max(int(points_px[i, 0] * _COLUMNS / width), 0), _COLUMNS - 1)
        line = min(max(int(points_px[i, 1] * _LINES / height), 0), _LINES - 1)
        counts[line * _COLUMNS + column] += 1
    return counts

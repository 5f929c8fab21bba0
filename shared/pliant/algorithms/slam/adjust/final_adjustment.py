"""The final adjustment of a segment: all its keyframes together, and the calibration.

Everything works on a list of observations, so time and memory grow with their number.
"""

from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, I64, BoolArray
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import inverse, matrix_to_pose
from pliant.algorithms.map_delta import MapMoves
from pliant.algorithms.slam.adjust.inertial_adjustment import (
    Coupling,
    CouplingOutcome,
    TimedSamples,
    with_samples,
)
from pliant.algorithms.slam.adjust.second_start import (
    SampledFrames,
    SecondMap,
    SecondPose,
    Sightings,
    second_map,
)
from pliant.algorithms.slam.calibration.changing_focal import evidence_of_change, gaps_s, walk_from
from pliant.algorithms.slam.calibration.corrected_view import CorrectedView, moved_px
from pliant.algorithms.slam.calibration.focal_search import best_along_focal
from pliant.algorithms.slam.calibration.held_unknowns import PRINCIPAL_POINT, contradicted, freed
from pliant.algorithms.slam.calibration.rolling_shutter import readout_flow
from pliant.algorithms.slam.calibration.self_calibration import SelfCalibration
from pliant.algorithms.slam.estimate.observation_table import list_errors
from pliant.algorithms.slam.estimate.problem import BundleProblem, BundleResult, shared_intrinsics
from pliant.algorithms.slam.estimate.schur import solve_schur
from pliant.algorithms.slam.estimate.triangulation import spread_of_rays
from pliant.algorithms.slam.locate.inverse_depth import at_infinity
from pliant.algorithms.slam.map.keyframe import Keyframe
from pliant.algorithms.slam.map.landmarks import MAPPED, Landmarks
from pliant.algorithms.slam.parameters import MappingParameters
from pliant.compiler.kernel import kernel

_CHUNK = 4096
"""Landmarks whose rays are compared at a time: bounds a dense table of keyframes x landmarks."""

MOST_SEEN = 32
"""Maximum keyframes that determine a landmark.  Time grows with the square of their number, for
instance in a room that is seen again and again, and 32 are as accurate as necessary.
"""

_MIN_DEPTH = 1e-6


@dataclass(kw_only=True)
class ObservationList:
    """The observations of all keyframes, keyframe by keyframe, and the state of both.

    rows: (N,) of the landmarks.     xyz: (N, 3).     T_world_camera: (M, 4, 4).
    camera, point: (O,) of each observation.    px: (O, 2).   weights: (O,).   flow: (O, 2) px.
    log_focal: (M,) and gaps_s: (M - 1,) of the keyframes, see ``changing_focal``.
    """

    rows: I32
    xyz: F64
    T_world_camera: F64
    camera: I32
    point: I32
    px: F32
    weights: F32
    fixed: BoolArray
    flow: F32 | None = None
    log_focal: F64 = field(default_factory=lambda: np.zeros(0))
    gaps_s: F64 = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        if not len(self.log_focal):
            self.log_focal = np.zeros(len(self.T_world_camera))
            self.gaps_s = np.full(max(len(self.T_world_camera) - 1, 0), np.inf)

    def see_by(self, view: CorrectedView) -> None:
        """Convert the pixels from a view's ideal camera to the image."""
        self.px = view.magnified(view.seen(self.px), self.log_focal[self.camera])

    def most_seen(self, per_keyframe: int) -> "ObservationList":
        """Return the problem with the fewest landmarks, the most observed first, that leave each
        keyframe this many, or all that another keyframe observes too.
        """
        counts = np.bincount(self.point, minlength=len(self.rows))
        order = np.argsort(-counts, kind="stable")[: np.count_nonzero(counts >= 2)]
        chosen = _enough(
            self.camera, self.point, counts, order, len(self.T_world_camera), per_keyframe
        )
        number = np.cumsum(chosen, dtype=np.int32) - 1
        kept = chosen[self.point]
        return replace(
            self,
            rows=self.rows[chosen],
            xyz=self.xyz.compress(chosen, 0),
            camera=self.camera[kept],
            point=number[self.point[kept]],
            px=self.px.compress(kept, 0),
            weights=self.weights[kept],
            flow=None if self.flow is None else self.flow[kept],
        )

    def depths(self) -> F64:
        """(O,) depth of each observed landmark in the camera that observes it."""
        return _depths(self.T_world_camera, self.xyz, self.camera, self.point)

    def scales(self, before: F64) -> F64:
        """(M,) median growth of the depths in each keyframe.

        before: (O,) depths.
        """
        after = self.depths()
        usable = (before > _MIN_DEPTH) & (after > _MIN_DEPTH)
        return self.medians(after[usable] / before[usable], self.camera[usable])

    def medians(self, values: F64, camera: I32) -> F64:
        """(M,) median of each keyframe's values; 1 without values.

        values: (n,).   camera: (n,) keyframe of each value, ascending.
        """
        ends = np.searchsorted(camera, np.arange(len(self.T_world_camera) + 1))
        medians = np.ones(len(self.T_world_camera))
        for slot in range(len(medians)):
            some = values[ends[slot] : ends[slot + 1]]
            if len(some):
                medians[slot] = np.median(some)
        return medians


@kernel
def _depths(T_world_camera: F64, xyz: F64, camera: I32, point: I32) -> F64:
    depths = np.empty(camera.size)
    for o in range(camera.size):
        T, X = T_world_camera[camera[o]], xyz[point[o]]
        x, y, z = X[0] - T[0, 3], X[1] - T[1, 3], X[2] - T[2, 3]
        depths[o] = x * T[0, 2] + y * T[1, 2] + z * T[2, 2]
    return depths


@kernel
def _enough(
    camera: I32, point: I32, counts: I64, order: I64, cameras: int, per_camera: int
) -> BoolArray:
    """(N,) whether a landmark is chosen: in the given order, if one of its cameras has too few so
    far.

    counts: (N,) observations of each.
    """
    ends = np.cumsum(counts)
    at = ends - counts
    seen_by = np.empty(point.size, np.int32)
    for o in range(point.size):
        seen_by[at[point[o]]] = camera[o]
        at[point[o]] += 1
    chosen = np.zeros(counts.size, np.bool_)
    have = np.zeros(cameras, np.int64)
    for n in order:
        sees = seen_by[ends[n] - counts[n] : ends[n]]
        for m in sees:
            chosen[n] |= have[m] < per_camera
        if chosen[n]:
            for m in sees:
                have[m] += 1
    return chosen


def moves_between(keyframe_ids: I64, before: F64, after: F64, scales: F64) -> MapMoves:
    """Return how the map around keyframes (M,) moves: from poses (M, 4, 4) to others, and by the
    scales (M,) about them.
    """
    moved = after @ inverse(before)
    turned = (moved[:, :3, :3] @ before[:, :3, 3, None])[:, :, 0]
    moved[:, :3, 3] = after[:, :3, 3] - scales[:, None] * turned
    moves = np.column_stack([matrix_to_pose(moved), scales])
    return MapMoves(keyframe_ids=keyframe_ids, moves=moves)


def adjust_keyframes(
    keyframes: list[Keyframe],
    points: Landmarks,
    known: SelfCalibration,
    parameters: MappingParameters,
    motions: F64,
    timed: TimedSamples | None = None,
    sampled: SampledFrames | None = None,
) -> tuple[SelfCalibration, I32, MapMoves, list[SecondPose]]:
    """Adjust all but the first keyframe, their landmarks and the calibration by Schur LM.

    Outlying observations are removed, and the landmarks' statistics updated.  The keyframes' pixels
    become those of the estimated camera, except for the readout.
    known: of the camera, whose pixels the keyframes have.    motions: (M, 6) of the keyframes, see
    ``FramePoses``.    timed: inertial samples.    sampled: tracks of all frames, which may show a
    better map from a second start.    Returns the new calibration, the rows of landmarks that are
    at infinity or seen by too few keyframes, how the map around each keyframe moves, and new poses
    of other frames, which a second start has.
    """
    given, before = known, known.view
    seen = list_observations(keyframes, points, known)
    seen.see_by(before)
    if known.uncertainty.sigmas.any():
        seen.flow = readout_flow(
            seen.T_world_camera, motions, seen.xyz, seen.camera, seen.point, seen.px, before.camera
        )
    iterations = parameters.window.final_iterations
    poses, depths = seen.T_world_camera.copy(), seen.depths()
    found = adjust_list(
        seen, known, parameters, iterations=iterations, start=known.correction, varying=True,
        timed=timed,
    )  # fmt: skip
    known = known.corrected(found.correction, found.covariance, len(keyframes))
    known = replace(known, changes=bool(len(found.log_focal)), log_focal=float(seen.log_focal[-1]))
    second = None
    if sampled is not None and timed is None:
        second = _second_start(seen, sampled, known, parameters)
    if second is not None:
        known = known.corrected(second.correction, second.covariance, len(keyframes))
        known = replace(known, changes=False, log_focal=0.0)
        _take_over(seen, second, before)
    view = known.view
    ids = np.array([keyframe.id for keyframe in keyframes], np.int64)
    moves = moves_between(ids, poses, seen.T_world_camera, seen.scales(depths))
    if seen.flow is not None:
        seen.px = seen.px - (known.correction[3] * seen.flow).astype(np.float32)
    seen.px = view.pixels(view.magnified(seen.px, -seen.log_focal[seen.camera]))
    points.move_to(seen.rows, seen.xyz)
    for slot, keyframe in enumerate(keyframes):
        keyframe.T_world_camera = seen.T_world_camera[slot]
    good = _forget_outliers(seen, keyframes, points, view.camera, parameters.window.outlier_px)
    count = np.bincount(seen.point[good], minlength=len(seen.rows))
    _update_statistics(seen, good, count, points, view.camera)
    for slot, keyframe in enumerate(keyframes):
        was, keyframe.log_focal = keyframe.log_focal, float(seen.log_focal[slot])
        keyframe.points_px = moved_px(
            keyframe.points_px + keyframe.rolled_px,
            given.view_at(was), known.view_at(keyframe.log_focal),
        )  # fmt: skip
        keyframe.rolled_px = np.zeros_like(keyframe.points_px)
    far = at_infinity(seen.xyz, keyframes[0].T_world_camera[:3, 3])
    frames = [] if second is None else second.frames
    return known, seen.rows[(count < 2) | far], moves, frames


def _second_start(
    seen: ObservationList, sampled: SampledFrames, known: SelfCalibration,
    parameters: MappingParameters,
) -> SecondMap | None:  # fmt: skip
    counts = np.bincount(seen.point, minlength=len(seen.rows))
    kept = _spread_out(seen.point, counts, MOST_SEEN)
    landmarks = Sightings(
        camera=sampled.keyframes[seen.camera[kept]].astype(np.int32), point=seen.point[kept],
        px=seen.px.compress(kept, 0), weights=seen.weights[kept], points=len(seen.rows),
    )  # fmt: skip
    depth = float(np.median(seen.medians(seen.depths(), seen.camera)))
    return second_map(
        sampled, seen.T_world_camera, seen.xyz, landmarks, known, parameters.bundle, depth,
        seen.log_focal,
    )  # fmt: skip


def _take_over(seen: ObservationList, second: SecondMap, view: CorrectedView) -> None:
    seen.T_world_camera, seen.xyz = second.T_world_camera, second.xyz
    seen.log_focal = 0.0 * seen.log_focal
    if seen.flow is not None:
        seen.flow = readout_flow(
            seen.T_world_camera, second.motions, seen.xyz, seen.camera, seen.point, seen.px,
            view.camera,
        )  # fmt: skip


def adjust_list(
    seen: ObservationList,
    known: SelfCalibration,
    parameters: MappingParameters,
    *,
    iterations: int,
    start: F64,
    varying: bool = False,
    timed: TimedSamples | None = None,
) -> BundleResult:
    """Adjust all but the first keyframe, all landmarks of two keyframes, and the calibration.

    ``seen`` is changed, except for its observations, which are pixels of the rectified image.
    known: of the camera.   start: (SHARED,) initial correction of the calibration.   varying: the
    focal length may change between keyframes, see ``changing_focal``.   timed: inertial samples,
    which are used where that length does not change.
    """
    counts = np.bincount(seen.point, minlength=len(seen.rows))
    chosen = counts >= 2
    bundle = parameters.bundle.model_copy(update={"max_iterations": iterations})
    uncertainty = known.prior(start) if known.uncertainty.sigmas.any() else None
    kept = chosen[seen.point] & _spread_out(seen.point, counts, MOST_SEEN)
    problem = _problem(seen, chosen, kept, known.given)
    if uncertainty is not None and known.is_guess:
        problem, start = best_along_focal(problem, bundle, uncertainty, start)
    solve = partial(
        solve_schur, problem, bundle, uncertainty=uncertainty, start=start, with_covariance=True,
        doubled=True,
    )  # fmt: skip
    found = solve()
    if varying and uncertainty is not None:
        if wrong := contradicted(problem, found, bundle, uncertainty):
            uncertainty = freed(uncertainty, *wrong)
            found = solve(uncertainty=uncertainty, start=found.correction)
        evidence = evidence_of_change(problem, found, bundle, uncertainty, seen.gaps_s)
        if known.changes or evidence.calls_for_more:
            wide = freed(uncertainty, PRINCIPAL_POINT)
            other = solve(walk=walk_from(seen.log_focal, seen.gaps_s), uncertainty=wide)
            confirmed = evidence.confirmed_by(other.log_focal, known=known.changes)
            found = other if confirmed else found
    if timed is not None and uncertainty is not None and not len(found.log_focal):
        found = with_samples(problem, found, bundle, uncertainty, timed)
    elif timed is not None:
        fixed, changes = CouplingOutcome.CALIBRATION_FIXED, CouplingOutcome.FOCAL_CHANGES
        outcome = fixed if uncertainty is None else changes
        timed.outcomes.append(Coupling(outcome=outcome, keyframes=len(seen.T_world_camera)))
    if varying:
        seen.log_focal = found.log_focal if len(found.log_focal) else 0.0 * seen.log_focal
    seen.xyz[chosen] = found.points_world
    seen.T_world_camera = found.T_world_camera
    return found


def list_observations(
    keyframes: list[Keyframe], points: Landmarks, known: SelfCalibration
) -> ObservationList:
    """px: as the rolling shutter recorded them.   known: of the camera, whose pixels the keyframes
    have.
    """
    mapped = [points.state[keyframe.rows] == MAPPED for keyframe in keyframes]
    pairs = list(zip(keyframes, mapped, strict=True))
    listed = [k.rows[each] for k, each in pairs]
    px = np.concatenate([(k.points_px + k.rolled_px).compress(each, 0) for k, each in pairs])
    sizes = np.array([len(rows) for rows in listed])
    seen = np.concatenate(listed)
    number = np.zeros(len(points.state), np.int32)
    number[seen] = 1
    rows = np.flatnonzero(number).astype(np.int32)
    # Oldest first: this order decides between landmarks with equally many observations.
    order = np.argsort(points.first_keyframe[rows], kind="stable")
    rows = rows[order]
    number[rows] = np.arange(len(rows), dtype=np.int32)
    return ObservationList(
        rows=rows,
        xyz=points.xyz.take(rows, 0),
        T_world_camera=np.array([keyframe.T_world_camera for keyframe in keyframes]),
        camera=np.repeat(np.arange(len(keyframes), dtype=np.int32), sizes),
        point=number[seen],
        px=px,
        weights=known.weights(px, estimates_k1=True),
        fixed=np.array([k.is_pure_rotation for k in keyframes]) | (np.arange(len(keyframes)) == 0),
        log_focal=np.array([keyframe.log_focal for keyframe in keyframes]),
        gaps_s=gaps_s(keyframes),
    )


@kernel
def _spread_out(point: I32, counts: I64, most: int) -> BoolArray:
    """(O,) whether an observation takes part: at most this many of each landmark, from all of the
    time that it was seen.   counts: (N,) observations of each.
    """
    kept = np.ones(point.size, np.bool_)
    rank = np.zeros(counts.size, np.int64)
    for o in range(point.size):
        n = counts[point[o]]
        if n > most:
            at = most * rank[point[o]] + point[o] % n  # different keyframes for different landmarks
            kept[o] = at // n != (at - most) // n
            rank[point[o]] += 1
    return kept


def _problem(
    seen: ObservationList, chosen: BoolArray, kept: BoolArray, camera: PinholeCamera
) -> BundleProblem:
    """Return the problem of the chosen landmarks and kept observations; the first keyframe is
    fixed.
    """
    number = np.cumsum(chosen, dtype=np.int32) - 1
    M = len(seen.T_world_camera)
    return BundleProblem(
        T_world_camera=seen.T_world_camera,
        points_world=seen.xyz.compress(chosen, 0),
        camera_index=seen.camera[kept],
        point_index=number[seen.point[kept]].astype(np.int32),
        points_px=seen.px.compress(kept, 0),
        intrinsics=shared_intrinsics(camera, M),
        fixed_cameras=seen.fixed,
        weights=seen.weights[kept],
        readout_flow=None if seen.flow is None else seen.flow[kept],
    )


def _forget_outliers(
    seen: ObservationList,
    keyframes: list[Keyframe],
    points: Landmarks,
    camera: PinholeCamera,
    outlier_px: float,
) -> BoolArray:
    """(O,) mask of the inliers; the keyframes forget the other observations."""
    errors = list_errors(seen.T_world_camera, seen.xyz, seen.camera, seen.point, seen.px, camera)
    good = errors <= outlier_px
    ends = np.cumsum(np.bincount(seen.camera, minlength=len(keyframes)))
    for slot, keyframe in enumerate(keyframes):
        keep = np.ones(len(keyframe.rows), np.bool_)
        mapped = points.state[keyframe.rows] == MAPPED
        keep[mapped] = good[ends[slot - 1] if slot else 0 : ends[slot]]
        keyframe.keep(keep)
    return good


def _update_statistics(
    seen: ObservationList, good: BoolArray, count: I64, points: Landmarks, camera: PinholeCamera
) -> None:
    """Update observations, parallax and uncertainty of the landmarks, as ``MapDelta``
    defines them.
    """
    rows, N = seen.rows, len(seen.rows)
    points.base_keyframes[rows], points.base_parallax_rad[rows] = 0, 0.0
    points.keyframes[rows] = count
    order = np.flatnonzero(good)
    order = order[np.argsort(seen.point[order], kind="stable")]
    ends = np.cumsum(count)
    for lo in range(0, N, _CHUNK):
        hi = min(lo + _CHUNK, N)
        some = order[(ends[lo - 1] if lo else 0) : ends[hi - 1]]
        # Only the keyframes that see some of them: all would be quadratic in the map's length.
        cameras, slots = np.unique(seen.camera[some], return_inverse=True)
        table = np.zeros((len(cameras), hi - lo), np.bool_)
        table[slots, seen.point[some] - lo] = True
        parallax, sigmas = spread_of_rays(
            seen.T_world_camera[cameras],
            table,
            np.arange(hi - lo),
            seen.xyz[lo:hi],
            focal_px=camera.fx,
        )
        points.parallax_rad[rows[lo:hi]] = parallax
        known = np.isfinite(sigmas)
        points.sigmas[rows[lo:hi][known]] = sigmas[known]
        rest = rows[lo:hi][~known]
        points.sigmas[rest] = np.maximum(points.sigmas[rest], 1e-3)

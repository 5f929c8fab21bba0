"""The final adjustment of a segment whose camera turns in one place, from a second start.

A camera on a head or a hand is ahead of the joint that turns it, by an arm a.  A turn by a small
angle t moves a point at depth z by ``f t (1 + a / z)`` px, and so does another focal length without
an arm.  Only differences of depth and large angles separate the two.  So a map that started with a
wrong motion stays in a local minimum, with a wrong focal length and readout.

The observations of keyframes alone have this minimum from every start: those that contradict the
map were removed, and few tracks reach the next keyframe.  So the sample of tracks in all frames
(``track_sample``) takes part: one adjustment of all landmarks and tracks, with all frames as
cameras, from two starts:

- the map as it is, with its calibration, and the changes of its focal length, if any;
- its rotations with the camera at the end of an arm along its axis, all points at the median depth,
  and the given calibration.

The kernel narrows, so that either converges from afar.  The second map replaces that of the run if
its cost is lower, and if the tracks prefer it beyond chance.  Landmarks do not count there, as the
map has chosen their observations.

The test is that of Vuong (1989, Likelihood ratio tests for model selection and non-nested
hypotheses, Theorem 5.1): the difference of the costs relative to its standard deviation.  Both maps
have the same unknowns.  Errors of a track are alike, and so are those of a frame.  So the variance
is that of sums over tracks plus that of sums over frames, less that of single observations
(Cameron, Gelbach and Miller 2011, Robust inference with multiway clustering, section 2).
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, I64
from pliant.algorithms.slam.adjust.track_sample import SampledTracks, turns_in_place
from pliant.algorithms.slam.calibration.rolling_shutter import motion_between, readout_flow
from pliant.algorithms.slam.calibration.self_calibration import SelfCalibration
from pliant.algorithms.slam.estimate.problem import (
    SHARED,
    BundleParameters,
    BundleProblem,
    BundleResult,
    CalibrationUncertainty,
    shared_intrinsics,
)
from pliant.algorithms.slam.estimate.schur import solve_schur

_ARM = 1 / 7
"""Length of the arm of the second start, as a share of the median depth."""

_WIDTHS = ((8.0, 15), (4.0, 15), (2.0, 15), (1.0, 20), (1.0, 30))
"""Multiples of the kernel's width, and maximum iterations with each.  The rolling shutter's flow is
computed again for each, and points behind a camera, which would stay there, return to the median
depth.
"""

_FIRST = 3
"""One in this many sampled tracks makes a first test: both starts by tracks alone, in a quarter of
the time.  Ordinary maps end there: all tracks together would hardly be certain.
"""

_CERTAIN = 3.0
"""Significance of the preference, in standard deviations: by chance one of 740 maps that are
equally good.
"""


class SampledFrames(NamedTuple):
    """Frames of a segment with M keyframes, and the sample of their tracks.

    numbers: (F,) of all frames with a pose, ascending.   hosts: (F,) the keyframe of each, and
    T_host_camera (F, 4, 4) its pose relative to it.   keyframes: (M,) their rows in these.
    sampled: tracks of these and of other frames.
    """

    numbers: I64
    hosts: I64
    T_host_camera: F64
    keyframes: I64
    sampled: list[SampledTracks]


class SecondMap(NamedTuple):
    """A better map than that of the run.

    T_world_camera: (M, 4, 4) of the keyframes, and motions (M, 6) as of ``FramePoses.motions``.
    xyz: (N, 3) of the landmarks.   correction, covariance: as of a ``BundleResult``.
    frames: the others of its frames.
    """

    T_world_camera: F64
    motions: F64
    xyz: F64
    correction: F64
    covariance: F64
    frames: list["SecondPose"]


class SecondPose(NamedTuple):
    """A frame in a ``SecondMap``, with its tracks at points_px (n, 2) of the ideal camera, without
    a rolling shutter, and the points xyz (n, 3) that they show.
    """

    frame: int
    T_world_camera: F64
    points_px: F32
    xyz: F64


@dataclass(frozen=True, kw_only=True)
class Sightings:
    """Observations in the cameras of all frames, as of a ``BundleProblem``.

    points: their number; the first ``landmarks`` of them are those of the map.
    """

    camera: I32
    point: I32
    px: F32
    weights: F32
    points: int
    landmarks: int = 0

    def of_tracks(self, every: int) -> "Sightings":
        """Return those of one in this many tracks, and of no landmark."""
        some = self.point >= self.landmarks
        some &= (self.point - self.landmarks) % every == 0
        number = (self.point[some] - self.landmarks) // every
        points = -(-(self.points - self.landmarks) // every)
        return Sightings(
            camera=self.camera[some], point=number.astype(np.int32), px=self.px.compress(some, 0),
            weights=self.weights[some], points=points,
        )  # fmt: skip


def second_map(
    frames: SampledFrames, T_world_keyframe: F64, xyz: F64, landmarks: Sightings,
    known: SelfCalibration, bundle: BundleParameters, depth: float, log_focal: F64,
) -> SecondMap | None:  # fmt: skip
    """Return the map from the second start, or None if the map of the run is as good.

    T_world_keyframe: (M, 4, 4) and xyz (N, 3): the map.   landmarks: their observations by
    keyframes.   known: the calibration of the map.   depth: median depth of the landmarks.
    log_focal: (M,) of the keyframes.
    """
    if not turns_in_place(T_world_keyframe, depth):
        return None
    run = T_world_keyframe[frames.hosts] @ frames.T_host_camera
    seen = _with_tracks(frames, landmarks, known)
    if seen.points == seen.landmarks:
        return None
    unknown = known.prior(known.correction) if known.uncertainty.sigmas.any() else None
    map_start = _Start(frames, known, unknown, bundle, depth)
    given = replace(known, correction=np.zeros(SHARED))
    arm_start = map_start._replace(known=given)
    arm = arm_start.on_arm(run)
    by_run = _focused(frames, seen, known, log_focal)
    tracks = seen.of_tracks(_FIRST)
    first = map_start.adjusted(run, by_run.of_tracks(_FIRST))
    second = arm_start.adjusted(arm, tracks)
    if not _is_better(second, first, tracks, bundle, _CERTAIN / np.sqrt(_FIRST)):
        return None
    first, second = map_start.adjusted(run, by_run, xyz), arm_start.adjusted(arm, seen)
    if not _is_better(second, first, seen, bundle, _CERTAIN):
        return None
    return arm_start.map_of(second, seen)


def _with_tracks(frames: SampledFrames, landmarks: Sightings, known: SelfCalibration) -> Sightings:
    """Add the tracks that are in two frames."""
    row = {number: n for n, number in enumerate(frames.numbers.tolist())}
    sampled = [each for each in frames.sampled if each.frame in row]
    sizes = np.array([len(each.ids) for each in sampled], np.int64)
    camera = np.repeat(np.array([row[each.frame] for each in sampled], np.int32), sizes)
    ids = np.concatenate([np.zeros(0, np.int64), *(each.ids for each in sampled)])
    px = np.concatenate([np.zeros((0, 2), np.float32), *(each.points_px for each in sampled)])
    _, number, counts = np.unique(ids, return_inverse=True, return_counts=True)
    several = counts >= 2
    kept = several[number]
    number = (np.cumsum(several, dtype=np.int32) - 1)[number[kept]]
    px = px.compress(kept, 0)
    weights = known.weights(known.view.pixels(px), estimates_k1=True)
    return Sightings(
        camera=np.concatenate([landmarks.camera, camera[kept]]),
        point=np.concatenate([landmarks.point, landmarks.points + number]).astype(np.int32),
        px=np.concatenate([landmarks.px, px]),
        weights=np.concatenate([landmarks.weights, weights]),
        points=landmarks.points + int(several.sum()),
        landmarks=landmarks.points,
    )


def _focused(
    frames: SampledFrames, seen: Sightings, known: SelfCalibration, log_focal: F64
) -> Sightings:
    """Return the observations as of a camera with a constant focal length.   log_focal: (M,)."""
    numbers = frames.numbers.astype(np.float64)
    each = np.interp(numbers, numbers[frames.keyframes], log_focal)
    return replace(seen, px=known.view.magnified(seen.px, -each[seen.camera]))


class _Start(NamedTuple):
    """known: the calibration to start with.   uncertainty: its prior; None: it is fixed."""

    frames: SampledFrames
    known: SelfCalibration
    uncertainty: CalibrationUncertainty | None
    bundle: BundleParameters
    depth: float

    def on_arm(self, T_world_camera: F64) -> F64:
        """(F, 4, 4) with the camera at the end of an arm; the first keyframe stays."""
        T, first = T_world_camera.copy(), self.frames.keyframes[0]
        T[:, :3, 3] = T[first, :3, 3] + _ARM * self.depth * (T[:, :3, 2] - T[first, :3, 2])
        return T

    def adjusted(self, start: F64, seen: Sightings, xyz: F64 | None = None) -> BundleResult:
        """Adjust from poses (F, 4, 4).   xyz: (N, 3) of the landmarks; other points are at the
        median depth.
        """
        poses, points = start, self._at_median_depth(start, seen)
        if xyz is not None:
            points[: seen.landmarks] = xyz
        known, correction, uncertainty = self.known, self.known.correction, self.uncertainty
        fixed = np.zeros(len(poses), np.bool_)
        fixed[self.frames.keyframes[0]] = True
        found = None
        for width, iterations in _WIDTHS:
            problem = BundleProblem(
                T_world_camera=poses, points_world=points, camera_index=seen.camera,
                point_index=seen.point, points_px=seen.px,
                intrinsics=shared_intrinsics(known.given, len(poses)), fixed_cameras=fixed,
                weights=seen.weights,
                readout_flow=None if uncertainty is None else self._flow(poses, points, seen),
            )  # fmt: skip
            changed = {
                "kernel_sigma_px": width * self.bundle.kernel_sigma_px,
                "max_iterations": iterations,
            }
            found = solve_schur(
                problem, self.bundle.model_copy(update=changed), uncertainty=uncertainty,
                start=correction, doubled=True, with_covariance=True,
            )  # fmt: skip
            poses, points = found.T_world_camera, found.points_world
            correction = found.correction
            behind = seen.point[~np.isfinite(found.squared_residuals)]
            points[behind] = self._at_median_depth(poses, seen)[behind]
        assert found is not None
        return found

    def _at_median_depth(self, T: F64, seen: Sightings) -> F64:
        """(N, 3) points at the median depth in the first camera that observes each."""
        X = np.zeros((seen.points, 3))
        number, first = np.unique(seen.point, return_index=True)
        rays = self.known.view.camera.normalise(self.known.view.pixels(seen.px.take(first, 0)))
        rays = self.depth * np.column_stack([rays, np.ones(len(rays))])
        host = T[seen.camera[first]]
        X[number] = np.einsum("nij,nj->ni", host[:, :3, :3], rays) + host[:, :3, 3]
        return X

    def _flow(self, T: F64, X: F64, seen: Sightings) -> F32:
        motions, camera = self._motions(T), self.known.view.camera
        return readout_flow(T, motions, X, seen.camera, seen.point, seen.px, camera)

    def _motions(self, T: F64) -> F64:
        """(F, 6) as of ``FramePoses.motions``."""
        numbers, rows = self.frames.numbers, np.arange(len(T))
        adjacent = np.concatenate([[False], np.diff(numbers) == 1, [False]])
        first, last = rows - adjacent[:-1], rows + adjacent[1:]
        frames = np.maximum(numbers[last] - numbers[first], 1)
        return motion_between(T[first], T[last], T) / frames[:, None]

    def map_of(self, found: BundleResult, seen: Sightings) -> SecondMap:
        """Return the adjusted map."""
        T, X = found.T_world_camera, found.points_world
        view = self.known.corrected(found.correction, found.covariance, 0).view
        shift = found.correction[3] * self._flow(T, X, seen)
        px = view.pixels(seen.px - shift.astype(np.float32))
        tracks = seen.point >= seen.landmarks
        order = np.flatnonzero(tracks)
        order = order[np.argsort(seen.camera[order], kind="stable")]
        ends = np.searchsorted(seen.camera[order], np.arange(len(T) + 1))
        ordinary = np.setdiff1d(np.arange(len(T)), self.frames.keyframes)
        poses = [
            SecondPose(
                frame=int(self.frames.numbers[row]),
                T_world_camera=T[row],
                points_px=px[order[ends[row] : ends[row + 1]]],
                xyz=X[seen.point[order[ends[row] : ends[row + 1]]]],
            )
            for row in ordinary.tolist()
        ]
        return SecondMap(
            T_world_camera=T[self.frames.keyframes],
            motions=self._motions(T)[self.frames.keyframes],
            xyz=X[: seen.landmarks],
            correction=found.correction,
            covariance=found.covariance,
            frames=[each for each in poses if len(each.xyz)],
        )


def _is_better(
    second: BundleResult, first: BundleResult, seen: Sightings, bundle: BundleParameters,
    certain: float,
) -> bool:  # fmt: skip
    """Whether the second cost is lower, by more than what may be left to converge, and the tracks
    prefer the second map by this number of standard deviations.
    """
    if not second.final_cost < (1.0 - bundle.min_relative_decrease) * first.final_cost:
        return False  # also of costs that are not finite
    tracks = seen.point >= seen.landmarks
    gain = _costs(first, seen, bundle) - _costs(second, seen, bundle)
    return preference(gain[tracks], seen.point[tracks], seen.camera[tracks]) > certain


def _costs(found: BundleResult, seen: Sightings, bundle: BundleParameters) -> F64:
    """(O,) cost of each observation."""
    squared, most = found.squared_residuals.astype(np.float64), bundle.kernel_sigma_px**2
    ahead = np.isfinite(squared)
    squared[~ahead] = 0.0
    if most:
        squared /= 1.0 + squared / most
    squared[~ahead] = most
    return 0.5 * seen.weights * squared


def preference(gain: F64, track: I32, camera: I32) -> float:
    """Return the sum of gains (O,) in standard deviations, of which those of a track and those of a
    camera are correlated.
    """
    rest = gain - gain.mean()
    variance = _of_sums(rest, track) + _of_sums(rest, camera) - float(rest @ rest)
    return float(gain.sum() / np.sqrt(max(variance, _of_sums(rest, camera))))


def _of_sums(values: F64, group: I32) -> float:
    sums = np.bincount(group, values)
    return float(sums @ sums)

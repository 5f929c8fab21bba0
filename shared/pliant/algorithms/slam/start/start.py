"""How a map starts: the frames so far become a small reconstruction, or a reason why not.

Every new frame is compared with the best earlier one: many shared tracks, and flow that no rotation
explains.  Two views allow several motions, especially of a plane.  Each gives a first structure,
intermediate frames join it by their tracks, and all are adjusted together.  The start that fits the
tracks best is accepted if many landmarks in several frames support it and no other motion fits
nearly as well.  So slow, rotating, still or ambiguous beginnings merely wait.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pliant.algorithms.arrays import F32, F64, I64
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import inverse
from pliant.algorithms.slam.calibration.turn_of_lens import turn_of_lens
from pliant.algorithms.slam.estimate.epipolar import (
    RelativePose,
    likely_pose,
    rays,
    relative_poses,
    rotation_between,
    two_view_depths,
)
from pliant.algorithms.slam.estimate.pose import Correspondences
from pliant.algorithms.slam.estimate.problem import CalibrationUncertainty
from pliant.algorithms.slam.estimate.triangulation import triangulate
from pliant.algorithms.slam.locate.localisation import refine
from pliant.algorithms.slam.parameters import MappingParameters, StartParameters
from pliant.algorithms.slam.start.first_map import BufferedFrame, Start, adjusted_start, table_of

_TRIED_REFERENCES = 8
"""Earlier frames compared with a new one."""

_ROTATION_SAMPLE = 400
"""Tracks that decide whether a rotation explains the flow; of fewer some count twice."""

_GLANCE = 400
"""Tracks for a quick parallax test of every waiting frame; a full test takes ten times as long."""

_CLEARLY_LESS = 0.7
"""Share of the required parallax below which the quick test is conclusive."""

_DECIDING = 500
"""Tracks, evenly of all, that decide between several motions; the start uses all."""

_NOISE_PX = 1.0
"""Error of a track without parallax."""

_EPIPOLAR_GATE_PX = 1.0
"""Maximum epipolar error of an inlier."""

_MIN_INLIER_SHARE = 0.5
"""Of the tracks that two frames share."""

_MIN_FRAMES = 3
"""Minimum frames of a start: a point of two frames always agrees with some depth."""

_AS_GOOD = 1.3
"""Multiple of the smallest misfit below which a motion has not been ruled out."""

_ONE_WAY = float(np.cos(0.1))
"""Cosine of the angle between translations that count as the same."""


@dataclass(frozen=True, kw_only=True)
class _Pair:
    """Tracks shared by an earlier frame and the newest, and the flow that no rotation explains."""

    reference: int
    indices_reference: I64
    indices_newest: I64
    residual_px: float
    flow_px: float


class _Parallax(NamedTuple):
    """The required parallax of a start, at this percentile of the agreeing tracks."""

    least_deg: float
    percentile: float


def find_start(
    waiting: list[BufferedFrame],
    camera: PinholeCamera,
    parameters: MappingParameters,
    *,
    motions: int | None = None,
) -> Start | str:
    """Return the map that starts with the newest of the waiting frames, or the reason why it
    cannot.

    motions: how many of the possible motions of two views are compared; None: all.
    """
    start = parameters.start
    if len(waiting) < _MIN_FRAMES:
        return f"too few frames: {len(waiting)} of {_MIN_FRAMES}"
    pairs = _pairs(waiting, camera, start)
    reason = _why_not(pairs, waiting, start)
    if reason:
        return reason
    # More parallax is better; shared tracks count less, because there are many.
    pairs.sort(key=lambda pair: -pair.residual_px * len(pair.indices_newest) ** 0.5)
    wanted = _wanted_parallax(waiting, start)
    for pair in pairs[:2]:
        found = _start_from(pair, waiting, camera, parameters, motions, wanted)
        if not isinstance(found, str):
            return found
        reason = reason or found
    return reason


def with_minimum_parallax(parameters: MappingParameters) -> MappingParameters:
    """Parameters with which a map starts as soon as it can."""
    start = parameters.start.model_copy(update={"patient_s": 0.0, "long_s": 0.0})
    return parameters.model_copy(update={"start": start})


def waits_long(waiting: list[BufferedFrame], start: StartParameters) -> bool:
    """Whether more parallax may never come."""
    return _waited_s(waiting) >= start.long_s


def why_no_start(
    waiting: list[BufferedFrame], camera: PinholeCamera, parameters: MappingParameters
) -> str:
    """Why an uncertain camera has too few tracks or too little parallax for a start, whatever its
    lens; "" otherwise.
    """
    if len(waiting) < _MIN_FRAMES:
        return f"too few frames: {len(waiting)} of {_MIN_FRAMES}"
    pairs = _pairs(waiting, camera, parameters.start, parameters.calibration)
    return _why_not(pairs, waiting, parameters.start)


def _why_not(pairs: list[_Pair], waiting: list[BufferedFrame], start: StartParameters) -> str:
    if not pairs:
        lasting = len(np.intersect1d(waiting[-_MIN_FRAMES].ids, waiting[-1].ids))
        return f"too few tracks: {lasting} of {start.min_tracks} last for {_MIN_FRAMES} frames"
    if max(pair.residual_px for pair in pairs) < 2.0 * _NOISE_PX:
        return _no_parallax(pairs)
    return ""


def _pairs(
    waiting: list[BufferedFrame],
    camera: PinholeCamera,
    parameters: StartParameters,
    unknown: CalibrationUncertainty | None = None,
) -> list[_Pair]:
    """unknown: uncertainty of the camera; None: a rotation is tested with the given camera."""
    newest = waiting[-1]
    earlier = len(waiting) - 1
    tried = np.linspace(0, earlier - 1, min(earlier, _TRIED_REFERENCES)).astype(int)
    tried[-1] = len(waiting) - _MIN_FRAMES  # shorter tracks start nothing, and look like a rotation
    tried = np.unique(tried)
    shared: list[tuple[int, I64, I64]] = []
    for index in tried.tolist():
        _, a, b = np.intersect1d(
            waiting[index].ids, newest.ids, assume_unique=True, return_indices=True
        )
        if len(a) >= parameters.min_tracks:
            shared.append((index, a, b))
    if not shared:
        return []
    samples: list[tuple[F32, F32]] = []
    for index, a, b in shared:
        some = np.linspace(0, len(a) - 1, _ROTATION_SAMPLE).astype(int)
        samples.append((waiting[index].points_px[a[some]], newest.points_px[b[some]]))
    points_a, points_b = np.array(samples).swapaxes(0, 1)
    a, b, scale = _normalise(camera, points_a), _normalise(camera, points_b), _NOISE_PX / camera.fx
    if unknown is None:
        _, residuals = rotation_between(a, b, scale=scale)
    else:
        residuals = turn_of_lens(
            a[:, ::2], b[:, ::2], scale=scale, focal_sigma=unknown.focal, lens_sigma=unknown.k1
        )
    residuals_px = np.median(residuals, axis=-1) * camera.fx
    flows_px = np.median(np.linalg.norm(points_a - points_b, axis=-1), axis=-1)
    return [
        _Pair(
            reference=index,
            indices_reference=a,
            indices_newest=b,
            residual_px=float(residuals_px[k]),
            flow_px=float(flows_px[k]),
        )
        for k, (index, a, b) in enumerate(shared)
    ]


def _normalise(camera: PinholeCamera, points_px: F32) -> F64:
    return camera.normalise(points_px.astype(np.float64))


def _no_parallax(pairs: list[_Pair]) -> str:
    if max(pair.flow_px for pair in pairs) > 20.0 * _NOISE_PX:
        return "pure rotation: a rotation explains all of the motion"
    return _too_little(
        max(pair.residual_px for pair in pairs), 2.0 * _NOISE_PX, "px without the rotation"
    )


def _too_little(parallax: float, least: float, unit: str) -> str:
    shown = np.floor(100.0 * parallax) / 100.0  # never report an insufficient value as equal
    return f"too little parallax: {shown:.2f} of {least:.2f} {unit}"


def _start_from(
    pair: _Pair,
    waiting: list[BufferedFrame],
    camera: PinholeCamera,
    parameters: MappingParameters,
    motions: int | None,
    wanted: _Parallax,
) -> Start | str:
    start = parameters.start
    a = _normalise(camera, waiting[pair.reference].points_px[pair.indices_reference])
    b = _normalise(camera, waiting[-1].points_px[pair.indices_newest])
    gate = _EPIPOLAR_GATE_PX / camera.fx
    every = max(1, len(a) // _GLANCE)
    glance = likely_pose(a[::every], b[::every], gate=gate)
    if glance is not None and glance.inliers.mean() >= _MIN_INLIER_SHARE:
        parallax = _parallax_deg(glance, wanted.percentile)
        if parallax < _CLEARLY_LESS * wanted.least_deg:
            return _too_little(parallax, wanted.least_deg, "deg")
    tried = relative_poses(a, b, gate=gate)
    if not tried:
        return "no essential matrix fits the tracks"
    reason = _why_not_with(tried[0], wanted)
    if reason:
        return reason  # the parallax of a worse motion is an error
    shared = waiting[-1].ids[pair.indices_newest]
    compared = tried[:motions]
    # A single motion needs no comparison, and few tracks are all needed.
    most = _DECIDING if len(compared) > 1 and len(shared) >= 2 * _DECIDING else len(shared)
    sample = shared[:: max(1, len(shared) // most)]
    least = wanted._replace(least_deg=start.min_parallax_deg)
    found: list[tuple[float, Start, RelativePose]] = []
    for two_views in compared:
        each = _why_not_with(two_views, least) or _reconstruct(
            pair, two_views, waiting, camera, parameters, most
        )
        if isinstance(each, str):
            reason = reason or each
            continue
        found.append((_misfit(each, sample, waiting, camera, parameters), each, two_views))
    if not found:
        return reason
    least_misfit, best, two_views = min(found, key=lambda each: each[0])
    for misfit, other, _ in found:
        if misfit < _AS_GOOD * least_misfit and not _agree(best, other):
            return "two motions explain the tracks equally well"
    reason = _why_not_with(two_views, wanted)
    if reason or most == len(shared):
        return reason or best
    return _reconstruct(pair, two_views, waiting, camera, parameters, len(shared))


def _agree(a: Start, b: Start) -> bool:
    """Whether both starts have the same direction of motion."""
    ways = [each.T_world_camera[-1, :3, 3] for each in (a, b)]
    return bool(ways[0] @ ways[1] > _ONE_WAY * np.prod(np.linalg.norm(ways, axis=1)))


def _wanted_parallax(waiting: list[BufferedFrame], start: StartParameters) -> _Parallax:
    """The required parallax.

    Under little parallax a start takes noise, and the readout of a rolling shutter, for shape; but
    where tracks end soon there is never more.  Straight ahead, near points leave the image first,
    so most of what two views share is always far.
    """
    if _waited_s(waiting) < start.patient_s:
        return _Parallax(start.parallax_deg, 50.0)
    percentile = 75.0 if waits_long(waiting, start) else 50.0
    return _Parallax(start.min_parallax_deg, percentile)


def _waited_s(waiting: list[BufferedFrame]) -> float:
    return 1e-9 * (waiting[-1].stamp_ns - waiting[0].stamp_ns)


def _why_not_with(two_views: RelativePose, wanted: _Parallax) -> str:
    share = float(two_views.inliers.mean())
    if share < _MIN_INLIER_SHARE:
        return f"too few tracks agree with one motion: {share:.0%} of {_MIN_INLIER_SHARE:.0%}"
    parallax = _parallax_deg(two_views, wanted.percentile)
    if parallax < wanted.least_deg:
        return _too_little(parallax, wanted.least_deg, "deg")
    return ""


def _parallax_deg(two_views: RelativePose, percentile: float) -> float:
    return float(np.degrees(np.percentile(two_views.parallax_rad[two_views.inliers], percentile)))


def _misfit(
    start: Start,
    ids: I64,
    waiting: list[BufferedFrame],
    camera: PinholeCamera,
    parameters: MappingParameters,
) -> float:
    """Mean of Geman-McClure's kernel over all tracks under the poses of a start, with or without
    points: a wrong motion would leave out the tracks that contradict it.
    """
    chosen = [frame for frame in waiting if frame.frame in start.frames]
    u, v, seen = table_of(chosen, ids)
    every = np.arange(len(ids))
    errors = triangulate(start.T_world_camera, u, v, seen, every, camera)[1].astype(np.float64)
    return float(np.mean(1.0 - 1.0 / (1.0 + (errors / parameters.bundle.kernel_sigma_px) ** 2)))


def _reconstruct(
    pair: _Pair,
    two_views: RelativePose,
    waiting: list[BufferedFrame],
    camera: PinholeCamera,
    parameters: MappingParameters,
    most: int,
) -> Start | str:
    """most: points, evenly of all, up to twice as many."""
    start = parameters.start
    newest = len(waiting) - 1
    spread = np.linspace(pair.reference, newest, min(start.keyframes, newest - pair.reference + 1))
    chosen = [waiting[i] for i in np.unique(np.round(spread).astype(int)).tolist()]
    # Seed: points of the two views; the frames between them join by the tracks they share.
    good = two_views.inliers
    ids = waiting[pair.reference].ids[pair.indices_reference[good]]
    rays_a = rays(
        _normalise(camera, waiting[pair.reference].points_px[pair.indices_reference[good]])
    )
    rays_b = rays(_normalise(camera, waiting[-1].points_px[pair.indices_newest[good]]))
    points = rays_a * two_view_depths(two_views.T_b_a, rays_a, rays_b)[0][:, None]
    # Depths of nearly parallel rays are noise; they come back once the poses are better.
    firm = two_views.parallax_rad[good] > np.radians(0.5 * start.min_parallax_deg)
    every = max(1, int(firm.sum()) // most)
    ids, points = ids[firm][::every], points[firm][::every]
    T_world_camera = np.tile(np.eye(4), (len(chosen), 1, 1))
    T_world_camera[-1] = inverse(two_views.T_b_a)
    for k in range(1, len(chosen) - 1):
        _, i, j = np.intersect1d(chosen[k].ids, ids, assume_unique=True, return_indices=True)
        if len(i) < start.min_points:
            return f"too few tracks last through the start: {len(i)} of {start.min_points}"
        located = refine(
            T_world_camera[k - 1], Correspondences(points[j], chosen[k].points_px[i]), camera,
            parameters.localisation,
        )  # fmt: skip
        T_world_camera[k] = located.T_world_camera
    return adjusted_start(chosen, T_world_camera, ids, points, camera, parameters)

"""How a map starts: the frames seen so far become a small reconstruction, or a reason why not.

Every new frame is compared with the best earlier one: many shared tracks, and flow that no rotation
explains.  Two views allow several motions, above all where most of what they share lies in a plane.
Each gives a first structure, frames in between join it by their tracks, and all are adjusted
together.  The start that the tracks fit best is accepted, if many points in several frames support
it and no other motion explains them nearly as well, so that slow, rotating, still or ambiguous
beginnings merely wait.
"""

from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, I64
from pliant.algorithms.bundle.problem import BundleProblem, shared_intrinsics
from pliant.algorithms.bundle.schur import solve_schur
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.epipolar import (
    RelativePose,
    rays,
    relative_poses,
    rotation_between,
    two_view_depths,
)
from pliant.algorithms.geometry import inverse
from pliant.algorithms.mapping.localisation import refine
from pliant.algorithms.mapping.parameters import MappingParameters, StartParameters
from pliant.algorithms.triangulation import triangulate

_TRIED_REFERENCES = 8
"""Earlier frames compared with a new one."""

_ROTATION_SAMPLE = 400
"""Tracks that decide whether a rotation explains the flow."""

_NOISE_PX = 1.0
"""Error of a track that is no parallax."""

_MIN_FRAMES = 3
"""Frames that a start needs: a point of two frames always agrees with some depth."""

_ADJUSTMENTS = 3
"""Rounds of adjusting and removing outliers."""

_AS_GOOD = 1.3
"""Times the least misfit: a motion with less has not been ruled out."""

_ONE_WAY = float(np.cos(0.1))
"""Cosine of the angle between translations that count as the same."""

_LEAST_WAITING = 12
"""Frames that wait for a start however old they are: a time lapse has no more."""


class Stamped(Protocol):
    """A frame and when it was taken."""

    @property
    def stamp_ns(self) -> int: ...


_F = TypeVar("_F", bound=Stamped)


@dataclass(frozen=True, kw_only=True)
class WaitingFrame:
    """What is kept of a frame until the map starts."""

    frame: int
    stamp_ns: int
    ids: I64
    points_px: F32
    kappas: F32


@dataclass(frozen=True, kw_only=True)
class Start:
    """A first map.  The world is the camera of the first keyframe; the median depth in it is 1.

    frames: (K,) frame numbers of the keyframes, ascending.   T_world_camera: (K, 4, 4).
    ids: (N,) track of each point, ascending.   points_world: (N, 3).
    keyframe_index, point_index, points_px: (O,) observations that support the points.
    """

    frames: I64
    T_world_camera: F64
    ids: I64
    points_world: F64
    keyframe_index: I32
    point_index: I32
    points_px: F32


@dataclass(frozen=True, kw_only=True)
class _Pair:
    """Tracks shared by an earlier frame and the newest, and the flow that no rotation explains."""

    reference: int
    indices_reference: I64
    indices_newest: I64
    residual_px: float
    flow_px: float


def keep_waiting(waiting: list[_F], newest: _F, parameters: StartParameters) -> list[_F]:
    """The waiting frames without those that are too old, and the newest one."""
    oldest_ns = newest.stamp_ns - 1e9 * parameters.max_s
    young = [frame for frame in waiting if frame.stamp_ns > oldest_ns]
    return [*max(young, waiting[1 - _LEAST_WAITING :], key=len), newest]


def find_start(
    waiting: list[WaitingFrame],
    camera: PinholeCamera,
    parameters: MappingParameters,
    *,
    motions: int | None = None,
) -> Start | str:
    """The map that starts with the newest of the waiting frames, or the reason why it cannot.

    motions: how many of those that two views allow are compared, None: all.
    """
    start = parameters.start
    if len(waiting) < _MIN_FRAMES:
        return f"too few frames: {len(waiting)} of {_MIN_FRAMES}"
    pairs = _pairs(waiting, camera, start)
    reason = _why_not(pairs, waiting, start)
    if reason:
        return reason
    # The more parallax the better; shared tracks count less, for there are many.
    pairs.sort(key=lambda pair: -pair.residual_px * len(pair.indices_newest) ** 0.5)
    for pair in pairs[:2]:
        found = _start_from(pair, waiting, camera, parameters, motions)
        if not isinstance(found, str):
            return found
        reason = reason or found
    return reason


def why_no_start(
    waiting: list[WaitingFrame], camera: PinholeCamera, parameters: MappingParameters
) -> str:
    """Why a camera sees too few tracks or too little parallax for a start; "" where it does not."""
    if len(waiting) < _MIN_FRAMES:
        return f"too few frames: {len(waiting)} of {_MIN_FRAMES}"
    return _why_not(_pairs(waiting, camera, parameters.start), waiting, parameters.start)


def _why_not(pairs: list[_Pair], waiting: list[WaitingFrame], start: StartParameters) -> str:
    if not pairs:
        return f"too few tracks: {_most_shared(waiting)} of {start.min_tracks}"
    if max(pair.residual_px for pair in pairs) < 2.0 * _NOISE_PX:
        return _no_parallax(pairs)
    return ""


def _pairs(
    waiting: list[WaitingFrame], camera: PinholeCamera, parameters: StartParameters
) -> list[_Pair]:
    newest = waiting[-1]
    pairs: list[_Pair] = []
    earlier = len(waiting) - 1
    tried = np.unique(np.linspace(0, earlier - 1, min(earlier, _TRIED_REFERENCES)).astype(int))
    for index in tried.tolist():
        reference = waiting[index]
        _, a, b = np.intersect1d(reference.ids, newest.ids, assume_unique=True, return_indices=True)
        if len(a) < parameters.min_tracks:
            continue
        every = max(1, len(a) // _ROTATION_SAMPLE)
        points_a, points_b = reference.points_px[a[::every]], newest.points_px[b[::every]]
        _, residuals = rotation_between(
            _normalise(camera, points_a), _normalise(camera, points_b), scale=_NOISE_PX / camera.fx
        )
        pairs.append(
            _Pair(
                reference=index,
                indices_reference=a,
                indices_newest=b,
                residual_px=float(np.median(residuals)) * camera.fx,
                flow_px=float(np.median(np.linalg.norm(points_a - points_b, axis=1))),
            )
        )
    return pairs


def _normalise(camera: PinholeCamera, points_px: F32) -> F64:
    return camera.normalise(points_px.astype(np.float64))


def _most_shared(waiting: list[WaitingFrame]) -> int:
    if len(waiting) < 2:
        return 0
    return len(np.intersect1d(waiting[0].ids, waiting[-1].ids, assume_unique=True))


def _no_parallax(pairs: list[_Pair]) -> str:
    if max(pair.flow_px for pair in pairs) > 20.0 * _NOISE_PX:
        return "pure rotation: a turn explains all of the motion"
    return _too_little(max(pair.residual_px for pair in pairs), 2.0 * _NOISE_PX, "px beside a turn")


def _too_little(parallax: float, least: float, unit: str) -> str:
    shown = np.floor(100.0 * parallax) / 100.0  # what falls short of it is not told as equal
    return f"too little parallax: {shown:.2f} of {least:.2f} {unit}"


def _start_from(
    pair: _Pair,
    waiting: list[WaitingFrame],
    camera: PinholeCamera,
    parameters: MappingParameters,
    motions: int | None,
) -> Start | str:
    start = parameters.start
    a = _normalise(camera, waiting[pair.reference].points_px[pair.indices_reference])
    b = _normalise(camera, waiting[-1].points_px[pair.indices_newest])
    tried = relative_poses(a, b, gate=start.epipolar_gate_px / camera.fx)
    if not tried:
        return "no essential matrix fits the tracks"
    reason = _why_not_with(tried[0], start)
    if reason:
        return reason  # parallax that a worse motion sees is its mistake
    shared = waiting[-1].ids[pair.indices_newest]
    found: list[tuple[float, Start]] = []
    for two_views in tried[:motions]:
        each = _why_not_with(two_views, start) or _reconstruct(
            pair, two_views, waiting, camera, parameters
        )
        if isinstance(each, str):
            reason = reason or each
            continue
        found.append((_misfit(each, shared, waiting, camera, parameters), each))
    if not found:
        return reason
    least, best = min(found, key=lambda each: each[0])
    for misfit, other in found:
        if misfit < _AS_GOOD * least and not _agree(best, other):
            return "two motions explain the tracks alike"
    return best


def _agree(a: Start, b: Start) -> bool:
    """Whether the camera of both starts has moved in one direction."""
    ways = [each.T_world_camera[-1, :3, 3] for each in (a, b)]
    return bool(ways[0] @ ways[1] > _ONE_WAY * np.prod(np.linalg.norm(ways, axis=1)))


def _why_not_with(two_views: RelativePose, start: StartParameters) -> str:
    share = float(two_views.inliers.mean())
    if share < start.min_inlier_share:
        return f"too few tracks agree with one motion: {share:.0%} of {start.min_inlier_share:.0%}"
    parallax = float(np.degrees(np.median(two_views.parallax_rad[two_views.inliers])))
    if parallax < start.min_parallax_deg:
        return _too_little(parallax, start.min_parallax_deg, "deg")
    return ""


def _misfit(
    start: Start,
    ids: I64,
    waiting: list[WaitingFrame],
    camera: PinholeCamera,
    parameters: MappingParameters,
) -> float:
    """Mean of Geman-McClure's kernel over tracks under the poses of a start, whether it has them as
    points or not: a wrong motion leaves out what tells against it."""
    chosen = [frame for frame in waiting if frame.frame in start.frames]
    frames, columns, points_px = _observations(chosen, ids)
    u, v = np.zeros((2, len(chosen), len(ids)), np.float32)
    seen = np.zeros(u.shape, np.bool_)
    u[frames, columns], v[frames, columns] = points_px.T
    seen[frames, columns] = True
    every = np.arange(len(ids))
    errors = triangulate(start.T_world_camera, u, v, seen, every, camera)[1].astype(np.float64)
    return float(np.mean(1.0 - 1.0 / (1.0 + (errors / parameters.bundle.kernel_sigma_px) ** 2)))


def _reconstruct(
    pair: _Pair,
    two_views: RelativePose,
    waiting: list[WaitingFrame],
    camera: PinholeCamera,
    parameters: MappingParameters,
) -> Start | str:
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
    ids, points = ids[firm], points[firm]
    T_world_camera = np.tile(np.eye(4), (len(chosen), 1, 1))
    T_world_camera[-1] = inverse(two_views.T_b_a)
    for k in range(1, len(chosen) - 1):
        _, i, j = np.intersect1d(chosen[k].ids, ids, assume_unique=True, return_indices=True)
        if len(i) < start.min_points:
            return f"too few tracks last through the start: {len(i)} of {start.min_points}"
        located = refine(
            T_world_camera[k - 1], points[j], chosen[k].points_px[i], camera,
            parameters.localisation,
        )  # fmt: skip
        T_world_camera[k] = located.T_world_camera
    scale = 1.0 / float(np.median(points[:, 2]))
    points *= scale
    T_world_camera[:, :3, 3] *= scale
    return _adjust(chosen, T_world_camera, ids, points, camera, parameters)


def _observations(chosen: list[WaitingFrame], ids: I64) -> tuple[I32, I32, F32]:
    keyframe_index: list[I32] = []
    point_index: list[I32] = []
    points_px: list[F32] = []
    for k, frame in enumerate(chosen):
        _, i, j = np.intersect1d(frame.ids, ids, assume_unique=True, return_indices=True)
        keyframe_index.append(np.full(len(i), k, np.int32))
        point_index.append(j.astype(np.int32))
        points_px.append(frame.points_px[i])
    return np.concatenate(keyframe_index), np.concatenate(point_index), np.concatenate(points_px)


def _adjust(
    chosen: list[WaitingFrame],
    T_world_camera: F64,
    ids: I64,
    points: F64,
    camera: PinholeCamera,
    parameters: MappingParameters,
) -> Start | str:
    start = parameters.start
    order = np.argsort(ids, kind="stable")
    ids, points = ids[order], points[order]
    keyframe_index, point_index, points_px = _observations(chosen, ids)
    fixed = np.zeros(len(chosen), np.bool_)
    fixed[0] = True
    median = np.inf
    for _ in range(_ADJUSTMENTS):
        problem = BundleProblem(
            T_world_camera=T_world_camera,
            points_world=points,
            camera_index=keyframe_index,
            point_index=point_index,
            points_px=points_px,
            intrinsics=shared_intrinsics(camera, len(chosen)),
            fixed_cameras=fixed,
        )
        result = solve_schur(problem, parameters.bundle)
        T_world_camera = result.T_world_camera
        error = np.sqrt(result.squared_residuals)
        median = float(np.median(error))
        keep = error < parameters.window.outlier_px
        # A point needs three frames: two always agree with some depth.
        seen = np.bincount(point_index[keep], minlength=len(ids))
        stays = seen >= 3
        keep &= stays[point_index]
        renumber = np.cumsum(stays) - 1
        ids, points = ids[stays], result.points_world[stays]
        keyframe_index, points_px = keyframe_index[keep], points_px[keep]
        point_index = renumber[point_index[keep]].astype(np.int32)
        if len(ids) < start.min_points:
            return f"too few points: {len(ids)} of {start.min_points}"
    if median > start.max_median_error_px:
        return f"no consistent start: error {median:.1f} of {start.max_median_error_px:.1f} px"
    return Start(
        frames=np.array([frame.frame for frame in chosen]),
        T_world_camera=T_world_camera,
        ids=ids,
        points_world=points,
        keyframe_index=keyframe_index,
        point_index=point_index,
        points_px=points_px,
    )

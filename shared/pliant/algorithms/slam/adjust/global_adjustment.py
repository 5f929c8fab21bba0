"""Global bundle adjustment, in parallel with tracking: when it is requested, run, and applied.

The window corrects what is new; drift beyond it requires all keyframes.  Their adjustment takes
longer than a frame, so it works on a copy of the map.  Its result is applied a fixed number of
frames later, which depends on the size of the map and not on the time that it took: a mapper that
does not have it by then waits.  If the shutter may be rolling, the first adjustment follows the
first keyframes, to estimate the readout.

Meanwhile the map has grown and the window has moved.  So the result does not state where the
landmarks are, but how the map around each keyframe moves: one similarity per keyframe, because
drift is small within a view.  The keyframes of the window move too: in a map of a few dozen
keyframes most of the drift is there.  Newer ones move rigidly with the last of them.  All of it
moves as little as it can, so that poses from before and after are consistent; at the end the
beginning returns to its place (``Segment.strayed``).  Lens, focal length and readout are estimated
each time, and used for later frames once they differ significantly from those in use.

A loop requests an adjustment immediately, and gets its result sooner: the pose graph of ``loops``
determines how the map moves, and a later adjustment refines it.  If the graph rejects all loops,
nothing moves.
"""

from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from pliant.algorithms.arrays import F64, I64
from pliant.algorithms.map_delta import MapMoves
from pliant.algorithms.slam.adjust.final_adjustment import (
    ObservationList,
    adjust_list,
    list_observations,
    moves_between,
)
from pliant.algorithms.slam.adjust.loops import Loop, close_loops
from pliant.algorithms.slam.adjust.segment import Segment
from pliant.algorithms.slam.calibration.rolling_shutter import readout_flow
from pliant.algorithms.slam.calibration.self_calibration import SelfCalibration
from pliant.algorithms.slam.estimate.problem import BundleResult, CalibrationUncertainty
from pliant.algorithms.slam.parameters import MappingParameters

_LEAST_TOLD = 0.2
"""Minimum share of the information about the readout that must come from the images, not
the prior.
"""

_GRAPH_SHARE = 0.1
"""Time of the pose graph, as a share of an adjustment."""


_NONE: F64 = np.zeros(0)


@dataclass(frozen=True, kw_only=True)
class AdjustmentJob:
    """A copy of the map after a frame, to be adjusted.

    keyframe_ids: (M,).   seen: their observations.   known: of the camera; ``seen`` has pixels of
    the rectified image.   loops: to be closed; without loops everything is adjusted.
    closed: whether loops have just been closed.   sigmas: (N,) of the landmarks.
    """

    frame: int
    keyframe_ids: I64
    seen: ObservationList
    known: SelfCalibration
    parameters: MappingParameters
    loops: list[Loop] = field(default_factory=list)
    closed: bool = False
    sigmas: F64 = field(default_factory=lambda: np.zeros(0))

    @property
    def distance_frames(self) -> int:
        """Frames after which the result is applied: its time grows with the observations."""
        limits = self.parameters.whole_map
        # Few keyframes take little time, and later ones depend on the result.
        least = min(limits.distance_frames, len(self.keyframe_ids))
        distance = max(least, len(self.seen.px) // limits.observations_per_frame)
        return round(_GRAPH_SHARE * distance) if self.loops else distance


class AdjustmentResult(NamedTuple):
    """How the map moves, or None; the closed loops, whose landmarks are to be merged; the new
    calibration; the number of loops that the others contradict; the change of each keyframe's log
    focal length, (0,) if the focal length is constant.
    """

    moves: MapMoves | None
    loops: list[Loop]
    calibration: SelfCalibration
    refused: int
    refocus: F64 = _NONE


@dataclass(kw_only=True)
class GlobalAdjustment:
    """Requests an adjustment when the segment has grown by a share: all of them together cost a
    small multiple of the last.

    due: number of keyframes at which the next one is requested.    job: requested, not applied yet.
    result: of the job, once a worker has finished it.    loops: to be closed by the next job,
    alone.
    closed: whether loops were closed since the last adjustment.
    """

    due: float = 0.0
    job: AdjustmentJob | None = None
    result: AdjustmentResult | None = None
    loops: list[Loop] = field(default_factory=list)
    closed: bool = False

    @property
    def closing(self) -> bool:
        """Whether loops are being closed."""
        return self.job is not None and len(self.job.loops) > 0

    def request(
        self,
        frame: int,
        segment: Segment,
        calibration: SelfCalibration,
        parameters: MappingParameters,
    ) -> None:
        """Request the adjustment of the map after a frame, if it is due."""
        camera = calibration.view.camera
        window, growth = parameters.window.keyframes, parameters.whole_map.growth
        count = len(segment.keyframes)
        # A window of half the map needs no global adjustment, except for the calibration.
        given = calibration.uncertainty
        least = parameters.start.keyframes if given.sigmas.any() else 2 * window
        made = count + len(segment.dropped)
        early = growth == 0.0 or count < least or made < self.due
        # The window would move with the part mapped before the camera was recognised.
        early = early or (segment.since > 0 and count - segment.since <= window)
        early = early and not self.closed
        if self.job is not None or (early and not self.loops):
            return
        points = segment.points
        keyframe_ids = np.array([keyframe.id for keyframe in segment.keyframes], np.int64)
        kept = partial(segment.dropped.host_of, kept=keyframe_ids)
        loops = [loop._replace(old=kept(loop.old), new=kept(loop.new)) for loop in self.loops]
        loops = [loop for loop in loops if np.isin((loop.old, loop.new), keyframe_ids).all()]
        loops = [loop.living(points) for loop in loops if loop.old != loop.new]
        self.loops = []
        if not loops:
            if early:
                return
            self.due = (1.0 + growth) * count + (made - count)
        seen = list_observations(segment.keyframes, points, calibration)
        if not loops:
            seen = seen.most_seen(parameters.whole_map.points_per_keyframe)
        seen.see_by(calibration.view)
        if given.readout > 0.0 and not loops:
            seen.flow = readout_flow(
                seen.T_world_camera, segment.path.motions(segment.keyframes), seen.xyz, seen.camera,
                seen.point, seen.px, camera,
            )  # fmt: skip
        self.job = AdjustmentJob(
            frame=frame,
            keyframe_ids=keyframe_ids,
            seen=seen,
            known=calibration,
            parameters=parameters,
            loops=loops,
            closed=self.closed,
            sigmas=points.sigmas[seen.rows].astype(np.float64),
        )
        self.closed = self.closed and len(loops) > 0

    def withdraw(self) -> None:
        """Drop the job; the next one closes its loops."""
        if self.job is not None:
            self.loops = [*self.job.loops, *self.loops]
            self.closed = self.closed or self.job.closed
        self.job = self.result = None

    def is_due(self, frame: int) -> bool:
        """Whether the result is applied before this frame."""
        job = self.job
        if job is None:
            return False
        return frame >= job.frame + job.distance_frames

    def take(self, frame: int) -> AdjustmentResult | None:
        """Return the result if it is applied before this frame."""
        return self.settle() if self.is_due(frame) else None

    def settle(self) -> AdjustmentResult | None:
        """As ``take``, however recent the request."""
        if self.job is None:
            return None
        result = find_moves(self.job) if self.result is None else self.result
        self.job = self.result = None
        if result.moves is not None:
            self.move(result.moves)
        self.closed = self.closed or len(result.loops) > 0
        return result

    def move(self, moves: MapMoves) -> None:
        """The world frames of the loops have moved."""
        for n, loop in enumerate(self.loops):
            old, new = moves.matrices(np.array([loop.old, loop.new]))
            self.loops[n] = loop._replace(S_old_new=old @ loop.S_old_new @ np.linalg.inv(new))


def find_moves(job: AdjustmentJob) -> AdjustmentResult:
    """Run a job: how the map around each keyframe moves, and the readout."""
    if job.loops:
        return _close(job)
    before, xyz = job.seen.T_world_camera, job.seen.xyz
    depths = job.seen.depths()
    seen = replace(job.seen, T_world_camera=before.copy(), xyz=xyz.copy())
    known, parameters = job.known, job.parameters
    found = adjust_list(
        seen, known, parameters, iterations=parameters.whole_map.iterations, start=known.in_use,
        varying=True,
    )  # fmt: skip
    after = _learned(known, found)
    # A window of half the map is as good, unless it lacked the calibration or the loops.
    bent = (known.readout == 0.0 and after.readout != 0.0) or not after.sees_like(known)
    refocus = seen.log_focal - job.seen.log_focal
    bent = bent or job.closed or after.changes or bool(refocus.any())
    moving = bent or len(job.keyframe_ids) >= 2 * parameters.window.keyframes
    nothing = AdjustmentResult(None, [], known, 0)  # non-finite poses would spread
    if not np.isfinite(seen.T_world_camera).all():
        return nothing
    moves = _moves(job, seen, before, depths) if moving else None
    if moves is not None and not np.isfinite(moves.moves).all():
        return nothing
    return AdjustmentResult(moves, [], after, 0, refocus if refocus.any() else _NONE)


def _close(job: AdjustmentJob) -> AdjustmentResult:
    """Return the result of the pose graph; no moves if it rejects all loops."""
    moves, loops = close_loops(
        job.seen, job.keyframe_ids, job.sigmas, job.loops,
        job.known.view.camera.fx,
    )  # fmt: skip
    refused = len(job.loops) - len(loops)
    return AdjustmentResult(moves if loops else None, loops, job.known, refused)


def _learned(known: SelfCalibration, found: BundleResult) -> SelfCalibration:
    """Return the calibration with the new estimate.

    Focal lengths that change are relative to a lens, which then is the one estimated with them.
    """
    correction, covariance = found.correction, found.covariance
    changes = len(found.log_focal) > 0
    readout, sigma = float(correction[3]), float(np.sqrt(covariance[3, 3]))
    if known.readout == 0.0:
        readout, sigma = _without_prior(readout, sigma, known.uncertainty)
    known = replace(known, changes=changes)
    if changes or known.is_refuted(correction, covariance):
        known = known.with_lens(correction, covariance)
    return known.with_readout(readout, sigma)


def _without_prior(
    readout: float, sigma: float, prior: CalibrationUncertainty
) -> tuple[float, float]:
    """Return the readout that the images alone determine, and its standard deviation.

    A prior at 0 draws it there, the more the fewer keyframes there are: if a Gaussian of precision
    p results from one of precision p - p_0 and the prior, its mean is (p - p_0) / p of the first.
    """
    if sigma == 0.0:
        return 0.0, 0.0
    share = 1.0 - (sigma * prior.prior_px / prior.readout) ** 2
    if share < _LEAST_TOLD:
        return 0.0, sigma
    return readout / share, float(sigma / np.sqrt(share))


def _moves(job: AdjustmentJob, seen: ObservationList, before: F64, depths: F64) -> MapMoves:
    """Return how the map moves, which is as little as possible.

    Nothing fixes its position, rotation and scale.  If the beginning, the least certain part, were
    fixed, all that the camera sees now would jump by each correction of it.  So the rotations of
    the keyframes cancel out, by R, and their centres c and the scales r of their views, at the
    median depth d of all, change least: ``min over s, t: sum of |s R c' + t - c|^2 + d^2 (s r -
    1)^2``.

    before: (M, 4, 4) poses and depths: (O,) of the observations so far.
    """
    scales, d = seen.scales(depths), float(np.median(depths)) if len(depths) else 1.0
    T = seen.T_world_camera.copy()
    U, _, Vt = np.linalg.svd(np.einsum("nij,nkj->ik", before[:, :3, :3], T[:, :3, :3]))
    U[:, 2] *= np.sign(np.linalg.det(U @ Vt))
    R = U @ Vt
    c, c_new = before[:, :3, 3], T[:, :3, 3] @ R.T
    from_mean, new_from_mean = c - c.mean(axis=0), c_new - c_new.mean(axis=0)
    both = (from_mean * new_from_mean).sum() + d**2 * scales.sum()
    s = both / ((new_from_mean**2).sum() + d**2 * (scales**2).sum())
    T[:, :3, :3] = R @ T[:, :3, :3]
    T[:, :3, 3] = c.mean(axis=0) + s * new_from_mean
    return moves_between(job.keyframe_ids, before, T, s * scales)


def held(moves: MapMoves, spans: list[tuple[int, int]], segment: int) -> MapMoves:
    """Return the moves of one segment so that content of other segments' keyframes stays.

    spans: (first keyframe id, segment) of all keyframes, ascending: a recognised segment continues
    after others.
    """
    ids, rows = moves.keyframe_ids, moves.moves
    still = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0])
    for first, of in spans:
        at = int(np.searchsorted(ids, first))
        if at == 0 or (at < len(ids) and ids[at] == first):
            continue
        own = min(int(np.searchsorted(moves.keyframe_ids, first)), len(moves.moves) - 1)
        row = moves.moves[own] if of == segment else still
        ids, rows = np.insert(ids, at, first), np.insert(rows, at, row, axis=0)
    return MapMoves(keyframe_ids=ids, moves=rows)

"""Global bundle adjustment, in parallel with tracking: when it is requested, run, and applied.

The window corrects what is new.  Drift beyond it takes all keyframes.  Their adjustment takes
longer than a frame, so it works on a copy of the map.  Its result is applied a number of frames
later that the size of the map decides, not the time that it took: whoever does not have it by then
waits.  Where the shutter may roll the first adjustment comes with the first keyframes, for the
readout.

Meanwhile the map has grown and the window has moved.  So the result is not where the points are,
but how the map around each keyframe moves: one similarity for each, as drift is small within what
a keyframe sees.  The keyframes that were in the window move, too: in a map of a few dozen most of
the drift is there.  What is newer moves rigidly with the last of them.  All of it moves as little
as it can, so that poses from before and after fit together; at the end the beginning is back in
its place (``Segment.strayed``).  Lens, focal length and readout are estimated anew each time, and
used for what comes next once they certainly differ from those in use.

A loop requests an adjustment at once, and gets its result sooner: the pose graph of ``loops`` says
how the map moves, and an adjustment after it does the rest.  Where the graph refuses all loops
nothing moves.
"""

from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from pliant.algorithms.arrays import F64, I64
from pliant.algorithms.bundle.problem import BundleResult, CalibrationUncertainty
from pliant.algorithms.map_delta import MapMoves
from pliant.algorithms.mapping.final_adjustment import (
    ObservationList,
    adjust_list,
    list_observations,
    moves_between,
)
from pliant.algorithms.mapping.loops import Loop, close_loops
from pliant.algorithms.mapping.parameters import MappingParameters
from pliant.algorithms.mapping.rolling_shutter import readout_flow
from pliant.algorithms.mapping.segment import Segment
from pliant.algorithms.mapping.self_calibration import SelfCalibration

_LEAST_TOLD = 0.2
"""Share of what is known of the readout that the images must tell, and not the prior."""

_GRAPH_SHARE = 0.1
"""Of the time that an adjustment takes: the graph of its keyframes."""


_NONE: F64 = np.zeros(0)


@dataclass(frozen=True, kw_only=True)
class AdjustmentJob:
    """A copy of the map as it is after a frame, to be adjusted.

    keyframe_ids: (M,).   seen: what they see.   known: of the camera; ``seen`` has pixels of the
    rectified image.   loops: to be closed; where there are none all of it is adjusted.
    closed: whether some have just been.   sigmas: (N,) of the points that are seen.
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
        """Frames after which the result is taken over: the time that it takes to find grows with
        the observations."""
        limits = self.parameters.whole_map
        # Few keyframes take little time, and say what those that follow wait for.
        least = min(limits.distance_frames, len(self.keyframe_ids))
        distance = max(least, len(self.seen.px) // limits.observations_per_frame)
        return round(_GRAPH_SHARE * distance) if self.loops else distance


class AdjustmentResult(NamedTuple):
    """How the map moves, None where it does not; the loops that were closed, whose points are to be
    joined; what is known of the camera by now; how many loops the others contradict; by how much
    the log focal length of each keyframe changes, (0,) where it is the same for all."""

    moves: MapMoves | None
    loops: list[Loop]
    calibration: SelfCalibration
    refused: int
    refocus: F64 = _NONE


@dataclass(kw_only=True)
class GlobalAdjustment:
    """Requests an adjustment whenever the segment has grown by a share: all of them together cost
    a small multiple of the last.

    due: keyframes made at which it requests the next.    job: requested, and not yet applied.
    result: of the job, where a worker has finished it.    loops: to be closed by the next job,
    alone.    closed: whether some have been, and nothing was adjusted since.
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
        """Request the adjustment of the map as it is after a frame, where that is due."""
        camera = calibration.view.camera
        window, growth = parameters.window.keyframes, parameters.whole_map.growth
        count = len(segment.keyframes)
        # While the window has half of the map it does well by itself, but for the calibration.
        least = parameters.start.keyframes if parameters.calibration.sigmas.any() else 2 * window
        made = count + len(segment.dropped)
        early = growth == 0.0 or count < least or made < self.due
        # The window would move with what was there before the camera was recognised.
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
        seen = list_observations(segment.keyframes, points, calibration, parameters)
        if not loops:
            seen = seen.most_seen(parameters.whole_map.points_per_keyframe)
        seen.see_by(calibration.view)
        if parameters.calibration.readout > 0.0 and not loops:
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
        """Whether the result is applied before a frame is worked on."""
        job = self.job
        if job is None:
            return False
        return frame >= job.frame + job.distance_frames

    def take(self, frame: int) -> AdjustmentResult | None:
        """The result, where it is applied before a frame is worked on."""
        return self.settle() if self.is_due(frame) else None

    def settle(self) -> AdjustmentResult | None:
        """As ``take``, no matter how long ago it was requested."""
        if self.job is None:
            return None
        result = find_moves(self.job) if self.result is None else self.result
        self.job = self.result = None
        if result.moves is not None:
            self.move(result.moves)
        self.closed = self.closed or len(result.loops) > 0
        return result

    def move(self, moves: MapMoves) -> None:
        """The worlds that loops tell of have moved."""
        for n, loop in enumerate(self.loops):
            old, new = moves.matrices(np.array([loop.old, loop.new]))
            self.loops[n] = loop._replace(S_old_new=old @ loop.S_old_new @ np.linalg.inv(new))


def find_moves(job: AdjustmentJob) -> AdjustmentResult:
    """How each keyframe moves with what hangs on it, and the readout."""
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
    after = _learned(known, found, parameters.calibration)
    # A window that is half of the map does as well, unless it did not know the camera or the loops.
    bent = (known.readout == 0.0 and after.readout != 0.0) or not after.sees_like(known)
    refocus = seen.log_focal - job.seen.log_focal
    bent = bent or job.closed or after.changes or bool(refocus.any())
    moving = bent or len(job.keyframe_ids) >= 2 * parameters.window.keyframes
    nothing = AdjustmentResult(
        None, [], known, 0
    )  # poses that are not finite would spread to the whole map
    if not np.isfinite(seen.T_world_camera).all():
        return nothing
    moves = _moves(job, seen, before, depths) if moving else None
    if moves is not None and not np.isfinite(moves.moves).all():
        return nothing
    return AdjustmentResult(moves, [], after, 0, refocus if refocus.any() else _NONE)


def _close(job: AdjustmentJob) -> AdjustmentResult:
    """What the graph makes of the loops; nothing where it refuses all of them."""
    moves, loops = close_loops(
        job.seen, job.keyframe_ids, job.sigmas, job.loops,
        job.known.view.camera.fx,
    )  # fmt: skip
    refused = len(job.loops) - len(loops)
    return AdjustmentResult(moves if loops else None, loops, job.known, refused)


def _learned(
    known: SelfCalibration, found: BundleResult, prior: CalibrationUncertainty
) -> SelfCalibration:
    """What is known with what was found.  Focal lengths that change are relative to a lens, which
    then is the one that was found with them."""
    correction, covariance = found.correction, found.covariance
    changes = len(found.log_focal) > 0
    readout, sigma = float(correction[3]), float(np.sqrt(covariance[3, 3]))
    if known.readout == 0.0:
        readout, sigma = _without_prior(readout, sigma, prior)
    known = replace(known, changes=changes)
    if changes or known.is_refuted(correction, covariance, prior):
        known = known.with_lens(correction, covariance)
    return known.with_readout(readout, sigma)


def _without_prior(
    readout: float, sigma: float, prior: CalibrationUncertainty
) -> tuple[float, float]:
    """The readout that the images alone tell, and its standard deviation.

    A prior at 0 draws it there, and few keyframes are drawn far: of a Gaussian of precision p that
    remains from one of precision p - p_0 and the prior's, the mean is (p - p_0) / p of the first.
    """
    if sigma == 0.0:
        return 0.0, 0.0
    share = 1.0 - (sigma * prior.prior_px / prior.readout) ** 2
    if share < _LEAST_TOLD:
        return 0.0, sigma
    return readout / share, float(sigma / np.sqrt(share))


def _moves(job: AdjustmentJob, seen: ObservationList, before: F64, depths: F64) -> MapMoves:
    """How the map moves, which is as little as it can.

    Nothing holds its place, turn and scale.  Held by its beginning, which is known least, all that
    the camera sees now would jump with what is learnt of that.  So the turns of the keyframes
    cancel out, by R, and their centres c and the scales r of what they see, at the median depth d
    of all, change least: ``min over s, t: sum of |s R c' + t - c|^2 + d^2 (s r - 1)^2``.

    before: (M, 4, 4) poses and depths: (O,) of the observations until now.
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
    """The moves of one segment, told so that what hangs on others' keyframes stays.

    spans: (first keyframe id, segment) of all keyframes, ascending: a segment that was recognised
    goes on after others.
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

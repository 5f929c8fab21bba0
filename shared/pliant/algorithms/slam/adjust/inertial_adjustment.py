"""The final adjustment with inertial samples: keyframe poses on which images and sensor agree.

After bundle adjustment has converged, the samples are aligned with the keyframes.  Where the
alignment accepts them, the poses are estimated once more, by the information of all observations
and by the samples between keyframes (``inertial.coupling``).  Landmarks and calibration follow.
"""

from dataclasses import dataclass, field, replace
from enum import IntEnum

import numpy as np

from pliant.algorithms.arrays import F64, I64
from pliant.algorithms.inertial.alignment import (
    InertialAlignment,
    align_inertial,
    averaged_signal,
    noise_densities,
)
from pliant.algorithms.inertial.coupling import couple
from pliant.algorithms.inertial.preintegration import ImuSignal
from pliant.algorithms.inertial.residuals import GRAVITY_M_S2, Nodes, State
from pliant.algorithms.inertial.rotation_alignment import longest_gap_s
from pliant.algorithms.inertial.samples import ImuSamples
from pliant.algorithms.slam.estimate.problem import (
    BundleParameters,
    BundleProblem,
    BundleResult,
    CalibrationUncertainty,
)
from pliant.algorithms.slam.estimate.schur import solve_schur, system_at

_MOST_KEYFRAMES = 600
"""Time grows with the cube of their number: some 20 s of a core for 600."""
_LONGEST_S = 3.0
"""Between keyframes that samples tie."""
_AROUND_S = 0.05
"""By how much the offset may change."""
_MOST_SIGMA = 10.0
"""Times the given noise, of pixels and of samples: beyond it neither explains the other."""
_AS_PREDICTED = 2.0
"""Growth of the images' cost, relative to that of its parabola, which does not hold beyond it."""


class CouplingOutcome(IntEnum):
    """Whether the samples moved the keyframes of a segment, or why not."""

    MOVED = 0
    NOT_ALIGNED = 1
    UNKNOWN_TIMES = 2
    TOO_MANY = 3
    FOCAL_CHANGES = 4
    DIVERGED = 5
    TOO_NOISY = 6
    IMAGES_DISAGREE = 7
    CALIBRATION_FIXED = 8


@dataclass(frozen=True, kw_only=True)
class Coupling:
    """keyframes: of a segment.   moved_m: median by which the samples moved them, in metres."""

    outcome: CouplingOutcome
    keyframes: int
    moved_m: float = 0.0


@dataclass(frozen=True, kw_only=True)
class TimedSamples:
    """Inertial samples of the whole source, and when M keyframes and F frames were captured.

    keyframes_ns: (M,), -1: unknown.   frames_ns: (F,), ascending.   hosts: (F,) the keyframe of
    each frame, and T_host_frame (F, 4, 4) its pose relative to it.
    outcomes: receives what came of each adjustment.
    """

    samples: ImuSamples
    keyframes_ns: I64
    frames_ns: I64
    hosts: I64
    T_host_frame: F64
    outcomes: list[Coupling] = field(default_factory=list[Coupling])


def with_samples(
    problem: BundleProblem, found: BundleResult, parameters: BundleParameters,
    uncertainty: CalibrationUncertainty, timed: TimedSamples,
) -> BundleResult:  # fmt: skip
    """Return the adjustment after the samples, or as it was where they do not improve it."""
    after, metres_per_unit = found, 0.0
    outcome = _fault(found.T_world_camera, timed)
    if outcome is None:
        outcome, after, metres_per_unit = _coupled(problem, found, parameters, uncertainty, timed)
    moved = np.linalg.norm((after.T_world_camera - found.T_world_camera)[:, :3, 3], axis=1)
    moved_m = metres_per_unit * float(np.median(moved))
    timed.outcomes.append(Coupling(outcome=outcome, keyframes=len(moved), moved_m=moved_m))
    return after


def _fault(T: F64, timed: TimedSamples) -> CouplingOutcome | None:
    """Why these keyframes cannot be tied by samples; None if they can."""
    if len(T) > _MOST_KEYFRAMES:
        return CouplingOutcome.TOO_MANY
    if len(np.unique(timed.keyframes_ns)) < 2 or timed.keyframes_ns.min() < 0:
        return CouplingOutcome.UNKNOWN_TIMES
    return None


def _coupled(
    problem: BundleProblem, found: BundleResult, parameters: BundleParameters,
    uncertainty: CalibrationUncertainty, timed: TimedSamples,
) -> tuple[CouplingOutcome, BundleResult, float]:  # fmt: skip
    """The outcome, the adjustment, and metres of a unit."""
    T = found.T_world_camera
    frames = T[timed.hosts] @ timed.T_host_frame
    aligned = align_inertial(timed.frames_ns, frames, timed.samples)
    least_px = float(np.sqrt(found.residual_variance(problem)))
    if not isinstance(aligned, InertialAlignment) or least_px == 0.0:
        return CouplingOutcome.NOT_ALIGNED, found, 0.0
    order, chained = _in_time(timed.keyframes_ns)
    columns = (6 * order[:, None] + np.arange(6)).ravel()
    information = system_at(problem, found, parameters, uncertainty).pose_information()
    nodes, signal, start = start_of(T[order], timed.keyframes_ns[order], chained, timed, aligned)
    coupled = couple(
        nodes, information[np.ix_(columns, columns)], problem.fixed_cameras[order], signal, start,
        noise_densities(signal), least_px=least_px,
    )  # fmt: skip
    if coupled is None:
        return CouplingOutcome.DIVERGED, found, 0.0
    if max(coupled.pixel_sigma, coupled.inertial_sigma) > _MOST_SIGMA:
        return CouplingOutcome.TOO_NOISY, found, 0.0
    poses = T.copy()
    poses[order, :3, :3], poses[order, :3, 3] = coupled.state.R, coupled.state.p
    poses[problem.fixed_cameras] = T[problem.fixed_cameras]
    held = replace(
        problem, T_world_camera=poses, points_world=found.points_world,
        fixed_cameras=np.ones(len(T), np.bool_),
    )  # fmt: skip
    after = solve_schur(
        held, parameters, uncertainty=uncertainty, start=found.correction, doubled=True
    )
    if after.final_cost - found.final_cost > _AS_PREDICTED * coupled.cost:
        return CouplingOutcome.IMAGES_DISAGREE, found, 0.0
    moved = replace(after, covariance=found.covariance)
    return CouplingOutcome.MOVED, moved, coupled.state.scale


def _in_time(times_ns: I64) -> tuple[I64, int]:
    """Rows (M,) in order of time, and the number of the first of them that differ in time.

    Two passes make two keyframes of a frame that both read.  Samples tie the first of these only,
    and images tie the other to it.
    """
    first = np.unique(times_ns, return_index=True)[1]
    rest = np.setdiff1d(np.arange(len(times_ns)), first)
    return np.concatenate([first, rest]), len(first)


def start_of(
    T: F64, times_ns: I64, chained: int, timed: TimedSamples, aligned: InertialAlignment
) -> tuple[Nodes, ImuSignal, State]:
    """Return keyframes as nodes, the samples in seconds after the first of them, and the state by
    the alignment.

    T: (M, 4, 4), and times_ns (M,), ascending for the first ``chained`` keyframes.  Samples tie
    none of the others.
    """
    origin_ns, count = int(times_ns[0]), len(T)
    times_s = np.float64(1e-9) * (times_ns - origin_ns)
    signal = averaged_signal(timed.samples, origin_ns)
    signal = replace(signal, accel=aligned.accel_sign * signal.accel)
    at = times_s[:chained] + aligned.time_offset_s
    tied = np.zeros(count - 1, np.bool_)
    covered = signal.covers(at[:-1] - _AROUND_S, at[1:] + _AROUND_S, longest_gap_s(signal))
    tied[: chained - 1] = covered & (np.diff(at) <= _LONGEST_S)
    R, p = T[:, :3, :3], T[:, :3, 3]
    v = np.zeros((count, 3))
    v[:chained] = aligned.metres_per_unit * np.gradient(p[:chained], times_s[:chained], axis=0)
    start = State(
        R=R,
        p=p,
        v=v,
        scale=aligned.metres_per_unit,
        gravity=-GRAVITY_M_S2 * aligned.up,
        R_camera_imu=aligned.R_camera_imu,
        p_camera_imu=aligned.p_camera_imu,
        gyro_bias=np.tile(aligned.gyro_bias, (count, 1)),
        accel_bias=np.tile(aligned.accel_bias, (count, 1)),
        offset_s=aligned.time_offset_s,
    )
    return Nodes(times_s=times_s, R=R, p=p, tied=tied), signal, start

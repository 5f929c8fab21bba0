"""The final adjustment with inertial samples: keyframe poses on which images and sensor agree.

After bundle adjustment has converged, the samples are aligned with the keyframes.  Where the
alignment accepts them, the poses are estimated once more, by the information of all observations
and by the samples between keyframes (``inertial.coupling``).  Landmarks and calibration follow.
"""

from dataclasses import dataclass, replace

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


@dataclass(frozen=True, kw_only=True)
class TimedSamples:
    """Inertial samples of the whole source, and when M keyframes and F frames were captured.

    keyframes_ns: (M,).   frames_ns: (F,), ascending.   hosts: (F,) the keyframe of each frame, and
    T_host_frame (F, 4, 4) its pose relative to it.
    """

    samples: ImuSamples
    keyframes_ns: I64
    frames_ns: I64
    hosts: I64
    T_host_frame: F64


def with_samples(
    problem: BundleProblem, found: BundleResult, parameters: BundleParameters,
    uncertainty: CalibrationUncertainty, timed: TimedSamples,
) -> BundleResult:  # fmt: skip
    """Return the adjustment after the samples, or as it was where they do not improve it."""
    times_ns, T = timed.keyframes_ns, found.T_world_camera
    if not 2 <= len(T) <= _MOST_KEYFRAMES or times_ns.min() < 0 or (np.diff(times_ns) <= 0).any():
        return found
    frames = T[timed.hosts] @ timed.T_host_frame
    aligned = align_inertial(timed.frames_ns, frames, timed.samples)
    least_px = float(np.sqrt(found.residual_variance(problem)))
    if not isinstance(aligned, InertialAlignment) or least_px == 0.0:
        return found
    information = system_at(problem, found, parameters, uncertainty).pose_information()
    nodes, signal, start = start_of(T, timed, aligned)
    coupled = couple(
        nodes, information, problem.fixed_cameras, signal, start, noise_densities(signal),
        least_px=least_px,
    )  # fmt: skip
    if coupled is None or max(coupled.pixel_sigma, coupled.inertial_sigma) > _MOST_SIGMA:
        return found
    poses = T.copy()
    free = ~problem.fixed_cameras
    poses[free, :3, :3], poses[free, :3, 3] = coupled.state.R[free], coupled.state.p[free]
    held = replace(
        problem, T_world_camera=poses, points_world=found.points_world,
        fixed_cameras=np.ones(len(T), np.bool_),
    )  # fmt: skip
    after = solve_schur(
        held, parameters, uncertainty=uncertainty, start=found.correction, doubled=True
    )
    if after.final_cost - found.final_cost > _AS_PREDICTED * coupled.cost:
        return found
    return replace(after, covariance=found.covariance)


def start_of(
    T: F64, timed: TimedSamples, aligned: InertialAlignment
) -> tuple[Nodes, ImuSignal, State]:
    """Return the keyframes with poses T (M, 4, 4) as nodes, the samples in seconds after the first
    of them, and the state by the alignment.
    """
    origin_ns, count = int(timed.keyframes_ns[0]), len(T)
    times_s = np.float64(1e-9) * (timed.keyframes_ns - origin_ns)
    signal = averaged_signal(timed.samples, origin_ns)
    at = times_s + aligned.time_offset_s
    tied = signal.covers(at[:-1] - _AROUND_S, at[1:] + _AROUND_S, longest_gap_s(signal))
    tied &= np.diff(times_s) <= _LONGEST_S
    R, p = T[:, :3, :3], T[:, :3, 3]
    start = State(
        R=R,
        p=p,
        v=aligned.metres_per_unit * np.gradient(p, times_s, axis=0),
        scale=aligned.metres_per_unit,
        gravity=-GRAVITY_M_S2 * aligned.up,
        R_camera_imu=aligned.R_camera_imu,
        p_camera_imu=aligned.p_camera_imu,
        gyro_bias=np.tile(aligned.gyro_bias, (count, 1)),
        accel_bias=np.tile(aligned.accel_bias, (count, 1)),
        offset_s=aligned.time_offset_s,
    )
    return Nodes(times_s=times_s, R=R, p=p, tied=tied), signal, start

"""The metric scale and the vertical of a finished trajectory, from inertial samples of an unknown
sensor; or why they cannot be had."""

from dataclasses import dataclass, replace

import numpy as np

from pliant.algorithms.arrays import F64, I64
from pliant.algorithms.inertial.estimator import NOISE_RANGE, Estimate, estimate
from pliant.algorithms.inertial.preintegration import GyroSignal, ImuSignal, NoiseDensity
from pliant.algorithms.inertial.residuals import GRAVITY, GRAVITY_M_S2, OFFSET, TURN, Nodes, State
from pliant.algorithms.inertial.rotation_alignment import (
    RotationAlignment,
    align_rotation,
    longest_gap_s,
    turns_of,
)
from pliant.algorithms.inertial.samples import ImuSamples

_NODE_S = 0.2
"""Between nodes: hands and drones accelerate by hardly more than 2 Hz, and errors of poses nearer
in time are alike."""
_LONGEST_S = 1.0
"""Between two tied nodes: in longer times a cheap sensor drifts."""
_BLOCK_S = 3.0
"""Errors of poses farther apart are independent: a camera sees other points by then."""
_MOST_NODES = 3000
_STRETCH = 50
"""Nodes that stay together where there are more."""
_RATE_HZ = 250.0
"""Samples of twice this rate and more are averaged: a camera that is carried moves slower."""
_AROUND_S = 0.05
"""By how much the offset may change after it was found by rotations."""
_LEAST_DENSITY = NoiseDensity(gyro=1e-4, accel=1e-3)
"""Below those of any sensor that is carried with a camera."""
_LEAST = 20
"""Poses, samples, and intervals between nodes."""
_EXPLAINED = 0.9
"""Of the square of the angular velocity.  A camera that was calibrated badly and a cheap gyro
differ by some percent of the angular velocity, in-camera stabilisation by most of it."""
_SMOOTHED = 0.003
"""Standard deviation of the scale, as a share, that all parts of a trajectory have in common: an
estimated one is smoother than the motion, and accelerometers have scale factors."""
_MOST_SIGMA = 0.05
"""Of the scale, as a share: beyond 5 % an estimate by eye is as good."""
_BIASES_M_S2 = 1.0
"""3 standard deviations of the length of an accelerometer's bias."""
_SPEED_CHANGE_M_S = 10.0
"""Of a carried sensor, between begin and end."""


@dataclass(frozen=True, kw_only=True)
class InertialAlignment:
    """Scale, vertical and sensor of a trajectory, with standard deviations.

    metres_per_unit: of the trajectory.   scale_sigma: as a share of it.   up: (3,) unit vector
    against gravity, in the trajectory's world; up_sigma_rad: of its direction.
    time_offset_s: t_imu - t_camera.   R_camera_imu, p_camera_imu: of the sensor, metres.
    gyro_bias, accel_bias: (3,) means over time.   accel_sign: -1 if the samples are the negative of
    the specific force (at rest -9.81 m/s^2 upwards), otherwise 1.
    explained: of the camera's rotation by the gyro.   seconds: in which poses and samples were
    compared.
    """

    metres_per_unit: float
    scale_sigma: float
    up: F64
    up_sigma_rad: float
    time_offset_s: float
    time_offset_sigma_s: float
    R_camera_imu: F64
    R_camera_imu_sigma_rad: float
    p_camera_imu: F64
    gyro_bias: F64
    accel_bias: F64
    accel_sign: float
    explained: float
    seconds: float


@dataclass(frozen=True)
class Refusal:
    """Why samples determine nothing reliable of a trajectory: one line, with figures."""

    reason: str


def align_inertial(
    stamps_ns: I64, T_world_camera: F64, samples: ImuSamples
) -> InertialAlignment | Refusal:
    """From the poses of one map segment: stamps (N,), ascending, and (N, 4, 4), in any unit."""
    if len(stamps_ns) < _LEAST or len(samples.stamps_ns) < _LEAST:
        return Refusal(
            f"{len(stamps_ns)} poses and {len(samples.stamps_ns)} inertial samples: "
            f"at least {_LEAST} of both are needed"
        )
    times_s = (stamps_ns - stamps_ns[0]) * 1e-9
    signal = averaged_signal(samples, int(stamps_ns[0]))
    gap_s = longest_gap_s(signal)
    rotation = align_rotation(times_s, turns_of(T_world_camera[:, :3, :3]), signal, gap_s)
    why = rotation_fault(rotation)
    if why or rotation is None:
        return Refusal(why)
    centred = T_world_camera[:, :3, 3] - T_world_camera[:, :3, 3].mean(axis=0)
    extent = float(np.sqrt((centred**2).sum(axis=1).mean()))
    if extent == 0.0:
        return Refusal("the camera does not move")
    nodes = _nodes(times_s, T_world_camera[:, :3, :3], centred / extent, signal, rotation, gap_s)
    tied = int(nodes.tied.sum())
    if tied < _LEAST:
        return Refusal(
            f"poses and inertial samples without gaps have {tied * _NODE_S:.1f} s in common: "
            f"at least {_LEAST * _NODE_S:.0f} s are needed"
        )
    allowed = _BIASES_M_S2 + _SPEED_CHANGE_M_S / (tied * _NODE_S)
    shown = float(np.linalg.norm(_mean_force(nodes, signal, rotation)))
    if abs(shown - GRAVITY_M_S2) > allowed:
        return Refusal(
            f"the accelerometer shows {shown:.1f} m/s^2 on average instead of {GRAVITY_M_S2}: "
            "its unit is another, or its axes are not those of the gyro"
        )
    for sign in (1.0, -1.0):
        found = _best(nodes, replace(signal, accel=sign * signal.accel), rotation)
        if found is not None and np.isfinite(_misfit(found)):
            return _judged(found, sign, nodes, rotation, extent)
    return Refusal(
        "the accelerometer does not fit the camera's motion at any scale: samples of another "
        "video, or hardly an acceleration (positions would be wrong by "
        f"{NOISE_RANGE[1]:.0%} of the trajectory's extent)"
    )


def averaged_signal(samples: ImuSamples, origin_ns: int) -> ImuSignal:
    """In seconds of the camera's first stamp, averaged where there are too many samples."""
    times_s = np.float64(1e-9) * (samples.stamps_ns - origin_ns)
    together = int(max(1.0 / (_RATE_HZ * float(np.median(np.diff(times_s)))), 1.0))
    count = len(times_s) // together

    def averaged(values: F64) -> F64:
        grouped = values[: count * together].reshape(count, together, *values.shape[1:])
        return np.asarray(grouped.mean(axis=1), np.float64)

    return ImuSignal(
        times_s=averaged(times_s),
        gyro=averaged(samples.gyro_rad_s),
        accel=averaged(samples.accel_m_s2),
    )


def noise_densities(signal: ImuSignal) -> NoiseDensity:
    """Of white noise, by the third differences of samples, of which the motion has little.

    The median of their squares is that of noise even where shocks are in between.
    """
    return NoiseDensity(
        gyro=gyro_noise_density(signal),
        accel=max(_noise_density(signal.times_s, signal.accel), _LEAST_DENSITY.accel),
    )


def gyro_noise_density(signal: GyroSignal) -> float:
    """That of the gyro alone, rad/s/sqrt(Hz)."""
    return max(_noise_density(signal.times_s, signal.gyro), _LEAST_DENSITY.gyro)


def _noise_density(times_s: F64, values: F64) -> float:
    root = float(np.sqrt(np.median(np.diff(times_s))))
    third = np.diff(values, n=3, axis=0)
    # 1, 3, 3 and 1 times the noise; 0.455 is the median of a squared normal variable.
    return float(np.sqrt(np.median(third**2) / (20.0 * 0.455))) * root


def rotation_fault(rotation: RotationAlignment | None) -> str:
    """Why the gyro does not fit the camera; "" if it does."""
    if rotation is None:
        return "poses and inertial samples without gaps do not overlap in time"
    fits = rotation.correlation**2
    if fits < _EXPLAINED <= rotation.mirrored**2:
        return (
            f"the axes of the gyro are left-handed: mirrored they fit the camera's rotation "
            f"(r {rotation.mirrored:.2f}), as they are they do not (r {rotation.correlation:.2f})"
        )
    if fits < _EXPLAINED:
        return (
            f"the gyro explains {fits:.0%} of the camera's rotation, {_EXPLAINED:.0%} are needed "
            f"(r {rotation.correlation:.2f}; the camera turns by {rotation.rate_rad_s:.2f} rad/s): "
            "stabilisation in the camera, samples of another video, or hardly a turn"
        )
    if rotation.explained < _EXPLAINED:
        return (
            f"the gyro turns {rotation.gain:.3g} times as fast as the camera: its unit is not "
            "rad/s, or the camera's focal length is wrong"
        )
    return ""


def _nodes(
    times_s: F64, R: F64, p: F64, signal: ImuSignal, rotation: RotationAlignment, gap_s: float
) -> Nodes:
    """Poses at least ``_NODE_S`` apart."""
    rows = [0]
    for row, time_s in enumerate(times_s.tolist()):
        if time_s - times_s[rows[-1]] > 0.999 * _NODE_S:
            rows.append(row)
    kept = np.array(rows)
    times = times_s[kept]
    starts, ends = times[:-1] + rotation.offset_s, times[1:] + rotation.offset_s
    tied = signal.covers(starts - _AROUND_S, ends + _AROUND_S, gap_s)
    tied &= np.diff(times) <= _LONGEST_S
    share = min(_MOST_NODES / len(times), 1.0)
    # Of a long recording, stretches that are spread evenly.
    stretch = np.arange(len(tied)) // _STRETCH
    tied &= np.floor((stretch + 1) * share) > np.floor(stretch * share)
    return Nodes(times_s=times, R=R[kept], p=p[kept], tied=tied)


def _world_forces(nodes: Nodes, signal: ImuSignal, rotation: RotationAlignment) -> F64:
    """Specific forces (K, 3) in the trajectory's world, averaged around tied nodes."""
    at = (nodes.times_s + rotation.offset_s)[:-1][nodes.tied]
    spread = np.linspace(0.0, _NODE_S, 5)
    _, forces = signal.at(at[:, None] + spread)
    R = nodes.R[:-1][nodes.tied] @ rotation.R_camera_imu
    return (R @ forces.mean(axis=1)[:, :, None])[:, :, 0]


def _mean_force(nodes: Nodes, signal: ImuSignal, rotation: RotationAlignment) -> F64:
    """Minus gravity, up to what the speed changes between begin and end: (3,).  Of the rotations
    that the gyro leaves open, the one with which it is longest."""
    means = [
        _world_forces(nodes, signal, replace(rotation, R_camera_imu=R)).mean(axis=0)
        for R in rotation.starts
    ]
    return max(means, key=lambda mean: float(np.linalg.norm(mean)))


def _best(nodes: Nodes, signal: ImuSignal, rotation: RotationAlignment) -> Estimate | None:
    """The estimate that leaves the least noise to the positions."""
    densities, best = noise_densities(signal), None
    for R_camera_imu in rotation.starts:
        start = _start(nodes, signal, replace(rotation, R_camera_imu=R_camera_imu))
        found = estimate(nodes, signal, start, densities, block_s=_BLOCK_S)
        if found is not None and (best is None or _misfit(found) < _misfit(best)):
            best = found
    return best


def _misfit(found: Estimate) -> float:
    """Standard deviation of positions in metres, where the estimate did not give up."""
    given_up = found.noise.position >= NOISE_RANGE[1] or found.noise.rotation >= NOISE_RANGE[1]
    return float("inf") if given_up else found.noise.position * found.state.scale


def _start(nodes: Nodes, signal: ImuSignal, rotation: RotationAlignment) -> State:
    """Gravity by the mean force, and the scale by the lengths of both accelerations."""
    forces = _world_forces(nodes, signal, rotation)
    mean = forces.mean(axis=0)
    gravity = -mean * (GRAVITY_M_S2 / (float(np.linalg.norm(mean)) + 1e-9))
    v = np.gradient(nodes.p, nodes.times_s, axis=0)
    bent = np.gradient(v, nodes.times_s, axis=0)[:-1][nodes.tied]
    scale = float(np.linalg.norm(forces + gravity) / (np.linalg.norm(bent) + 1e-9))
    return State(
        R=nodes.R,
        p=nodes.p,
        v=v * scale,
        scale=scale,
        gravity=gravity,
        R_camera_imu=rotation.R_camera_imu,
        p_camera_imu=np.zeros(3),
        gyro_bias=np.tile(rotation.gyro_bias, (len(nodes.p), 1)),
        accel_bias=np.zeros(nodes.p.shape),
        offset_s=rotation.offset_s,
    )


def _judged(
    found: Estimate, accel_sign: float, nodes: Nodes, rotation: RotationAlignment, extent: float
) -> InertialAlignment | Refusal:
    # Blocks are few in a short clip: their spread alone would be small by chance.
    independent = np.diag(np.linalg.inv(found.information))
    sigmas = np.sqrt(np.maximum(np.diag(found.covariance), independent))
    state, sigma = found.state, float(np.hypot(sigmas[0], _SMOOTHED))
    if not sigma <= _MOST_SIGMA:
        return Refusal(
            f"the scale is known to +- {min(sigma, 9.99):.0%} only ({_MOST_SIGMA:.0%} needed): the "
            "camera accelerates too little, or moves too uniformly; move it briskly to and fro"
        )
    return InertialAlignment(
        metres_per_unit=state.scale / extent,
        scale_sigma=sigma,
        up=-state.gravity / GRAVITY_M_S2,
        up_sigma_rad=float(np.linalg.norm(sigmas[GRAVITY])),
        time_offset_s=state.offset_s,
        time_offset_sigma_s=float(sigmas[OFFSET][0]),
        R_camera_imu=state.R_camera_imu,
        R_camera_imu_sigma_rad=float(np.linalg.norm(sigmas[TURN])),
        p_camera_imu=state.p_camera_imu,
        gyro_bias=state.gyro_bias.mean(axis=0),
        accel_bias=state.accel_bias.mean(axis=0),
        accel_sign=accel_sign,
        explained=rotation.explained,
        seconds=float(np.diff(nodes.times_s)[nodes.tied].sum()),
    )

"""Exact inertial samples of known motions, for tests and benchmarks."""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation, RotationSpline

from pliant.algorithms.arrays import F64, I64
from pliant.algorithms.inertial.samples import ImuSamples

GRAVITY = np.array([0.0, 0.0, -9.81])


@dataclass(frozen=True, kw_only=True)
class Sensor:
    """rate_hz: of its samples.  Densities of white noise, and of the biases' random walks, in SI
    units.  Biases: of the start."""

    rate_hz: float
    gyro_noise: float
    accel_noise: float
    gyro_walk: float
    accel_walk: float
    gyro_bias: float
    accel_bias: float


ADIS16448 = Sensor(
    rate_hz=200.0, gyro_noise=1.7e-4, accel_noise=2.0e-3, gyro_walk=1.9e-5, accel_walk=3.0e-3,
    gyro_bias=0.075, accel_bias=0.15,
)  # fmt: skip
"""EuRoC's, by the data set's sensor.yaml (Burri et al. 2016)."""
PHONE = Sensor(
    rate_hz=100.0, gyro_noise=3.0e-4, accel_noise=3.0e-3, gyro_walk=1.0e-5, accel_walk=5.0e-4,
    gyro_bias=0.01, accel_bias=0.1,
)  # fmt: skip
PERFECT = Sensor(
    rate_hz=200.0, gyro_noise=0.0, accel_noise=0.0, gyro_walk=0.0, accel_walk=0.0,
    gyro_bias=0.0, accel_bias=0.0,
)  # fmt: skip


class Motion:
    """A camera's motion through stamped poses: twice continuously differentiable splines."""

    def __init__(self, stamps_ns: I64, T_world_camera: F64) -> None:
        self.stamps_ns = stamps_ns
        self.origin_ns = int(stamps_ns[0])
        self.times_s: F64 = (stamps_ns - self.origin_ns) * 1e-9
        self._positions = make_interp_spline(self.times_s, T_world_camera[:, :3, 3], k=5)
        self._rotations = RotationSpline(
            self.times_s, Rotation.from_matrix(T_world_camera[:, :3, :3])
        )

    def T_world_camera(self, times_s: F64) -> F64:
        """(N, 4, 4) at times after the first pose."""
        T = np.tile(np.eye(4), (len(times_s), 1, 1))
        T[:, :3, :3] = self._rotations(times_s).as_matrix()
        T[:, :3, 3] = self._positions(times_s)
        return T

    def measured(self, times_s: F64, R_camera_imu: F64, p_camera_imu: F64) -> tuple[F64, F64]:
        """Angular velocity and specific force (N, 3) of an ideal sensor."""
        R = self._rotations(times_s).as_matrix() @ R_camera_imu
        rate = self._rotations(times_s, 1)
        change = self._rotations(times_s, 2)
        accel = self._positions(times_s, nu=2)
        lever = np.cross(change, p_camera_imu) + np.cross(rate, np.cross(rate, p_camera_imu))
        accel = accel + (self._rotations(times_s).as_matrix() @ lever[:, :, None])[:, :, 0]
        force = (R.swapaxes(1, 2) @ (accel - GRAVITY)[:, :, None])[:, :, 0]
        return rate @ R_camera_imu, force


def samples_of(
    motion: Motion, sensor: Sensor, rng: np.random.Generator, *, R_camera_imu: F64,
    p_camera_imu: F64, offset_s: float,
) -> ImuSamples:  # fmt: skip
    """What a sensor records, whose clock shows ``offset_s`` more than the camera's."""
    step = 1.0 / sensor.rate_hz
    times: F64 = np.arange(motion.times_s[0] + 0.37 * step, motion.times_s[-1], step)
    gyro, accel = motion.measured(times, R_camera_imu, p_camera_imu)
    count = len(times)

    def disturbed(values: F64, bias: float, walk: float, noise: float) -> F64:
        start = bias * _direction(rng)
        walked = np.cumsum(rng.normal(size=(count, 3)), axis=0) * walk * np.sqrt(step)
        return values + start + walked + rng.normal(size=(count, 3)) * noise / np.sqrt(step)

    stamps = motion.origin_ns + np.rint((times + offset_s) * 1e9).astype(np.int64)
    return ImuSamples(
        stamps_ns=stamps,
        gyro_rad_s=disturbed(gyro, sensor.gyro_bias, sensor.gyro_walk, sensor.gyro_noise),
        accel_m_s2=disturbed(accel, sensor.accel_bias, sensor.accel_walk, sensor.accel_noise),
    )


def hand_held(seconds: float, *, seed: int = 0) -> Motion:
    """Poses at 20 Hz of a camera that is waved about: 0.5 m/s^2 and 0.6 rad/s, below 1 Hz."""
    rng = np.random.default_rng(seed)
    times: F64 = np.arange(0.0, seconds, 0.05)
    frequencies = rng.uniform(0.1, 0.8, (6, 6))
    phases = rng.uniform(0.0, 2.0 * np.pi, (6, 6))
    waves = np.sin(2.0 * np.pi * frequencies * times[:, None, None] + phases)
    speeds = waves / (2.0 * np.pi * frequencies)
    T = np.tile(np.eye(4), (len(times), 1, 1))
    T[:, :3, 3] = 0.15 * (speeds[:, :3] / frequencies[:3]).sum(axis=2)
    turns = 0.35 * speeds[:, 3:].sum(axis=2)
    T[:, :3, :3] = Rotation.from_rotvec(turns).as_matrix()
    return Motion(1_000_000_000 + np.rint(times * 1e9).astype(np.int64), T)


def _direction(rng: np.random.Generator) -> F64:
    vector = rng.normal(size=3)
    return vector / np.linalg.norm(vector)

"""Scale, vertical and sensor of a trajectory, from exact inertial samples with noise."""

from dataclasses import replace

import numpy as np
import pytest
from inertial_motion import GRAVITY, PERFECT, PHONE, Motion, Sensor, hand_held, samples_of

from pliant.algorithms.arrays import F64
from pliant.algorithms.geometry import quat_from_rotation, rotation_from_quat, so3_exp, so3_log
from pliant.algorithms.inertial import alignment
from pliant.algorithms.inertial.alignment import InertialAlignment, Refusal, align_inertial
from pliant.algorithms.inertial.chain import solve_chain
from pliant.algorithms.inertial.preintegration import (
    ImuSignal,
    NoiseDensity,
    Preintegrated,
    preintegrate,
)
from pliant.algorithms.inertial.residuals import COMMON, OWN, State, linearised
from pliant.algorithms.inertial.rotation_alignment import align_rotation, turns_of
from pliant.algorithms.inertial.samples import ImuSamples

R_CAMERA_IMU = so3_exp(np.array([0.3, 2.0, 1.0]))
P_CAMERA_IMU = np.array([0.03, 0.02, -0.04])
DENSITIES = NoiseDensity(gyro=1e-3, accel=1e-2)
UNIT_M = 3.7
"""Metres in a unit of the estimated trajectories."""


def measured(
    motion: Motion, seed: int, sensor: Sensor = PHONE, offset_s: float = 0.4
) -> tuple[F64, ImuSamples]:
    """Poses with noise in a world and a unit of their own, and samples."""
    rng = np.random.default_rng(seed)
    samples = samples_of(
        motion, sensor, rng, R_camera_imu=R_CAMERA_IMU, p_camera_imu=P_CAMERA_IMU, offset_s=offset_s
    )
    return estimated(motion, rng), samples


def estimated(motion: Motion, rng: np.random.Generator, noise_m: float = 0.002) -> F64:
    T = motion.T_world_camera(motion.times_s)
    turned = T[:, :3, :3] @ so3_exp(np.radians(0.1) * rng.normal(size=(len(T), 3)))
    T[:, :3, :3] = WORLD @ turned
    T[:, :3, 3] = (T[:, :3, 3] + noise_m * rng.normal(size=(len(T), 3))) @ WORLD.T / UNIT_M
    return T


WORLD = so3_exp(np.array([1.0, -0.5, 2.0]))


def aligned(motion: Motion, poses: F64, samples: ImuSamples) -> InertialAlignment:
    found = align_inertial(motion.stamps_ns, poses, samples)
    assert isinstance(found, InertialAlignment), found
    return found


def refused(motion: Motion, poses: F64, samples: ImuSamples) -> str:
    found = align_inertial(motion.stamps_ns, poses, samples)
    assert isinstance(found, Refusal), found
    assert "\n" not in found.reason
    return found.reason


def angle_deg(R: F64) -> float:
    return float(np.degrees(np.linalg.norm(so3_log(R))))


@pytest.fixture(scope="module")
def walk() -> Motion:
    return hand_held(20.0)


def test_finds_scale_vertical_and_sensor(walk: Motion) -> None:
    poses, samples = measured(walk, 1)
    found = aligned(walk, poses, samples)
    assert found.metres_per_unit == pytest.approx(UNIT_M, rel=0.01)
    assert found.scale_sigma < 0.01
    assert np.degrees(np.arccos(found.up @ WORLD[:, 2])) < 0.3
    assert found.time_offset_s == pytest.approx(0.4, abs=0.002)
    assert angle_deg(found.R_camera_imu.T @ R_CAMERA_IMU) < 0.5
    assert np.abs(found.p_camera_imu - P_CAMERA_IMU).max() < 0.03


def test_gives_the_same_bytes_again(walk: Motion) -> None:
    poses, samples = measured(walk, 1)
    first, second = (aligned(walk, poses, samples) for _ in range(2))
    for name, value in vars(first).items():
        assert np.asarray(value).tobytes() == np.asarray(getattr(second, name)).tobytes()


def test_errors_are_as_large_as_their_standard_deviations(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(alignment, "_SMOOTHED", 0.0)  # these poses are not
    motion = hand_held(15.0)
    scale, vertical, offset = [], [], []
    for seed in range(20):
        samples = measured(motion, seed, offset_s=0.1 * seed - 1.0)[1]
        poses = estimated(motion, np.random.default_rng(100 + seed), noise_m=0.02)
        found = aligned(motion, poses, samples)
        scale.append((found.metres_per_unit / UNIT_M - 1.0) / found.scale_sigma)
        vertical.append(np.linalg.norm(found.up - WORLD[:, 2]) / found.up_sigma_rad)
        offset.append((found.time_offset_s - (0.1 * seed - 1.0)) / found.time_offset_sigma_s)
    for errors in (scale, vertical, offset):
        # 99.9 % of the root mean squares of 20 normal numbers are between 0.51 and 1.5.
        assert 0.5 < np.sqrt(np.mean(np.square(errors))) < 1.6


def axis_orders() -> list[F64]:
    """The 24 rotations that permute the axes."""
    found = []
    for order in ([0, 1, 2], [1, 2, 0], [2, 0, 1], [0, 2, 1], [2, 1, 0], [1, 0, 2]):
        for signs in np.ndindex(2, 2, 2):
            R = np.eye(3)[order] * (1.0 - 2.0 * np.array(signs))
            found += [R] if np.linalg.det(R) > 0.0 else []
    return found


def test_any_axis_order_and_offset(walk: Motion) -> None:
    poses, samples = measured(walk, 2)
    orders = axis_orders()
    assert len(orders) == 24
    times_s = (walk.stamps_ns - walk.stamps_ns[0]) * 1e-9
    for number, order in enumerate(orders):
        shift_s = 0.7 * number - 8.0
        signal = ImuSignal(
            times_s=(samples.stamps_ns - walk.stamps_ns[0]) * 1e-9 + shift_s,
            gyro=samples.gyro_rad_s @ order,
            accel=samples.accel_m_s2 @ order,
        )
        found = align_rotation(times_s, turns_of(poses[:, :3, :3]), signal, 0.04)
        assert found is not None
        assert angle_deg(found.R_camera_imu.T @ R_CAMERA_IMU @ order) < 0.5
        assert found.offset_s == pytest.approx(0.4 + shift_s, abs=0.003)


def test_turns_about_one_axis_are_enough(walk: Motion) -> None:
    T = walk.T_world_camera(walk.times_s)
    T[:, :3, :3] = so3_exp(np.outer(0.6 * np.sin(0.1 * walk.times_s**2), [0.0, 0.0, 1.0]))
    motion = Motion(walk.stamps_ns, T)
    poses, samples = measured(motion, 3)
    found = aligned(motion, poses, samples)
    assert abs(found.metres_per_unit / UNIT_M - 1.0) < 3.0 * found.scale_sigma < 0.05


def test_samples_with_gaps(walk: Motion) -> None:
    poses, samples = measured(walk, 4)
    times = (samples.stamps_ns - samples.stamps_ns[0]) * 1e-9
    kept = (times % 3.1) > 0.4
    found = aligned(walk, poses, ImuSamples(**{k: v[kept] for k, v in vars(samples).items()}))
    assert abs(found.metres_per_unit / UNIT_M - 1.0) < max(3.0 * found.scale_sigma, 0.01)


def test_accelerations_of_the_opposite_sign(walk: Motion) -> None:
    poses, samples = measured(walk, 4)
    given = aligned(walk, poses, samples)
    found = aligned(walk, poses, replace(samples, accel_m_s2=-samples.accel_m_s2))
    assert (given.accel_sign, found.accel_sign) == (1.0, -1.0)
    assert found.metres_per_unit == given.metres_per_unit
    assert found.up.tolist() == given.up.tolist()


def test_refuses_samples_of_another_motion(walk: Motion) -> None:
    poses, samples = measured(walk, 5)
    other = measured(hand_held(20.0, seed=9), 5)[1]
    assert "the gyro explains" in refused(walk, poses, other)
    mixed = replace(samples, accel_m_s2=other.accel_m_s2)
    assert "accelerometer" in refused(walk, poses, mixed)


def test_refuses_wrong_axes_and_units(walk: Motion) -> None:
    poses, samples = measured(walk, 6)
    swapped = [1, 0, 2]
    gyro, accel = samples.gyro_rad_s, samples.accel_m_s2
    both = replace(samples, gyro_rad_s=gyro[:, swapped], accel_m_s2=accel[:, swapped])
    assert "left-handed" in refused(walk, poses, both)
    for order in (swapped, [1, 2, 0], [2, 0, 1]):
        assert "accelerometer" in refused(walk, poses, replace(samples, accel_m_s2=accel[:, order]))
    assert "1.0 m/s^2 on average" in refused(walk, poses, replace(samples, accel_m_s2=accel / 9.81))
    assert "57.3 times as fast" in refused(
        walk, poses, replace(samples, gyro_rad_s=gyro * 57.3)
    ).replace("57.2", "57.3").replace("57.4", "57.3")


def test_refuses_stabilised_images(walk: Motion) -> None:
    poses, samples = measured(walk, 7)
    quat = quat_from_rotation(poses[:, :3, :3])
    quat = np.where((quat @ quat[0])[:, None] < 0.0, -quat, quat)
    window = np.ones(31) / 31.0
    padded = np.pad(quat, ((15, 15), (0, 0)), mode="edge")
    smooth = np.column_stack([np.convolve(column, window, "valid") for column in padded.T])
    poses[:, :3, :3] = rotation_from_quat(smooth)
    assert "stabilisation in the camera" in refused(walk, poses, samples)


def test_refuses_too_little_motion(walk: Motion) -> None:
    T = walk.T_world_camera(walk.times_s)
    samples = measured(walk, 8)[1]
    still = T.copy()
    still[:] = T[0]
    rng = np.random.default_rng(8)
    shaken = estimated(Motion(walk.stamps_ns, still), rng)
    assert "hardly a turn" in refused(walk, shaken, samples)
    line = T.copy()
    line[:, :3, 3] = np.outer(walk.times_s, [0.5, 0.2, 0.1])
    for positions in (line, np.where(np.arange(4) == 3, still, T)):
        motion = Motion(walk.stamps_ns, positions)
        assert "acceler" in refused(motion, *measured(motion, 8))


def test_refuses_what_is_no_data(walk: Motion) -> None:
    poses, samples = measured(walk, 9)
    assert "0 inertial samples" in refused(walk, poses, ImuSamples.empty())
    few = ImuSamples(**{k: v[::40] for k, v in vars(samples).items()})
    assert isinstance(align_inertial(walk.stamps_ns, poses, few), Refusal | InertialAlignment)
    zero = replace(samples, accel_m_s2=np.zeros_like(samples.accel_m_s2))
    assert "accelerometer shows 0.0" in refused(walk, poses, zero)
    on_the_spot = poses.copy()
    on_the_spot[:, :3, 3] = 1.0
    assert refused(walk, on_the_spot, samples) == "the camera does not move"


def test_long_and_fast_recordings_are_thinned_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(alignment, "_MOST_NODES", 60)
    motion = hand_held(40.0)
    poses, samples = measured(motion, 10, replace(PHONE, rate_hz=1000.0))
    found = aligned(motion, poses, samples)
    assert found.seconds < 25.0
    assert found.metres_per_unit == pytest.approx(UNIT_M, rel=0.03)


# The parts.


def test_chains_are_solved_as_dense_equations() -> None:
    rng = np.random.default_rng(0)
    for count in range(1, 12):
        blocks = rng.normal(size=(count, 3, 3))
        diagonal = blocks @ blocks.swapaxes(1, 2) + 5.0 * np.eye(3)
        upper, right = rng.normal(size=(count - 1, 3, 3)), rng.normal(size=(count, 3, 2))
        dense = np.zeros((3 * count, 3 * count))
        for i in range(count):
            dense[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = diagonal[i]
        for i in range(count - 1):
            dense[3 * i : 3 * i + 3, 3 * i + 3 : 3 * i + 6] = upper[i]
            dense[3 * i + 3 : 3 * i + 6, 3 * i : 3 * i + 3] = upper[i].T
        wanted = np.linalg.solve(dense, right.reshape(-1, 2))
        assert np.allclose(solve_chain(diagonal, upper, right).reshape(-1, 2), wanted)


STARTS_S, ENDS_S = np.array([2.0, 5.0, 11.0]), np.array([2.2, 5.3, 11.4])


@pytest.fixture(scope="module")
def fast(walk: Motion) -> ImuSignal:
    samples = measured(walk, 0, replace(PERFECT, rate_hz=800.0), 0.0)[1]
    return ImuSignal(
        times_s=(samples.stamps_ns - walk.stamps_ns[0]) * 1e-9,
        gyro=samples.gyro_rad_s,
        accel=samples.accel_m_s2,
    )


def summed(
    signal: ImuSignal, shift_s: float = 0.0, gyro: F64 | None = None, accel: F64 | None = None
) -> Preintegrated:
    none = np.zeros((len(STARTS_S), 3))
    gyro, accel = none if gyro is None else none + gyro, none if accel is None else none + accel
    return preintegrate(signal, STARTS_S + shift_s, ENDS_S + shift_s, gyro, accel, DENSITIES)


def difference(a: Preintegrated, b: Preintegrated) -> F64:
    turned = so3_log(a.rotation.swapaxes(1, 2) @ b.rotation)
    return np.concatenate([turned, b.velocity - a.velocity, b.position - a.position], axis=1)


def test_sums_are_the_motion_between_two_times(walk: Motion, fast: ImuSignal) -> None:
    def sensor(times_s: F64) -> tuple[F64, F64]:
        T = walk.T_world_camera(times_s)
        return T[:, :3, :3] @ R_CAMERA_IMU, T[:, :3, :3] @ P_CAMERA_IMU + T[:, :3, 3]

    def velocity(times_s: F64) -> F64:
        return (sensor(times_s + 1e-4)[1] - sensor(times_s - 1e-4)[1]) / 2e-4

    sums, dt = summed(fast), (ENDS_S - STARTS_S)[:, None]
    (R_a, p_a), (R_b, p_b) = sensor(STARTS_S), sensor(ENDS_S)
    v_a, v_b, back = velocity(STARTS_S), velocity(ENDS_S), R_a.swapaxes(1, 2)
    assert np.abs(so3_log(sums.rotation.swapaxes(1, 2) @ back @ R_b)).max() < 1e-5
    moved = np.stack([v_b - v_a - GRAVITY * dt, p_b - p_a - v_a * dt - 0.5 * GRAVITY * dt**2])
    own = (back @ moved[..., None])[..., 0]
    assert np.abs(own[0] - sums.velocity).max() < 1e-4
    assert np.abs(own[1] - sums.position).max() < 1e-4


def test_derivatives_of_sums(fast: ImuSignal) -> None:
    sums, e = summed(fast), 1e-6
    for axis, step in enumerate(np.eye(3) * e):
        by_gyro = difference(summed(fast, gyro=-step), summed(fast, gyro=step)) / (2.0 * e)
        by_accel = difference(summed(fast, accel=-step), summed(fast, accel=step)) / (2.0 * e)
        assert np.allclose(by_gyro, sums.by_bias[:, :, axis], atol=1e-7)
        assert np.allclose(by_accel, sums.by_bias[:, :, 3 + axis], atol=1e-7)
    by_offset = difference(summed(fast, -e), summed(fast, e)) / (2.0 * e)
    # Within a step the sums are constant to the third order in it only.
    assert np.allclose(by_offset, sums.by_offset, atol=1e-4)


def test_covariance_of_sums(fast: ImuSignal) -> None:
    rng, root = np.random.default_rng(3), np.sqrt(100.0)
    slow = {name: values[::8] for name, values in vars(fast).items()}
    fast = ImuSignal(**slow)
    exact, errors = summed(fast), []
    for _ in range(300):
        noisy = replace(
            fast,
            gyro=fast.gyro + rng.normal(size=fast.gyro.shape) * DENSITIES.gyro * root,
            accel=fast.accel + rng.normal(size=fast.accel.shape) * DENSITIES.accel * root,
        )
        errors.append(difference(exact, summed(noisy)))
    found = np.einsum("ski,skj->kij", errors, errors) / len(errors)
    scale = np.sqrt(np.einsum("kii->ki", exact.covariance))
    # Correlations of 300 draws have standard deviations of 1 / sqrt(300).
    off = (found - exact.covariance) / (scale[:, :, None] * scale[:, None, :])
    assert np.abs(off).max() < 0.3


def test_sums_are_those_of_gtsam(fast: ImuSignal) -> None:
    gtsam = pytest.importorskip("gtsam", reason="no wheel of gtsam for this platform")
    parameters = gtsam.PreintegrationParams.MakeSharedU(9.81)
    parameters.setGyroscopeCovariance(DENSITIES.gyro**2 * np.eye(3))
    parameters.setAccelerometerCovariance(DENSITIES.accel**2 * np.eye(3))
    parameters.setIntegrationCovariance(np.zeros((3, 3)))
    bias = np.array([0.1, -0.2, 0.15]), np.array([0.02, 0.03, -0.01])
    sums = summed(fast, accel=bias[0], gyro=bias[1])
    for k, (start, end) in enumerate(zip(STARTS_S, ENDS_S, strict=True)):
        theirs = gtsam.PreintegratedImuMeasurements(parameters, gtsam.imuBias.ConstantBias(*bias))
        times = np.linspace(start, end, 2001)
        for middle, dt in zip(0.5 * (times[1:] + times[:-1]), np.diff(times), strict=True):
            gyro, accel = fast.at(np.array([middle]))
            theirs.integrateMeasurement(accel[0], gyro[0], dt)
        assert np.allclose(sums.rotation[k], theirs.deltaRij().matrix(), atol=2e-5)
        assert np.allclose(sums.velocity[k], theirs.deltaVij(), atol=5e-4)
        assert np.allclose(sums.position[k], theirs.deltaPij(), atol=1e-4)
        spread = np.sqrt(np.diag(theirs.preintMeasCov()))[[0, 1, 2, 6, 7, 8, 3, 4, 5]]
        assert np.allclose(np.sqrt(np.diag(sums.covariance[k])), spread, rtol=0.03)


def test_jacobians_of_residuals(fast: ImuSignal) -> None:
    rng = np.random.default_rng(1)
    count = 4
    state = State(
        R=so3_exp(rng.normal(size=(count, 3))),
        p=rng.normal(size=(count, 3)),
        v=rng.normal(size=(count, 3)),
        scale=2.5,
        gravity=9.81 * so3_exp(rng.normal(size=3))[0],
        R_camera_imu=R_CAMERA_IMU,
        p_camera_imu=P_CAMERA_IMU,
        gyro_bias=0.01 * rng.normal(size=(count, 3)),
        accel_bias=0.1 * rng.normal(size=(count, 3)),
        offset_s=0.01,
    )
    first_nodes = np.array([0, 2])

    def residual(of: State) -> F64:
        at = STARTS_S[:2] + of.offset_s
        biases = of.gyro_bias[first_nodes], of.accel_bias[first_nodes]
        sums = preintegrate(fast, at, at + 0.3, *biases, DENSITIES)
        return linearised(of, sums, first_nodes).residual

    at, e = STARTS_S[:2] + state.offset_s, 1e-6
    biases = state.gyro_bias[first_nodes], state.accel_bias[first_nodes]
    linear = linearised(state, preintegrate(fast, at, at + 0.3, *biases, DENSITIES), first_nodes)

    def numeric(common: F64, own: F64) -> F64:
        ahead, back = state.moved(common, own), state.moved(-common, -own)
        return (residual(ahead) - residual(back)) / (2.0 * e)

    for column in range(COMMON):
        step = e * np.eye(COMMON)[column]
        found = numeric(step, np.zeros((count, OWN)))
        assert np.allclose(found, linear.by_common[:, :, column], atol=2e-4), column
    for column in range(OWN):
        for rows, wanted in ((first_nodes, linear.by_first), (first_nodes + 1, linear.by_second)):
            own = np.zeros((count, OWN))
            own[rows, column] = e
            found = numeric(np.zeros(COMMON), own)
            assert np.allclose(found, wanted[:, :, column], atol=1e-5), column

"""Poses of keyframes by images and inertial samples together."""

from dataclasses import replace

import numpy as np
import pytest
from bundle_scene import make_scene, project
from inertial_motion import ADIS16448, PHONE, Motion, Sensor, hand_held, samples_of

from pliant.algorithms.arrays import F64
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import align_umeyama, hat, inverse, so3_exp
from pliant.algorithms.inertial.alignment import (
    InertialAlignment,
    align_inertial,
    averaged_signal,
    noise_densities,
)
from pliant.algorithms.inertial.coupling import Coupled, System, couple
from pliant.algorithms.inertial.estimator import bias_walks, own_priors, prior_of_common
from pliant.algorithms.inertial.preintegration import preintegrate
from pliant.algorithms.inertial.residuals import COMMON, OWN, Nodes, State, linearised
from pliant.algorithms.inertial.samples import ImuSamples
from pliant.algorithms.slam.adjust.inertial_adjustment import (
    CouplingOutcome,
    TimedSamples,
    start_of,
    with_samples,
)
from pliant.algorithms.slam.estimate.problem import (
    BundleParameters,
    BundleProblem,
    CalibrationUncertainty,
    shared_intrinsics,
)
from pliant.algorithms.slam.estimate.schur import solve_schur, system_at

R_CAMERA_IMU = so3_exp(np.array([0.3, 2.0, 1.0]))
UNIT_M = 3.7
STEP = 6
"""Frames between keyframes: 0.3 s."""


def keyframes_of(motion: Motion) -> F64:
    """True poses, in a unit of their own."""
    T = motion.T_world_camera(motion.times_s[::STEP])
    T[:, :3, 3] /= UNIT_M
    return T


def timed_samples(motion: Motion, samples: ImuSamples) -> TimedSamples:
    """With poses of the frames between keyframes that are right relative to these."""
    T = motion.T_world_camera(motion.times_s)
    T[:, :3, 3] /= UNIT_M
    hosts = np.arange(len(T)) // STEP
    return TimedSamples(
        samples=samples, keyframes_ns=motion.stamps_ns[::STEP], frames_ns=motion.stamps_ns,
        hosts=hosts, T_host_frame=inverse(T[::STEP])[hosts] @ T,
    )  # fmt: skip


def drifted(T: F64, sigma: float, turn: float, rng: np.random.Generator) -> tuple[F64, F64]:
    """Poses whose steps have errors of these standard deviations, and their information."""
    count = len(T)
    found, V = T.copy(), np.zeros((6 * count, 6 * count))
    weights = np.repeat([turn**-2, sigma**-2], 3)
    for k in range(count - 1):
        step = inverse(T[k]) @ T[k + 1]
        step[:3, 3] += sigma * rng.normal(size=3)
        step[:3, :3] = step[:3, :3] @ so3_exp(turn * rng.normal(size=3))
        found[k + 1] = found[k] @ step
        J = np.zeros((6, 12))
        J[:3, :3], J[:3, 6:9] = -step[:3, :3].T, np.eye(3)
        R_t = found[k, :3, :3].T
        J[3:, :3], J[3:, 3:6], J[3:, 9:] = hat(step[:3, 3]), -R_t, R_t
        V[6 * k : 6 * k + 12, 6 * k : 6 * k + 12] += J.T @ (weights[:, None] * J)
    return found, V


def measured(motion: Motion, seed: int, sensor: Sensor = PHONE) -> ImuSamples:
    return samples_of(
        motion, sensor, np.random.default_rng(seed), R_camera_imu=R_CAMERA_IMU,
        p_camera_imu=np.array([0.03, 0.02, -0.04]), offset_s=0.4,
    )  # fmt: skip


def coupled(motion: Motion, T: F64, V: F64, samples: ImuSamples) -> Coupled | None:
    timed = timed_samples(motion, samples)
    frames = T[timed.hosts] @ timed.T_host_frame
    aligned = align_inertial(timed.frames_ns, frames, samples)
    assert isinstance(aligned, InertialAlignment), aligned
    nodes, signal, start = start_of(T, timed.keyframes_ns, len(T), timed, aligned)
    fixed = np.arange(len(T)) == 0
    return couple(nodes, V, fixed, signal, start, noise_densities(signal), least_px=0.1)


def error(p: F64, true: F64) -> float:
    scale, R, t = align_umeyama(p, true, with_scale=True)
    return float(np.sqrt((((scale * p @ R.T + t) - true) ** 2).sum(axis=1).mean()))


@pytest.mark.parametrize("sensor", [PHONE, ADIS16448])
def test_samples_remove_drift(sensor: Sensor) -> None:
    motion = hand_held(30.0, seed=3)
    true = keyframes_of(motion)
    before, after = [], []
    for seed in range(2):
        T, V = drifted(true, 3e-4, 6e-3, np.random.default_rng(seed))
        found = coupled(motion, T, V, measured(motion, seed, sensor))
        assert found is not None
        before.append(error(T[:, :3, 3], true[:, :3, 3]))
        after.append(error(found.state.p, true[:, :3, 3]))
        # The first pose and the unit of length stay.
        assert np.allclose(found.state.p[0], T[0, :3, 3], atol=1e-6)
        assert np.allclose(found.state.R[0], T[0, :3, :3], atol=1e-6)
        along = T[:, :3, 3] - T[0, :3, 3]
        assert abs(((found.state.p - T[:, :3, 3]) * along).sum()) < 1e-3 * (along**2).sum()
        assert 0.7 < found.pixel_sigma < 1.4
    assert np.mean(after) < 0.5 * np.mean(before)


def test_gaps_count_neither_for_nor_against_the_samples() -> None:
    """Samples that end early, and six gaps of half a second."""
    motion = hand_held(30.0, seed=3)
    true = keyframes_of(motion)
    T, V = drifted(true, 3e-4, 6e-3, np.random.default_rng(0))
    before = error(T[:, :3, 3], true[:, :3, 3])
    samples = measured(motion, 0, ADIS16448)
    seconds = 1e-9 * (samples.stamps_ns - samples.stamps_ns[0])
    for kept in (seconds < 20.0, (seconds + 2.0) % 5.0 > 0.5):
        some = ImuSamples(
            stamps_ns=samples.stamps_ns[kept], gyro_rad_s=samples.gyro_rad_s[kept],
            accel_m_s2=samples.accel_m_s2[kept],
        )  # fmt: skip
        found = coupled(motion, T, V, some)
        assert found is not None
        assert found.inertial_sigma < 1.3
        assert error(found.state.p, true[:, :3, 3]) < 0.75 * before


def test_a_good_map_stays_and_a_bad_sensor_weighs_little() -> None:
    motion = hand_held(30.0, seed=4)
    true = keyframes_of(motion)
    T, V = drifted(true, 1e-5, 1e-5, np.random.default_rng(0))
    before = error(T[:, :3, 3], true[:, :3, 3])
    good = measured(motion, 1)
    found = coupled(motion, T, V, good)
    assert found is not None
    assert error(found.state.p, true[:, :3, 3]) < 1.1 * before
    # Scale factors of 5 %, different on each axis: no white noise.
    bad = replace(good, accel_m_s2=good.accel_m_s2 * np.array([1.05, 0.96, 1.0]))
    found = coupled(motion, T, V, bad)
    assert found is not None
    assert found.inertial_sigma > 3.0
    assert error(found.state.p, true[:, :3, 3]) < 1.5 * before


def test_few_keyframes_do_not_show_that_images_are_worse_than_their_pixels() -> None:
    """Rotations have larger errors than the images predict, positions are right."""
    for seed in range(4):
        motion = hand_held(6.0, seed=40 + seed)
        true = keyframes_of(motion)
        T, _ = drifted(true, 3e-5, 3e-4, np.random.default_rng(seed))
        _, V = drifted(true, 3e-5, 7.5e-5, np.random.default_rng(seed))
        found = coupled(motion, T, V, measured(motion, seed, ADIS16448))
        assert found is not None
        before = error(T[:, :3, 3], true[:, :3, 3])
        assert error(found.state.p, true[:, :3, 3]) < 1.05 * before
        assert found.pixel_sigma == 0.1
        assert found.inertial_sigma > 1.5


def test_the_step_is_that_of_all_equations_at_once() -> None:
    motion = hand_held(9.0, seed=5)
    true = keyframes_of(motion)
    rng = np.random.default_rng(2)
    T, V = drifted(true, 0.002, 0.002, rng)
    V[:] += 10.0 * np.eye(len(V))
    samples = measured(motion, 3)
    times_s = motion.times_s[::STEP]
    signal, count = averaged_signal(samples, motion.origin_ns), len(T)
    tied = np.ones(count - 1, np.bool_)
    tied[[4, 11]] = False
    nodes = Nodes(times_s=times_s, R=T[:, :3, :3], p=T[:, :3, 3], tied=tied)
    state = State(
        R=T[:, :3, :3], p=T[:, :3, 3], v=0.1 * rng.normal(size=(count, 3)), scale=3.0,
        gravity=np.array([0.0, 0.0, -9.81]), R_camera_imu=R_CAMERA_IMU,
        p_camera_imu=0.01 * rng.normal(size=3), gyro_bias=0.01 * rng.normal(size=(count, 3)),
        accel_bias=0.1 * rng.normal(size=(count, 3)), offset_s=0.4,
    )  # fmt: skip
    densities, s2, g2 = noise_densities(signal), 2.0, 1e6
    found = System(nodes, V, signal, state, densities, s2, g2).solve()[0]

    rows = np.flatnonzero(tied)
    ends = times_s + state.offset_s
    sums = preintegrate(
        signal, ends[rows], ends[rows + 1], state.gyro_bias[rows], state.accel_bias[rows], densities
    )
    wide = OWN * count + COMMON
    A, b = np.zeros((wide, wide)), np.zeros(wide)
    root = np.linalg.inv(np.linalg.cholesky(sums.covariance))
    walk = bias_walks(state, rows, np.diff(ends)[rows])
    for one, whitening in ((linearised(state, sums, rows), root), (walk, np.eye(6)[None])):
        for k, i in enumerate(rows):
            J, W = np.zeros((one.residual.shape[1], wide)), whitening[k % len(whitening)]
            J[:, OWN * i : OWN * i + 2 * OWN] = np.hstack([one.by_first[k], one.by_second[k]])
            J[:, OWN * count :] = one.by_common[k]
            A[:] += (W @ J).T @ (W @ J) / g2
            b -= (W @ J).T @ (W @ one.residual[k]) / g2
    pose = (OWN * np.arange(count)[:, None] + np.arange(6)).ravel()
    A[np.ix_(pose, pose)] += V / s2
    for part, sigma, value in own_priors(state, rows):
        at = OWN * np.arange(count)[:, None] + part
        A[at, at] += 1.0 / sigma[:, None] ** 2
        b[at] -= value / sigma[:, None] ** 2
    prior, deviation = prior_of_common(state)
    A[OWN * count :, OWN * count :] += prior
    b[OWN * count :] -= prior @ deviation
    expected = np.linalg.solve(A, b)
    assert np.allclose(found.own.ravel(), expected[: OWN * count], rtol=1e-5, atol=1e-8)
    assert np.allclose(found.common, expected[OWN * count :], rtol=1e-5, atol=1e-8)


def test_pose_information_is_that_of_finite_differences() -> None:
    scene = make_scene(cameras=4, points=25, noise_px=0.3, visible=0.8)
    plain, unsure = BundleParameters(kernel_sigma_px=0.0), CalibrationUncertainty(readout=0.0)
    problem = scene.problem
    adjusted = solve_schur(problem, plain, uncertainty=unsure)
    V = system_at(problem, adjusted, plain, unsure).pose_information()
    T, xyz = adjusted.T_world_camera, adjusted.points_world
    cameras, points = len(T), len(xyz)

    def predicted(x: F64) -> F64:
        moves = x[: 6 * cameras].reshape(cameras, 6)
        poses = T.copy()
        poses[:, :3, :3] = T[:, :3, :3] @ so3_exp(moves[:, :3])
        poses[:, :3, 3] += moves[:, 3:]
        s, k1 = adjusted.correction[:2] + x[-2:]
        lens = problem.intrinsics.copy()
        lens[:, :2] *= np.exp(s)
        lens[:, 4] += k1
        px = project(poses, xyz + x[6 * cameras : -2].reshape(points, 3), lens)
        return px[problem.camera_index, problem.point_index].ravel()

    size, h = 6 * cameras + 3 * points + 2, 1e-6
    J = np.array([(predicted(h * e) - predicted(-h * e)) / (2.0 * h) for e in np.eye(size)]).T
    H = J.T @ J
    H[[-2, -1], [-2, -1]] += 1.0 / unsure.sigmas[:2] ** 2
    rest = slice(6 * cameras, None)
    n = 6 * cameras
    expected = H[:n, :n] - H[:n, rest] @ np.linalg.solve(H[rest, rest], H[rest, :n])
    assert not V[:12].any()
    assert np.allclose(
        V[12:, 12:], expected[12:, 12:], rtol=1e-4, atol=1e-5 * np.abs(expected).max()
    )


def drifting_scene(motion: Motion, rng: np.random.Generator) -> tuple[BundleProblem, F64]:
    """Landmarks about a path, whose tracks drift; and true poses."""
    true = keyframes_of(motion)
    camera = PinholeCamera(width=640, height=480, fx=400.0, fy=400.0, cx=320.0, cy=240.0)
    intrinsics = shared_intrinsics(camera, len(true))
    points = rng.uniform(-1.2, 1.2, (3000, 3))
    points /= np.linalg.norm(points, axis=1)[:, None] / rng.uniform(0.6, 1.2, 3000)[:, None]
    local = np.einsum("mji,mnj->mni", true[:, :3, :3], points - true[:, None, :3, 3])
    ahead = local[..., 2] > 0.1
    px = project(true, points, intrinsics)
    inside = (px > 0.0).all(axis=-1) & (px[..., 0] < 640) & (px[..., 1] < 480) & ahead
    begun = rng.integers(-8, len(true), len(points))
    age = np.arange(len(true))[:, None] - begun
    seen = inside & (age >= 0) & (age < 10)
    long = seen.sum(axis=0) >= 4
    points, px, seen = points[long], px[:, long], seen[:, long]
    camera_index, point_index = np.nonzero(seen)
    errors = np.cumsum(rng.normal(0.0, 0.15, px.shape), axis=0)  # of one track alike
    observed = (px + errors)[camera_index, point_index]
    problem = BundleProblem(
        T_world_camera=true, points_world=points, camera_index=camera_index.astype(np.int32),
        point_index=point_index.astype(np.int32), points_px=observed.astype(np.float32),
        intrinsics=intrinsics, fixed_cameras=np.arange(len(true)) == 0,
    )  # fmt: skip
    return problem, true


def test_adjustment_with_samples_is_better_and_without_their_own_the_same() -> None:
    motion = hand_held(30.0, seed=6)
    problem, true = drifting_scene(motion, np.random.default_rng(6))
    parameters = BundleParameters()
    unsure = CalibrationUncertainty(readout=0.0)
    found = solve_schur(problem, parameters, uncertainty=unsure, with_covariance=True)
    before = error(found.T_world_camera[:, :3, 3], true[:, :3, 3])
    timed = timed_samples(motion, measured(motion, 1))
    better = with_samples(problem, found, parameters, unsure, timed)
    assert error(better.T_world_camera[:, :3, 3], true[:, :3, 3]) < 0.8 * before
    assert np.array_equal(better.T_world_camera[0], found.T_world_camera[0])
    assert not np.array_equal(better.points_world, found.points_world)
    assert np.array_equal(better.covariance, found.covariance)
    again = with_samples(problem, found, parameters, unsure, timed)
    assert again.T_world_camera.tobytes() == better.T_world_camera.tobytes()
    assert [each.outcome for each in timed.outcomes] == [CouplingOutcome.MOVED] * 2
    assert 1e-4 < timed.outcomes[0].moved_m < 0.1
    others = measured(hand_held(30.0, seed=7), 1)
    for wrong in (
        replace(timed, samples=others),
        replace(timed, keyframes_ns=timed.keyframes_ns[::-1]),
        replace(timed, samples=ImuSamples.empty()),
    ):
        assert with_samples(problem, found, parameters, unsure, wrong) is found
        assert timed.outcomes.pop().outcome != CouplingOutcome.MOVED


def test_keyframes_come_in_any_order_and_some_twice() -> None:
    """As of two passes, of which the second reads backwards."""
    motion = hand_held(30.0, seed=6)
    problem, _ = drifting_scene(motion, np.random.default_rng(6))
    parameters, unsure = BundleParameters(), CalibrationUncertainty(readout=0.0)
    timed, count = timed_samples(motion, measured(motion, 1)), len(problem.T_world_camera)
    order = np.concatenate([[0], np.arange(count - 1, 0, -1)])
    place = np.argsort(order)

    def shuffled(array: F64) -> F64:
        return array[order]

    other = replace(
        problem, T_world_camera=shuffled(problem.T_world_camera),
        camera_index=place[problem.camera_index].astype(np.int32),
        fixed_cameras=problem.fixed_cameras[order], intrinsics=shuffled(problem.intrinsics),
    )  # fmt: skip
    turned = replace(
        timed, keyframes_ns=timed.keyframes_ns[order], hosts=place[timed.hosts],
        T_host_frame=timed.T_host_frame,
    )  # fmt: skip
    found = solve_schur(problem, parameters, uncertainty=unsure, with_covariance=True)
    in_order = with_samples(problem, found, parameters, unsure, timed).T_world_camera
    same = replace(found, T_world_camera=shuffled(found.T_world_camera))
    out_of_order = with_samples(other, same, parameters, unsure, turned).T_world_camera
    np.testing.assert_allclose(out_of_order, shuffled(in_order), atol=1e-6)
    assert not np.allclose(out_of_order, same.T_world_camera, atol=1e-5)
    # Three keyframes that see many landmarks have the times of others: images alone place them.
    twice, many = timed.keyframes_ns.copy(), np.array([26, 64, 94])
    twice[many] = twice[many - 1]
    placed = with_samples(problem, found, parameters, unsure, replace(timed, keyframes_ns=twice))
    assert timed.outcomes[-1].outcome == CouplingOutcome.MOVED
    before, true_p = (each.T_world_camera[:, :3, 3] for each in (found, problem))
    assert error(placed.T_world_camera[:, :3, 3], true_p) < 0.8 * error(before, true_p)

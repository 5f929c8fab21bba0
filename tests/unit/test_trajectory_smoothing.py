"""Trajectories are smoothed as far as their own errors call for it."""

import numpy as np
import pytest

from pliant.algorithms.arrays import F64, I64
from pliant.algorithms.geometry import inverse, so3_exp
from pliant.algorithms.slam.estimate import trajectory_smoothing as smoothing

FRAMES = 120
STAMPS_NS = np.arange(FRAMES, dtype=np.int64) * 33_333_333
INFORMATION = np.tile(np.diag([1e5, 1e5, 2e4, 2e5, 2e5, 2e5]), (FRAMES, 1, 1))


def by_hand() -> F64:
    """(N, 4, 4) of a camera in a hand: slow swings, in metres and seconds."""
    t = 1e-9 * STAMPS_NS
    T = np.tile(np.eye(4), (FRAMES, 1, 1))
    T[:, :3, 3] = np.column_stack([np.sin(t), 0.3 * np.cos(2.0 * t), 0.2 * t])
    T[:, :3, :3] = so3_exp(np.column_stack([0.1 * np.sin(t), 0.4 * t, np.zeros(FRAMES)]))
    return T


def with_noise(T_world_camera: F64, seed: int = 0) -> F64:
    """Poses that are off by 3 mm and 1 mrad, each by itself."""
    generator = np.random.default_rng(seed)
    xi = generator.normal(0.0, np.repeat([3e-3, 1e-3], 3), (len(T_world_camera), 6))
    return inverse(smoothing._se3_exp(xi) @ inverse(T_world_camera))


def smooth_trajectory(T: F64, information: F64, stamps_ns: I64, most: float = 50.0) -> F64:
    return smoothing.smooth_trajectory(T, information, stamps_ns, most)


def off_m(T: F64, truth: F64) -> float:
    """RMS distance of the positions."""
    return float(np.sqrt(((T[:, :3, 3] - truth[:, :3, 3]) ** 2).sum(axis=1).mean()))


def test_the_logarithm_undoes_the_exponential() -> None:
    xi = np.random.default_rng(0).normal(0.0, [[1e-9], [1e-3], [0.5]], (3, 6))
    assert smoothing._se3_log(smoothing._se3_exp(xi)) == pytest.approx(xi, rel=1e-9, abs=1e-14)


def test_the_adjoint_is_the_derivative() -> None:
    generator = np.random.default_rng(1)
    D = smoothing._se3_exp(generator.normal(0.0, 0.4, (1, 6)))
    adjoint, step = smoothing._adjoints(D)[0], 1e-6
    for column in range(6):
        xi = np.zeros((1, 6))
        xi[0, column] = step
        moved = smoothing._se3_log(D @ smoothing._se3_exp(xi) @ inverse(D))[0] / step
        assert moved == pytest.approx(adjoint[:, column], abs=1e-5)


def test_filter_and_smoother_solve_the_least_squares_problem() -> None:
    """The same as the normal equations of all frames at once, in plain numpy."""
    T = inverse(with_noise(by_hand()[:12]))
    D = T[1:] @ inverse(T[:-1])
    steps, adjoints = smoothing._se3_log(D), smoothing._adjoints(D)
    dt = np.full(11, 1 / 30) * np.linspace(0.7, 1.3, 11)
    covariance = np.linalg.inv(INFORMATION[:12])
    motion = smoothing._Motion(covariance, steps, adjoints, dt, steps / dt[:, None])
    generator = np.random.default_rng(2)
    motion._frame_weights = generator.uniform(0.5, 2.0, 12)
    motion._step_weights = generator.uniform(0.5, 2.0, 12)
    variances = np.log([4.0, 0.3, 0.7])
    found, _ = motion.corrections(variances)
    H, b = np.zeros((144, 144)), np.zeros(144)
    for n in range(12):
        here = slice(12 * n, 12 * n + 6)
        H[here, here] += motion._frame_weights[n] * np.linalg.inv(4.0 * covariance[n])
    H[6:12, 6:12] += np.diag(1.0 / motion._spread)
    for n in range(11):
        q = np.diag([0.3] * 3 + [0.7] * 3) / motion._step_weights[n + 1]
        blocks = np.array([[dt[n] ** 3 / 3, dt[n] ** 2 / 2], [dt[n] ** 2 / 2, dt[n]]])
        W = np.linalg.inv(np.kron(blocks, q))
        F = np.block([[adjoints[n], dt[n] * np.eye(6)], [np.zeros((6, 6)), np.eye(6)]])
        J = np.zeros((12, 144))
        J[:, 12 * n : 12 * n + 12], J[:, 12 * n + 12 : 12 * n + 24] = -F, np.eye(12)
        offset = np.concatenate([steps[n], np.zeros(6)])
        H += J.T @ W @ J
        b -= J.T @ W @ offset
    expected = np.linalg.solve(H, b).reshape(12, 12)[:, :6]
    assert found == pytest.approx(expected, rel=1e-5, abs=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_noise_of_each_frame_goes(seed: int) -> None:
    truth = by_hand()
    noisy = with_noise(truth, seed)
    smoothed = smooth_trajectory(noisy, INFORMATION, STAMPS_NS)
    assert off_m(smoothed, truth) < 0.6 * off_m(noisy, truth)


def test_poses_without_noise_stay() -> None:
    truth = by_hand()
    assert off_m(smooth_trajectory(truth, INFORMATION, STAMPS_NS), truth) < 2e-5


def test_a_sudden_turn_is_not_rounded_off() -> None:
    """A camera on rails that jerks to another direction now and then, placed exactly."""
    truth = np.tile(np.eye(4), (FRAMES, 1, 1))
    velocity = np.random.default_rng(3).normal(0.0, 0.5, (6, 3)).repeat(20, axis=0)
    truth[:, :3, 3] = np.cumsum(velocity / 30.0, axis=0)
    smoothed = smooth_trajectory(truth, INFORMATION, STAMPS_NS)
    assert np.linalg.norm(smoothed[:, :3, 3] - truth[:, :3, 3], axis=1).max() < 1e-4


def test_one_bad_pose_does_not_move_its_neighbours() -> None:
    truth = by_hand()
    noisy = with_noise(truth)
    bad = noisy.copy()
    bad[60, :3, 3] += 0.02
    smoothed = smooth_trajectory(noisy, INFORMATION, STAMPS_NS)
    beside = smooth_trajectory(bad, INFORMATION, STAMPS_NS)
    others = np.arange(FRAMES) != 60
    assert off_m(beside[others], smoothed[others]) < 1e-3
    assert off_m(beside[60:61], truth[60:61]) < 0.01


@pytest.mark.parametrize("unknown", [np.nan, 0.0])
def test_a_pose_of_unknown_information_stays(unknown: float) -> None:
    truth = by_hand()
    noisy, information = with_noise(truth), INFORMATION.copy()
    information[:8] = unknown
    smoothed = smooth_trajectory(noisy, information, STAMPS_NS)
    assert off_m(smoothed[:8], noisy[:8]) == 0.0
    assert off_m(smoothed[8:], truth[8:]) < 0.7 * off_m(noisy[8:], truth[8:])


def test_a_cut_splits_the_trajectory() -> None:
    """A camera that is somewhere else from one frame to the next."""
    truth = by_hand()
    truth[70:, :3, 3] += (0.9, -0.4, 0.2)
    noisy = with_noise(truth)
    smoothed = smooth_trajectory(noisy, INFORMATION, STAMPS_NS)
    assert np.linalg.norm(smoothed[:, :3, 3] - truth[:, :3, 3], axis=1).max() < 0.02


def test_the_unit_of_length_does_not_matter() -> None:
    noisy = with_noise(by_hand())
    unit = np.diag(np.repeat([0.01, 1.0], 3))
    larger, other = noisy.copy(), unit @ INFORMATION @ unit
    larger[:, :3, 3] *= 100.0
    smoothed = smooth_trajectory(noisy, INFORMATION, STAMPS_NS)
    assert off_m(smooth_trajectory(larger, other, STAMPS_NS), larger) == pytest.approx(
        100.0 * off_m(smoothed, noisy), rel=0.02
    )


def test_few_frames_stay_as_they_are() -> None:
    noisy = with_noise(by_hand())[:5]
    assert off_m(smooth_trajectory(noisy, INFORMATION[:5], STAMPS_NS[:5]), noisy) == 0.0


def test_poses_of_which_none_follows_from_the_others_stay() -> None:
    """Stills from all around: only a noise far beyond that of a pose would make them a path."""
    jumps = with_noise(by_hand()[::6])
    jumps[:, :3, 3] += np.random.default_rng(4).normal(0.0, 0.3, (20, 3))
    stays = smooth_trajectory(jumps, INFORMATION[:20], np.arange(20) * 1_000_000_000)
    assert off_m(stays, jumps) < 2e-3


def test_a_noise_that_no_pose_has_is_not_taken_for_one() -> None:
    noisy = with_noise(by_hand())
    assert off_m(smooth_trajectory(noisy, INFORMATION, STAMPS_NS, most=0.1), noisy) == 0.0

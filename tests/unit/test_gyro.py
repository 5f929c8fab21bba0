"""How the gyro tells the turns of a camera, and when it is not believed."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from inertial_motion import ADIS16448, PHONE, Motion, Sensor, hand_held, samples_of

from pliant.algorithms.arrays import F64
from pliant.algorithms.geometry import so3_exp, so3_log
from pliant.algorithms.inertial.alignment import averaged_signal
from pliant.algorithms.inertial.gyro import Gyro, integrated
from pliant.algorithms.inertial.samples import ImuSamples
from pliant.algorithms.slam.adjust.carried_frames import carried_poses
from pliant.algorithms.slam.adjust.ordinary_frames import EarlierPose
from pliant.algorithms.slam.map.keyframe import Keyframe

NOISE_RAD = np.radians(0.05)
MOUNTED = so3_exp(np.array([0.4, 1.0, 2.0]))


def samples(motion: Motion, sensor: Sensor = PHONE, offset_s: float = 0.08) -> ImuSamples:
    return samples_of(
        motion, sensor, np.random.default_rng(1), R_camera_imu=MOUNTED,
        p_camera_imu=np.array([0.02, -0.01, 0.03]), offset_s=offset_s,
    )  # fmt: skip


def gyro_of(given: ImuSamples) -> Gyro:
    gyro = Gyro.of(given)
    assert gyro is not None
    return gyro


def seen(motion: Motion) -> F64:
    """Rotations of the camera as images show them."""
    noise = np.random.default_rng(2).normal(size=(len(motion.stamps_ns), 3))
    return motion.T_world_camera(motion.times_s)[:, :3, :3] @ so3_exp(NOISE_RAD * noise)


def shown(gyro: Gyro, stamps_ns: list[int], R: F64) -> None:
    for (first, second), before, after in zip(pairwise(stamps_ns), R[:-1], R[1:], strict=True):
        gyro.see(first, second, before.T @ after)


def test_derivatives_of_an_integrated_turn() -> None:
    signal = averaged_signal(samples(hand_held(5.0)), 1_000_000_000)
    bias = np.array([0.1, -0.2, 0.3])
    turn, by_bias, by_offset = integrated(signal, 1.003, 1.871, bias)
    step = 1e-6
    for axis, unit in enumerate(np.eye(3)):
        moved, _, _ = integrated(signal, 1.003, 1.871, bias + step * unit)
        np.testing.assert_allclose(so3_log(turn.T @ moved) / step, by_bias[:, axis], atol=1e-4)
    moved, _, _ = integrated(signal, 1.003 + step, 1.871 + step, bias)
    np.testing.assert_allclose(so3_log(turn.T @ moved) / step, by_offset, atol=1e-4)


@pytest.mark.parametrize("sensor", [ADIS16448, PHONE])
def test_turns_are_as_exact_as_they_claim(sensor: Sensor) -> None:
    motion = hand_held(20.0)
    gyro, R, stamps = gyro_of(samples(motion, sensor)), seen(motion), motion.stamps_ns.tolist()
    true = motion.T_world_camera(motion.times_s)[:, :3, :3]
    errors, squares = [], []
    for now in range(1, len(stamps)):
        before = now - 10
        turn = gyro.turn(stamps[before], stamps[now]) if before >= 0 else None
        if turn is not None:
            e = so3_log(turn.R.T @ true[before].T @ true[now])
            errors.append(np.linalg.norm(e))
            squares.append(e @ np.linalg.solve(turn.covariance, e))
        gyro.see(stamps[now - 1], stamps[now], R[now - 1].T @ R[now])
    assert len(errors) > 0.6 * len(stamps)
    assert np.degrees(max(errors)) < 0.4
    assert 0.1 < np.mean(squares) < 4.0  # three numbers of unit variance


def turned_back(given: ImuSamples) -> ImuSamples:
    return replace(given, gyro_rad_s=given.gyro_rad_s[::-1].copy())


def left_handed(given: ImuSamples) -> ImuSamples:
    return replace(given, gyro_rad_s=given.gyro_rad_s[:, [1, 0, 2]])


def in_degrees(given: ImuSamples) -> ImuSamples:
    return replace(given, gyro_rad_s=np.degrees(given.gyro_rad_s))


@pytest.mark.parametrize("spoil", [turned_back, left_handed, in_degrees])
def test_a_gyro_of_something_else_is_never_believed(spoil) -> None:
    motion = hand_held(20.0)
    gyro = gyro_of(spoil(samples(motion)))
    shown(gyro, motion.stamps_ns.tolist(), seen(motion))
    assert not gyro.is_believed
    assert gyro.turn(int(motion.stamps_ns[-2]), int(motion.stamps_ns[-1])) is None


def test_the_gyro_of_a_stabilised_video_is_never_believed() -> None:
    motion = hand_held(20.0)
    turns = so3_log(seen(motion))
    smooth = np.column_stack([np.convolve(each, np.ones(41) / 41, "same") for each in turns.T])
    gyro = gyro_of(samples(motion))
    shown(gyro, motion.stamps_ns.tolist(), so3_exp(smooth))
    assert not gyro.is_believed


def test_a_gyro_that_stops_to_fit_is_dropped() -> None:
    motion = hand_held(20.0)
    given = samples(motion)
    late = np.arange(len(given.stamps_ns)) > len(given.stamps_ns) // 2
    frozen = replace(given, gyro_rad_s=np.where(late[:, None], 0.0, given.gyro_rad_s))
    gyro = gyro_of(frozen)
    shown(gyro, motion.stamps_ns.tolist(), seen(motion))
    assert gyro.is_believed
    assert gyro.dropped
    assert len(gyro.signal.times_s) == 2
    assert gyro.turn(int(motion.stamps_ns[150]), int(motion.stamps_ns[151])) is None


def piece(given: ImuSamples, first_ns: float, last_ns: float) -> ImuSamples:
    """The samples of an interval, without its begin."""
    rows = (given.stamps_ns > first_ns) & (given.stamps_ns <= last_ns)
    return ImuSamples(**{name: values[rows] for name, values in vars(given).items()})


def hearing(given: ImuSamples, until_ns: list[float]) -> Iterator[tuple[int, Gyro]]:
    """The number of each frame but the first, and the gyro that has heard the samples by then.

    until_ns: time of the last of these, for each frame.
    """
    gyro = gyro_of(piece(given, -np.inf, until_ns[10]))
    for now in range(1, len(until_ns)):
        if now > 10:
            gyro.add_samples(piece(given, until_ns[now - 1], until_ns[now]))
        yield now, gyro


@pytest.mark.parametrize("late_s", [-0.01, 0.02])
def test_a_gyro_is_heard_while_frames_come(late_s: float) -> None:
    """Samples that are late by a part of a frame predict none, but are known in the end."""
    motion = hand_held(150.0)
    given, stamps, R = samples(motion), motion.stamps_ns.tolist(), seen(motion)
    whole, predicted, apart = gyro_of(given), 0, list[float]()
    for now, gyro in hearing(given, [stamp + 1e9 * (0.08 - late_s) for stamp in stamps]):
        predicted += gyro.predict(stamps[now - 1], stamps[now]) is not None
        for each in (gyro, whole):
            each.see(stamps[now - 1], stamps[now], R[now - 1].T @ R[now])
        turns = [each.turn(stamps[now - 15], stamps[now - 5]) for each in (gyro, whole)]
        if turns[0] is not None and turns[1] is not None:
            apart.append(float(np.linalg.norm(so3_log(turns[0].R.T @ turns[1].R))))
    assert len(gyro.blocks) > 1
    assert gyro.is_believed
    assert not gyro.dropped
    all_but_first = len(stamps) - 140  # before it is believed
    if late_s < 0.0:
        assert predicted > all_but_first
        assert gyro.late <= 1
    else:
        assert gyro.late > all_but_first
        assert predicted == 0
    assert len(apart) > all_but_first
    assert np.degrees(max(apart)) < 0.2


@pytest.mark.parametrize("spoil", [turned_back, left_handed, in_degrees])
def test_a_wrong_gyro_that_is_heard_late_is_never_believed(spoil) -> None:
    motion = hand_held(30.0)
    stamps, R = motion.stamps_ns.tolist(), seen(motion)
    given = spoil(samples(motion))
    for now, gyro in hearing(given, [stamp + 1e9 * (0.08 - 0.1) for stamp in stamps]):
        assert gyro.predict(stamps[now - 1], stamps[now]) is None
        gyro.see(stamps[now - 1], stamps[now], R[now - 1].T @ R[now])
    assert not gyro.is_believed
    assert gyro.late <= 1


def test_turns_are_forgotten_after_two_minutes() -> None:
    motion = hand_held(20.0)
    gyro = gyro_of(samples(motion))
    turn, step_ns = np.eye(3), 50_000_000
    for number in range(3000):
        gyro.see(
            motion.origin_ns + number * step_ns, motion.origin_ns + (number + 1) * step_ns, turn
        )
        assert len(gyro._times_s) == len(gyro._turns) + 1 <= 2402
    assert not gyro.given_up


def test_a_gyro_that_explains_nothing_is_given_up_and_keeps_no_samples() -> None:
    motion = hand_held(600.0)
    gyro = gyro_of(turned_back(samples(motion)))
    shown(gyro, motion.stamps_ns.tolist(), seen(motion))
    assert gyro.given_up
    assert not gyro.is_believed
    assert len(gyro.signal.times_s) == 2
    assert not gyro._turns


def test_an_estimate_before_a_loss_is_the_prior_of_the_next() -> None:
    """What a minute of turns has shown is not replaced by what 4 s show."""
    motion = hand_held(70.0)
    stamps, R = motion.stamps_ns.tolist(), seen(motion)
    gyro = gyro_of(samples(motion))
    shown(gyro, stamps[:1180], R[:1180])
    assert gyro.is_believed
    before = gyro._aligned
    gyro.lose()
    shown(gyro, stamps[1200:1280], R[1200:1280])
    after = gyro._aligned
    assert before is not None
    assert after is not None
    assert after.at_s > before.at_s + 5.0
    sigmas = [np.sqrt(np.diag(each.covariance)) for each in (before, after)]
    assert np.all(sigmas[1][:6] < 1.5 * sigmas[0][:6])
    apart = so3_log(after.R_camera_imu @ before.R_camera_imu.T)
    assert np.all(np.abs(apart) < 3.0 * sigmas[0][:3])
    assert np.linalg.norm(so3_log(after.R_camera_imu.T @ MOUNTED)) < 0.004


def test_unsure_images_do_not_contradict() -> None:
    """Of frames that show little, rotations are as wrong as their variance says."""
    motion = hand_held(30.0)
    stamps, R = motion.stamps_ns.tolist(), seen(motion)
    blurred = R @ so3_exp(0.3 * np.random.default_rng(5).normal(size=(len(R), 3)))
    for variance, dropped in ((0.3**2, False), (0.0, True)):
        gyro = gyro_of(samples(motion))
        shown(gyro, stamps[:300], R[:300])
        assert gyro.is_believed
        for now in range(300, 400):
            turn = blurred[now - 1].T @ blurred[now]
            gyro.see(stamps[now - 1], stamps[now], turn, (variance, variance))
        assert gyro.dropped == dropped


def test_a_gap_in_the_samples_has_no_turn() -> None:
    motion = hand_held(20.0)
    given = samples(motion, offset_s=0.0)
    times_s = 1e-9 * (given.stamps_ns - motion.origin_ns)
    kept = (times_s < 15.0) | (times_s > 15.3)
    gyro = gyro_of(ImuSamples(**{name: values[kept] for name, values in vars(given).items()}))
    shown(gyro, motion.stamps_ns.tolist(), seen(motion))
    at = {second: motion.origin_ns + round(1e9 * second) for second in (14.5, 14.95, 15.25, 15.5)}
    assert gyro.turn(at[14.5], at[14.95]) is not None
    assert gyro.turn(at[14.95], at[15.25]) is None
    assert gyro.turn(at[14.5], at[15.5]) is None


def test_frames_of_a_gap_get_poses_by_the_gyro() -> None:
    motion = hand_held(20.0)
    stamps, T = motion.stamps_ns.tolist(), motion.T_world_camera(motion.times_s)
    gyro = gyro_of(samples(motion))
    shown(gyro, stamps, seen(motion))
    keyframe = Keyframe(
        id=0, frame=0, segment=0, T_world_camera=np.eye(4), rows=np.zeros(0, np.int32),
        points_px=np.zeros((0, 2), np.float32), rolled_px=np.zeros((0, 2), np.float32),
    )  # fmt: skip
    # One, half a second, and more than can be bridged.
    lost = [60, *range(100, 110), *range(200, 230)]
    placed = [
        EarlierPose(frame=number, keyframe=keyframe, T_world_camera=T[number], inliers=100)
        for number in range(len(stamps))
        if number not in lost
    ]
    carried = carried_poses(placed, dict(enumerate(stamps)), lost, gyro)
    assert [each.frame for each in carried] == lost[:11]
    for each in carried:
        off = so3_log(T[each.frame][:3, :3].T @ each.T_world_camera[:3, :3])
        assert np.degrees(np.linalg.norm(off)) < 0.1
        assert np.linalg.norm(T[each.frame][:3, 3] - each.T_world_camera[:3, 3]) < 0.01

"""What images show of a camera's turns, where its poses have a prior by the gyro."""

from itertools import pairwise
from types import SimpleNamespace

import numpy as np

from pliant.algorithms.arrays import F64
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import move_by_similarity, so3_exp, so3_log
from pliant.algorithms.inertial.gyro import GyroTurn
from pliant.algorithms.slam.active.frame_turns import ByImage, FrameTurns
from pliant.algorithms.slam.frame import Frame
from pliant.algorithms.slam.locate.localisation import Motion
from pliant.algorithms.slam.mapper import Mapper
from pliant.algorithms.slam.parameters import MappingParameters
from pliant.algorithms.tracks import FrameExtrema

CAMERA = PinholeCamera(width=320, height=240, fx=300.0, fy=300.0, cx=159.5, cy=119.5)
POINTS = np.random.default_rng(0).uniform((-2.0, -1.5, 3.0), (2.0, 1.5, 8.0), (300, 3))
STEP_NS, FEW = 33_333_333, 40


def R_world_camera(frame: int) -> F64:
    return so3_exp(np.array([0.0, -0.01 * frame, 0.0]))


def seen(frame: int, count: int) -> Frame:
    """Tracks of the first points."""
    centre = np.array([0.1 * frame, 0.02 * frame, 0.0])
    px = CAMERA.project((POINTS[:count] - centre) @ R_world_camera(frame)).astype(np.float32)
    tracks = FrameExtrema(
        ids=np.arange(count), points_px=px, ages=np.full(count, frame, np.int32),
        kappas=np.ones(count, np.float32), states=np.zeros(count, np.uint8),
        maxima=np.column_stack([px, np.ones(count)]).astype(np.float32),
        dominant_flow=np.eye(2, 3),
    )  # fmt: skip
    return Frame(frame, STEP_NS * frame, tracks)


class WrongGyro:
    """It is sure of turns that are wrong by a constant."""

    is_over, counters, frames = False, {}, 0

    def __init__(self) -> None:
        self.shown: list[tuple[F64, float]] = []

    def predict(self, first_ns: int, second_ns: int) -> GyroTurn:
        frames = round((second_ns - first_ns) / STEP_NS)
        wrong = so3_exp(np.array([0.0, -0.01 * frames + 1e-3, 0.0]))
        return GyroTurn(R=wrong, covariance=1e-10 * np.eye(3))

    def see(self, first_ns: int, second_ns: int, R: F64, variances: tuple[float, float]) -> None:
        self.shown.append((R, sum(variances)))


def test_a_gyro_is_judged_by_images_without_its_own_part_in_the_pose() -> None:
    mapper, gyro = Mapper(CAMERA, MappingParameters(), seed=0), WrongGyro()
    for frame in range(10):
        mapper.process(seen(frame, len(POINTS)))
    mapper._turns = FrameTurns(gyro)  # type: ignore[arg-type]
    poses = [mapper._motion.poses[1][:3, :3]]
    for frame in range(10, 14):
        mapper.process(seen(frame, FEW))
        poses.append(mapper._motion.poses[1][:3, :3])
    true = R_world_camera(9).T @ R_world_camera(10)

    def off(turn: F64) -> float:
        return float(np.linalg.norm(so3_log(true.T @ turn)))

    dragged = [off(before.T @ after) for before, after in pairwise(poses)]
    by_images = [off(turn) for turn, _ in gyro.shown]
    assert len(by_images) == 4
    assert dragged[1] > 1e-4
    assert by_images[1] < 0.01 * dragged[1]
    # Later ones are those in a map whose landmarks have been dragged along.
    assert max(by_images) < 0.5 * max(dragged)
    assert all(0.0 < variance < 2.0 * (1.0 / CAMERA.fx) ** 2 for _, variance in gyro.shown)


def test_a_world_that_moves_before_a_turn_is_shown_changes_no_turn() -> None:
    """As where a keyframe corrects the calibration, and with it the map."""
    S = np.eye(4)
    S[:3, :3] = 1.7 * so3_exp(np.array([0.4, -0.2, 0.3]))
    shown: list[F64] = []
    for move in (np.eye(4), S):
        gyro, motion = WrongGyro(), Motion.at(9, 9 * STEP_NS, np.eye(4))
        turns = FrameTurns(gyro)  # type: ignore[arg-type]
        turns.here = ByImage(stamp_ns=10 * STEP_NS, R=R_world_camera(2), variance=0.1)
        turns.follow(move)
        placed = SimpleNamespace(
            frame=SimpleNamespace(stamp_ns=10 * STEP_NS),
            T_world_camera=move_by_similarity(move, np.eye(4)),
        )
        turns.see(motion.moved(move), placed)  # type: ignore[arg-type]
        ((R, _),) = gyro.shown
        shown.append(R)
    np.testing.assert_allclose(shown[0], R_world_camera(2), atol=1e-12)
    np.testing.assert_allclose(shown[1], shown[0], atol=1e-12)

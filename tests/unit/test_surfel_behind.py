"""Surfels that the camera has passed: behind it they are outside, and nothing is NaN."""

from dataclasses import fields
from typing import Literal

import numpy as np
import pytest
from surfel_scene import STEP_S, board_renderer, film, motion

from pliant.algorithms.arrays import I64
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.surfels.parameters import SurfelParameters
from pliant.algorithms.surfels.patch_sampling import A, B, X
from pliant.algorithms.surfels.surfel_frame import SurfelFrame, SurfelState
from pliant.algorithms.surfels.surfel_tracker import SurfelTracker
from pliant.rendering.film import RenderedFrame

Mode = Literal["static", "moving"]
KINDS = [("static", 8), ("static", 0), ("moving", 8), ("moving", 0)]


@pytest.fixture(scope="module")
def board() -> tuple[list[RenderedFrame], PinholeCamera]:
    """A camera that hardly moves before a board 1 m away."""
    motions = [motion((0.0, 0.0, 0.0), (0.0005 * k, 0.0, 0.001 * k)) for k in range(4)]
    renderer, camera = board_renderer(motions)
    return film(renderer, 4), camera


def start(
    board: tuple[list[RenderedFrame], PinholeCamera], mode: Mode, neighbours: int
) -> tuple[SurfelTracker, SurfelFrame]:
    frames, camera = board
    parameters = SurfelParameters(max_surfels=60, levels=2, camera=mode, neighbours=neighbours)
    tracker = SurfelTracker(parameters)
    return tracker, tracker.start(frames[0].image, frames[0].depth_m, camera)


def put(tracker: SurfelTracker, rows: I64, shift: tuple[float, float, float]) -> None:
    """Surfels are somewhere else than where they were born."""
    table = tracker._now.table
    for poses in (table.poses, table.guesses):
        poses[rows, X : X + 3] += shift
    table.rest[rows] += shift
    table.tried[rows] += shift


def mirrored(image: np.ndarray) -> np.ndarray:
    """Nothing that was seen: no turn brings it there."""
    return np.ascontiguousarray(image[:, ::-1])


def assert_finite(frame: SurfelFrame) -> None:
    for item in fields(frame):
        assert np.isfinite(getattr(frame, item.name)).all(), item.name


@pytest.mark.parametrize(("mode", "neighbours"), KINDS)
@pytest.mark.parametrize("depth", [-2.0, -1.0, -0.98])
def test_surfels_behind_the_camera_are_outside(
    board: tuple[list[RenderedFrame], PinholeCamera], mode: Mode, neighbours: int, depth: float
) -> None:
    """Some far behind, some in the plane of the camera, some at its lens; the others live on."""
    tracker, first = start(board, mode, neighbours)
    passed = first.points_px[:, 0] < np.quantile(first.points_px[:, 0], 0.3)
    put(tracker, np.flatnonzero(passed), (0.0, 0.0, depth))
    for number in (1, 2, 3):
        frame = tracker.track(board[0][number].image, STEP_S)
        assert_finite(frame)
        assert not frame.lost
        assert (frame.state[~passed] == SurfelState.TRACKED).mean() > 0.9
        if depth < -1.5:
            assert (frame.state[passed] == SurfelState.OUTSIDE).all()
        else:
            # Neighbours may bring one back; it is in front of the camera then.
            found = frame.positions[frame.state == SurfelState.TRACKED]
            T = frame.T_world_camera
            assert ((found - T[:3, 3]) @ T[:3, 2] > 0.5).all()


@pytest.mark.parametrize(("mode", "neighbours"), KINDS)
def test_all_behind_is_a_loss(
    board: tuple[list[RenderedFrame], PinholeCamera], mode: Mode, neighbours: int
) -> None:
    """Where the view is no known one; a depth map starts another segment."""
    tracker, first = start(board, mode, neighbours)
    put(tracker, np.arange(len(first.ids)), (0.0, 0.0, -2.0))
    frame = tracker.track(mirrored(board[0][1].image), STEP_S)
    assert_finite(frame)
    assert frame.lost
    assert (frame.state == SurfelState.OUTSIDE).all()
    after = board[0][2]
    again = tracker.track(mirrored(after.image), STEP_S, None, mirrored(after.depth_m))
    assert_finite(again)
    assert not again.lost
    assert again.segment == 1


@pytest.mark.parametrize(("mode", "neighbours"), [kind for kind in KINDS if kind[0] != "static"])
def test_a_camera_that_is_beyond_them(
    board: tuple[list[RenderedFrame], PinholeCamera], mode: Mode, neighbours: int
) -> None:
    """The last pose of the camera is wrong by so much that all surfels are behind it: they are lost
    until the view is a known one."""
    tracker, _ = start(board, mode, neighbours)
    tracker._now.T_world_camera = motion((0.0, 0.0, 0.0), (0.0, 0.0, 1.5))
    frame = tracker.track(mirrored(board[0][1].image), STEP_S)
    assert_finite(frame)
    assert frame.lost
    assert (frame.state == SurfelState.OUTSIDE).all()
    found = tracker.track(board[0][2].image, STEP_S)
    assert (found.state == SurfelState.TRACKED).mean() > 0.9


def test_a_camera_that_flies_past_a_surfel() -> None:
    """Towards a slanted board and over its near edge: what is passed is outside."""
    motions = [motion((0.0, 0.0, 0.0), (0.0, 0.0, 0.06 * k)) for k in range(16)]
    renderer, camera = board_renderer(motions, tilt_rad=0.9)
    frames = film(renderer, len(motions))
    tracker = SurfelTracker(SurfelParameters(max_surfels=150, levels=3, camera="moving"))
    tracker.start(frames[0].image, frames[0].depth_m, camera)
    passed = False
    for frame in frames[1:]:
        result = tracker.track(frame.image, STEP_S)
        assert_finite(result)
        depth = result.positions[:, 2] - result.T_world_camera[2, 3]
        behind = depth < 0.0
        passed |= bool(behind.any())
        assert not (result.state[behind] == SurfelState.TRACKED).any()
    assert passed


@pytest.mark.parametrize(("mode", "neighbours"), KINDS)
def test_surfels_are_not_seen_from_behind(
    board: tuple[list[RenderedFrame], PinholeCamera], mode: Mode, neighbours: int
) -> None:
    """The mirror image is that of the board's back, if it were of glass."""
    tracker, _ = start(board, mode, neighbours)
    table = tracker._now.table
    mirror = np.array([-1.0, 1.0, 1.0])
    for poses in (table.poses, table.guesses):
        for part in (X, A, B):
            poses[:, part : part + 3] *= mirror
    frame = tracker.track(mirrored(board[0][0].image), STEP_S)
    assert not (frame.state == SurfelState.TRACKED).any()
    assert_finite(frame)

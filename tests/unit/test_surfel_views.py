"""Surfels that are found back after a loss because their view is recognised."""

import numpy as np
import pytest
from surfel_scene import STEP_S, board_renderer, film, motion

from pliant.algorithms.arrays import F64
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import inverse, transform
from pliant.algorithms.surfels.parameters import SurfelParameters
from pliant.algorithms.surfels.surfel_frame import SurfelFrame, SurfelState
from pliant.algorithms.surfels.surfel_tracker import SurfelTracker
from pliant.rendering.film import RenderedFrame
from pliant.state import save_state

HERE, NEARBY, TURNED, ELSEWHERE, AGAIN = range(5)
MOTIONS = [
    motion((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
    motion((0.0, 0.0, 0.01), (0.01, 0.0, 0.0)),
    motion((0.05, -0.1, 1.2), (0.12, -0.05, -0.15)),
    motion((0.0, 0.0, 0.0), (1.0, 0.5, 0.0)),
    motion((0.0, 0.1, -0.7), (-0.1, 0.08, 0.05)),
]
"""Where the camera is: nearby, turned by 70 degrees, where it sees nothing that it has seen."""

Film = tuple[list[RenderedFrame], PinholeCamera]


@pytest.fixture(scope="module")
def board() -> Film:
    renderer, camera = board_renderer(MOTIONS, noise=2.0)
    return film(renderer, len(MOTIONS)), camera


def started(board: Film, camera: str) -> tuple[SurfelTracker, SurfelFrame]:
    frames, pinhole = board
    parameters = SurfelParameters.model_validate({"max_surfels": 150, "camera": camera})
    tracker = SurfelTracker(parameters)
    return tracker, tracker.start(frames[HERE].image, frames[HERE].depth_m, pinhole)


def in_view(first: SurfelFrame, T: F64, camera: PinholeCamera) -> np.ndarray:
    points_px = camera.project(transform(inverse(T), first.positions))
    size = np.array([camera.width, camera.height])
    return np.all((points_px > 12) & (points_px < size - 12), axis=1)


@pytest.mark.parametrize("mode", ["static", "moving"])
@pytest.mark.parametrize("covered", [True, False])
def test_a_displaced_surface_is_found_again(board: Film, mode: str, covered: bool) -> None:
    """After the dark, or from one frame to the next: too far for the image to draw it there."""
    frames, camera = board
    tracker, first = started(board, mode)
    for _ in range(3 if covered else 0):
        assert tracker.track(np.full_like(frames[HERE].image, 5), STEP_S).lost
    found = tracker.track(frames[TURNED].image, STEP_S)
    T = MOTIONS[TURNED]
    np.testing.assert_array_equal(found.ids, first.ids)
    tracked, seen = found.state == SurfelState.TRACKED, in_view(first, T, camera)
    assert (tracked & seen).sum() > 0.9 * seen.sum() > 40
    here = transform(inverse(found.T_world_camera), found.positions[tracked])
    truth = transform(inverse(T), first.positions[tracked])
    assert np.median(np.linalg.norm(here - truth, axis=1)) < 0.005
    if mode == "moving":
        np.testing.assert_allclose(found.T_world_camera, T, atol=0.005)
    else:
        np.testing.assert_array_equal(found.T_world_camera, np.eye(4))


@pytest.mark.parametrize("mode", ["static", "moving"])
def test_surfels_are_not_found_in_another_place(board: Film, mode: str) -> None:
    frames, _ = board
    tracker, first = started(board, mode)
    for _ in range(3):
        elsewhere = tracker.track(frames[ELSEWHERE].image, STEP_S)
        assert elsewhere.lost
        assert elsewhere.segment == 0
        np.testing.assert_array_equal(elsewhere.positions, first.positions)


def test_in_the_dark_no_depth_starts_anew(board: Film) -> None:
    """With a depth map for each frame, too, surfels are the same ones afterwards."""
    frames, _ = board
    tracker, first = started(board, "static")
    for _ in range(20):
        dark = tracker.track(
            np.full_like(frames[HERE].image, 5), STEP_S, depth=frames[HERE].depth_m
        )
        assert dark.lost
    after = tracker.track(frames[NEARBY].image, STEP_S, depth=frames[NEARBY].depth_m)
    assert after.segment == 0
    still = after.state[np.isin(after.ids, first.ids)] == SurfelState.TRACKED
    assert still.sum() > 0.9 * len(first.ids)


def test_the_camera_comes_back_from_another_segment(board: Film) -> None:
    frames, camera = board
    tracker, first = started(board, "moving")
    there = tracker.track(frames[ELSEWHERE].image, STEP_S, depth=frames[ELSEWHERE].depth_m)
    assert there.segment == 1
    assert not np.isin(there.ids, first.ids).any()
    back = tracker.track(frames[AGAIN].image, STEP_S)
    assert back.segment == 0
    np.testing.assert_array_equal(back.ids, first.ids)
    seen = in_view(first, MOTIONS[AGAIN], camera)
    assert (back.state == SurfelState.TRACKED).sum() > 0.9 * seen.sum()
    np.testing.assert_allclose(back.T_world_camera, MOTIONS[AGAIN], atol=0.005)
    # And there again: that segment is as it was left.
    again = tracker.track(frames[ELSEWHERE].image, STEP_S)
    assert again.segment == 1
    np.testing.assert_array_equal(again.ids, there.ids)
    assert (again.state == SurfelState.TRACKED).mean() > 0.9


def test_a_map_of_one_segment_changes_no_other(board: Film) -> None:
    frames, _ = board

    def back(*, settled: bool) -> bytes:
        tracker, _ = started(board, "moving")
        there = tracker.track(frames[ELSEWHERE].image, STEP_S, depth=frames[ELSEWHERE].depth_m)
        if settled:
            rows = np.arange(len(there.ids))
            tracker.settle(rows, there.positions, np.full(len(rows), 1e-3))
        result = tracker.track(frames[AGAIN].image, STEP_S)
        assert result.segment == 0
        return result.T_world_camera.tobytes()

    assert back(settled=True) == back(settled=False)


def test_the_same_bytes_and_a_bound(board: Film) -> None:
    """However often tracking starts anew."""
    frames, _ = board

    def run() -> list[bytes]:
        tracker, _ = started(board, "static")
        generator, out = np.random.default_rng(0), list[bytes]()
        for _ in range(5):
            blocks = generator.integers(40, 200, (30, 40), np.uint8)
            image = np.kron(blocks, np.ones((8, 8), np.uint8))
            result = tracker.track(image, STEP_S, depth=frames[HERE].depth_m)
            assert result.segment == len(out) + 1
            out.append(result.positions.tobytes() + result.state.tobytes())
        assert len(save_state(tracker)) < size
        return out

    tracker, _ = started(board, "static")
    size = 5 * len(save_state(tracker))
    assert run() == run()

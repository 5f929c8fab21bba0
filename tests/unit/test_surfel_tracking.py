"""Surfels followed through rendered frames, with a static camera."""

import numpy as np
import pytest
from surfel_scene import HEIGHT, STEP_S, WIDTH, board_renderer, film, motion

from pliant.algorithms.arrays import F64
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import inverse, transform
from pliant.algorithms.surfels.deformation_graph import pull_of_edges
from pliant.algorithms.surfels.graph_alignment import relocate
from pliant.algorithms.surfels.parameters import SurfelParameters
from pliant.algorithms.surfels.patch_sampling import X
from pliant.algorithms.surfels.remembered_views import RememberedViews
from pliant.algorithms.surfels.surfel_alignment import (
    Templates,
    align_all,
    make_workspace,
    no_equilibrium,
)
from pliant.algorithms.surfels.surfel_frame import SurfelFrame, SurfelState
from pliant.algorithms.surfels.surfel_tracker import SurfelTracker
from pliant.rendering.film import RenderedFrame

SMALL = SurfelParameters(max_surfels=60, levels=2)


@pytest.fixture(scope="module")
def board() -> tuple[list[RenderedFrame], PinholeCamera, list[F64]]:
    """Four frames of a board, noise-free; the camera moves, as if the board did."""
    motions = [
        motion((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
        motion((0.003, -0.008, 0.01), (0.006, 0.004, -0.01)),
        motion((0.01, -0.016, 0.02), (0.015, 0.004, -0.03)),
        motion((0.01, -0.03, 0.03), (0.025, 0.01, -0.05)),
    ]
    renderer, camera = board_renderer(motions)
    return film(renderer, 4), camera, motions


def assert_finite(frame: SurfelFrame) -> None:
    for value in vars(frame).values():
        if isinstance(value, np.ndarray) and value.dtype.kind == "f":
            assert np.isfinite(value).all()


def arrays(frame: SurfelFrame) -> list[bytes]:
    return [v.tobytes() for v in vars(frame).values() if isinstance(v, np.ndarray)]


def test_recovery_without_noise(
    board: tuple[list[RenderedFrame], PinholeCamera, list[F64]],
) -> None:
    frames, camera, motions = board
    tracker = SurfelTracker(SMALL)
    first = tracker.start(frames[0].image, frames[0].depth_m, camera)
    assert len(first.ids) == 60
    for frame, T in zip(frames[1:], motions[1:], strict=True):
        result = tracker.track(frame.image, STEP_S)
        truth = transform(inverse(T), first.positions)
        good = result.state == SurfelState.TRACKED
        assert good.mean() >= 0.95
        error = np.linalg.norm(result.positions - truth, axis=1)[good]
        assert np.median(error) < 0.003
        lateral = np.linalg.norm(camera.project(truth) - result.points_px, axis=1)[good]
        assert np.median(lateral) < 0.03
        R = T[:3, :3].T
        turned = np.einsum("ij,njk->nik", R, first.tangents)
        angle = np.linalg.norm(result.tangents - turned, axis=(1, 2))[good]
        assert np.median(angle) < 0.03
        assert_finite(result)


def test_the_same_frame_changes_nothing(
    board: tuple[list[RenderedFrame], PinholeCamera, list[F64]],
) -> None:
    frames, camera, _ = board
    tracker = SurfelTracker(SMALL)
    first = tracker.start(frames[0].image, frames[0].depth_m, camera)
    again = tracker.track(frames[0].image, STEP_S)
    np.testing.assert_allclose(again.positions, first.positions, atol=1e-5)
    assert (again.zncc > 0.9999).all()


def test_same_bytes_in_every_run(
    board: tuple[list[RenderedFrame], PinholeCamera, list[F64]],
) -> None:
    frames, camera, _ = board
    runs = []
    for _ in range(2):
        tracker = SurfelTracker(SMALL)
        results = [tracker.start(frames[0].image, frames[0].depth_m, camera)]
        results += [tracker.track(frame.image, STEP_S) for frame in frames[1:]]
        runs.append([arrays(result) for result in results])
    assert runs[0] == runs[1]


def test_batch_is_one_by_one(
    board: tuple[list[RenderedFrame], PinholeCamera, list[F64]],
) -> None:
    frames, camera, _ = board
    tracker = SurfelTracker(SMALL)
    tracker.start(frames[0].image, frames[0].depth_m, camera)
    level = tracker._frames.pyramid(frames[1].image, camera)[0]
    matcher = tracker._frames.matcher(tracker._now.table, 0, level)
    start = tracker._now.table.poses
    together = start.copy()
    align_all(together, np.ones(len(start), np.uint8), no_equilibrium(len(start)), matcher)
    alone = start.copy()
    for k in range(len(start) - 1, -1, -1):
        one = Templates(*(each[k : k + 1].copy() for each in matcher.templates))
        fresh = matcher._replace(templates=one, work=make_workspace(23))
        align_all(alone[k : k + 1], np.ones(1, np.uint8), no_equilibrium(1), fresh)
    assert (together != start).any()
    assert together.tobytes() == alone.tobytes()


def test_a_second_search_finds_surfels_moved_past_their_image(
    board: tuple[list[RenderedFrame], PinholeCamera, list[F64]],
) -> None:
    frames, camera, _ = board
    tracker = SurfelTracker(SMALL)
    tracker.start(frames[0].image, frames[0].depth_m, camera)
    table, level = tracker._now.table, tracker._frames.pyramid(frames[0].image, camera)[0]
    n = len(table)
    off = table.poses.copy()
    off[:, X] += 1.2 / camera.fx * off[:, X + 2]
    wanted = (np.arange(n) % 2).astype(np.uint8)
    for strain, left in ((0.02, 0.5), (0.2, 0.25)):  # neighbours that hold less, let go
        found = off.copy()
        relocate(
            found,
            wanted,
            table.edges,
            tracker._frames.matcher(tracker._now.table, 0, level),
            strain,
        )
        np.testing.assert_array_equal(found[wanted == 0], off[wanted == 0])
        errors = np.linalg.norm((found - table.poses)[wanted > 0, X : X + 3], axis=1)
        assert np.median(errors) < left * 1.2 / camera.fx
    held = pull_of_edges(table.edges, n, 25.0, 0.02)
    ends, lengths = table.edges.ends, table.edges.lengths
    mine = (ends == 0).any(axis=1)
    np.testing.assert_allclose(held[0], (25.0 / (0.02 * lengths[mine]) ** 2).sum())


def test_tried_positions_are_published(
    board: tuple[list[RenderedFrame], PinholeCamera, list[F64]],
) -> None:
    frames, camera, _ = board
    tracker = SurfelTracker(SMALL)
    first = tracker.start(frames[0].image, frames[0].depth_m, camera)
    np.testing.assert_array_equal(first.tried, first.positions)
    second = tracker.track(frames[1].image, STEP_S)
    good = second.state == SurfelState.TRACKED
    np.testing.assert_array_equal(second.tried[good], second.positions[good])
    covered = frames[2].image.copy()
    covered[:, 160:] = 60
    third = tracker.track(covered, STEP_S)
    bad = third.state != SurfelState.TRACKED
    assert bad.any()
    assert (third.tried[bad] != third.positions[bad]).any(axis=1).mean() > 0.9
    assert_finite(third)


def test_gain_and_bias_take_up_the_light(
    board: tuple[list[RenderedFrame], PinholeCamera, list[F64]],
) -> None:
    frames, camera, _ = board
    tracker = SurfelTracker(SMALL)
    tracker.start(frames[0].image, frames[0].depth_m, camera)
    darker = np.rint(0.7 * frames[1].image + 10.0).astype(np.uint8)
    result = tracker.track(darker, STEP_S)
    good = result.state == SurfelState.TRACKED
    assert good.mean() > 0.95
    assert np.median(result.gains[good]) == pytest.approx(1 / 0.7, rel=0.03)
    assert np.median(result.biases[good]) == pytest.approx(-10 / 0.7, abs=5.0)


def test_black_frame_jump_and_cover_are_stated(
    board: tuple[list[RenderedFrame], PinholeCamera, list[F64]],
) -> None:
    frames, camera, _ = board
    tracker = SurfelTracker(SMALL)
    first = tracker.start(frames[0].image, frames[0].depth_m, camera)
    black = tracker.track(np.zeros_like(frames[0].image), STEP_S)
    assert black.lost
    assert not (black.state == SurfelState.TRACKED).any()
    np.testing.assert_array_equal(black.positions, first.positions)
    noise = np.random.default_rng(0).integers(0, 255, frames[0].image.shape).astype(np.uint8)
    assert_finite(tracker.track(noise, STEP_S))
    # Found again where the frame shows them again.
    again = tracker.track(frames[0].image, STEP_S)
    assert (again.state == SurfelState.TRACKED).mean() > 0.95
    covered = frames[0].image.copy()
    covered[:, : WIDTH // 2] = 128
    result = tracker.track(covered, STEP_S)
    under = first.points_px[:, 0] < WIDTH // 2 - 15
    assert not (result.state[under] == SurfelState.TRACKED).any()
    beside = first.points_px[:, 0] > WIDTH // 2 + 15
    assert (result.state[beside] == SurfelState.TRACKED).mean() > 0.95
    assert_finite(result)


def test_lost_surfels_make_room_for_new_ones(
    board: tuple[list[RenderedFrame], PinholeCamera, list[F64]],
) -> None:
    frames, camera, _ = board
    tracker = SurfelTracker(SMALL.model_copy(update={"lost_after_s": 2.5 * STEP_S}))
    first = tracker.start(frames[0].image, frames[0].depth_m, camera)
    for _ in range(4):
        lost = tracker.track(np.zeros_like(frames[0].image), STEP_S)
    assert (lost.state == SurfelState.LOST).all()
    assert lost.segment == 0
    restarted = tracker.track(
        np.flip(frames[0].image, 1).copy(), STEP_S, depth=np.flip(frames[0].depth_m, 1)
    )
    assert restarted.segment == 1
    assert not restarted.lost
    assert restarted.ids.min() > first.ids.max()
    assert (restarted.age == 0).all()


@pytest.mark.parametrize(
    ("fps", "lost_in", "dropped_in"), [(5, 3, 28), (30, 16, 166), (60, 32, 331)]
)
def test_surfels_are_lost_and_dropped_after_seconds_of_the_stream(
    board: tuple[list[RenderedFrame], PinholeCamera, list[F64]],
    fps: int,
    lost_in: int,
    dropped_in: int,
) -> None:
    frames, camera, _ = board
    tracker = SurfelTracker(SMALL.model_copy(update={"max_surfels": 30, "levels": 1}))
    first = tracker.start(frames[0].image, frames[0].depth_m, camera)
    covered = frames[0].image.copy()
    covered[:, : WIDTH // 2] = 128
    under = first.ids[first.points_px[:, 0] < WIDTH // 2 - 15]
    assert len(under) > 5
    for number in range(1, dropped_in + 1):
        result = tracker.track(covered, 1.0 / fps, depth=frames[0].depth_m)
        there = np.isin(result.ids, under)
        assert there.sum() == (0 if number == dropped_in else len(under))
        assert (result.state[there] == SurfelState.LOST).all() == (number >= lost_in)


def test_births_fill_what_is_free(
    board: tuple[list[RenderedFrame], PinholeCamera, list[F64]],
) -> None:
    frames, camera, _ = board
    tracker = SurfelTracker(SMALL)
    half = frames[0].depth_m.copy()
    half[:, 100:] = 0.0
    first = tracker.start(frames[0].image, half, camera)
    assert 0 < len(first.ids) < 60
    result = tracker.track(frames[1].image, STEP_S, depth=frames[1].depth_m)
    assert len(result.ids) == 60
    np.testing.assert_array_equal(result.ids[: len(first.ids)], first.ids)
    assert (result.born[len(first.ids) :] == 1).all()


def test_a_background_without_depth_is_no_part_of_the_texture(
    board: tuple[list[RenderedFrame], PinholeCamera, list[F64]],
) -> None:
    """A surface that moves before one that does not: the still part must not hold the patch."""
    frames, camera, motions = board
    depth = frames[0].depth_m.copy()
    depth[:, 150:] = 0.0
    shown = frames[1].image.copy()
    edge = camera.project(transform(inverse(motions[1]), camera_points(camera, depth, 150)))
    right = np.arange(WIDTH)[None, :] >= np.median(edge[:, 0])
    shown[right.repeat(HEIGHT, 0)] = 20
    frozen = frames[0].image.copy()
    frozen[:, 150:] = 20
    tracker = SurfelTracker(SMALL.model_copy(update={"levels": 1}))
    first = tracker.start(frozen, depth, camera)
    near = np.flatnonzero(first.points_px[:, 0] > 150 - 11)
    assert len(near)
    background = tracker._now.table.templates[0].images[near, 0] > 1e6
    assert (background.sum(axis=1) > 0).all()
    result = tracker.track(shown, STEP_S)
    truth = transform(inverse(motions[1]), first.positions)
    error = np.linalg.norm(result.positions - truth, axis=1)[near]
    assert np.median(error) < 0.004
    assert result.visible[near].min() > 0.8


def camera_points(camera: PinholeCamera, depth: F64, column: int) -> F64:
    """(H, 3) points of the column left of ``column``."""
    rows = np.arange(camera.height)
    pixels = np.stack([np.full(len(rows), column - 1.0), rows], axis=1)
    rays = np.concatenate([camera.normalise(pixels), np.ones((len(rows), 1))], axis=1)
    return rays * depth[rows, column - 1][:, None]


def test_no_texture_and_no_depth_give_no_surfels() -> None:
    camera = PinholeCamera(width=WIDTH, height=HEIGHT, fx=200.0, fy=200.0, cx=159.5, cy=119.5)
    flat = np.full((HEIGHT, WIDTH), 120, np.uint8)
    tracker = SurfelTracker(SMALL)
    frame = tracker.start(flat, np.ones((HEIGHT, WIDTH)), camera)
    assert frame.lost
    assert len(frame.ids) == 0
    assert tracker.track(flat, STEP_S).lost
    textured = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH)).astype(np.uint8)
    assert tracker.start(textured, np.zeros((HEIGHT, WIDTH)), camera).lost
    assert tracker.track(textured, STEP_S, depth=np.full((HEIGHT, WIDTH), np.nan)).lost


def test_wrong_input_is_refused() -> None:
    camera = PinholeCamera(width=WIDTH, height=HEIGHT, fx=200.0, fy=200.0, cx=159.5, cy=119.5)
    image, depth = np.zeros((HEIGHT, WIDTH), np.uint8), np.ones((HEIGHT, WIDTH))
    tracker = SurfelTracker(SMALL)
    with pytest.raises(ValueError, match="before start"):
        tracker.track(image, STEP_S)
    with pytest.raises(ValueError, match="expected depth of shape"):
        tracker.start(image, depth[1:], camera)
    with pytest.raises(ValueError, match="expected a uint8 image"):
        tracker.start(image.astype(np.float32), depth, camera)  # type: ignore[arg-type]


@pytest.mark.parametrize("mode", ["static", "moving"])
def test_prediction_bridges_a_jump(mode: str) -> None:
    """50 px between two frames: beyond the photometric basin, and no loss with a prediction."""
    motions = [motion((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)), motion((0.0, 0.0, 0.0), (0.19, 0.0, 0.0))]
    renderer, camera = board_renderer(motions)
    frames = film(renderer, 2)
    found = {}
    for predicted in (False, True):
        tracker = SurfelTracker(SMALL.model_copy(update={"camera": mode}))
        first = tracker.start(frames[0].image, frames[0].depth_m, camera)
        shown = camera.project(transform(inverse(motions[1]), first.positions))
        prediction = shown - first.points_px + 2.0
        prediction[::10] = np.nan
        tracker._views = RememberedViews()  # else it is found back
        result = tracker.track(frames[1].image, STEP_S, prediction if predicted else None)
        staying = (shown[:, 0] > 15) & (shown[:, 0] < WIDTH - 15) & np.isfinite(prediction[:, 0])
        px = result.points_px - shown
        right = (np.abs(px).max(axis=1) < 0.5) & (result.state == SurfelState.TRACKED)
        found[predicted] = right[staying].mean()
        assert_finite(result)
    assert found[False] < 0.5
    # With a moving camera the equilibrium first holds against a jump of the whole scene.
    assert found[True] > (0.9 if mode == "static" else 0.75)
    with pytest.raises(ValueError, match="expected a prediction of shape"):
        tracker.track(frames[1].image, STEP_S, prediction[1:])

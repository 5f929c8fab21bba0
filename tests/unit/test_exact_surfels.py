"""Surfels against exact truth: errors, states and scores that are known beforehand."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pliant.algorithms.geometry import inverse, so3_exp, transform
from pliant.algorithms.surfels.surfel_frame import SurfelFrame, SurfelState
from pliant.datasets import open_source
from pliant.datasets.builtin import builtin_folder
from pliant.datasets.rectifier import Rectifier
from pliant.errors import DatasetError
from pliant.evaluation.exact_surfels import ExactSurfels, format_exact
from pliant.evaluation.later_surfels import LaterSurfels, format_later, scaled, true_scale
from pliant.evaluation.surface_truth import MaterialPoints, SurfaceTruth

FRAMES = 25


def open_truth(cache: Path, source: str) -> SurfaceTruth:
    folder = builtin_folder(source, cache=cache)
    return SurfaceTruth(folder, Rectifier(open_source(str(folder)).calibration).camera)


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="module")
def sliding(cache: Path) -> SurfaceTruth:
    return open_truth(cache, f"built-in:sliding?frames={FRAMES}&width=64")


@pytest.fixture(scope="module")
def breathing(cache: Path) -> SurfaceTruth:
    return open_truth(cache, f"built-in:breathing?frames={FRAMES}&width=64")


def pixels() -> np.ndarray:
    u, v = np.meshgrid(np.arange(6, 60, 6), np.arange(6, 44, 6))
    return np.stack([u.ravel(), v.ravel()], axis=1).astype(np.float64)


def surfels_at(
    truth: SurfaceTruth, positions: np.ndarray, T_world_camera: np.ndarray, state: np.ndarray,
    zncc: np.ndarray,
) -> SurfelFrame:  # fmt: skip
    n, zeros = len(positions), np.zeros(len(positions), np.float32)
    seen = truth.camera.project(transform(inverse(T_world_camera), positions))
    tangents = np.zeros((n, 3, 2))
    tangents[:, 0, 0] = tangents[:, 1, 1] = np.linspace(0.5, 0.7, n)
    return replace(
        SurfelFrame.empty(), lost=False, T_world_camera=T_world_camera, ids=np.arange(n) + 3,
        positions=positions, tangents=tangents, deformations=np.zeros((n, 3)),
        points_px=seen.astype(np.float32), zncc=zncc.astype(np.float32), visible=zeros,
        sigma=zeros, gains=zeros, biases=zeros, state=state.astype(np.uint8),
        age=np.zeros(n, np.int32), born=np.zeros(n, np.int32),
    )  # fmt: skip


def world_of(truth: SurfaceTruth, frame: int) -> tuple[np.ndarray, np.ndarray]:
    """Exact positions and camera of a frame, in the world of surfels that start in frame 0."""
    to_world = inverse(truth.T_world_camera[0])
    points = truth.at_pixels(0, pixels())
    return transform(to_world, truth.positions(points, frame)), to_world @ truth.T_world_camera[
        frame
    ]


def test_errors_are_those_that_were_put_in(breathing: SurfaceTruth) -> None:
    judge = ExactSurfels(breathing)
    start, T_first = world_of(breathing, 0)
    n = len(start)
    tracked, good = np.zeros(n), np.full(n, 0.99)
    judge.add(0, SurfelFrame.empty())  # before the start there is nothing to judge
    judge.add(0, surfels_at(breathing, start, T_first, tracked, good))
    exact, T = world_of(breathing, 20)
    depth = transform(inverse(T), exact)[:, 2:]
    rays = transform(inverse(T), exact) / depth
    # All are 0.5 % too far along their rays; one is lost, and was never followed.
    found = transform(T, rays * depth * 1.005)
    state = tracked.copy()
    state[4] = SurfelState.LOST
    found[4] = start[4]
    judge.add(20, surfels_at(breathing, found, T, state, good))
    first, row = judge.rows
    assert first.rmse < 1e-6
    assert first.camera < 1e-9
    others = np.arange(n) != 4
    length = np.linalg.norm(rays, axis=1)
    assert row.rmse == pytest.approx(0.005 * np.sqrt(np.mean(length[others] ** 2)), rel=1e-4)
    assert row.in_camera == pytest.approx(row.rmse, rel=1e-6)
    assert row.rmse_all > row.rmse
    assert (row.alive, row.judged, row.right) == (n - 1, n, 1.0)
    assert row.frozen_m == pytest.approx(np.sqrt(np.mean(np.sum((start - exact) ** 2, axis=1))))
    assert 0 < row.followed <= row.followable <= n
    assert judge.by_sheet() == {"surface": (n, pytest.approx(row.rmse, rel=1e-6))}
    assert [error for _, _, error in judge.by_size(1)] == [pytest.approx(row.rmse, rel=1e-6)]
    assert "camera: RMSE of its position" in format_exact(judge, moving_camera=True)


def test_the_error_of_the_camera_is_separate(breathing: SurfaceTruth) -> None:
    judge = ExactSurfels(breathing)
    start, T_first = world_of(breathing, 0)
    n = len(start)
    judge.add(0, surfels_at(breathing, start, T_first, np.zeros(n), np.ones(n)))
    exact, T = world_of(breathing, 9)
    off = np.eye(4)
    off[:3, :3], off[:3, 3] = so3_exp(np.array([0.0, 0.01, 0.0])), (0.003, 0.0, 0.004)
    wrong = T @ off
    in_camera = transform(inverse(T), exact)
    judge.add(9, surfels_at(breathing, transform(wrong, in_camera), wrong, np.zeros(n), np.ones(n)))
    row = judge.rows[1]
    assert row.camera_m == pytest.approx(0.005)
    assert row.camera_rad == pytest.approx(0.01)
    assert row.camera == pytest.approx(0.005 / in_camera[:, 2].mean())
    assert row.in_camera < 1e-6
    assert row.rmse > 0.003
    assert judge.summary()["camera_rmse"] == pytest.approx(row.camera)


def test_what_another_sheet_drags_along_is_counted(sliding: SurfaceTruth) -> None:
    judge = ExactSurfels(sliding)
    start, T = world_of(sliding, 0)
    n = len(start)
    judge.add(0, surfels_at(sliding, start, T, np.zeros(n), np.ones(n)))
    exact, _ = world_of(sliding, FRAMES - 1)
    sheet = sliding.at_pixels(0, pixels()).sheet
    assert sorted(set(sheet.tolist())) == [0, 1]
    # Two of the rear sheet go with the front one; one is off, but on its own; one is dead.
    rear = np.flatnonzero(sheet == 1)[:4]
    front = MaterialPoints(np.array([0]), np.array([[25.0, 40.0]]))
    gone = sliding.positions(front, FRAMES - 1) - sliding.positions(front, 0)
    found, state = exact.copy(), np.zeros(n)
    found[rear[[0, 1, 3]]] = start[rear[[0, 1, 3]]] + gone
    found[rear[2]] -= gone[0]
    state[rear[3]] = SurfelState.OUTLIER
    judge.add(FRAMES - 1, surfels_at(sliding, found, T, state, np.ones(n)))
    assert judge.rows[1].dragged == 2
    judge.add(FRAMES - 1, surfels_at(sliding, exact, T, np.zeros(n), np.ones(n)))
    assert judge.rows[2].dragged == 0
    assert judge.summary()["dragged_ever"] == 2.0


@pytest.mark.parametrize("field", ["zncc", "confidence"])
def test_the_curve_of_what_is_published_has_a_known_area(sliding: SurfaceTruth, field: str) -> None:
    judge = ExactSurfels(sliding)
    start, T = world_of(sliding, 0)
    n = len(start)
    judge.add(0, surfels_at(sliding, start, T, np.zeros(n), np.ones(n)))
    exact, _ = world_of(sliding, 3)
    wrong = np.arange(n) % 2 == 1
    found = exact.copy()
    found[wrong] += (0.05, 0.0, 0.0)
    # Half of the wrong ones look as good as the right ones: ties count half.
    score = np.where(wrong & (np.arange(n) % 4 == 1), 0.3, 0.9)
    state = np.where(score < 0.5, SurfelState.OUTLIER, SurfelState.TRACKED)
    frame = surfels_at(sliding, found, T, state, np.ones(n))
    judge.add(3, replace(frame, **{field: score.astype(np.float32)}))
    low = np.count_nonzero(wrong & (score < 0.5)) / np.count_nonzero(wrong)
    assert judge.summary()["auc"] == pytest.approx(low + 0.5 * (1.0 - low))
    assert judge.summary()["auc_image"] == judge.summary()["auc"]


def test_what_was_not_kept_counts_where_it_was_tried(sliding: SurfaceTruth) -> None:
    start, T = world_of(sliding, 0)
    n = len(start)
    exact, _ = world_of(sliding, 3)
    wrong = np.arange(n) % 2 == 1
    found = exact * np.where(wrong, 1.05, 1.0)[:, None]  # along the ray: the image cannot tell
    state = np.where(wrong, SurfelState.OUTLIER, SurfelState.TRACKED)
    zncc = np.where(wrong, 0.3, 0.9)
    for tried, auc, in_place in ((found, 1.0, True), (exact, np.nan, True), (None, 1.0, False)):
        judge = ExactSurfels(sliding)
        judge.add(0, surfels_at(sliding, start, T, np.zeros(n), np.ones(n)))
        frame = surfels_at(sliding, found, T, state, zncc)
        if tried is None:  # an old recording: at its pixel, at the depth that was kept
            shifted = frame.points_px + np.where(wrong, 9.0, 0.0)[:, None].astype(np.float32)
            frame = replace(frame, points_px=shifted)
        else:
            frame = replace(frame, tried=tried)
        judge.add(3, frame)
        assert judge.summary()["auc"] == pytest.approx(auc, nan_ok=True)
        assert np.isnan(judge.summary()["auc_image"]) == in_place


def test_losses_and_restarts(sliding: SurfaceTruth) -> None:
    judge = ExactSurfels(sliding)
    start, T = world_of(sliding, 0)
    n = len(start)
    good = surfels_at(sliding, start, T, np.zeros(n), np.ones(n))
    judge.add(0, good)
    judge.add(1, good)
    judge.add(2, replace(good, lost=True))
    judge.add(3, replace(good, segment=1))  # others that happen to have these numbers
    assert judge.summary()["frames_until_loss"] == 2.0
    assert [row.alive for row in judge.rows] == [n, n, n, 0]
    with pytest.raises(DatasetError, match=r"no surfaces\.npz"):
        SurfaceTruth(Path("nowhere"), sliding.camera)


def test_what_is_covered_is_not_visible(cache: Path) -> None:
    truth = open_truth(cache, f"built-in:sliding?frames={FRAMES}&width=64&tool=1")
    points = truth.at_pixels(0, pixels())
    assert truth.visible(points, 0).all()
    shown = truth.at_pixels(18, pixels())
    on_tool = MaterialPoints(shown.sheet[shown.sheet == 2], shown.where[shown.sheet == 2])
    assert len(on_tool.sheet) > 0
    assert truth.visible(on_tool, 18).all()
    hidden = ~truth.visible(points, 18, 2.0)
    assert 1 <= hidden.sum() < 0.5 * len(hidden)


def test_surfels_born_later_are_judged_by_their_own_points(breathing: SurfaceTruth) -> None:
    """Those of frame 9 are 0.5 % too far along their rays when they are born, 2 % in frame 20."""
    later = LaterSurfels(breathing)
    start, T_first = world_of(breathing, 0)
    n = len(start)
    first = surfels_at(breathing, start, T_first, np.zeros(n), np.ones(n))
    later.add(0, first)
    assert later.summary()["births"] == 0
    to_world, new = inverse(breathing.T_world_camera[0]), pixels()[::2] + 3.0
    points = breathing.at_pixels(9, new)
    lengths = []
    for frame, share in ((9, 0.005), (20, 0.02)):
        old, T = world_of(breathing, frame)
        exact = transform(inverse(T), transform(to_world, breathing.positions(points, frame)))
        lengths.append(np.sqrt(np.mean(np.sum((exact / exact[:, 2:]) ** 2, axis=1))))
        found = np.concatenate([old, transform(T, exact * (1.0 + share))])
        m = len(found)
        ages = np.where(np.arange(m) < n, frame, frame - 9).astype(np.int32)
        surfels = surfels_at(breathing, found, T, np.zeros(m), np.ones(m))
        later.add(frame, replace(surfels, age=ages))
    figures = later.summary()
    assert (figures["births"], figures["alive"]) == (len(new), len(new))
    assert figures["at_birth"] == pytest.approx(0.005 * lengths[0], rel=1e-3)
    assert figures["in_camera"] == pytest.approx(0.02 * lengths[1], rel=1e-3)
    assert figures["whole"] == pytest.approx(0.02 * lengths[1], rel=1e-3)
    assert "born later" in format_later(later)


def test_a_scale_that_is_arbitrary_is_found_and_given(breathing: SurfaceTruth) -> None:
    start, T_first = world_of(breathing, 0)
    n = len(start)
    metric = surfels_at(breathing, start, T_first, np.zeros(n), np.ones(n))
    half = scaled(metric, 0.5)
    assert true_scale(0, half, breathing) == pytest.approx(2.0, rel=1e-6)
    np.testing.assert_allclose(scaled(half, 2.0).positions, metric.positions)
    np.testing.assert_allclose(scaled(half, 2.0).T_world_camera, metric.T_world_camera)
    judge = ExactSurfels(breathing)
    judge.add(0, scaled(half, true_scale(0, half, breathing)))
    assert judge.rows[0].rmse < 1e-6

"""The measures of surfels against true depth, on cases with known answers."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.surfels.surfel_frame import SurfelFrame, SurfelState
from pliant.evaluation.surfel_truth import (
    SurfelTruth,
    format_surfels,
    lift,
    mean_rows,
    roc,
    scaled_mean,
    trimmed_rmse,
)

CAMERA = PinholeCamera(width=160, height=120, fx=150.0, fy=150.0, cx=79.5, cy=59.5)
POINTS = np.array([[u, v] for u in range(40, 121, 20) for v in range(40, 81, 20)], np.float32)


def surfels(positions: np.ndarray, state: np.ndarray | None = None) -> SurfelFrame:
    n = len(positions)
    zeros = np.zeros(n, np.float32)
    return replace(
        SurfelFrame.empty(), lost=False, ids=np.arange(n) + 5, positions=positions,
        tangents=np.zeros((n, 3, 2)), deformations=np.zeros((n, 3)), points_px=POINTS[:n],
        zncc=zeros, visible=zeros, sigma=zeros, gains=zeros, biases=zeros,
        state=np.zeros(n, np.uint8) if state is None else state,
        age=np.zeros(n, np.int32), born=np.zeros(n, np.int32),
    )  # fmt: skip


def picture() -> np.ndarray:
    noise = np.random.default_rng(0).integers(0, 256, (120, 160), np.uint8)
    return cv2.GaussianBlur(noise, (0, 0), 2.0)


def test_a_plane_that_comes_nearer_is_measured_exactly() -> None:
    """The image shifts by 3 px, the plane comes from 1.0 m to 0.9 m; one surfel is lost."""
    first = picture()
    second = np.roll(first, 3, axis=1)
    near, far = np.full((120, 160), 0.9), np.full((120, 160), 1.0)
    start, _ = lift(POINTS, far, CAMERA)
    true, _ = lift(POINTS + np.float32([3.0, 0.0]), near, CAMERA)
    state = np.zeros(len(POINTS), np.uint8)
    state[0] = SurfelState.LOST
    found = true + np.array([0.0, 0.0, 0.004])
    found[0] = start[0]
    truth = SurfelTruth(CAMERA)
    truth.add(0, SurfelFrame.empty(), first, far)  # before the start there is nothing to judge
    truth.add(1, surfels(start), first, far)
    truth.add(2, surfels(found, state), second, near)
    before, after = truth.rows
    assert (before.frame, before.alive, before.compared) == (1, 15, 15)
    assert before.rmse < 1e-9
    assert before.cloud < 1e-9
    assert (after.alive, after.judged, after.compared_all) == (14, 15, 15)
    assert after.rmse == pytest.approx(0.004, rel=0.05)
    assert after.depth_rmse_90 == pytest.approx(0.004, rel=1e-3)
    assert after.cloud == pytest.approx(0.004, abs=1e-6)
    assert after.frozen_cloud == pytest.approx(0.1, rel=0.01)
    assert after.rmse_all > after.rmse
    assert after.frozen_rmse == pytest.approx(0.1, rel=0.1)
    assert after.scaled_mean_80 < 0.001  # a scale hides what is wrong with the depth
    assert mean_rows(truth.rows)["rmse"] == after.rmse
    assert "14/15" in format_surfels(truth.rows)


def test_depth_is_not_lifted_across_an_edge_a_hole_or_the_border() -> None:
    depth = np.ones((120, 160))
    depth[:, 80:] = 2.0
    depth[50, 50] = 0.0
    points = np.array([[20.5, 20.5], [79.5, 20.0], [50.5, 50.0], [-1.0, 5.0], [159.5, 5.0]])
    _, known = lift(points.astype(np.float32), depth, CAMERA)
    assert known.tolist() == [True, False, False, False, False]


def test_area_under_the_curve_is_the_chance_of_the_right_order() -> None:
    generator = np.random.default_rng(0)
    scores = np.round(generator.normal(0.0, 1.0, 200), 1)  # with ties
    inlier = generator.random(200) < 0.5 + 0.3 * np.tanh(scores)
    pairs = scores[inlier][:, None] - scores[~inlier][None]
    expected = np.mean((pairs > 0) + 0.5 * (pairs == 0))
    assert roc(scores, inlier)[2] == pytest.approx(expected)
    assert roc(np.array([1.0, 2.0]), np.array([False, True]))[2] == 1.0
    assert np.isnan(roc(scores, np.ones(200, np.bool_))[2])


def test_trimmed_and_scaled_variants() -> None:
    assert trimmed_rmse(np.array([1.0] * 9 + [100.0]), 0.9) == 1.0
    points = np.random.default_rng(0).normal(2.0, 1.0, (50, 3))
    assert scaled_mean(points, 1.3 * points, 0.8) < 1e-12
    assert np.isnan(scaled_mean(points[:0], points[:0], 0.8))

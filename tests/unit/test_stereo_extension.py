"""Surfaces that continue in the holes beside them."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from stereo_scene import CAMERA, pose, true_inverse, view

from pliant.algorithms.arrays import F32, F64, BoolArray
from pliant.algorithms.stereo.extension import (
    _likeness,  # pyright: ignore[reportPrivateUsage]
    _mismatch,  # pyright: ignore[reportPrivateUsage]
    _weigh,  # pyright: ignore[reportPrivateUsage]
    extended,
    reduced,
)
from pliant.algorithms.stereo.views import NOT_SHOWN, DenseDepth, StereoView, motion

STEPS = (-3, -2, 2, 3)
SHAPE = (CAMERA.height, CAMERA.width)


def sources() -> list[StereoView]:
    return [view(step) for step in STEPS]


def near_outlines(w: F64, reach_px: int) -> BoolArray:
    """Within so many pixels of a depth discontinuity."""
    high, low = (
        change(w.astype(np.float32), np.ones((3, 3))) for change in (cv2.dilate, cv2.erode)
    )
    jump = (high - low > 0.1 * high).astype(np.uint8)
    return np.asarray(cv2.dilate(jump, np.ones((2 * reach_px + 1,) * 2))) > 0


def agreed_on(w: F64 | F32, support: float = 6.0) -> DenseDepth:
    return DenseDepth(w.astype(np.float32), np.full(w.shape, support, np.float32))


def holed(w: F64, hole: BoolArray) -> F32:
    return np.where(hole, 0.0, w).astype(np.float32)


def test_a_spread_foreground_is_put_back() -> None:
    true = true_inverse(0)
    spread = np.asarray(cv2.dilate(true.astype(np.float32), np.ones((7, 7))), np.float32)
    hole = near_outlines(true, 4)
    found = extended(holed(true, hole), agreed_on(spread), view(0), sources())
    before, after = (np.abs(each[hole] / true[hole] - 1.0) > 0.05 for each in (spread, found))
    assert before.mean() > 0.2
    assert after.mean() < 0.5 * before.mean()
    assert not found[~hole].any()


def test_a_slanted_plane_continues_with_its_slope() -> None:
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    plane = 0.25 + 4e-4 * (u - 40.0) + 3e-4 * (v - 30.0)
    hole = (np.abs(u - 60) < 5) & (np.abs(v - 40) < 5)
    even = replace(view(0), grey=np.full(SHAPE, 90, np.uint8))
    away = replace(even, T_world_camera=pose(0) @ np.diag([-1.0, 1.0, -1.0, 1.0]))
    nothing = agreed_on(np.zeros(SHAPE))
    found = extended(holed(plane, hole), nothing, even, [away])  # no source shows it
    np.testing.assert_allclose(found[hole], plane[hole], rtol=1e-4)


def test_a_hole_that_sources_show_stays_without_agreement() -> None:
    true = true_inverse(0)
    hole = near_outlines(true, 2)
    few = agreed_on(true, support=1.0)
    found = extended(holed(true, hole), few, view(0), [view(0), view(0)])
    assert not found.any()


def test_without_sources_what_was_agreed_on_remains() -> None:
    true = true_inverse(0)
    hole = near_outlines(true, 4)
    covered = replace(view(0), grey=np.where(true > np.median(true), view(0).grey, NOT_SHOWN))
    found = extended(holed(true, hole), agreed_on(true), covered, [])
    shown = covered.grey != NOT_SHOWN
    np.testing.assert_array_equal(found, np.where(hole & shown, true, 0.0).astype(np.float32))


def test_what_is_not_shown_has_no_depth() -> None:
    true = true_inverse(0)
    hole = near_outlines(true, 4)
    covered = replace(view(0), grey=np.where(hole, NOT_SHOWN, view(0).grey).astype(np.uint8))
    assert not extended(holed(true, hole), agreed_on(true), covered, sources()).any()


@pytest.mark.parametrize(("u", "v"), [(40, 30), (70, 50), (25, 60)])
def test_the_mismatch_is_that_of_plain_numpy(u: int, v: int) -> None:
    reference, others = view(0), sources()
    poses = np.stack([other.T_world_camera for other in others])
    moved = motion(CAMERA, reference.T_world_camera, poses)
    w, slopes = float(true_inverse(0)[v, u]) * 1.02, (2e-4, -1e-4)
    y, x = np.mgrid[v - 2 : v + 3, u - 2 : u + 3]
    grey = reference.grey.astype(np.float64)
    weights = np.rint(1024 * np.exp(-np.abs(grey[y, x] - grey[v, u]) / 6.0))
    costs: list[float] = []
    for A, b, other in zip(moved.homographies, moved.translations, others, strict=True):
        depth = w + slopes[0] * (x - u) + slopes[1] * (y - v)
        p = np.stack([x, y, np.ones_like(x)], axis=-1) @ A.T + depth[..., None] * b
        at = (p[..., :2] / p[..., 2:]).astype(np.float32)
        image = other.grey.astype(np.float32)
        there = cv2.remap(image, at[..., 0], at[..., 1], cv2.INTER_LINEAR).astype(np.float64)
        r, s = (each - np.average(each, weights=weights) for each in (grey[y, x], there))
        joint, rr, ss = (np.average(each, weights=weights) for each in (r * s, r * r, s * s))
        costs.append(1.0 - joint / np.sqrt((rr + 4.0) * (ss + 4.0)))
    window, each = np.empty((5, 5)), np.empty(len(others))
    _weigh(reference.grey, u, v, _likeness(), window, True)
    np.testing.assert_array_equal(window, weights)
    images = np.stack([other.grey for other in others])
    plane = (w, *slopes)
    found = _mismatch(
        reference.grey, images, moved.homographies, moved.translations, u, v, plane, window, each
    )
    assert found == pytest.approx(np.mean(sorted(costs)[:2]), abs=0.03)


def test_a_reduced_pixel_is_the_mean_of_inverse_depths_all_known() -> None:
    depths = np.array([[1.0, 2.0, 4.0, 4.0, 9.0], [2.0, 1.0, 0.0, 4.0, 9.0]], np.float32)
    np.testing.assert_allclose(reduced(depths, 2), [[0.75, 0.0]])

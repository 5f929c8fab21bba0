"""Local maxima against a plain search, and their sub-pixel positions."""

import numpy as np
import pytest

from pliant.algorithms.arrays import F32
from pliant.algorithms.tracking.curvature import CURVATURE_BORDER, curvature
from pliant.algorithms.tracking.maxima import curvature_and_maxima, find_maxima


def plain_maxima(kappa: F32, threshold: float) -> set[tuple[int, int]]:
    """Every pixel that exceeds its eight neighbours, as (row, column)."""
    b = CURVATURE_BORDER
    found: set[tuple[int, int]] = set()
    for y in range(b, kappa.shape[0] - b):
        for x in range(b, kappa.shape[1] - b):
            block = kappa[y - 1 : y + 2, x - 1 : x + 2]
            if (
                kappa[y, x] > threshold
                and kappa[y, x] == block.max()
                and (block == kappa[y, x]).sum() == 1
            ):
                found.add((y, x))
    return found


@pytest.mark.parametrize("shape", [(40, 61), (20, 16), (9, 9), (8, 30)])
def test_finds_what_a_plain_search_finds(shape: tuple[int, int]) -> None:
    kappa = np.random.default_rng(1).normal(0.0, 10.0, shape).astype(np.float32)
    pixels, maxima = find_maxima(kappa, 1.0)
    expected = plain_maxima(kappa, 1.0) | plain_maxima(-kappa, 1.0)
    assert {(int(p) // shape[1], int(p) % shape[1]) for p in pixels} == expected
    assert np.all(np.diff(pixels) > 0)
    np.testing.assert_array_equal(maxima[:, 2], kappa.ravel()[pixels])


def test_a_plateau_counts_at_most_once() -> None:
    kappa = np.zeros((20, 20), np.float32)
    kappa[10, 9:11] = 5.0
    assert len(find_maxima(kappa, 1.0)[0]) == 1
    assert len(find_maxima(np.full((20, 20), 3.0, np.float32), 1.0)[0]) == 0


def test_parabola_is_placed_exactly() -> None:
    v, u = np.mgrid[0:30, 0:30]
    kappa = (100.0 - 2.0 * (u - 14.3) ** 2 - 3.0 * (v - 11.8) ** 2).astype(np.float32)
    _, maxima = find_maxima(kappa, 1.0)
    np.testing.assert_allclose(maxima[0, :2], [14.3, 11.8], atol=1e-3)


@pytest.mark.parametrize("shape", [(40, 97), (9, 41), (31, 16), (8, 60)])
def test_one_pass_equals_curvature_and_then_maxima(shape: tuple[int, int]) -> None:
    image = np.random.default_rng(2).integers(0, 256, shape, np.uint8)
    fused = curvature_and_maxima(image, 1.0, 0.5)
    smooth, kappa = curvature(image, 1.0)
    apart = (smooth, kappa, *find_maxima(kappa, 0.5))
    for one, other in zip(fused, apart, strict=True):
        np.testing.assert_array_equal(one, other)

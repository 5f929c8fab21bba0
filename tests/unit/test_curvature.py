"""The fused curvature kernel against plain numpy, and hill climbing against a plain search."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pliant.algorithms.arrays import F32, F64
from pliant.algorithms.image.pixels import pixels_of
from pliant.algorithms.tracking.curvature import CURVATURE_BORDER, climb, curvature, gaussian_taps

SIZE = 40
"""Of what is climbed on."""


def plain_curvature(image: F64, sigma_px: float) -> tuple[F64, F64]:
    """Eq. 1 as it stands, on whole images."""
    w0, w1, w2, w3 = (float(w) for w in gaussian_taps(sigma_px))
    taps = np.array([w3, w2, w1, w0, w1, w2, w3])
    padded = np.pad(image.astype(np.float64), 3, mode="edge")
    rows = sum(taps[i] * padded[i : i + image.shape[0]] for i in range(7))
    smooth = sum(taps[i] * rows[:, i : i + image.shape[1]] for i in range(7))

    def stencil(vertical: list[float], horizontal: list[float]) -> F64:
        edged = np.pad(smooth, 1, mode="edge")
        h, w = smooth.shape
        total = np.zeros((h, w))
        for i in range(3):
            for j in range(3):
                total += vertical[i] * horizontal[j] * edged[i : i + h, j : j + w]
        return total

    blur, first, second = [0.25, 0.5, 0.25], [-0.5, 0.0, 0.5], [1.0, -2.0, 1.0]
    fx, fy = stencil(blur, first), stencil(first, blur)
    fxx, fyy, fxy = stencil(blur, second), stencil(second, blur), stencil(first, first)
    kappa = fy**2 * fxx - 2.0 * fx * fy * fxy + fx**2 * fyy
    b = CURVATURE_BORDER
    inner = np.zeros_like(kappa)
    inner[b:-b, b:-b] = kappa[b:-b, b:-b]
    return smooth, inner


@pytest.mark.parametrize("shape", [(40, 60), (33, 47), (9, 9), (64, 9)])
@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_kernel_equals_plain_numpy(shape: tuple[int, int], dtype: type) -> None:
    image = np.random.default_rng(0).integers(0, 256, shape).astype(dtype)
    smooth, kappa = curvature(image, 1.0)
    expected_smooth, expected_kappa = plain_curvature(image, 1.0)
    np.testing.assert_allclose(smooth, expected_smooth, atol=1e-3)
    scale = max(float(np.abs(expected_kappa).max()), 1.0)
    np.testing.assert_allclose(kappa, expected_kappa, atol=1e-5 * scale)


def test_dark_blob_has_its_maximum_at_its_centre() -> None:
    v, u = np.mgrid[0:41, 0:41]
    grey = 200.0 - 150.0 * np.exp(-((u - 20) ** 2 + (v - 17) ** 2) / 18.0)
    _, kappa = curvature(grey.astype(np.float32), 1.0)
    # At the very centre the gradient is zero, so the maxima form a ring around it.
    ring = np.argwhere(kappa > 0.5 * kappa.max())
    np.testing.assert_allclose(ring.mean(axis=0), [17.0, 20.0], atol=0.01)


@given(st.floats(0.5, 1.3))
def test_taps_sum_to_one(sigma_px: float) -> None:
    w0, w1, w2, w3 = (float(w) for w in gaussian_taps(sigma_px))
    assert w0 + 2.0 * (w1 + w2 + w3) == pytest.approx(1.0, abs=1e-6)


def test_offset_changes_nothing_and_gain_cubes() -> None:
    image = np.random.default_rng(2).random((30, 30)).astype(np.float32) * 50.0
    _, kappa = curvature(image, 1.0)
    _, shifted = curvature(image + np.float32(100.0), 1.0)
    _, scaled = curvature(image * np.float32(2.0), 1.0)
    limit = float(np.abs(kappa).max())
    np.testing.assert_allclose(shifted, kappa, atol=1e-3 * limit)
    np.testing.assert_allclose(scaled, 8.0 * kappa, atol=1e-4 * limit)


def plain_climb(kappa: F32, at: tuple[float, float], sign: float, weight: float) -> int:
    """Eq. 5 with sigma = 3 px: to the best of the nine pixels until that is the one in between."""
    x, y = (int(np.floor(position + 0.5)) for position in at)
    while True:
        if not CURVATURE_BORDER <= min(x, y) <= max(x, y) < SIZE - CURVATURE_BORDER:
            return -1
        v, u = np.mgrid[y - 1 : y + 2, x - 1 : x + 2].astype(np.float64)
        squares = (u - at[0]) ** 2 + (v - at[1]) ** 2
        height = sign * kappa[y - 1 : y + 2, x - 1 : x + 2] + weight * 9.0 / (squares + 9.0)
        if height.max() <= height[1, 1]:
            return y * SIZE + x
        row, column = np.unravel_index(np.argmax(height), (3, 3))
        x, y = x + int(column) - 1, y + int(row) - 1


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("weight", [0.0, 5.0, 50.0])
def test_climbs_as_a_plain_search_does(sign: float, weight: float) -> None:
    rng = np.random.default_rng(4)
    noise = rng.normal(0.0, 10.0, (SIZE + 4, SIZE + 4))
    # Smooth enough for climbs of several steps.
    kappa = sum(noise[i : i + SIZE, j : j + SIZE] for i in range(5) for j in range(5))
    kappa = np.asarray(kappa, np.float32)
    starts = rng.uniform(2.0, SIZE - 3.0, (200, 2)).astype(np.float32)
    for u, v in starts:
        limits = np.float32(sign), np.float32(weight), np.float32(3.0)
        pixel = climb(pixels_of(kappa), u, v, *limits)
        assert pixel == plain_climb(kappa, (float(u), float(v)), sign, weight)


def test_a_start_outside_ends_there() -> None:
    kappa = np.zeros((SIZE, SIZE), np.float32)
    start = np.float32(1e6)
    one = np.float32(1.0)
    assert climb(pixels_of(kappa), start, start, one, one, one) == -1

"""The dominant flow: matching, and the robust affine fit against known motions."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pliant.algorithms.arrays import F64
from pliant.algorithms.tracking.dominant_flow import (
    BriefExtractor,
    fit_affine,
    geman_mcclure_weights,
    match_features,
)


def geman_mcclure(squares: F64, sigma: float) -> F64:
    """Eq. 3."""
    return squares / (squares + sigma**2)


def test_weights_are_the_derivative_of_the_kernel() -> None:
    """d rho / d(x^2) = weight / sigma^2, by finite differences."""
    squares, h, sigma = np.linspace(0.5, 80.0, 20), 1e-4, 3.0
    numeric = (geman_mcclure(squares + h, sigma) - geman_mcclure(squares - h, sigma)) / (2.0 * h)
    np.testing.assert_allclose(numeric * sigma**2, geman_mcclure_weights(squares, sigma), rtol=1e-6)


@settings(max_examples=25)
@given(
    st.floats(-0.1, 0.1),
    st.floats(0.9, 1.1),
    st.floats(-60.0, 60.0),
    st.floats(-60.0, 60.0),
    st.integers(0, 1000),
)
def test_fit_recovers_an_affine_through_outliers(
    angle: float, zoom: float, b_u: float, b_v: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    A = zoom * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    centre = np.array([320.0, 240.0])
    b = centre + np.array([b_u, b_v]) - A @ centre
    x = rng.uniform([0, 0], [640, 480], (200, 2))
    y = x @ A.T + b + rng.normal(0.0, 1.0, x.shape)
    y[:60] = rng.uniform([0, 0], [640, 480], (60, 2))
    fit = fit_affine(x.astype(np.float32), y.astype(np.float32), sigma_px=6.0)
    grid = np.array([[0.0, 0.0], [640.0, 0.0], [0.0, 480.0], [640.0, 480.0]])
    error = grid @ fit[:, :2].T + fit[:, 2] - (grid @ A.T + b)
    assert np.abs(error).max() < 2.0


def test_too_few_pairs_give_the_identity() -> None:
    few = np.zeros((5, 2), np.float32)
    np.testing.assert_array_equal(fit_affine(few, few, sigma_px=6.0), np.eye(2, 3))


@pytest.mark.parametrize(
    ("size", "shift"), [((640, 480), (12, -18)), ((640, 480), (36, 24)), ((320, 96), (18, 6))]
)
def test_features_of_a_shifted_image_match(size: tuple[int, int], shift: tuple[int, int]) -> None:
    width, height = size
    rng = np.random.default_rng(5)
    coarse = rng.integers(0, 256, (90, 120)).astype(np.uint8)
    world = np.kron(coarse, np.ones((8, 8), np.uint8))
    part = world[100 : 100 + height, 100 : 100 + width]
    rows, columns = slice(100 - shift[1], None), slice(100 - shift[0], None)
    first = np.ascontiguousarray(part)
    second = np.ascontiguousarray(world[rows, columns][:height, :width])
    brief = BriefExtractor(np.random.default_rng(0), 300)
    sources, targets = match_features(
        brief.extract(first), brief.extract(second), max_distance_bits=64, max_shift_px=180.0
    )
    assert len(sources) > 50
    fit = fit_affine(sources, targets, sigma_px=6.0)
    middle = 0.5 * np.array(size)
    moved = middle @ fit[:, :2].T + fit[:, 2] - middle
    np.testing.assert_allclose(moved, shift, atol=1.5)


def test_small_and_empty_images_have_no_features() -> None:
    brief = BriefExtractor(np.random.default_rng(0), 300)
    assert len(brief.extract(np.zeros((480, 640), np.uint8)).points_px) == 0
    assert len(brief.extract(np.zeros((20, 30), np.uint8)).points_px) == 0

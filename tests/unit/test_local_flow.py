"""The grid of local flow on known motion, and the climb on a known hill."""

import numpy as np
import pytest

from pliant.algorithms.arrays import F32
from pliant.algorithms.image.pixels import halve, pixels_of, shrink
from pliant.algorithms.tracking.curvature import climb, curvature
from pliant.algorithms.tracking.local_flow import CELL_PX, Flow, flow_at, grid_shape, local_flow
from pliant.algorithms.tracking.maxima import find_maxima

HEIGHT, WIDTH = 240, 320
IDENTITY = np.eye(2, 3, dtype=np.float32).ravel()


def scene(shift_u: F32, shift_v: F32) -> F32:
    """A texture at all scales, moved by fields of displacement."""
    rng = np.random.default_rng(1)
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH].astype(np.float64)
    u, v = u - shift_u, v - shift_v
    grey = np.full((HEIGHT, WIDTH), 120.0)
    for wavelength in np.geomspace(8.0, 150.0, 50):
        angle, phase = rng.uniform(0.0, 2.0 * np.pi, 2)
        k = 2.0 * np.pi / wavelength
        grey += 1.2 * wavelength**0.5 * np.sin(k * (u * np.cos(angle) + v * np.sin(angle)) + phase)
    return grey.astype(np.float32)


def levels(image: F32) -> list[F32]:
    half = halve(image)
    quarter = halve(half)
    return [half, quarter, halve(quarter)]


@pytest.mark.parametrize("shift", [(0.0, 0.0), (9.0, -6.0), (-14.0, 11.0)])
def test_grid_finds_two_motions(shift: tuple[float, float]) -> None:
    """The right half moves by 4 px more than the left half does."""
    extra = np.where(np.arange(WIDTH) < WIDTH // 2, 0.0, 4.0)[None, :] * np.ones((HEIGHT, 1))
    before = scene(np.zeros((HEIGHT, WIDTH)), np.zeros((HEIGHT, WIDTH)))
    after = scene(shift[0] + extra, shift[1] + 0.0 * extra)
    _, kappa = curvature(before, 1.0)
    _, maxima = find_maxima(kappa, 0.5)
    hint = np.zeros((*grid_shape(WIDTH, HEIGHT), 2), np.float32)
    flow = local_flow(levels(before), levels(after), maxima, IDENTITY, hint).grid
    columns = (np.arange(flow.shape[1]) + 0.5) * CELL_PX
    inner = flow[2:-2]
    for sign, expected in ((columns < WIDTH / 2 - 40, 0.0), (columns > WIDTH / 2 + 40, 4.0)):
        safe = sign & (columns > 50) & (columns < WIDTH - 50)
        error = inner[:, safe] - np.array([shift[0] + expected, shift[1]])
        assert np.median(np.linalg.norm(error, axis=-1)) < 0.25


def test_flow_is_interpolated_on_top_of_the_dominant_flow() -> None:
    grid = np.zeros((3, 4, 2), np.float32)
    grid[:, 1, 0], grid[:, 2, 0] = 1.0, 3.0
    affine = np.array([1.0, 0.0, 5.0, 0.0, 1.0, -2.0], np.float32)
    centre = np.float32(2.0 * CELL_PX)
    found = flow_at(Flow(grid, affine), centre, np.float32(30.0))
    np.testing.assert_allclose(found, [7.0, -2.0], atol=1e-5)
    corner = flow_at(Flow(grid, affine), np.float32(0.0), np.float32(0.0))
    np.testing.assert_allclose(corner, [5.0, -2.0], atol=1e-5)


def test_climb_reaches_the_summit_and_the_pull_holds_it_back() -> None:
    v, u = np.mgrid[0:40, 0:50]
    hill = (100.0 - (u - 30.0) ** 2 - (v - 20.0) ** 2).astype(np.float32)
    one = np.float32(1.0)
    args = (np.float32(24.0), np.float32(17.0))
    free = climb(pixels_of(hill), *args, one, np.float32(0.0), np.float32(3.0))
    assert (free % 50, free // 50) == (30, 20)
    valley = climb(pixels_of(-hill), *args, -one, np.float32(0.0), np.float32(3.0))
    assert valley == free
    held = climb(pixels_of(hill), *args, one, np.float32(1e5), np.float32(3.0))
    assert (held % 50, held // 50) == (24, 17)
    assert climb(pixels_of(hill), np.float32(1.0), np.float32(20.0), one, one, one) == -1


def test_smaller_images_are_means_of_blocks() -> None:
    image = np.random.default_rng(0).integers(0, 256, (49, 63), np.uint8)
    blocks = image[:48, :62].reshape(24, 2, 31, 2).mean(axis=(1, 3))
    np.testing.assert_allclose(halve(image), blocks, atol=1e-4)
    sixths = image[:48, :60].reshape(8, 6, 10, 6).mean(axis=(1, 3))
    np.testing.assert_allclose(shrink(image, 6), sixths, atol=1e-3)

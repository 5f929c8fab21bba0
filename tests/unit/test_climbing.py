"""Hill climbing against a plain search, step by step."""

import numpy as np
import pytest

from pliant.algorithms.arrays import F32
from pliant.algorithms.image.pixels import pixels_of
from pliant.algorithms.tracking.climbing import climb
from pliant.algorithms.tracking.curvature import CURVATURE_BORDER

SIZE = 40


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

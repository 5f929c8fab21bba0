"""Of near-duplicate views the blurred ones go, on pixels known exactly."""

import numpy as np

from pliant.algorithms.image.duplicate_views import sharp_views

WIDTH = 640
POINTS = np.random.default_rng(0).uniform((0.0, 0.0), (640.0, 480.0), (200, 2))


def kept(shifts: list[float], sharpness: list[float]) -> list[bool]:
    pixels = POINTS + np.array([(shift, 0.0) for shift in shifts])[:, None]
    return sharp_views(pixels, np.array(sharpness), WIDTH).tolist()


def test_the_blurred_one_of_two_views_of_the_same_goes() -> None:
    assert kept([0.0, 10.0], [0.5, 0.6]) == [False, True]
    assert kept([0.0, 10.0], [0.6, 0.5]) == [True, False]


def test_views_that_are_as_sharp_or_show_something_else_stay() -> None:
    assert kept([0.0, 10.0], [0.5, 0.54]) == [True, True]
    assert kept([0.0, 0.06 * WIDTH], [0.5, 0.6]) == [True, True]
    half_seen = np.stack([POINTS, POINTS])
    half_seen[1, :120] = np.nan  # they share less than half of what the first sees
    assert sharp_views(half_seen, np.array([0.5, 0.9]), WIDTH).all()
    assert sharp_views(np.full((2, 5, 2), np.nan), np.array([0.5, 0.9]), WIDTH).all()
    assert sharp_views(np.zeros((0, 5, 2)), np.zeros(0), WIDTH).shape == (0,)


def test_no_view_goes_for_one_that_goes_itself() -> None:
    # Each is a near-duplicate of the next alone: the second goes for the third, the first stays.
    assert kept([0.0, 30.0, 60.0], [0.5, 0.6, 0.7]) == [True, False, True]
    assert kept([0.0, 30.0, 60.0], [0.6, 0.5, 0.7]) == [True, False, True]

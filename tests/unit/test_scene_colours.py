"""Colour images of the built-in scenes: what is tracked in them is the grey image, exactly."""

import cv2
import numpy as np
import pytest

from pliant.datasets.builtin import parse_builtin
from pliant.datasets.builtin_rigid import SequenceOptions, rigid_plan
from pliant.rendering.colours import LEAST, MOST, colour_image, shares
from pliant.rendering.scenes import SCENES


def test_every_grey_value_in_every_colour_is_the_same_grey_again() -> None:
    grey, share = np.arange(256, dtype=np.uint8), np.linspace(LEAST, MOST, 37)
    greys, reds, blues = np.meshgrid(grey, share, share, indexing="ij")
    flat = (256, -1)
    image = colour_image(greys.reshape(flat), reds.reshape(flat), blues.reshape(flat))
    np.testing.assert_array_equal(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), greys.reshape(flat))


def test_a_colour_is_more_or_less_red_and_blue_than_grey() -> None:
    grey = np.full((1, 4), 100, np.uint8)
    red, blue = np.array([[0.0, 0.5, -0.5, 0.0]]), np.array([[0.0, 0.0, 0.0, 0.5]])
    image = colour_image(grey, red, blue)[0].astype(int)
    assert np.ptp(image[0]) <= 1
    assert image[1, 0] > 130 > 70 > image[2, 0]
    assert image[3, 2] > 130
    ends = colour_image(np.array([[0, 255]], np.uint8), np.full((1, 2), 0.5), np.full((1, 2), -0.5))
    assert ends[0].tolist() == [[0, 0, 0], [255, 255, 255]]


def test_a_tint_does_not_change_brightness() -> None:
    assert shares((1.0, 1.0, 1.0)) == pytest.approx((0.0, 0.0))
    assert shares((0.3, 0.2, 0.1)) == pytest.approx(shares((1.2, 0.8, 0.4)))
    for make in SCENES.values():
        for solid in make().scene.solids:
            for tint in (solid.material.tint, *solid.material.hues):
                assert all(LEAST <= share <= MOST for share in shares(tint))


@pytest.mark.parametrize(
    ("source", "colour"),
    [("room", True), ("tabletop", True), ("tiny", False), ("room?colour=0", False),
     ("tiny?colour=1", True)],
)  # fmt: skip
def test_scenes_are_in_colour_by_default_or_option(source: str, colour: bool) -> None:
    name, options = parse_builtin(source)
    assert isinstance(options, SequenceOptions)
    assert rigid_plan(name, options).camera.colour == colour

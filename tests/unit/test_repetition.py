"""An image that shows the same again a step aside is told from one that does not."""

import cv2
import numpy as np
import pytest
from mapping_scene import CAMERA

from pliant.algorithms.arrays import U8
from pliant.algorithms.places.features import describe
from pliant.algorithms.places.repetition import repeated_share

_GATE_PX = 4.0


def tiles(count: int, other: float) -> U8:
    """A wall of so many by so many tiles that look the same.   other: share of them that do not."""
    rng = np.random.default_rng(0)
    side = CAMERA.height // count

    def tile() -> np.ndarray:
        return cv2.GaussianBlur(rng.integers(0, 255, (side, side)).astype(np.float32), (0, 0), 4.0)

    same = tile()
    lines = [
        np.hstack([tile() if rng.random() < other else same for _ in range(CAMERA.width // side)])
        for _ in range(count)
    ]
    grey = cv2.normalize(np.vstack(lines), None, 0, 255, cv2.NORM_MINMAX)  # pyright: ignore
    return (grey + rng.normal(0.0, 2.0, grey.shape)).clip(0, 255).astype(np.uint8)


def share_of(grey: U8) -> float:
    """Of its corners, as of a wall 2 m away."""
    seen = describe(grey)
    rays = np.column_stack([CAMERA.normalise(seen.points_px.astype(np.float64)), np.ones(700)])
    corners = np.arange(0, 700, 3)
    return repeated_share(
        seen, corners, 2.0 * rays[corners], CAMERA, gate_px=_GATE_PX, least_step=0.2
    )


@pytest.mark.parametrize("count", [3, 6])
def test_tiles_show_the_same_again(count: int) -> None:
    assert share_of(tiles(count, 0.0)) > 0.8


def test_tiles_of_which_most_are_others_do_not() -> None:
    assert share_of(tiles(6, 0.8)) < 0.3
    assert share_of(tiles(6, 1.0)) < 0.1


def test_corners_that_lie_at_one_spot_are_no_step() -> None:
    seen = describe(tiles(6, 0.0))
    xyz = np.tile([0.0, 0.0, 2.0], (700, 1))
    assert repeated_share(seen, np.arange(700), xyz, CAMERA, gate_px=4.0, least_step=0.2) == 0.0

"""Surfels beside an instrument, which their patches of the coarse scales contain."""

import cv2
import numpy as np

from pliant.algorithms.arrays import F64
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.surfels.parameters import SurfelParameters
from pliant.algorithms.surfels.surfel_frame import SurfelState
from pliant.algorithms.surfels.surfel_tracker import SurfelTracker

WIDTH, HEIGHT = 320, 240
TOP, BOTTOM, STEP_PX = 90, 150, 8
"""Rows of the instrument, and how far it moves in each frame."""
FRAMES = 10
NEAR_PX = 0.5


def texture(seed: int, blur_px: float) -> F64:
    """Smooth noise with a standard deviation of one."""
    noise = np.random.default_rng(seed).normal(0.0, 1.0, (HEIGHT, WIDTH))
    smooth = np.asarray(cv2.GaussianBlur(noise, (0, 0), blur_px), np.float64)
    return smooth / smooth.std()


def test_an_instrument_does_not_move_the_still_surface_beside_it() -> None:
    still, instrument = 120.0 + 6.0 * texture(0, 2.0), 120.0 + 60.0 * texture(1, 4.0)
    random = np.random.default_rng(2)
    camera = PinholeCamera(width=WIDTH, height=HEIGHT, fx=300.0, fy=300.0, cx=159.5, cy=119.5)
    p = SurfelParameters(depth_from="flat", max_surfels=200, min_strength=0.0)
    tracker = SurfelTracker(p)
    born = np.zeros((0, 2))
    beside = np.zeros(0, np.bool_)
    alive, off = [], []
    for number in range(FRAMES + 1):
        image = still.copy()
        left = 5 + STEP_PX * number
        image[TOP:BOTTOM, left : left + 120] = instrument[TOP:BOTTOM, 60:180]
        image += random.normal(0.0, 2.0, image.shape)
        grey = np.clip(image, 0, 255).astype(np.uint8)
        if number == 0:
            born = tracker.start(grey, np.ones((HEIGHT, WIDTH)), camera).points_px
            half = p.patch_px // 2 + 1
            beside = (born[:, 1] < TOP - half) | (born[:, 1] >= BOTTOM + half)
            assert beside.sum() > 80
            continue
        frame = tracker.track(grey, 1.0 / 30.0)
        distance = np.linalg.norm(frame.points_px[: len(born)] - born, axis=1)
        alive.append((frame.state[: len(born)] == SurfelState.TRACKED)[beside].mean())
        off.append((distance[beside] > NEAR_PX).mean())
    # With the pose of the coarse scales alone 83 % live in the worst frame, and 13 % are off.
    assert min(alive) > 0.9
    assert np.mean(off) < 0.08

"""A turn of a camera whose lens is unknown is told from motion."""

import numpy as np
import pytest

from pliant.algorithms.arrays import F64
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import so3_exp
from pliant.algorithms.slam.calibration.self_calibration import SelfCalibration, widened
from pliant.algorithms.slam.calibration.turn_of_lens import turn_of_lens
from pliant.algorithms.slam.parameters import MappingParameters
from pliant.algorithms.slam.start.first_map import BufferedFrame
from pliant.algorithms.slam.start.focal_hypotheses import find_start_of

GUESSED = PinholeCamera(fx=554.0, fy=554.0, cx=319.5, cy=239.5, width=640, height=480)
INTERVAL_NS = 33_000_000


def seen(points: F64, focal: float, k1: float) -> F64:
    """(N, 2) pixels of points (N, 3) in camera coordinates; NaN behind it."""
    n = points[:, :2] / np.where(points[:, 2:] > 0.1, points[:, 2:], np.nan)
    bent = n * (1.0 + k1 * (n**2).sum(axis=1, keepdims=True))
    bent[(n**2).sum(axis=1) > 1.5] = np.nan
    return bent * focal + (GUESSED.cx, GUESSED.cy)


def pair(focal: float, k1: float, R: F64, t: F64) -> tuple[F64, F64]:
    """Points of two views on the guessed camera's plane z = 1, with 0.3 px of noise."""
    random = np.random.default_rng(0)
    points = random.uniform((-12, -9, 2), (12, 9, 12), (6000, 3))
    px = np.array([seen(points, focal, k1), seen((points - t) @ R, focal, k1)])
    inside = ((px > 0.0) & (px < (640.0, 480.0))).all(axis=(0, 2))
    a, b = GUESSED.normalise(px[:, inside] + random.normal(0.0, 0.3, (2, inside.sum(), 2)))
    return a, b


def unexplained_px(a: F64, b: F64) -> float:
    scale = 1.0 / GUESSED.fx
    left = turn_of_lens(a, b, scale=scale, focal_sigma=0.4, lens_sigma=0.1)
    return float(np.median(left)) * GUESSED.fx


@pytest.mark.parametrize("focal", [400.0, 480.0, 900.0])
@pytest.mark.parametrize("k1", [0.0, -0.2])
@pytest.mark.parametrize("axis", [(0.0, 0.3, 0.0), (0.25, 0.0, 0.0), (0.1, 0.1, 0.4)])
def test_a_rotation_is_explained_for_every_lens(
    focal: float, k1: float, axis: tuple[float, float, float]
) -> None:
    a, b = pair(focal, k1, so3_exp(np.array(axis)), np.zeros(3))
    assert unexplained_px(a, b) < 1.2


@pytest.mark.parametrize("t", [(0.0, 0.0, 0.5), (0.6, 0.0, 0.0), (0.2, -0.1, 0.3)])
@pytest.mark.parametrize("k1", [0.0, -0.2])
def test_no_lens_explains_motion(t: tuple[float, float, float], k1: float) -> None:
    a, b = pair(400.0, k1, so3_exp(np.array([0.0, 0.1, 0.0])), np.array(t))
    assert unexplained_px(a, b) > 2.0


def test_pairs_of_views_are_published_together() -> None:
    a, b = pair(480.0, -0.1, so3_exp(np.array([0.0, 0.2, 0.0])), np.zeros(3))
    alone = turn_of_lens(a, b, scale=2e-3, focal_sigma=0.4, lens_sigma=0.1)
    both = turn_of_lens(
        np.array([a, b]), np.array([b, a]), scale=2e-3, focal_sigma=0.4, lens_sigma=0.1
    )
    np.testing.assert_allclose(both[0], alone, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("rate", [0.006, 0.02])
def test_a_turn_starts_no_map_though_the_lens_is_wide_and_unknown(rate: float) -> None:
    """One focal length after the other, without distortion, sees parallax in it."""
    random = np.random.default_rng(0)
    points = random.normal(size=(20_000, 3))
    born = random.integers(-60, 120, len(points))
    waiting: list[BufferedFrame] = []
    for frame in range(0, 120, 4):
        R = so3_exp(np.array([0.03 * np.sin(0.2 * frame), rate * frame, 0.0]))
        px = seen(points @ R, 350.0, -0.2)
        inside = ((px > 0.0) & (px < (640.0, 480.0))).all(axis=1)
        ids = np.flatnonzero(inside & (born <= frame) & (frame < born + 60))
        noisy = px[ids] + random.normal(0.0, 0.3, (len(ids), 2))
        waiting.append(
            BufferedFrame(
                frame=frame,
                stamp_ns=frame * INTERVAL_NS,
                ids=ids,
                points_px=noisy.astype(np.float32),
                kappas=np.ones(len(ids), np.float32),
            )
        )
    guess = widened(MappingParameters(), 0.4)
    known = SelfCalibration.of(GUESSED, guess.calibration)
    for count in (10, 20, 30):
        found = find_start_of(waiting[:count], known, guess)
        assert isinstance(found, str)
        assert "pure rotation" in found

"""Surfels that move like one rigid thing, as before a camera that moves."""

import numpy as np
import pytest

from pliant.algorithms.arrays import F64
from pliant.algorithms.geometry import so3_exp
from pliant.algorithms.surfels.surfel_frame import SurfelFrame, SurfelState
from pliant.results.moving_together import MovingTogether

COUNT = 200


def surfels(positions: F64, *, segment: int = 0) -> SurfelFrame:
    count = len(positions)
    none = np.zeros(count, np.float32)
    return SurfelFrame(
        frame=0, segment=segment, lost=False, T_world_camera=np.eye(4), ids=np.arange(count),
        positions=positions, tangents=np.zeros((count, 3, 2)), deformations=np.zeros((count, 3)),
        points_px=np.zeros((count, 2), np.float32), zncc=none, visible=none,
        sigma=none, gains=none, biases=none,
        state=np.full(count, SurfelState.TRACKED, np.uint8), age=np.zeros(count, np.int32),
        born=np.zeros(count, np.int32),
    )  # fmt: skip


def surface(wave_m: float, share: float) -> F64:
    """(N, 3) a surface half a metre away, that waves; seen from beside by a share of a walk."""
    x, y = np.random.default_rng(1).uniform(-0.2, 0.2, (2, COUNT))
    z = 0.5 + 0.03 * np.sin(20.0 * x) + share * wave_m * np.sin(15.0 * y)
    still = np.stack([x, y, z], axis=1)
    return still @ so3_exp(share * np.array([0.05, 0.1, 0.0])).T + share * np.array([0.06, 0.02, 0])


@pytest.mark.parametrize(
    ("wave_m", "walk", "share"),
    [(0.002, 1.0, 1.0), (0.05, 1.0, 0.0), (0.05, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 1.0, 1.0)],
)
def test_a_rigid_motion_with_a_little_of_their_own_is_one(
    wave_m: float, walk: float, share: float
) -> None:
    together = MovingTogether()
    for frame in range(10):
        moved = surface(wave_m, frame / 9.0)
        still = surface(0.0, 0.0) + (surface(wave_m, frame / 9.0) - surface(0.0, frame / 9.0))
        together.take(frame, surfels(moved if walk else still))
    seen = len(together.frames) / 10
    assert (seen > 0.5) == (share > 0.5)
    assert share or not seen


def test_static_points_behind_moving_ones_show_that_the_camera_is_static() -> None:
    together, still = MovingTogether(), surface(0.0, 0.0) + np.array([0.0, 0.0, 0.2])
    for frame in range(10):
        positions = np.concatenate([surface(0.0, frame / 9.0), still])
        together.take(frame, surfels(positions))
    assert not together.frames


def test_another_segment_is_compared_with_its_own_beginning() -> None:
    together = MovingTogether()
    together.take(0, surfels(surface(0.0, 0.0)))
    together.take(1, surfels(surface(0.0, 1.0), segment=1))
    together.take(2, surfels(surface(0.0, 1.0)[:10], segment=1))
    assert not together.frames

"""The map of a camera before which something stands, or passes: as good as of what is left."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest
from benchmarks.in_process import process

import pliant
from pliant.algorithms.arrays import F64, U8, BoolArray
from pliant.algorithms.image.masks import clearance_of, packed
from pliant.config import load_config
from pliant.datasets import Dataset, SourceFrame, decode, open_source
from pliant.evaluation.run_evaluation import evaluate_trajectory
from pliant.formats.trajectory_files import read_trajectory
from pliant.map_history import MapHistory

pytestmark = pytest.mark.slow
WIDTH, HEIGHT = 320, 240


def bonnet(frame: int) -> BoolArray:
    """All but the lower third."""
    used = np.ones((HEIGHT, WIDTH), np.bool_)
    used[2 * HEIGHT // 3 :] = False
    return used


def passer_by(frame: int) -> BoolArray:
    """All but an ellipse of a third of the image, which crosses it."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    return ((u - 40.0 - 6.0 * frame) / 70.0) ** 2 + ((v - 120.0) / 110.0) ** 2 > 1.0


class Covered:
    """The built-in tiny room, a part of it behind a foreign pattern."""

    is_live = False

    def __init__(self, part: Callable[[int], BoolArray], seed: int, *, masked: bool) -> None:
        self.room: Dataset = open_source("built-in:tiny")
        self.name, self.frame_count = self.room.name, self.room.frame_count
        self.calibration, self.ground_truth_path = (
            self.room.calibration,
            self.room.ground_truth_path,
        )
        self._part = part
        self._masked = masked
        values = np.random.default_rng(seed).normal(0.0, 1.0, (HEIGHT, WIDTH)).astype(np.float32)
        blurred = sum(s * cv2.GaussianBlur(values, (0, 0), s) for s in (1.5, 4.0))
        self._pattern: U8 = np.clip(120 + 60 * blurred / np.std(blurred), 0, 255).astype(np.uint8)

    def __iter__(self) -> Iterator[SourceFrame]:
        for frame in self.room:
            used = self._part(frame.index)
            data = np.where(used, decode(frame), self._pattern).tobytes()
            yield replace(
                frame, encoding="mono8", data=data, width=WIDTH, height=HEIGHT,
                mask=packed(used) if self._masked else b"",
            )  # fmt: skip


@cache
def mapped(
    part: Callable[[int], BoolArray] | None = None, seed: int = 0, *, masked: bool = True
) -> tuple[F64, float, MapHistory]:
    """Poses (N, 7), ATE in m, and the map: of the bare room, or of one that is covered."""
    source = Covered(part, seed, masked=masked) if part else open_source("built-in:tiny")
    history = MapHistory()
    count = sum(1 for _ in process(source, load_config(), history))
    assert source.ground_truth_path is not None
    truth = read_trajectory(source.ground_truth_path)
    trajectory = history.trajectory(history.final())
    ate = evaluate_trajectory(trajectory, truth, frames=count).ate_m
    assert ate is not None
    return trajectory.T_world_camera, ate.rmse, history


@pytest.mark.parametrize("part", [bonnet, passer_by])
def test_what_is_covered_makes_no_difference_to_the_map(part: Callable[[int], BoolArray]) -> None:
    clean, first, second = mapped(), mapped(part, 1), mapped(part, 2)
    np.testing.assert_array_equal(first[0], second[0])
    np.testing.assert_array_equal(first[2].points().positions, second[2].points().positions)
    assert len(first[0]) == 40
    assert first[1] < 3.0 * clean[1]


def test_without_a_mask_what_moves_with_the_camera_bends_the_path() -> None:
    masked, bare = (mapped(bonnet, 1, masked=each)[1] for each in (True, False))
    assert bare > 10.0 * masked


def test_one_image_after_the_other_takes_a_mask_with_each() -> None:
    source = Covered(passer_by, 1, masked=False)
    slam = pliant.Slam(source.calibration)
    for frame in source:
        used = passer_by(frame.index)
        taken = slam.take(decode(frame), 1e-9 * frame.stamp_ns, 255 * used.astype(np.uint8))
        u, v = np.rint(taken.points_px).astype(np.int64).T
        assert clearance_of(used)[v, u].min() > 4
    slam.finish()
    poses, _, _ = mapped(passer_by, 1)
    np.testing.assert_array_equal(slam.trajectory.T_world_camera, poses)

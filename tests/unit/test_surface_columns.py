"""Nearest points, ICP, and the figures of a surface in several registrations."""

import numpy as np
import pytest

from pliant.algorithms.arrays import F64
from pliant.algorithms.geometry import so3_exp
from pliant.evaluation.criteria import Similarity
from pliant.evaluation.surface_columns import format_columns, registered, surface_columns
from pliant.evaluation.surface_distance import nearest


@pytest.mark.parametrize("most", [0.02, 0.3, 5.0])
def test_the_nearest_are_those_of_plain_numpy(most: float) -> None:
    generator = np.random.default_rng(0)
    points, others = generator.uniform(-1, 1, (300, 3)), generator.uniform(-1, 0.5, (700, 3))
    points[::50] *= 3.0
    rows, distances = nearest(points, others, most)
    every = np.linalg.norm(points[:, None] - others, axis=-1)
    near = every.min(axis=1) <= most
    np.testing.assert_array_equal(rows >= 0, near)
    np.testing.assert_array_equal(rows[near], every.argmin(axis=1)[near])
    np.testing.assert_allclose(distances[near], every.min(axis=1)[near])
    assert np.isinf(distances[~near]).all()


def test_nothing_is_near_nothing() -> None:
    none, one = np.zeros((0, 3)), np.zeros((1, 3))
    assert nearest(one, none, 1.0)[0].tolist() == [-1]
    assert nearest(none, one, 1.0)[0].tolist() == []
    assert surface_columns(one, none, one, 1.0) == {}


def box(spacing: float, seed: int = 0) -> F64:
    """Six walls, 2, 2.5 and 3 m long: a corner alone would look the same at any scale."""
    generator = np.random.default_rng(seed)
    walls: list[F64] = []
    for axis, (first, second, away) in enumerate(((2.5, 3.0, 2.0), (3.0, 2.0, 2.5), (2.0, 2.5, 3))):
        for at in (0.0, away):
            count = int(first * second / spacing**2)
            wall = np.full((count, 3), at)
            wall[:, (axis + 1) % 3] = generator.uniform(0.0, first, count)
            wall[:, (axis + 2) % 3] = generator.uniform(0.0, second, count)
            walls.append(wall)
    return np.concatenate(walls)


MOVE = Similarity(
    scale=1.03, R=so3_exp(np.array([[0.01, -0.02, 0.01]]))[0], t=np.array([0.02, 0.0, -0.03])
)
DIAMETER = 4.4


def test_icp_finds_how_a_surface_was_moved() -> None:
    true = box(0.02)
    R, t = MOVE.R, MOVE.t
    rigid = (box(0.03, 1) - t) @ R
    found = registered(rigid, true, DIAMETER, with_scale=False)
    np.testing.assert_allclose(found.R, R, atol=2e-3)
    np.testing.assert_allclose(found.t, t, atol=5e-3)
    scaled = registered(rigid / MOVE.scale, true, DIAMETER, with_scale=True)
    assert scaled.scale == pytest.approx(MOVE.scale, abs=5e-3)


def test_columns_separate_registration_shape_and_floor() -> None:
    true = box(0.02)
    samples = (box(0.03, 1) - MOVE.t) @ MOVE.R / MOVE.scale
    columns = surface_columns(samples, box(0.02, 2), true, DIAMETER)
    chamfer = [columns[name].chamfer_m for name in ("trajectory", "icp", "icp_scale", "floor")]
    assert chamfer == sorted(chamfer, reverse=True)
    assert chamfer[0] > 0.03
    assert chamfer[2] < 0.02
    assert columns["floor"].f_score > 0.99
    assert columns["trajectory"].scale == columns["icp"].scale == 1.0
    assert columns["icp_scale"].scale == pytest.approx(MOVE.scale, abs=5e-3)
    assert columns["icp_scale"].f_5cm > columns["trajectory"].f_5cm
    told = format_columns(columns)
    assert "+ ICP, scale" in told
    assert "Chamfer" in told


def test_what_is_far_is_not_in_the_rmse_but_in_the_f_score() -> None:
    true = box(0.02)
    stray = true[:2000] + 10.0
    near = surface_columns(true, true, true, DIAMETER)["trajectory"]
    far = surface_columns(np.concatenate([true, stray]), true, true, DIAMETER)["trajectory"]
    assert near.accuracy_m == far.accuracy_m == 0.0
    assert near.f_5cm == 1.0
    assert far.f_5cm < 0.99

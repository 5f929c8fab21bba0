"""The street that ``scripts/bench street-block`` renders, and what ``scripts/bench loops`` says."""

import numpy as np
import pytest
from benchmarks import loops
from benchmarks.played import Played
from benchmarks.street_block import CAMERA, render, ride, street_block

from pliant.algorithms.arrays import F64
from pliant.config import load_config
from pliant.evaluation.criteria import path_length


def ridden() -> F64:
    """(N, 4, 4) poses, ten a second."""
    path = ride()
    return np.array([path.T_world_camera(t) for t in np.arange(0.0, path.duration_s, 0.1)])


def test_the_ride_comes_back_to_where_it_began():
    T = ridden()
    assert 200.0 < path_length(T) < 205.0
    away = np.linalg.norm(T[:40, :3, 3] - T[-1, :3, 3], axis=1)
    again = T[away.argmin()]
    assert away.min() < 0.4
    assert again[:3, 2] @ T[-1, :3, 2] > 0.999
    assert np.linalg.norm(T[0, :3, 3] - T[-1, :3, 3]) > 12.0


def test_a_larger_block_has_a_longer_street():
    path = ride((62.0, 53.0))
    T = np.array([path.T_world_camera(t) for t in np.arange(0.0, path.duration_s, 0.1)])
    assert 500.0 < path_length(T) < 530.0
    assert len(street_block((62.0, 53.0)).solids) > 2.0 * len(street_block().solids)


def test_nothing_is_ridden_into():
    positions = ridden()[:, :3, 3]
    for solid in street_block().solids[1:]:
        x, y, z = (positions - solid.centre).T
        cos, sin = np.cos(solid.rotation[2]), np.sin(solid.rotation[2])
        own = np.column_stack([cos * x + sin * y, cos * y - sin * x, z])
        beyond = np.maximum(np.abs(own) - 0.5 * np.array(solid.size), 0.0)
        assert np.linalg.norm(beyond, axis=1).min() > 0.8, solid.name


def test_the_end_error_is_what_the_way_has_left():
    n = np.arange(300)
    true = np.column_stack([np.cos(0.02 * n), np.sin(0.02 * n), 0.05 * np.sin(0.3 * n)])
    mine = 0.5 * true[:, ::-1]
    mine[200:] += (0.0, 0.02, 0.0)
    poses = {k: np.append(at, (0.0, 0.0, 0.0, 1.0)) for k, at in enumerate(mine * (1.0, 1.0, -1.0))}
    came = Played(
        final=poses, online=poses, truth=dict(enumerate(true)), lit=300, segments=1, joined=[],
        same_places=0, compared={}, cpu_ms=0.0,
    )  # fmt: skip
    assert loops.end_error_m(came) == pytest.approx(0.04, rel=1e-6)
    assert loops.path_m(came) > 5.9


@pytest.mark.slow
def test_a_short_ride_is_one_map(tmp_path):
    folder = tmp_path / "street"
    render(folder, frames=24, camera=CAMERA.model_copy(update={"width": 320, "height": 240}))
    _, row, _ = loops.measure([str(folder)], load_config())
    name, _, places, *_, segments, posed, _ = (cell.strip() for cell in row.split("|")[1:-1])
    assert (name, places, segments, posed) == ("street", "on", "1", "100.0 %")

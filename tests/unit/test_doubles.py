"""Doubles among tracks against a plain search in order of age."""

import numpy as np
import pytest

from pliant.algorithms.tracking.track_table import TRACK, Tracks
from pliant.algorithms.tracking.upkeep import remove_doubles

HEIGHT, WIDTH = 50, 75


def plain_survivors(tracks: Tracks) -> list[int]:
    """Rows with no older survivor within 1 px; the latest in a pixel stands for all in it."""
    kept: list[int] = []
    owners: dict[tuple[int, int], int] = {}
    points = np.column_stack([tracks["u"], tracks["v"]])
    for i, (u, v) in enumerate(points):
        if tracks["alive"][i] == 0:
            continue
        x, y = int(u + np.float32(0.5)), int(v + np.float32(0.5))
        around = [(x + dx, y + dy) for dx in (-1, 0, 1) for dy in (-1, 0, 1)]
        near = [points[owners[at]] for at in around if at in owners]
        if all(np.float32(((other - (u, v)) ** 2).sum()) >= 1.0 for other in near):
            owners[x, y] = i
            kept.append(i)
    return kept


@pytest.mark.parametrize("count", [0, 30, 300, 2000])
def test_keeps_what_a_plain_search_keeps(count: int) -> None:
    rng = np.random.default_rng(count)
    tracks = np.zeros(count, TRACK)
    tracks["u"], tracks["v"] = rng.uniform(4.0, [WIDTH - 5.0, HEIGHT - 5.0], (count, 2)).T
    tracks["alive"] = rng.random(count) < 0.9
    expected = plain_survivors(tracks)
    owners = np.full((HEIGHT, WIDTH), -7, np.int32)
    remove_doubles(tracks, owners)
    assert np.flatnonzero(tracks["alive"]).tolist() == expected

"""Doubles among tracks against a plain search in order of age."""

import numpy as np
import pytest

from pliant.algorithms.arrays import F32, I32
from pliant.algorithms.tracking import track_table as table
from pliant.algorithms.tracking.upkeep import remove_doubles

HEIGHT, WIDTH = 50, 75


def plain_survivors(floats: F32, ints: I32) -> list[int]:
    """Rows with no older survivor within 1 px; the latest in a pixel stands for all in it."""
    kept: list[int] = []
    owners: dict[tuple[int, int], int] = {}
    for i, (u, v) in enumerate(floats[:, [table.U, table.V]]):
        if ints[i, table.ALIVE] == 0:
            continue
        x, y = int(u + np.float32(0.5)), int(v + np.float32(0.5))
        around = [(x + dx, y + dy) for dx in (-1, 0, 1) for dy in (-1, 0, 1)]
        near = [floats[owners[at], [table.U, table.V]] for at in around if at in owners]
        if all(np.float32(((other - (u, v)) ** 2).sum()) >= 1.0 for other in near):
            owners[x, y] = i
            kept.append(i)
    return kept


@pytest.mark.parametrize("count", [0, 30, 300, 2000])
def test_keeps_what_a_plain_search_keeps(count: int) -> None:
    rng = np.random.default_rng(count)
    floats = np.zeros((count, table.FLOATS), np.float32)
    floats[:, [table.U, table.V]] = rng.uniform(4.0, [WIDTH - 5.0, HEIGHT - 5.0], (count, 2))
    ints = np.zeros((count, table.INTS), np.int32)
    ints[:, table.ALIVE] = rng.random(count) < 0.9
    expected = plain_survivors(floats, ints)
    owners = np.full((HEIGHT, WIDTH), -7, np.int32)
    remove_doubles(count, floats, ints, owners)
    assert np.flatnonzero(ints[:, table.ALIVE]).tolist() == expected

"""Columns that grow into an .npz."""

from pathlib import Path

import numpy as np
import pytest

from pliant.errors import ResultError
from pliant.formats.npz import NpzWriter


def write(path: Path) -> None:
    with NpzWriter(path) as npz:
        for n in (3, 0, 2):
            npz.add("points", np.arange(3.0 * n, dtype=np.float32).reshape(n, 3))
            npz.add("count", np.array([n]))
            npz.add("flag", np.array([n > 0]))


def test_numpy_reads_what_was_added_and_the_bytes_are_the_same_again(tmp_path: Path) -> None:
    write(tmp_path / "a.npz")
    write(tmp_path / "b.npz")
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    with np.load(tmp_path / "a.npz") as content:
        assert content["points"].dtype == np.float32
        np.testing.assert_array_equal(content["points"][:3].ravel(), np.arange(9.0))
        assert content["points"].shape == (5, 3)
        assert content["count"].tolist() == [3, 0, 2]
        assert content["flag"].tolist() == [True, False, True]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.npz", "b.npz"]


def write_both(path: Path, first: np.ndarray, second: np.ndarray) -> None:
    with NpzWriter(path) as npz:
        npz.add("points", first)
        npz.add("points", second)


def test_rows_of_another_kind_are_refused_and_leave_no_file(tmp_path: Path) -> None:
    good = np.zeros((1, 3))
    for wrong in (np.zeros((1, 2)), np.zeros((1, 3), np.float32)):
        with pytest.raises(ValueError, match="points"):
            write_both(tmp_path / "a.npz", good, wrong)
    assert not (tmp_path / "a.npz").exists()
    (tmp_path / "dir.npz").mkdir()
    with pytest.raises(ResultError, match="cannot be written"):
        write_both(tmp_path / "dir.npz", good, good)

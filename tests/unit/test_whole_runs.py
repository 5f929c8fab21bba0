"""The tables of whole runs, which take hours: a row is told when it is there."""

from pathlib import Path
from typing import Any

import pytest
from benchmarks import whole_runs


def test_a_row_of_losses_follows_each_run(monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[Path] = []

    def run_once(source: str, output: Path, services: Any) -> float:
        for name in whole_runs.FILES:
            (output / name).write_text(f"{source} {len(done) // 2}")
        done.append(output)
        return 1.0

    books = {"recorder": {"messages": {"a": 2, "b": 3}, "lost": 0, "duplicated": 1}}
    monkeypatch.setattr(whole_runs, "run_once", run_once)
    monkeypatch.setattr(whole_runs, "write_results", lambda output: books)
    table = whole_runs.losses("source", 3)
    assert next(table).startswith("| run |")
    for number, same in enumerate(("yes", "yes", "NO"), start=1):
        assert next(table) == f"| {number} | 5 | 0 | 1 | {same} |"
        assert len(done) == number

"""The rows that `scripts/bench in-process` prints."""

from benchmarks.in_process import measure

TINY = "built-in:tiny"


def test_a_row_for_each_source_and_seed_and_a_wrong_focal_length_costs() -> None:
    *_, first, second = measure([TINY], ["tracking.max_tracks=2000"], range(2), 1.0)
    assert first.startswith(f"| {TINY} | 0 | ")
    assert second.startswith(f"| {TINY} | 1 | ")
    assert first.endswith(" um | 100.0 % |")
    *_, wrong = measure([TINY], ["tracking.max_tracks=2000"], [0], 1.2)
    assert " mm | " in wrong

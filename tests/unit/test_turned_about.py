"""The rows that `scripts/bench turned-about` prints."""

from benchmarks.turned_about import WAYS, measure


def test_a_row_for_each_way_and_the_means() -> None:
    *rows, means = list(measure(["built-in:tiny"], ["tracking.max_tracks=2000"], 24, 1))[1:]
    shown = [[cell.strip() for cell in row.strip("|").split("|")] for row in rows[-len(WAYS) :]]
    assert [cells[2] for cells in shown] == [way.name for way in WAYS]
    for _, first, _, posed, segments, *errors in shown:
        assert first == "0"
        assert segments == "1"
        some, of = map(int, posed.split(" of "))
        assert some == of
        assert all(0.0 < float(each.removesuffix(" %")) < 5.0 for each in errors)
    assert means.startswith(f"geometric means of {len(WAYS)}")

"""The rows that `scripts/bench map-starts` prints."""

from benchmarks.map_starts import measure


def test_a_row_for_each_source() -> None:
    *_, row = measure(["built-in:tiny"], ["tracking.max_tracks=2000"], 3, 4)
    cells = [cell.strip() for cell in row.strip("|").split("|")]
    assert cells[0] == "built-in:tiny"
    made, of = map(int, cells[1].split(" of "))
    assert 1 <= made <= of == 3
    shares = [float(cell.removesuffix(" %")) for cell in cells[2:]]
    assert all(0.0 < share < 10.0 for share in shares)

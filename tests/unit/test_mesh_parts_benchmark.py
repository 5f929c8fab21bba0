"""The comparison of meshing's parts, on a keyframe small enough for a test."""

from benchmarks import mesh_parts


def rows(lines: list[str]) -> dict[str, list[str]]:
    cells = [line.strip("| ").split(" | ") for text in lines for line in text.splitlines()]
    return {row[0].split(",")[0]: row[1:] for row in cells if len(row) > 1}


def test_smoothing_is_compared_on_the_same_scenes() -> None:
    lines = list(mesh_parts.measure(vertices=2000, repeats=1, seeds=2))
    table = rows(lines)
    assert float(table["Delaunay"][0]) > 0.0
    assert table["Delaunay + NLTGV"][1] == "45"
    assert float(table["none"][1]) == 1.0
    assert float(table["NLTGV"][1]) > 3.0


def test_volumes_are_timed_at_both_resolutions() -> None:
    table = rows(list(mesh_parts.measure(vertices=500, repeats=1, seeds=1)))
    for kind, paper in (("coarse", "175"), ("fine", "4000")):
        assert float(table[f"{kind} TSDF: both"][0]) > 0.0
        assert table[f"{kind} TSDF: both"][1] == paper

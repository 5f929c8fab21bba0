"""The comparison of meshing's parts, on a keyframe small enough for a test."""

import importlib

import pytest
from benchmarks import mesh_parts

from pliant.fusion import volume
from pliant.fusion.open3d_import import FusionError


def rows(lines: list[str]) -> dict[str, list[str]]:
    cells = [line.strip("| ").split(" | ") for text in lines for line in text.splitlines()]
    return {row[0].split(",")[0]: row[1:] for row in cells if len(row) > 1}


def test_smoothing_is_compared_on_the_same_scenes(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing() -> None:
        raise FusionError("open3d is missing")

    monkeypatch.setattr(volume, "require_open3d", missing)
    lines = list(mesh_parts.measure(vertices=2000, repeats=1, seeds=2))
    assert "no TSDF: open3d is missing" in lines
    table = rows(lines)
    assert float(table["Delaunay"][0]) > 0.0
    assert table["Delaunay + NLTGV"][1] == "45"
    assert float(table["none"][1]) == 1.0
    assert float(table["NLTGV"][1]) > float(table["Laplacian"][1]) > 1.0


def test_volumes_are_timed_at_both_resolutions() -> None:
    try:
        importlib.import_module("open3d")
    except (ImportError, OSError) as error:
        pytest.skip(f"open3d: {error}")
    table = rows(list(mesh_parts.measure(vertices=500, repeats=1, seeds=1)))
    for kind, paper in (("coarse", "175"), ("fine", "4000")):
        assert float(table[f"{kind} TSDF: both"][0]) > 0.0
        assert table[f"{kind} TSDF: both"][1] == paper

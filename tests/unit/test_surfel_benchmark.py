"""The tables of surfels: every table has its rows, and a row its figures."""

import re
from pathlib import Path

import pytest
from benchmarks import deforming_maps, surfels
from benchmarks.surfels import LIMITS, LOSSES, MAPS, TABLES, measure

from pliant.algorithms.surfels.parameters import SurfelParameters
from pliant.datasets.builtin import parse_builtin
from pliant.errors import DatasetError
from pliant.evaluation.deforming_map_truth import DeformingMapErrors


def lines(sources: list[str], tables: list[str], *, quick: bool = False) -> list[str]:
    made = measure(sources, tracks=None, tables=tables, frames=3, surfels=20, quick=quick)
    return [line for said in made for line in said.splitlines()]


def test_a_row_has_a_figure_in_every_column(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PLIANT_CACHE_DIR", str(tmp_path))
    source = "built-in:sliding?width=160&frames=3"
    said = lines([source], ["targets", "scales"], quick=True)
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in said if line[:1] == "|"]
    header, default, one, four = rows[0], rows[2], rows[5], rows[6]
    assert [row[1] for row in (default, one, four)] == ["default", "1 scales", "4 scales"]
    assert default[0] == "sliding width=160 frames=3"
    figures = dict(zip(header, default, strict=True))
    assert re.fullmatch(r"0\.\d\d", figures["RMSE %"])
    assert figures["alive at end"].endswith("%")
    assert figures["until loss"] == "3"
    assert float(figures["ms a frame"]) > 0.0


def test_a_folder_without_exact_surfaces_has_the_figures_that_depth_gives(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PLIANT_CACHE_DIR", str(tmp_path))
    said = lines(["built-in:tiny?width=160&frames=3"], ["targets"])
    header, _, row = ([cell.strip() for cell in line.split("|")[1:-1]] for line in said[-3:])
    figures = dict(zip(header, row, strict=True))
    assert figures["alive at end"].endswith("%")
    assert figures["RMSE %"]
    assert figures["camera %"] == figures["until loss"] == ""
    assert float(figures["ms a frame"]) > 0.0


@pytest.mark.parametrize("table", [name for name in TABLES if name not in (LIMITS, LOSSES, MAPS)])
def test_every_table_names_sequences_that_there_are(
    table: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the paper and without; the settings are parameters that are valid."""
    opened: list[str] = []

    def figures(_sequence: None, _parameters: SurfelParameters) -> list[str]:
        return ["0"] * 10

    def no_sequence(source: str, _frames: int) -> None:
        parse_builtin(source)
        opened.append(source)

    monkeypatch.setattr(surfels, "load", no_sequence)
    monkeypatch.setattr(surfels, "_measure", figures)
    said = list(measure([], tracks="paper.npz", tables=[table], frames=9, surfels=20, quick=False))
    assert len(opened) == len(set(opened)) >= 3
    assert len(said) >= 2 + len(opened)
    assert not any("tracks=" in line for line in said)


def test_the_table_of_maps_names_sequences_that_there_are(monkeypatch: pytest.MonkeyPatch) -> None:
    judged: list[str] = []

    def errors(source: str) -> tuple[DeformingMapErrors | str, list[str]]:
        parse_builtin(source)
        judged.append(source)
        windows = ["8", "7", *["0.25"] * 3, "700"]
        if "room" in source:
            return "it is rigid", windows
        return DeformingMapErrors(9, 99, *[0.01] * 7), windows

    monkeypatch.setattr(deforming_maps, "_judged", errors)
    said = list(measure([], tracks=None, tables=[MAPS], frames=9, surfels=20, quick=False))
    assert len(judged) == len(set(judged)) >= 3
    assert sum("1.00" in line for line in said) == len(judged) - 1
    assert sum("| it is rigid |" in line for line in said) == 1
    assert "\n".join(said).count("| 8 | 7 | 0.25 |") == len(judged)


def test_mistakes_are_one_line() -> None:
    with pytest.raises(DatasetError, match="no table 'modles'; there are targets, models"):
        lines([], ["modles"])
    with pytest.raises(DatasetError, match="no such file"):
        lines(["nowhere"], ["targets"])

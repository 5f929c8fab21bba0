"""Which sources a folder holds, and what a batch refuses before it begins."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from pliant.config import config_yaml, load_config
from pliant.datasets import sources_in
from pliant.datasets.source_spec import SourceSpec
from pliant.errors import DatasetError, ResultError
from pliant.results.folder import folder_name
from pliant_services.batch.command import run_batch
from pliant_services.run.request import RunRequest
from pliant_services.run.resume import resumed_config


def folder_of_images(path: Path) -> Path:
    path.mkdir(parents=True)
    cv2.imwrite(str(path / "0.png"), np.zeros((48, 64), np.uint8))
    return path


def test_sources_of_a_folder(tmp_path: Path) -> None:
    for name in ("b.MP4", "a.mov", "a.yaml", "notes.txt", ".hidden.mp4", "drive.bag"):
        (tmp_path / name).touch()
    folder_of_images(tmp_path / "walk")
    (tmp_path / "empty").mkdir()
    results = folder_of_images(tmp_path / "results" / "old").parent
    found = sources_in(tmp_path, but=results)
    assert [path.name for path in found] == ["a.mov", "b.MP4", "drive.bag", "walk"]
    with pytest.raises(DatasetError, match="is itself a sequence: use `pliant run "):
        sources_in(tmp_path / "walk", but=results)
    with pytest.raises(DatasetError, match="contains no source"):
        sources_in(tmp_path / "empty", but=results)


def test_a_folder_with_something_else_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "clips").mkdir()
    (tmp_path / "clips" / "a.mp4").touch()
    output = tmp_path / "mine"
    output.mkdir()
    (output / "thesis.txt").touch()
    with pytest.raises(ResultError, match="exists and is no batch folder"):
        run_batch(tmp_path / "clips", output, jobs=1, options=[])
    (output / "batch.json").write_text("{}")
    with pytest.raises(ResultError, match="not a batch summary"):
        run_batch(tmp_path / "clips", output, jobs=1, options=[])
    (output / "batch.json").write_text(json.dumps({"options": ["--fov", "70"], "clips": []}))
    with pytest.raises(ResultError, match=r"other options of run \(--fov 70\)"):
        run_batch(tmp_path / "clips", output, jobs=1, options=["--fov", "60"])
    assert len(list(output.iterdir())) == 2


def test_a_run_is_taken_up_with_the_options_that_it_was_begun_with(tmp_path: Path) -> None:
    (tmp_path / "state").mkdir()
    settings = ["tracking.max_tracks=5000"]
    (tmp_path / "config.yaml").write_text(config_yaml(load_config(overrides=settings, seed=3)))
    same = RunRequest(source=SourceSpec(location="a.mp4"), overrides=settings, seed=3)
    assert resumed_config(tmp_path, same) == resumed_config(
        tmp_path, RunRequest(source=SourceSpec(location="a.mp4"))
    )
    for other in (
        RunRequest(source=SourceSpec(location="a.mp4"), overrides=settings),
        RunRequest(source=SourceSpec(location="a"), seed=4),
    ):
        with pytest.raises(ResultError, match="and this one differs"):
            resumed_config(tmp_path, other)


def test_a_result_folder_keeps_the_letters_of_its_source() -> None:
    named = {"clips/Küche 1.mp4": "Küche_1.mp4", "家.mov": "家.mov", "a/b/": "b", "x?*y": "x_y"}
    assert {source: folder_name(source) for source in named} == named

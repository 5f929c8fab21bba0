"""Images that are spoilt: the map goes on, and what moves by itself is said to."""

from collections.abc import Collection
from functools import partial
from pathlib import Path
from typing import cast

import cv2
import numpy as np
import pytest
from benchmarks.rough import CASES, Case, RoughFrames, Spoil, follow, thing

from pliant.algorithms.map_delta import LOST
from pliant.config import load_config
from pliant.datasets import open_source
from pliant.datasets.base import Dataset
from pliant.evaluation.run_evaluation import evaluate_trajectory
from pliant.formats.trajectory_files import read_trajectory
from pliant.results.judgement import doubtful_frames
from pliant.results.run import Run

TINY = "built-in:tiny"


def follow_tiny(spoil: Spoil, but: Collection[int] = ()) -> tuple[Run, float]:
    """A run of the scene with some images spoilt, and the error of the frames ``but`` some as a
    share of the path."""
    frames = RoughFrames(open_source(TINY), Case(source=TINY, spoil=spoil))
    run = follow(cast(Dataset, frames), load_config(None, []))
    assert frames.ground_truth_path is not None
    final = {frame: pose for frame, pose in run.history.final().items() if frame not in but}
    truth = read_trajectory(frames.ground_truth_path)
    found = evaluate_trajectory(run.history.trajectory_in(0, final), truth)
    assert found.ate_percent_of_path is not None
    return run, 0.01 * found.ate_percent_of_path


def blurred(pixels):
    return cv2.blur(pixels, (15, 15))


@pytest.mark.parametrize(
    ("spoilt", "change"), [(range(24, 25), np.zeros_like), (range(24, 28), blurred)]
)
def test_the_map_continues_after_a_dark_frame_and_after_blurred_ones(spoilt, change):
    run, error = follow_tiny(
        lambda number, pixels: change(pixels) if number in spoilt else pixels, spoilt
    )
    history = run.history
    states, final = history.states, history.final()
    assert {number for number, (state, _) in states.items() if state == LOST} <= {*spoilt}
    assert {*doubtful_frames(history)} <= {*spoilt}
    assert {*range(len(states))} - {*final} <= {*spoilt}
    assert {segment for segment, _ in final.values()} == {0}
    assert error < 1e-3


def test_half_of_the_image_that_moves_is_reported_and_does_not_move_the_camera():
    plain, _ = follow_tiny(lambda _, pixels: pixels)
    assert not doubtful_frames(plain.history)
    moves, first = partial(thing, 0.5), 20
    run, error = follow_tiny(
        lambda number, pixels: moves(number, pixels) if number >= first else pixels
    )
    told = [frame for frame in doubtful_frames(run.history) if frame >= first]
    assert len(told) > 0.6 * (len(run.tracks) - first)
    assert error < 2e-3


def test_every_row_of_the_docs_is_a_case() -> None:
    page = (Path(__file__).parents[2] / "docs" / "results.md").read_text(encoding="utf-8")
    section = page.partition("<!-- bench rough -->\n")[2].partition("\n<!--")[0]
    table = [line for line in section.splitlines() if line.startswith("|")]
    rows = [line.split("|")[1].strip() for line in table[2:]]
    assert len(rows) > 30
    cases = {name.removeprefix("built-in:").replace(" %", "%") for name in CASES}
    assert {row.replace(" %", "%") for row in rows} <= cases

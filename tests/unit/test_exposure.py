"""Images that show nothing, and what a run says of them."""

import numpy as np
import pytest
from odd_videos import scene

from pliant.algorithms.image.exposure import BLACK, FLAT, WHITE, flaw_of
from pliant.config import load_config
from pliant.datasets.base import SourceFrame
from pliant.datasets.calibration import calibration_from_fov
from pliant.map_history import MapHistory
from pliant.offline import Pipeline
from pliant.results.report import last_reason


@pytest.mark.parametrize(("grey", "flaw"), [(0, BLACK), (16, BLACK), (255, WHITE), (128, FLAT)])
def test_what_shows_nothing_is_named(grey: int, flaw: str) -> None:
    """With noise, and with a time stamp in a corner."""
    noise = np.random.default_rng(0).integers(-2, 3, (240, 320))
    image = np.clip(grey + noise, 0, 255).astype(np.uint8)
    image[:10, :70] = 200
    assert flaw_of(image) == flaw


def test_what_shows_little_shows_something() -> None:
    grey = scene()[:, :, 0].astype(float)
    assert flaw_of(grey.astype(np.uint8)) == ""
    dark = 0.3 * (grey - grey.mean()) + 20
    assert flaw_of(np.clip(dark, 0, 255).astype(np.uint8)) == ""
    for side in (1, 2, 3):
        assert flaw_of(np.zeros((side, side), np.uint8)) == BLACK


def test_frames_that_are_black_are_said_to_be() -> None:
    history = MapHistory()
    pipeline = Pipeline(calibration_from_fov(320, 240, 60.0), load_config(), history)
    pixels = np.full((240, 320, 3), 3, np.uint8).tobytes()
    for index in range(6):
        frame = SourceFrame(
            index=index, stamp_ns=index * 40_000_000, encoding="rgb8", data=pixels, width=320,
            height=240,
        )  # fmt: skip
        assert pipeline.take(frame).delta.reason == BLACK


def test_a_run_counts_the_frames_that_show_nothing() -> None:
    assert (
        last_reason([BLACK] * 60 + ["too few tracks: 0 of 100"] * 40)
        == "60 of 100 frames are black"
    )
    assert last_reason([WHITE]) == "1 of 1 frames are overexposed"
    assert last_reason([BLACK, "too little parallax"]) == "too little parallax"
    assert last_reason([]) == ""

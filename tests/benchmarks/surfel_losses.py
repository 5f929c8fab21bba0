"""Surfels after the dark: how many are found back, and how exactly."""

from collections.abc import Iterator, Sequence
from copy import copy

import cv2
import numpy as np

from benchmarks import surfel_sequences
from benchmarks.table import markdown
from pliant.algorithms.arrays import F64, U8
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import so3_exp
from pliant.algorithms.surfels.parameters import SurfelParameters
from pliant.algorithms.surfels.surfel_tracker import SurfelTracker
from pliant.evaluation.exact_surfels import ExactRow, ExactSurfels

_FIRST = 20
_DARK_S = (1, 2, 3)
_FPS = 30
_TURN = np.array([0.1, 0.12, np.radians(60.0)])
"""Of the camera in the dark, where it is turned there: rotation vector, rad."""
_AFTER = (0, 5, _FPS)
_TRAVEL = "built-in:breathing?amplitude=0.03&seconds=8&travel=0.25"
_HEADER = ("sequence", "dark", "depth of", "turned", "followed", "in camera %", "camera %")


def measure_losses(sources: Sequence[str], tracks: str | None, surfels: int) -> Iterator[str]:
    """After 20 frames the camera sees nothing for a while, in which all goes on.

    Figures of the first frame after the dark, of the sixth, and of that a second later.  Where the
    camera was turned, what it sees is warped: a camera that stands still takes that for a motion of
    the scene.
    """
    paper = [f"built-in:kinect-paper?tracks={tracks}"] if tracks else []
    yield f"\nlosses, after {_FIRST} frames, at most {surfels} surfels"
    yield markdown(_HEADER, [])
    for source in sources or [*paper, _TRAVEL]:
        moving = source.startswith("built-in:breathing")
        parameters = SurfelParameters.model_validate(
            {"max_surfels": surfels, "camera": "moving" if moving else "static"}
        )
        frames = _FIRST + _FPS * (_DARK_S[-1] + 1) + 1
        sequence = surfel_sequences.load(source, frames, all_depths=True)
        for dark_s, every, turned in (
            *((seconds, False, False) for seconds in _DARK_S),
            (_DARK_S[1], False, True),
            (_DARK_S[1], True, False),
        ):
            rows = _after(sequence, parameters, dark_s, every=every, turned=turned)
            name = source.removeprefix("built-in:").partition("?")[0]
            cells = [
                name, f"{dark_s} s", "all" if every else "the first", "60 deg" if turned else "",
                " / ".join(f"{100.0 * r.followed / max(1, r.followable):.0f} %" for r in rows),
                " / ".join(f"{100.0 * r.in_camera:.2f}" for r in rows),
                " / ".join(f"{100.0 * r.camera:.2f}" for r in rows) if moving else "",
            ]  # fmt: skip
            yield "| " + " | ".join(cells) + " |"


def _after(
    sequence: surfel_sequences.Sequence, parameters: SurfelParameters, dark_s: float, *,
    every: bool, turned: bool,
) -> list[ExactRow]:  # fmt: skip
    """every: all frames have a depth map, those in the dark, too."""
    assert sequence.truth is not None
    tracker, generator = SurfelTracker(parameters), np.random.default_rng(0)
    truth, again, T = copy(sequence.truth), _FIRST + round(_FPS * dark_s), np.eye(4)
    T[:3, :3] = so3_exp(_TURN)
    if turned:
        truth.T_world_camera = truth.T_world_camera.copy()
        truth.T_world_camera[again:] = truth.T_world_camera[again:] @ T
    exact = ExactSurfels(truth)
    for number in range(again + _AFTER[-1] + 1):
        image, depth = sequence.images[number], sequence.depths[number] if every else None
        if number == 0:
            exact.add(0, tracker.start(image, sequence.depths[0], sequence.camera))
            continue
        if _FIRST <= number < again:
            image = np.clip(generator.normal(4.0, 2.0, image.shape), 0, 255).astype(np.uint8)
        elif number >= again and turned:
            image = _warped(image, T[:3, :3], sequence.camera)
        frame = tracker.track(image, sequence.interval_s(number), depth=depth)
        if number - again in _AFTER:
            exact.add(number, frame)
    return exact.rows[1:]


def _warped(image: U8, R: F64, camera: PinholeCamera) -> U8:
    """What a camera sees that is turned by R (3, 3), black where that is not known."""
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
    H = K @ R.T @ np.linalg.inv(K)
    return np.asarray(cv2.warpPerspective(image, H, (camera.width, camera.height)), np.uint8)

"""Rough video: is the camera followed through it, how well, and does the verdict say where not?

Sequences whose truth is known, spoilt image by image: dark, blurred, covered, half hidden by
something that moves, few frames a second, turns on the spot, gain, a camera held upright.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import cast

import cv2
import numpy as np

from benchmarks.table import markdown_header, markdown_row
from pliant.algorithms.arrays import F64, U8
from pliant.config import Config
from pliant.datasets import open_source
from pliant.datasets.base import BUILTIN_PREFIX, Dataset, SourceFrame
from pliant.datasets.calibration import Calibration, calibration_yaml
from pliant.datasets.rectifier import Rectifier, decode
from pliant.evaluation.presentation import metres
from pliant.evaluation.run_evaluation import evaluate_trajectory
from pliant.formats.trajectory_files import read_trajectory
from pliant.messages.types import CameraStream
from pliant.offline import Pipeline
from pliant.results.report import rigid_report
from pliant.results.run import Run

_HEADER = (
    *("case", "frames posed", "segments", "ATE, final", "of the path", "ATE, online"),
    *("doubtful poses", "verdict"),
)

Spoil = Callable[[int, U8], U8]
"""What becomes of the pixels (H, W) or (H, W, 3) of the frame of a number."""


@dataclass(frozen=True, kw_only=True)
class Case:
    """frames: first ones of the source that are taken, one of ``every``.  upright: turned by 90
    degrees, with their camera."""

    source: str
    spoil: Spoil = lambda _, pixels: pixels
    frames: int = 1_000_000
    every: int = 1
    upright: bool = False


class RoughFrames:
    """The frames of a case: ``pliant.datasets.base``."""

    is_live = False

    def __init__(self, source: Dataset, case: Case) -> None:
        self._source, self._case = source, case
        self.name, self.ground_truth_path = source.name, source.ground_truth_path
        count = min(case.frames, source.frame_count or case.frames)
        self.frame_count: int | None = -(-count // case.every)
        self.calibration = upright(source.calibration) if case.upright else source.calibration

    def __iter__(self) -> Iterator[SourceFrame]:
        case = self._case
        for frame in self._source:
            if frame.index >= case.frames:
                return
            if frame.index % case.every:
                continue
            pixels = case.spoil(frame.index, decode(frame))
            pixels = np.rot90(pixels, -1) if case.upright else pixels
            yield SourceFrame(
                index=frame.index // case.every, stamp_ns=frame.stamp_ns, data=pixels.tobytes(),
                encoding="mono8" if pixels.ndim == 2 else "rgb8", width=pixels.shape[1],
                height=pixels.shape[0],
            )  # fmt: skip


def upright(given: Calibration) -> Calibration:
    """The camera of images that are turned clockwise by 90 degrees."""
    k = list(given.distortion)
    if len(k) >= 4 and given.model != "fisheye":
        k[2], k[3] = k[3], -k[2]
    return replace(
        given, width=given.height, height=given.width, fx=given.fy, fy=given.fx,
        cx=given.height - 1 - given.cy, cy=given.cx, distortion=tuple(k), depth=None,
    )  # fmt: skip


def _while(frames: range, spoil: Spoil) -> Spoil:
    return lambda number, pixels: spoil(number, pixels) if number in frames else pixels


def dark(_: int, pixels: U8) -> U8:
    """Nothing at all."""
    return np.zeros_like(pixels)


def blurred(_: int, pixels: U8) -> U8:
    """As 31 px are wide."""
    return np.asarray(cv2.blur(pixels, (31, 31)), np.uint8)


def covered(number: int, pixels: U8) -> U8:
    """A dark hand before most of the image, a little elsewhere in each frame."""
    height, width = pixels.shape[:2]
    hand = np.zeros((height, width), np.uint8)
    sway = 0.02 * width * np.sin(0.9 * number)
    middle = (round(0.5 * width + sway), round(0.62 * height))
    cv2.ellipse(hand, middle, (round(0.44 * width), round(0.5 * height)), 0, 0, 360, 255, -1)
    for finger in range(4):
        tip = (round((0.2 + 0.2 * finger) * width + sway), round(0.02 * height))
        cv2.line(hand, middle, tip, 255, round(0.15 * width))
    shade = 20.0 + 6.0 * np.sin(0.03 * np.arange(width) + 0.02 * np.arange(height)[:, None])
    if pixels.ndim == 3:
        return np.where(hand[..., None] > 0, shade[..., None], pixels).astype(np.uint8)
    return np.where(hand > 0, shade, pixels).astype(np.uint8)


def thing(share: float, number: int, pixels: U8) -> U8:
    """Something textured before a share of the image, that swings by itself."""
    height, width = pixels.shape[:2]
    wide, high = round(np.sqrt(share) * width), round(np.sqrt(share) * height)
    left = 0.5 * (width - wide) * (1.0 + 0.8 * np.sin(0.06 * number))
    top = 0.5 * (height - high) * (1.0 + 0.8 * np.sin(0.045 * number + 1.0))
    M = np.array([[1.0, 0.0, left], [0.0, 1.0, top]], np.float32)
    texture, whole = _texture(wide, high), np.full((high, wide), 255, np.uint8)
    shown = cv2.warpAffine(texture, M, (width, height))
    there = cv2.warpAffine(whole, M, (width, height)).astype(np.float32) / 255.0
    if pixels.ndim == 3:
        shown, there = shown[..., None], there[..., None]
    return np.asarray(there * shown + (1.0 - there) * pixels, np.uint8)


def _texture(width: int, height: int) -> U8:
    """Blotches of all sizes, the same each time."""
    generator, total = np.random.default_rng(5), np.zeros((height, width), np.float32)
    for octave in range(2, 7):
        size = max(2, width >> octave), max(2, height >> octave)
        noise = generator.normal(size=(size[1], size[0])).astype(np.float32)
        total += cv2.resize(noise, (width, height), interpolation=cv2.INTER_CUBIC)
    return np.clip(120.0 + 25.0 * total, 0.0, 255.0).astype(np.uint8)


def gain(flicker: float, number: int, pixels: U8) -> U8:
    """Darker in two steps, and from frame to frame as much lighter or darker."""
    factor = 1.0 if number < 50 else 0.7 if number < 100 else 0.5
    factor *= 1.0 + flicker * np.sin(2.1 * number)
    return np.clip(factor * pixels, 0.0, 255.0).astype(np.uint8)


def pale(_: int, pixels: U8) -> U8:
    """A quarter of the contrast."""
    return (96.0 + 0.25 * pixels).astype(np.uint8)


def _cases() -> dict[str, Case]:
    return {**_spoilt_for_a_while(), **_moving(), **_few(), **_light(), **_turned()}


def _spoilt_for_a_while() -> dict[str, Case]:
    cases: dict[str, Case] = {}
    for source, first in (("tsukuba150", 70), ("built-in:room?frames=120", 60)):
        cases[source] = Case(source=source)
        for count, name, spoil in (
            *((count, "dark", dark) for count in (1, 3, 10)),
            (5, "blurred by 31 px", blurred),
            (10, "behind a hand", covered),
        ):
            spoilt = _while(range(first, first + count), spoil)
            cases[f"{source}, {count} {name}"] = Case(source=source, spoil=spoilt)
    return cases


def _moving() -> dict[str, Case]:
    return {
        f"{source}, {share:.0%} moves by itself from frame {first} on": Case(
            source=source, spoil=_while(range(first, count), partial(thing, share)), frames=count
        )
        for source, count in (("tsukuba150", 150), ("7scenes_redkitchen400", 200))
        for share in (0.4, 0.55)
        for first in (0, 60)
    }


def _few() -> dict[str, Case]:
    steps = {"7scenes_redkitchen400": (1, 3, 6), "tum_fr1_xyz": (1, 3, 6)}
    steps |= {"kitti_00_small1018": (1, 2)}
    counts = {"7scenes_redkitchen400": 200, "tum_fr1_xyz": 798, "kitti_00_small1018": 400}
    cases: dict[str, Case] = {}
    for source, all_steps in steps.items():
        count = counts[source]
        for every in all_steps:
            name = f"one of {every} of {count}" if every > 1 else f"{count} frames"
            cases[f"{source}, {name}"] = Case(source=source, every=every, frames=count)
    return cases


def _light() -> dict[str, Case]:
    light: dict[str, Spoil] = {
        "gain 0.7, then 0.5": partial(gain, 0.0),
        "gain 0.7, then 0.5, and 30 % flicker": partial(gain, 0.3),
        "a quarter of the contrast": pale,
    }
    return {
        f"tsukuba150, {name}": Case(source="tsukuba150", spoil=spoil)
        for name, spoil in light.items()
    }


def _turned() -> dict[str, Case]:
    xyz = "tum_fr1_xyz"
    cases = {f"{xyz}, 300 frames": Case(source=xyz, frames=300)}
    cases[f"{xyz}, 300 frames, upright"] = Case(source=xyz, frames=300, upright=True)
    turns = {axis: f"built-in:room?turn={axis}" for axis in ("yaw", "pitch", "roll")}
    turns["pitch, 320 columns"] = f"{turns['pitch']}&width=320"
    return cases | {f"room, a full turn ({axis})": Case(source=s) for axis, s in turns.items()}


CASES = _cases()


def measure(folder: Path, config: Config, only: list[str]) -> Iterator[str]:
    """A row for each case whose name has one of the words.   folder: of the sequences."""
    yield markdown_header(_HEADER)
    for name, case in CASES.items():
        if only and not any(word in name for word in only):
            continue
        built_in = case.source.startswith(BUILTIN_PREFIX)
        source = open_source(case.source if built_in else str(folder / case.source))
        yield markdown_row((name, *report_row(cast(Dataset, RoughFrames(source, case)), config)))


def follow(frames: Dataset, config: Config) -> Run:
    """What a recording of a run would say of its map."""
    run = Run(stream=_stream(frames))
    pipeline = Pipeline(frames.calibration, config, run.history)
    for source in frames:
        found = pipeline.take(source)
        run.tracks[source.index] = len(found.tracks.ids)
        run.inliers[source.index] = found.delta.inliers
        run.take_calibration(found.delta)
    run.take_calibration(pipeline.finish())
    return run


def report_row(frames: Dataset, config: Config) -> tuple[str, ...]:
    run = follow(frames, config)
    history, count = run.history, len(run.tracks)
    final = history.final()
    report = rigid_report(run, final)
    assert frames.ground_truth_path is not None
    truth = read_trajectory(frames.ground_truth_path)
    longest, ates = history.longest_segment(), list[str]()
    shares = list[float | None]()
    poses: dict[int, tuple[int, F64]]
    for poses in (final, history.online):
        found = evaluate_trajectory(history.trajectory_in(longest, poses), truth)
        ates.append("-" if found.ate_m is None else metres(found.ate_m.rmse))
        shares.append(found.ate_percent_of_path)
    posed = sum(segment == longest for segment, _ in final.values())
    share = "-" if shares[0] is None else f"{shares[0]:.3f} %"
    doubtful = len(report["doubtful_frames"]) / max(len(final), 1)
    return (
        f"{posed} of {count}", str(len(report["segments"])), ates[0], share, ates[1],
        f"{doubtful:.0%}", f"{report['verdict']}: {report['verdict_reason']}",
    )  # fmt: skip


def _stream(frames: Dataset) -> CameraStream:
    camera = Rectifier(frames.calibration).camera
    return CameraStream(
        frame=0, stamp_ns=0, frame_id="camera", source=frames.name, mode="lossless",
        frames=frames.frame_count or 0, calibration=calibration_yaml(frames.calibration),
        width=camera.width, height=camera.height, fx=camera.fx, fy=camera.fy, cx=camera.cx,
        cy=camera.cy, focal_sigma=frames.calibration.focal_sigma,
    )  # fmt: skip

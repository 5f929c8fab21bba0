"""Focal lengths that change during a clip: is the map right, and does the verdict say so?

Sequences with ground truth, magnified image by image about their principal point: focus breathing,
a slow zoom, a fast one, and stabilisation, whose crop moves against the camera's rotation.
"""

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import cast

import cv2
import numpy as np

from benchmarks.rough import Case, RoughFrames, report_row
from benchmarks.table import markdown_header, markdown_row
from pliant.algorithms.arrays import F64, U8
from pliant.algorithms.geometry import pose_to_matrix, so3_log
from pliant.config import Config
from pliant.datasets import open_source
from pliant.datasets.base import BUILTIN_PREFIX, Dataset
from pliant.datasets.calibration import Calibration
from pliant.formats.trajectory_files import read_trajectory

_HEADER = (
    *("case", "frames posed", "segments", "ATE, final", "of the path", "ATE, online"),
    *("doubtful poses", "verdict"),
)
_FPS = 30.0
_CROP = 1.1
"""Magnification of electronic stabilisation: what is cut off is the room in which it moves."""

SOURCES = {
    "built-in:room": 300,
    "built-in:corridor": 300,
    "built-in:tabletop": 300,
    "tsukuba150": 150,
    "tum_fr1_xyz": 400,
    "7scenes_redkitchen400": 200,
}
"""Frames of each."""

Magnification = Callable[[int, int], float]
"""Of a frame, by its number and how many there are."""


def constant(_: int, __: int) -> float:
    """The control: no change."""
    return 1.0


def breathing(by: float, number: int, _: int) -> float:
    """A focus that hunts within a share, once in four seconds."""
    return 1.0 + by * (0.5 + 0.5 * float(np.sin(2.0 * np.pi * number / (4.0 * _FPS))))


def slow_zoom(by: float, number: int, count: int) -> float:
    """From the first frame to the last."""
    return by ** (number / (count - 1))


def fast_zoom(number: int, count: int) -> float:
    """By 1.3 within the second in the middle."""
    return 1.3 ** float(np.clip((number - 0.5 * count) / _FPS + 0.5, 0.0, 1.0))


MAGNIFICATIONS: dict[str, Magnification] = {
    "constant": constant,
    "breathing 3 %": partial(breathing, 0.03),
    "breathing 2 %": partial(breathing, 0.02),
    "slow zoom 1.3": partial(slow_zoom, 1.3),
    "slow zoom 1.02": partial(slow_zoom, 1.02),
    "zoom 1.3 in 1 s": fast_zoom,
}


def magnified(
    magnification: Magnification, count: int, camera: Calibration, number: int, pixels: U8
) -> U8:
    """A frame about the principal point: the same lens with another focal length."""
    factor = magnification(number, count)
    return pixels if factor == 1.0 else _moved(pixels, camera, factor, np.zeros(3))


def stabilised(shakes: F64, camera: Calibration, number: int, pixels: U8) -> U8:
    """Cropped, shifted and rolled against the shaking (count, 3) of the camera."""
    return _moved(pixels, camera, _CROP, shakes[min(number, len(shakes) - 1)])


def _moved(pixels: U8, camera: Calibration, factor: float, turn: F64) -> U8:
    """turn: (3,) rotation vector of the camera that shift and roll of the crop undo."""
    height, width = pixels.shape[:2]
    room = 0.5 * (factor - 1.0) / factor
    shift = np.clip(camera.fx * turn[[1, 0]] * (1.0, -1.0), -room * width, room * width)
    cos, sin = factor * np.cos(turn[2]), factor * np.sin(turn[2])
    A = np.array([[cos, -sin], [sin, cos]])
    c = np.array([camera.cx, camera.cy])
    M = np.column_stack([A, c + factor * shift - A @ c])
    moved = cv2.warpAffine(
        pixels, M, (width, height), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
    )
    return np.asarray(moved, np.uint8)


def shaking(truth: Path, stamps_ns: list[int]) -> F64:
    """(count, 3) rotation of each frame against the mean of the second about it."""
    trajectory = read_trajectory(truth)
    nearest = np.abs(trajectory.stamps_ns[:, None] - np.array(stamps_ns)).argmin(axis=0)
    R = np.array([pose_to_matrix(pose)[:3, :3] for pose in trajectory.poses[nearest]])
    half, shakes = round(0.5 * _FPS), np.zeros((len(R), 3))
    for n in range(len(R)):
        near = R[max(n - half, 0) : n + half + 1]
        shakes[n] = -so3_log(np.swapaxes(R[n], 0, 1) @ near).mean(axis=0)
    return shakes


def cases(folder: Path, only: list[str]) -> Iterator[tuple[str, Dataset]]:
    """Those whose name has one of the words.   folder: of the sequences."""
    for name, frames in SOURCES.items():
        wanted = [
            how
            for how in (*MAGNIFICATIONS, "stabilised")
            if not only or any(word in f"{name}, {how}" for word in only)
        ]
        if not wanted:
            continue
        built_in = name.startswith(BUILTIN_PREFIX)
        source = open_source(name if built_in else str(folder / name))
        count = min(frames, source.frame_count or frames)
        camera = source.calibration
        for how in wanted:
            if how == "stabilised":
                assert source.ground_truth_path is not None
                stamps = [frame.stamp_ns for frame, _ in zip(source, range(count), strict=False)]
                spoil = partial(stabilised, shaking(source.ground_truth_path, stamps), camera)
            else:
                spoil = partial(magnified, MAGNIFICATIONS[how], count, camera)
            case = Case(source=name, spoil=spoil, frames=count)
            yield f"{name}, {how}", cast(Dataset, RoughFrames(source, case))


def measure(folder: Path, config: Config, only: list[str]) -> Iterator[str]:
    """A row for each case whose name has one of the words.   folder: of the sequences."""
    yield markdown_header(_HEADER)
    for name, frames in cases(folder, only):
        yield markdown_row((name, *report_row(frames, config)))

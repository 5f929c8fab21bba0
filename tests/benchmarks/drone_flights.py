"""EuRoC's motions through rendered scenes: is a flight ever lost, and how accurate is it?

The motions of real flights, with the blur and the exposure that they bring at 20 images a second
and a wide lens; the images are rendered, so that the truth is exact and nothing is to be fetched.
"""

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from benchmarks.drone_scenes import drone_scene
from benchmarks.in_process import process
from benchmarks.painting import paint_faces
from benchmarks.table import markdown_header, markdown_row
from pliant.algorithms.arrays import F64
from pliant.config import load_config
from pliant.datasets.base import SourceFrame
from pliant.datasets.calibration import Calibration
from pliant.errors import PliantError
from pliant.evaluation.presentation import metres
from pliant.evaluation.run_evaluation import evaluate_trajectory
from pliant.formats.trajectory_files import read_trajectory
from pliant.map_history import MapHistory
from pliant.rendering.face_textures import FaceTexture
from pliant.rendering.paths import SampledPath
from pliant.rendering.render import CameraOptions, Renderer, SceneGeometry

_THREADS = 2
_AT_A_TIME = 16

CAMERA = CameraOptions(width=752, height=480, focal=390.0, fps=20.0, blur=0.3)
"""EuRoC's left camera after rectification; 15 ms of exposure."""


class Flight:
    """A source of frames that are rendered as they are asked for: ``pliant.datasets.base``."""

    is_live = False

    def __init__(self, name: str, truth: Path, renderer: Renderer, stamps_ns: Sequence[int]):
        self.name = name
        self.ground_truth_path: Path | None = truth
        self.frame_count = len(stamps_ns)
        pinhole = CAMERA.pinhole()
        self.calibration = Calibration(
            model="pinhole", width=pinhole.width, height=pinhole.height, fx=pinhole.fx,
            fy=pinhole.fy, cx=pinhole.cx, cy=pinhole.cy,
        )  # fmt: skip
        self._renderer = renderer
        self._stamps_ns = stamps_ns

    def __iter__(self) -> Iterator[SourceFrame]:
        with ThreadPoolExecutor(_THREADS) as threads:
            for first in range(0, self.frame_count, _AT_A_TIME):
                last = min(first + _AT_A_TIME, self.frame_count)
                yield from threads.map(self._frame, range(first, last))

    def _frame(self, number: int) -> SourceFrame:
        stamp = self._stamps_ns[number]
        image = self._renderer.frame(number, (stamp - self._stamps_ns[0]) * 1e-9).image
        return SourceFrame(
            index=number, stamp_ns=stamp, encoding="mono8", data=image.tobytes(),
            width=image.shape[1], height=image.shape[0],
        )  # fmt: skip


def flights(folder: Path, only: Sequence[str] = (), frames: int | None = None) -> Iterator[Flight]:
    """One for each motion of a folder (TUM files); those of one place fly through one scene.

    The first two letters of a file's name are its place.   Raises PliantError without any.
    """
    files = [file for file in sorted(folder.glob("*.txt")) if not only or file.stem in only]
    if not files:
        raise PliantError(f"{folder}: no such motions: it needs a TUM file for each flight")
    scenes: dict[str, tuple[SceneGeometry, list[FaceTexture]]] = {}
    for file in files:
        place, truth = file.stem[:2], read_trajectory(file)
        if place not in scenes:
            scenes[place] = _scene_of(place, folder)
        times: F64 = (truth.stamps_ns - truth.stamps_ns[0]) * 1e-9
        renderer = Renderer(*scenes[place], SampledPath(times, truth.poses), CAMERA)
        yield Flight(file.stem, file, renderer, truth.stamps_ns[:frames].tolist())


def _scene_of(place: str, folder: Path) -> tuple[SceneGeometry, list[FaceTexture]]:
    """Geometry and textures: about all flights of the place, whichever are flown."""
    files = sorted(folder.glob(f"{place}*.txt"))
    flown = np.concatenate([read_trajectory(file).positions for file in files])
    geometry = SceneGeometry(drone_scene(place, flown))
    return geometry, paint_faces(geometry)


def measure(
    folder: Path, *, only: Sequence[str], frames: int | None, overrides: Sequence[str]
) -> Iterator[str]:
    """One row a flight: ATE, and the share of its frames in the longest segment."""
    header = ("flight", "frames", "ATE, final", "ATE, online", "of the path", "posed", "segments")
    yield markdown_header(header)
    errors: list[float] = []
    for flight in flights(folder, only, frames):
        row, error = _fly(flight, overrides)
        errors += [] if error is None else [error]
        yield markdown_row(row)
    if errors:
        yield f"mean {metres(float(np.mean(errors)))}, worst {metres(max(errors))}"


def _fly(flight: Flight, overrides: Sequence[str]) -> tuple[list[str], float | None]:
    history = MapHistory()
    for _ in process(flight, load_config(None, overrides), history):
        pass
    assert flight.ground_truth_path is not None
    truth = read_trajectory(flight.ground_truth_path)
    longest = history.longest_segment()
    segments = {pose[0] for pose in history.final().values()}
    cells: list[str] = []
    found = []
    for poses in (history.final(), history.online):
        chosen = {frame: pose for frame, pose in poses.items() if pose[0] == longest}
        found.append(evaluate_trajectory(history.trajectory(chosen), truth))
        ate = found[-1].ate_m
        cells.append("fails" if ate is None else metres(ate.rmse))
    final = found[0]
    share = final.ate_percent_of_path
    row = [
        flight.name,
        str(flight.frame_count),
        *cells,
        "-" if share is None else f"{share:.3f} %",
        f"{100.0 * final.localised / flight.frame_count:.1f} %",
        str(len(segments)),
    ]
    return row, None if final.ate_m is None else final.ate_m.rmse

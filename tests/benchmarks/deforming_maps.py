"""The final map of scenes that deform against exact ground truth, and why others have none."""

import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from benchmarks.table import markdown
from pliant.algorithms.arrays import F64, I64
from pliant.algorithms.deformable.deforming_window import DeformingWindow
from pliant.algorithms.deformable.moving_landmarks import WindowMap
from pliant.algorithms.geometry import inverse, pose_to_matrix, transform
from pliant.algorithms.map_delta import TRACKING
from pliant.algorithms.slam.calibration.corrected_view import corrected_view
from pliant.config import load_config
from pliant.datasets import open_source
from pliant.datasets.builtin import builtin_folder
from pliant.datasets.builtin_deforming import SURFACES_NAME
from pliant.datasets.rectifier import Rectifier
from pliant.evaluation.deforming_map_truth import DeformingMapErrors, judge_deforming_map
from pliant.evaluation.surface_truth import SurfaceTruth
from pliant.evaluation.surfel_truth import rmse
from pliant.map_history import MapHistory
from pliant.offline import Pipeline
from pliant.results.deforming_map import adjust_and_write

_SOURCES = (
    *(
        f"built-in:breathing?seconds=8&{options}"
        for options in (
            "amplitude=0&travel=0.25",
            "amplitude=0.01&travel=0.25",
            "amplitude=0.03&travel=0.25",
            "amplitude=0.03",
            "amplitude=0.08&travel=0.25",
            "amplitude=0.03&travel=0.25&tool=1&gloss=1",
        )
    ),
    *("built-in:sliding", "built-in:stretching", "built-in:objects"),
    *("built-in:room", "built-in:tabletop", "built-in:corridor"),
)
_HEADER = (
    *("sequence", "landmarks", "RMSE %", "median %", "at rest %", "in camera %", "camera %"),
    *("covered", "mesh, median %"),
)


_WINDOWS = ("sequence", "windows", "trusted", "shape %", "units %", "camera %", "ms each")


def measure_maps(sources: Sequence[str]) -> Iterator[str]:
    """Row by row; the maps are made by the rigid pipeline in this process."""
    yield "\nfinal map, all frames"
    yield markdown(_HEADER, [])
    windows: list[list[str]] = []
    for source in sources or _SOURCES:
        found, row = _judged(source)
        cells = [found] if isinstance(found, str) else _cells(found)
        windows.append([_short(source), *row])
        yield "| " + " | ".join([_short(source), *cells]) + " |"
    yield "\nwhile it runs: the map of the last 3 s, once a second"
    yield markdown(_WINDOWS, windows)


def _judged(source: str) -> tuple[DeformingMapErrors | str, list[str]]:
    """Errors, or why there are none; and a row of the windows."""
    dataset, history = open_source(source), MapHistory()
    pipeline = Pipeline(dataset.calibration, load_config(), history)
    camera = Rectifier(dataset.calibration).camera
    tracks: list[tuple[int, I64, F64]] = []
    window, windows, spent_s = DeformingWindow(), list[WindowMap](), 0.0
    for frame in dataset:
        mapped = pipeline.take(frame)
        found = mapped.tracks
        tracks.append((frame.index, found.ids, found.points_px.astype(np.float64)))
        if mapped.delta.state != TRACKING:
            continue
        view = corrected_view(camera, ())
        here = window.follow(found.ids, found.points_px, view)
        if window.take(frame.index, frame.stamp_ns, found.ids, found.points_px, here):
            poses = {
                n: pose_to_matrix(pose[None])[0]
                for n, (segment, pose) in history.final().items()
                if segment == mapped.delta.segment
            }
            begun_s = time.process_time()
            windows.append(window.adjust(poses, view))
            spent_s += time.process_time() - begun_s
    pipeline.finish()
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "deforming_map.npz"
        problem = adjust_and_write(file, history, camera, tracks)
        problem = problem and f"none: {problem}"
        trusted = [each for each in windows if len(each.frames)]
        row = [str(len(windows)), str(len(trusted))]
        cost = f"{1e3 * spent_s / max(len(windows), 1):.0f}"
        if not (builtin_folder(source) / SURFACES_NAME).is_file():
            return problem or "has one; its exact surface is unknown", [*row, "", "", "", cost]
        truth = SurfaceTruth(builtin_folder(source), camera)
        row += [*(_window_cells(trusted, truth) if trusted else ["", "", ""]), cost]
        return problem or judge_deforming_map(file, truth), row


def _window_cells(windows: Sequence[WindowMap], truth: SurfaceTruth) -> list[str]:
    """RMSE of the landmarks in view in the camera's frame, each window in its own unit; standard
    deviation of these units; RMSE of the motion of the camera over a window, by the depth."""
    units, shapes, cameras = list[float](), list[float](), list[float]()
    for found in windows:
        rows, frame = found.in_view, int(found.frames[-1])
        points = truth.at_pixels(frame, found.points_px[rows].astype(np.float64))
        T_true = truth.T_world_camera[found.frames[[0, -1]]]
        exact = transform(inverse(T_true[1]), truth.positions(points, frame))
        T = found.T_world_camera
        there = transform(inverse(T[-1]), (found.rest + found.moved()[-1])[rows])
        known = np.isfinite(exact).all(axis=1)
        exact, there = exact[known], there[known]
        unit = float(np.median(exact[:, 2] / there[:, 2]))
        shapes.append(rmse((unit * there - exact) / exact[:, 2:]))
        motion = unit * (inverse(T[0]) @ T[-1])[:3, 3] - (inverse(T_true[0]) @ T_true[1])[:3, 3]
        cameras.append(float(np.linalg.norm(motion)) / float(exact[:, 2].mean()))
        units.append(unit)
    figures = (
        rmse(np.array(shapes)[:, None]),
        np.std(units) / np.mean(units),
        rmse(np.array(cameras)[:, None]),
    )
    return [f"{100.0 * figure:.2f}" for figure in figures]


def _cells(errors: DeformingMapErrors) -> list[str]:
    shares = (errors.whole, errors.median, errors.rest, errors.in_camera, errors.camera)
    return [
        str(errors.landmarks),
        *(f"{100.0 * share:.2f}" for share in shares),
        f"{errors.covered:.1%}",
        f"{100.0 * errors.surface:.2f}",
    ]


def _short(source: str) -> str:
    name, _, query = source.removeprefix("built-in:").partition("?")
    return " ".join([name, *(item for item in query.split("&") if item != "seconds=8")])

"""The final map of scenes that deform against exact ground truth, and why others have none."""

import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from benchmarks.table import markdown
from pliant.algorithms.arrays import F64, I64
from pliant.config import load_config
from pliant.datasets import open_source
from pliant.datasets.builtin import builtin_folder
from pliant.datasets.rectifier import Rectifier
from pliant.evaluation.deforming_map_truth import DeformingMapErrors, judge_deforming_map
from pliant.evaluation.surface_truth import SurfaceTruth
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


def measure_maps(sources: Sequence[str]) -> Iterator[str]:
    """Row by row; the map is made by the rigid pipeline in this process."""
    yield "\nfinal map, all frames"
    yield markdown(_HEADER, [])
    for source in sources or _SOURCES:
        found = _judged(source)
        cells = ["none", found] if isinstance(found, str) else _cells(found)
        yield "| " + " | ".join([_short(source), *cells]) + " |"


def _judged(source: str) -> DeformingMapErrors | str:
    """Errors, or why there is no map."""
    dataset, history = open_source(source), MapHistory()
    pipeline = Pipeline(dataset.calibration, load_config(), history)
    tracks: list[tuple[int, I64, F64]] = []
    for frame in dataset:
        found = pipeline.take(frame).tracks
        tracks.append((frame.index, found.ids, found.points_px.astype(np.float64)))
    pipeline.finish()
    camera = Rectifier(dataset.calibration).camera
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "deforming_map.npz"
        problem = adjust_and_write(file, history, camera, tracks)
        if problem:
            return problem
        return judge_deforming_map(file, SurfaceTruth(builtin_folder(source), camera))


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

"""Behind ``pliant eval --surfels``: a recording of surfels against ground truth of its source.

A deforming built-in sequence has exact ground truth; any other source the true depth of its frames.
"""

from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from pliant.datasets import open_source
from pliant.datasets.base import BrokenFrame, is_builtin
from pliant.datasets.builtin import builtin_folder
from pliant.datasets.builtin_deforming import SURFACES_NAME
from pliant.datasets.depth import DepthRectifier
from pliant.datasets.rectifier import Rectifier
from pliant.datasets.source_spec import SourceSpec
from pliant.errors import ResultError
from pliant.evaluation.deforming_map_truth import format_deforming_map, judge_deforming_map
from pliant.evaluation.exact_surfels import ExactSurfels, format_exact
from pliant.evaluation.later_surfels import LaterSurfels, format_later, scaled, true_scale
from pliant.evaluation.surface_truth import SurfaceTruth
from pliant.evaluation.surfel_truth import SurfelTruth, format_surfels, mean_rows
from pliant.recording.reader import Recording
from pliant.results.folder import DEFORMING_MAP_NAME, RECORDING_NAME
from pliant.results.surfels import is_metric, recorded_surfels


def surfels_against_truth(result: Path, source: str, figures: dict[str, Any]) -> Iterator[str]:
    """Errors, frame by frame.  ``source``: what the run was made of, with depth for every frame.

    Raises ResultError and DatasetError.
    """
    folder = builtin_folder(source) if is_builtin(source) else Path(source)
    if (folder / SURFACES_NAME).is_file():
        yield _against_surfaces(result, folder, figures)
        return
    dataset = open_source(SourceSpec(location=source, depth="all"))
    rectifier, depths = Rectifier(dataset.calibration), DepthRectifier(dataset.calibration)
    truth = SurfelTruth(rectifier.camera)
    for surfels, frame in zip(
        recorded_surfels(result / RECORDING_NAME), dataset, strict=False
    ):  # a run that was stopped is judged as far as it came
        if surfels.missing or not frame.depth:
            continue
        try:
            grey, _ = rectifier.rectify(frame)
            depth_m = depths.rectify(frame.index, frame.depth)
        except BrokenFrame:
            continue
        truth.add(surfels.frame, surfels, grey, depth_m)
    if not truth.rows:
        raise ResultError(_nothing(result))
    figures["surfels"] = {
        "frames": [asdict(row) for row in truth.rows],
        "mean": mean_rows(truth.rows),
    }
    yield format_surfels(truth.rows)


def _against_surfaces(result: Path, folder: Path, figures: dict[str, Any]) -> str:
    dataset = open_source(str(folder))
    truth = SurfaceTruth(folder, Rectifier(dataset.calibration).camera)
    judge, later = ExactSurfels(truth), LaterSurfels(truth)
    # Where the scale is arbitrary, that of the first surfels is given, once for the whole run.
    scale = 1.0 if is_metric(Recording(result / RECORDING_NAME).metadata()) else None
    for surfels in recorded_surfels(result / RECORDING_NAME):
        if surfels.frame >= len(truth):
            raise ResultError(
                f"{result}: has more frames than {folder}: pass the sequence of this run"
            )
        if surfels.missing or (scale is None and not len(surfels.ids)):
            continue
        scale = scale or true_scale(surfels.frame, surfels, truth)
        judge.add(surfels.frame, scaled(surfels, scale))
        later.add(surfels.frame, scaled(surfels, scale))
    if not judge.rows:
        raise ResultError(_nothing(result))
    false, true, _ = judge.curve()
    kept = np.unique(np.linspace(0, len(false) - 1, 200).astype(int)) if len(false) else []
    figures["surfels"] = {
        "frames": [asdict(row) for row in judge.rows],
        "summary": judge.summary(),
        "scale": scale,
        "later": later.summary(),
        "sheets": {name: {"count": n, "rmse": e} for name, (n, e) in judge.by_sheet().items()},
        "sizes_mm": [{"from": a, "to": b, "rmse": e} for a, b, e in judge.by_size()],
        "roc": {"false_positive": false[kept].tolist(), "true_positive": true[kept].tolist()},
    }
    text = format_exact(judge, moving_camera=truth.moving_camera)
    if later.summary()["births"]:
        text += "\n" + format_later(later)
    if (result / DEFORMING_MAP_NAME).is_file():
        errors = judge_deforming_map(result / DEFORMING_MAP_NAME, truth)
        figures["final_map"] = asdict(errors)
        text += "\n" + format_deforming_map(errors)
    return text


def _nothing(result: Path) -> str:
    return f"{result}: has no surfels: run it with --profile deformable"

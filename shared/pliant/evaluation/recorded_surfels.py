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
from pliant.messages.types import Surfels
from pliant.recording.reader import Recording
from pliant.results.folder import DEFORMING_MAP_NAME, RECORDING_NAME
from pliant.results.surfel_frames import final_surfels, recorded_surfels
from pliant.results.surfels import is_metric


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
        final_surfels(result / RECORDING_NAME), dataset, strict=False
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
    recording = result / RECORDING_NAME
    # Where the scale is arbitrary, that of the first surfels is given, once for the whole run.
    scale = 1.0 if is_metric(Recording(recording).metadata()) else None
    figures["surfels"], text = _exact(result, final_surfels(recording), truth, scale)
    if (result / DEFORMING_MAP_NAME).is_file():
        errors = judge_deforming_map(result / DEFORMING_MAP_NAME, truth)
        figures["final_map"] = asdict(errors)
        figures["surfels_online"], online = _exact(
            result, recorded_surfels(recording), truth, scale
        )
        text = f"final\n{text}\n{format_deforming_map(errors)}\n\nonline\n{online}"
    return text


def _exact(
    result: Path, surfels: Iterator[Surfels], truth: SurfaceTruth, scale: float | None
) -> tuple[dict[str, Any], str]:
    """Figures and text.  scale: metres by a unit; None: that of the first surfels."""
    judge, later = ExactSurfels(truth), LaterSurfels(truth)
    for each in surfels:
        if each.frame >= len(truth):
            raise ResultError(
                f"{result}: has more frames than ground truth: pass the sequence of this run"
            )
        if each.missing or (scale is None and not len(each.ids)):
            continue
        scale = scale or true_scale(each.frame, each, truth)
        judge.add(each.frame, scaled(each, scale))
        later.add(each.frame, scaled(each, scale))
    if not judge.rows:
        raise ResultError(_nothing(result))
    false, true, _ = judge.curve()
    kept = np.unique(np.linspace(0, len(false) - 1, 200).astype(int)) if len(false) else []
    figures = {
        "frames": [asdict(row) for row in judge.rows],
        "summary": judge.summary(),
        "scale": scale,
        "later": later.summary(),
        "sheets": {name: {"count": n, "rmse": e} for name, (n, e) in judge.by_sheet().items()},
        "sizes_mm": [{"from": a, "to": b, "rmse": e} for a, b, e in judge.by_size()],
        "roc": {"false_positive": false[kept].tolist(), "true_positive": true[kept].tolist()},
    }
    text = format_exact(judge, moving_camera=truth.moving_camera)
    return figures, f"{text}\n{format_later(later)}" if later.summary()["births"] else text


def _nothing(result: Path) -> str:
    return f"{result}: has no surfels: run it with --profile deformable"

"""Behind ``pliant eval --surfels``: a recording of surfels against the true depth of its source."""

from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

from pliant.datasets import Rectifier, open_source
from pliant.datasets.base import BrokenFrame
from pliant.datasets.depth import DepthRectifier
from pliant.errors import ResultError
from pliant.evaluation.surfel_truth import SurfelTruth, format_surfels, mean_rows
from pliant_services.results import RECORDING_NAME
from pliant_services.surfel_results import recorded_surfels


def surfels_against_truth(result: Path, source: str, figures: dict[str, Any]) -> Iterator[str]:
    """Errors, frame by frame.  ``source``: what the run was made of, with depth for every frame.

    Raises ResultError and DatasetError.
    """
    dataset = open_source(source, depth="all")
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
        raise ResultError(f"{result}: has no surfels to judge; was it --profile deformable?")
    figures["surfels"] = {
        "frames": [asdict(row) for row in truth.rows],
        "mean": mean_rows(truth.rows),
    }
    yield format_surfels(truth.rows)

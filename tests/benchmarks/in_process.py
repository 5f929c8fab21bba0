"""The rigid pipeline in one process on several sources: ATE of the final and the causal poses."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.table import markdown_header, markdown_row
from pliant.config import load_config
from pliant.datasets import open_source
from pliant.errors import DatasetError
from pliant.evaluation.report import metres
from pliant.evaluation.result import TrajectoryEvaluation, evaluate_trajectory
from pliant.formats.trajectory_files import read_trajectory
from pliant.map_history import MapHistory
from pliant.offline import Pipeline

_HEADER = ("sequence", "seed", "ATE, final", "ATE, causal", "frames with a pose")


@dataclass(frozen=True)
class Run:
    """What a run came to: its longest segment against the true poses."""

    final: TrajectoryEvaluation
    causal: TrajectoryEvaluation
    median_inliers: float


def run(source: str, overrides: Sequence[str], focal: float = 1.0) -> Run:
    """Run a source that has true poses.  ``focal``: the given focal length is taken times this.

    Raises DatasetError where it has none.
    """
    config = load_config(None, overrides)
    dataset = open_source(source, part=config.ingest)
    if dataset.ground_truth_path is None:
        raise DatasetError(f"{source}: has no true poses to compare with")
    truth = read_trajectory(dataset.ground_truth_path)
    given, history = dataset.calibration, MapHistory()
    lens = replace(given, fx=focal * given.fx, fy=focal * given.fy)
    pipeline = Pipeline(lens, config, history)
    inliers = [pipeline.take(frame).delta.inliers for frame in dataset]
    pipeline.finish()
    longest = history.longest_segment()
    final, causal = (
        evaluate_trajectory(history.trajectory_in(longest, poses), truth, frames=len(inliers))
        for poses in (history.final(), history.causal)
    )
    return Run(final, causal, float(np.median(inliers)))


def measure(
    sources: Sequence[str], overrides: Sequence[str], seeds: Sequence[int], focal: float
) -> Iterator[str]:
    """A row for each source and seed."""
    yield markdown_header(_HEADER)
    for source in sources:
        for seed in seeds:
            found = run(source, [*overrides, f"seed={seed}"], focal)
            yield markdown_row(
                [
                    Path(source).name,
                    str(seed),
                    shown_ate(found.final),
                    shown_ate(found.causal),
                    f"{100.0 * (found.final.success_rate or 0.0):.1f} %",
                ]
            )


def shown_ate(evaluation: TrajectoryEvaluation) -> str:
    """The RMSE, or "fails" where nothing could be aligned."""
    return metres(evaluation.ate_m.rmse) if evaluation.ate_m else "fails"

"""Maps begun at many places of a sequence: how far off are they soon after?"""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from benchmarks.in_process import share_of, spread_of, true_poses
from benchmarks.table import markdown_header, markdown_row
from pliant.algorithms.map_delta import TRACKING
from pliant.config import Config, load_config
from pliant.datasets import open_source
from pliant.datasets.base import Dataset, SourceFrame
from pliant.evaluation.run_evaluation import evaluate_trajectory
from pliant.map_history import MapHistory
from pliant.offline import Pipeline
from pliant.trajectory import Trajectory

_HEADER = ("sequence", "maps", "final: median", "mean", "worst", "online: median", "mean", "worst")


def measure(
    sources: Sequence[str], overrides: Sequence[str], starts: int, following: int
) -> Iterator[str]:
    """A row for each source: errors as a share of the spread of the true positions.

    starts: at so many places, evenly over the source.   following: frames after the map's begin.
    """
    yield markdown_header(_HEADER)
    config = load_config(None, overrides)
    for source in sources:
        dataset = open_source(source, config.ingest)
        truth = true_poses(dataset)
        frames = list(dataset)
        firsts = np.linspace(0, len(frames), starts, endpoint=False).astype(int).tolist()
        found = [_errors(dataset, frames[first:], truth, config, following) for first in firsts]
        errors = np.array([each for each in found if each])
        maps = f"{len(errors)} of {starts}"
        yield markdown_row([Path(source).name, maps, *_shown(errors.reshape(-1, 2).T)])


def _errors(
    dataset: Dataset,
    frames: Sequence[SourceFrame],
    truth: Trajectory,
    config: Config,
    following: int,
) -> tuple[float, float] | None:
    """Final and online error of a map of the first frames; None where none begins."""
    history = MapHistory()
    pipeline = Pipeline(dataset.calibration, config, history)
    tracked = 0
    for source in frames:
        tracked += pipeline.take(source).delta.state == TRACKING
        if tracked > following:
            break
    pipeline.finish()
    if tracked <= following:
        return None  # what is over so soon tells of the end of the source
    longest = history.longest_segment()
    poses = (history.final(), history.online)
    found = [evaluate_trajectory(history.trajectory_in(longest, each), truth) for each in poses]
    times = history.trajectory_in(longest, poses[0]).stamps_ns
    among = (truth.stamps_ns >= times[0]) & (truth.stamps_ns <= times[-1])
    spread = spread_of(truth.select(np.flatnonzero(among)))
    return share_of(spread, found[0]), share_of(spread, found[1])


def _shown(errors: np.ndarray) -> Iterator[str]:
    for each in errors:
        for value in (np.median(each), each.mean(), each.max()) if len(each) else (np.nan,) * 3:
            yield f"{100.0 * value:.2f} %"

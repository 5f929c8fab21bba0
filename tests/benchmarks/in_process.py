"""The rigid pipeline in this process: ATE of the final and the online poses, and the estimates."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import numpy as np

from benchmarks.table import markdown_header, markdown_row
from pliant.config import Config, load_config
from pliant.datasets import Calibration, open_source
from pliant.datasets.base import Dataset
from pliant.errors import DatasetError
from pliant.evaluation.presentation import metres
from pliant.evaluation.run_evaluation import TrajectoryEvaluation, evaluate_trajectory
from pliant.formats.trajectory_files import read_trajectory
from pliant.map_history import MapHistory
from pliant.offline import MappedFrame, Pipeline
from pliant.trajectory import Trajectory

_HEADER = ("sequence", "seed", "ATE, final", "ATE, online", "frames with a pose")


@dataclass(frozen=True)
class Mapped:
    """What a run came to.

    final, online: its longest segment against the true poses.   share: of the frames with a pose in
    it.   tracks, inliers: medians over the frames.   correction, sigmas: of the calibration, as of
    ``MapDelta``; empty where nothing was told.
    """

    final: TrajectoryEvaluation
    online: TrajectoryEvaluation
    share: float
    tracks: float
    inliers: float
    correction: tuple[float, ...]
    sigmas: tuple[float, ...]

    @property
    def ate_m(self) -> float:
        """The final error; inf where there is none."""
        return self.final.ate_m.rmse if self.final.ate_m else np.inf

    @property
    def ate(self) -> str:
        """The final error, and the share of frames where some are missing."""
        missing = f" at {100.0 * self.share:.0f} %" if self.share < 0.99 else ""
        return shown_ate(self.final) + missing

    @property
    def both(self) -> str:
        """The final error, and the online one."""
        return f"{self.ate} / {shown_ate(self.online)}"


def run(
    dataset: Dataset,
    overrides: Sequence[str] = (),
    *,
    frames: int | None = None,
    calibration: Calibration | None = None,
) -> Mapped:
    """Map the first frames of a source; None: all.   calibration: instead of the source's own.

    Raises DatasetError where it has no true poses.
    """
    truth = true_poses(dataset)
    history = MapHistory()
    pipeline = Pipeline(calibration or dataset.calibration, load_config(None, overrides), history)
    counts: list[tuple[int, int]] = []
    delta = None
    for source in islice(dataset, frames):
        frame = pipeline.take(source)
        counts.append((len(frame.tracks.ids), frame.delta.inliers))
        delta = frame.delta
    ends = (delta, pipeline.finish())
    told = [each for each in ends if each and each.calibration_correction]
    tracks, inliers = np.median(counts, axis=0).tolist()
    longest, final = history.longest_segment(), history.final()
    return Mapped(
        final=evaluate_trajectory(history.trajectory_in(longest, final), truth, frames=len(counts)),
        online=evaluate_trajectory(history.trajectory_in(longest, history.online), truth),
        share=sum(segment == longest for segment, _ in final.values()) / len(counts),
        tracks=tracks,
        inliers=inliers,
        correction=tuple(told[-1].calibration_correction) if told else (),
        sigmas=tuple(told[-1].calibration_sigmas) if told else (),
    )


def process(dataset: Dataset, config: Config, history: MapHistory) -> Iterator[MappedFrame]:
    """Track and map every frame of a source; ``history`` is complete once the iterator ends."""
    pipeline = Pipeline(dataset.calibration, config, history)
    for source in dataset:
        yield pipeline.take(source)
    pipeline.finish()


def measure(
    sources: Sequence[str],
    overrides: Sequence[str],
    seeds: Sequence[int],
    focal: float,
    off_centre: float = 0.0,
    aspect: float = 1.0,
) -> Iterator[str]:
    """A row for each source and seed.   focal: the given focal length is multiplied by this.
    off_centre: added to the principal point, across, as a share of the focal length.   aspect: the
    given fx alone is multiplied by this, as of video that was resized to another shape."""
    yield markdown_header(_HEADER)
    for source in sources:
        dataset = open_source(source, load_config(None, overrides).ingest)
        given = dataset.calibration
        cx = given.cx + off_centre * given.fx
        lens = replace(given, fx=aspect * focal * given.fx, fy=focal * given.fy, cx=cx)
        for seed in seeds:
            found = run(dataset, [*overrides, f"seed={seed}"], calibration=lens)
            ates = shown_ate(found.final), shown_ate(found.online)
            share = f"{100.0 * found.share:.1f} %"
            yield markdown_row([Path(source).name, str(seed), *ates, share])


def true_poses(dataset: Dataset) -> Trajectory:
    """Those that came with a source.   Raises DatasetError where none did."""
    if dataset.ground_truth_path is None:
        raise DatasetError(f"{dataset.name}: has no true poses to compare with")
    return read_trajectory(Path(dataset.ground_truth_path))


def spread_of(truth: Trajectory) -> float:
    """RMS distance of the positions from their mean, in metres."""
    return float(np.linalg.norm(truth.positions.std(axis=0)))


def share_of(spread_m: float, evaluation: TrajectoryEvaluation) -> float:
    """The RMSE as a share of that; inf where nothing could be aligned."""
    return evaluation.ate_m.rmse / spread_m if evaluation.ate_m else np.inf


def shown_ate(evaluation: TrajectoryEvaluation) -> str:
    """The RMSE, or "fails" where nothing could be aligned."""
    return metres(evaluation.ate_m.rmse) if evaluation.ate_m else "fails"

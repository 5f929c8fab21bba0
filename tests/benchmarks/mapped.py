"""A source through the rigid pipeline in this process, and what it found of its lens."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from pliant.config import load_config
from pliant.datasets.base import Dataset
from pliant.evaluation.report import metres
from pliant.evaluation.result import evaluate_trajectory
from pliant.formats.trajectory_files import read_trajectory
from pliant.map_history import MapHistory
from pliant.offline import Pipeline


@dataclass(frozen=True)
class Mapped:
    """ate_m, causal_m: of the longest segment; the first is inf where it has less than 90 % of the
    frames.
    share: of the frames with a pose in it.   tracks, inliers: medians over the frames.
    correction, sigmas: of the calibration, as of ``MapDelta``.
    """

    ate_m: float
    causal_m: float
    share: float
    segments: int
    tracks: float
    inliers: float
    correction: tuple[float, ...]
    sigmas: tuple[float, ...]

    @property
    def ate(self) -> str:
        """The final error, and the share of frames where some are missing."""
        shown = metres(self.ate_m) if np.isfinite(self.ate_m) else "fails"
        return shown + (f" at {100.0 * self.share:.0f} %" if self.share < 0.99 else "")

    @property
    def both(self) -> str:
        """The final error, and the causal one."""
        return f"{self.ate} / {metres(self.causal_m) if np.isfinite(self.causal_m) else 'fails'}"


def run(dataset: Dataset, overrides: Sequence[str] = (), frames: int | None = None) -> Mapped:
    """Map the first frames of a source that has a truth; None: all."""
    config, history = load_config(None, list(overrides)), MapHistory()
    pipeline = Pipeline(dataset.calibration, config, history)
    counts: list[tuple[int, int]] = []
    delta = None
    for source in islice(dataset, frames):
        frame = pipeline.take(source)
        delta = frame.delta
        counts.append((len(frame.tracks.ids), delta.inliers))
    told = [each for each in (delta, pipeline.finish()) if each and each.calibration_correction]
    tracks, inliers = np.median(counts, axis=0).tolist()
    final = history.final()
    longest = history.longest_segment()
    assert dataset.ground_truth_path is not None
    truth = read_trajectory(Path(dataset.ground_truth_path))
    errors: list[float] = []
    share = 0.0
    for poses, of in ((history.causal, None), (final, len(counts))):
        chosen = {frame: pose for frame, pose in poses.items() if pose[0] == longest}
        share = len(chosen) / len(counts)
        mine = history.trajectory(chosen)
        found = evaluate_trajectory(mine, truth, frames=of) if chosen else None
        errors.append(found.ate_m.rmse if found and found.ate_m else np.inf)
    return Mapped(
        ate_m=errors[1],
        causal_m=errors[0],
        share=share,
        segments=len({segment for segment, _ in final.values()}),
        tracks=tracks,
        inliers=inliers,
        correction=tuple(told[-1].calibration_correction) if told else (),
        sigmas=tuple(told[-1].calibration_sigmas) if told else (),
    )

"""What a second pass finds: a source mapped as it is, and again where it was lost."""

import time
from collections.abc import Iterator, Sequence
from copy import deepcopy
from dataclasses import dataclass, field, replace
from pathlib import Path

from benchmarks.in_process import shown_ate, true_poses
from benchmarks.table import markdown_header, markdown_row
from pliant.algorithms.arrays import F64
from pliant.algorithms.slam.atlas.known_places import KnownPlaces
from pliant.algorithms.slam.map.kept_keyframe import KeptKeyframe
from pliant.backwards import lost_stretches, reach_back
from pliant.config import Config
from pliant.datasets import Calibration, open_source
from pliant.datasets.base import Dataset, SourceFrame
from pliant.datasets.source_spec import SourceSpec
from pliant.errors import DatasetError
from pliant.evaluation.run_evaluation import evaluate_trajectory
from pliant.map_history import MapHistory
from pliant.offline import Pipeline
from pliant.trajectory import Trajectory

_HEADER = (
    *("source", "pass", "frames with a pose", "segments", "in the largest", "ATE"),
    *("of the first's frames", "CPU"),
)


@dataclass
class Frames:
    """A source that is held in memory."""

    calibration: Calibration
    frames: list[SourceFrame]
    name: str = "frames"
    is_live: bool = False
    ground_truth_path: Path | None = None
    frame_count: int | None = field(init=False)

    def __post_init__(self) -> None:
        self.frame_count = len(self.frames)

    def __iter__(self) -> Iterator[SourceFrame]:
        yield from self.frames


@dataclass(frozen=True, kw_only=True)
class Pass:
    """What a pass came to.   poses: by frame, final."""

    history: MapHistory
    poses: dict[int, tuple[int, F64]]
    kept: list[KeptKeyframe]
    cpu_s: float

    @property
    def segments(self) -> int:
        """How many there are."""
        return len({segment for segment, _ in self.poses.values()})

    @property
    def largest(self) -> dict[int, tuple[int, F64]]:
        """Poses of the segment that has most of them."""
        longest = self.history.longest_segment()
        return {frame: pose for frame, pose in self.poses.items() if pose[0] == longest}


def run(dataset: Dataset, config: Config, places: KnownPlaces | None = None) -> Pass:
    """Map all of a source.   places: instead of those that a mapper has."""
    began, history = time.process_time(), MapHistory()
    pipeline = Pipeline(dataset.calibration, config, history, places=places)
    for source in dataset:
        pipeline.take(source)
    pipeline.finish()
    spent = time.process_time() - began
    return Pass(history=history, poses=history.final(), kept=pipeline.kept(), cpu_s=spent)


def run_again(dataset: Dataset, config: Config, first: Pass) -> Pass:
    """The second pass; the first where nothing is lost."""
    began = time.process_time()
    history = deepcopy(first.history)
    segments = {frame: segment for frame, (segment, _) in first.poses.items()}
    stretches = lost_stretches(segments, history.stamps_ns)
    if not stretches:
        return replace(first, cpu_s=0.0)
    reached = reach_back(dataset, config, first.kept, stretches, history)
    spent = time.process_time() - began
    return Pass(history=history, poses=history.final(), kept=reached.kept, cpu_s=spent)


def measure(
    sources: Sequence[str], config: Config, *, frames: int | None, calibration: Path | None
) -> Iterator[str]:
    """Two rows for each source.   frames: the first ones; None: all."""
    yield markdown_header(_HEADER)
    for name in sources:
        opened = open_source(SourceSpec(location=name, calibration=calibration), config.ingest)
        held = Frames(opened.calibration, list(opened)[:frames])
        try:
            truth = true_poses(opened)
        except DatasetError:
            truth = None
        first = run(held, config)
        both = {"first": first, "second": run_again(held, config, first)}
        for title, one in both.items():
            same = {f: pose for f, pose in one.largest.items() if f in first.largest}
            yield markdown_row(
                [
                    *(Path(name).name, title, f"{len(one.poses)} of {len(held.frames)}"),
                    *(str(one.segments), f"{len(one.largest) / len(held.frames):.1%}"),
                    *(_ate(one, poses, truth) for poses in (one.largest, same)),
                    f"{one.cpu_s:.0f} s",
                ]
            )


def _ate(one: Pass, poses: dict[int, tuple[int, F64]], truth: Trajectory | None) -> str:
    if truth is None:
        return "-"
    return shown_ate(evaluate_trajectory(one.history.trajectory(poses), truth))

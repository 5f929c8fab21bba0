"""Errors of a map before and after inertial samples have moved its keyframes, at the end of a run.

The map is made once, without samples.  Its last adjustment is then done without samples, and with
those of each sensor, so that nothing else differs.
"""

from collections.abc import Iterator, Sequence
from copy import deepcopy
from pathlib import Path

import numpy as np

from benchmarks.dark_turns import samples
from benchmarks.in_process import true_poses
from benchmarks.inertial import SENSORS, source_of
from benchmarks.table import markdown_header, markdown_row
from pliant.algorithms.inertial.samples import ImuSamples
from pliant.algorithms.slam.adjust.inertial_adjustment import CouplingOutcome
from pliant.config import load_config
from pliant.evaluation.presentation import metres
from pliant.evaluation.run_evaluation import evaluate_trajectory
from pliant.map_history import MapHistory
from pliant.offline import Pipeline
from pliant.trajectory import Trajectory


def measure(motions: Path | None, names: Sequence[str], frames: int, seeds: int) -> Iterator[str]:
    """A row for each source and seed, and the geometric mean of the changes by each sensor."""
    yield markdown_header(("motion", "s", "seed", "keyframes", "without", *SENSORS))
    changes: dict[str, list[float]] = {sensor: [] for sensor in SENSORS}
    for name in names:
        dataset = source_of(name, motions, frames)
        truth, frames_of = true_poses(dataset), list(dataset)
        for seed in range(seeds):
            config = load_config(None, [f"seed={seed}"])
            made = Pipeline(dataset.calibration, config, MapHistory())
            for source in frames_of:
                made.take(source)
            without, _ = _finished(made, truth, None)
            cells = list[str]()
            for sensor in SENSORS:
                ate_m, told = _finished(made, truth, samples(truth, sensor, seed))
                changes[sensor].append(ate_m / without)
                cells.append(f"{metres(ate_m)} ({ate_m / without - 1.0:+.1%}{told})")
            seconds = 1e-9 * (max(made.history.stamps_ns.values()) - int(truth.stamps_ns[0]))
            count = len(made.history.keyframes)
            about = name, f"{seconds:.0f}", str(seed), str(count), metres(without)
            yield markdown_row([*about, *cells])
    means = {sensor: np.exp(np.mean(np.log(each))) - 1.0 for sensor, each in changes.items()}
    shown = ", ".join(f"{sensor} {mean:+.1%}" for sensor, mean in means.items())
    yield f"geometric mean of the changes: {shown}"


def _finished(made: Pipeline, truth: Trajectory, given: ImuSamples | None) -> tuple[float, str]:
    """RMSE of the longest segment, and a note if the samples did not move its keyframes."""
    ended = deepcopy(made)
    if given is not None:
        ended.add_samples(given)
    ended.finish()
    history = ended.history
    found = history.trajectory_in(history.longest_segment(), history.final())
    ate = evaluate_trajectory(found, truth).ate_m
    outcome = CouplingOutcome(int(ended.counters.get("coupling_outcome", 0)))
    note = "" if outcome == CouplingOutcome.MOVED else f", {outcome.name}"
    return (np.inf if ate is None else ate.rmse), note

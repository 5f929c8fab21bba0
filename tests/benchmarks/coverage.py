"""Coverage of reported uncertainties: errors, divided by the standard deviations that are reported.

The focal length is found without a calibration; the scale, of a map with its calibration, by the
depth maps of the source.  Of calibrated uncertainties 95 % are below two.
"""

import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from benchmarks.in_process import run, true_poses
from benchmarks.table import markdown_header, markdown_row
from pliant.datasets import open_source
from pliant.datasets.base import Dataset
from pliant.datasets.calibration import calibration_from_fov
from pliant.datasets.source_spec import SourceSpec
from pliant.errors import DatasetError, PliantError
from pliant.evaluation.run_evaluation import evaluate_trajectory
from pliant.exit_codes import DONE, INCOMPLETE
from pliant.formats.trajectory_files import read_trajectory
from pliant.results.calibration import with_model_error
from pliant.results.known_scale import read_scale

_HEADER = ("sequence", "seed", "value", "error", "standard deviation", "error, times that")


def measure(sources: Sequence[str], seeds: Sequence[int], frames: int | None) -> Iterator[str]:
    """Rows for each source and seed, and how many lie within two standard deviations.

    frames: the first that a focal length is found from; None: all.
    """
    yield markdown_header(_HEADER)
    times: list[float] = []
    for name in sources:
        source = open_source(name)
        for seed in seeds:
            found = _focal(source, seed, frames), _scale(name, source, seed)
            for told, each in zip(("focal length", "scale"), found, strict=True):
                if each is None:
                    continue
                error, sigma = each
                times.append(abs(error) / sigma)
                cells = f"{100.0 * error:+.2f} %", f"{100.0 * sigma:.2f} %", f"{times[-1]:.1f}"
                yield markdown_row([Path(name).name, str(seed), told, *cells])
    yield f"\n{sum(each <= 2.0 for each in times)} of {len(times)} are below two"


def _focal(source: Dataset, seed: int, frames: int | None) -> tuple[float, float] | None:
    """Error and standard deviation of the logarithm; None where it was not found."""
    truth = source.calibration
    guess = calibration_from_fov(truth.width, truth.height, None)
    found = run(source, [f"seed={seed}"], frames=frames, calibration=guess)
    if not found.correction:
        return None
    error = float(np.log(guess.fx / truth.fx)) + found.correction[0]
    return error, with_model_error(found.sigmas[0])


def _scale(name: str, source: Dataset, seed: int) -> tuple[float, float] | None:
    """Error and standard deviation, as shares; None where the source has no depth maps."""
    try:
        open_source(SourceSpec(location=name, depth="first"))
    except DatasetError:
        return None
    with tempfile.TemporaryDirectory(prefix="pliant-coverage-") as made:
        folder = Path(made) / "result"
        _pliant("run", name, "--seed", str(seed), "--output", str(folder))
        _pliant("scale", str(folder), "--depth", name)
        told = read_scale(folder)
        assert told is not None
        estimate = read_trajectory(folder / "trajectory.txt")
    alignment = evaluate_trajectory(estimate, true_poses(source)).alignment
    return None if alignment is None else (-float(np.log(alignment.scale)), told.sigma)


def _pliant(*words: str) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "pliant_services.cli", *words], capture_output=True, text=True
    )
    if done.returncode not in (DONE, INCOMPLETE):
        raise PliantError(f"pliant {' '.join(words)}: {done.stderr.strip()}")

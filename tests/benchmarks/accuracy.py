"""The whole pipeline through its processes on several sources: accuracy, density and speed."""

import json
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from benchmarks.table import markdown
from pliant.datasets import open_source
from pliant.errors import PliantError
from pliant.evaluation.presentation import metres, summarise
from pliant.evaluation.run_evaluation import evaluate_result

_HEADER = (
    "sequence",
    "ATE, final",
    "of the path",
    "ATE, online",
    "frames with a pose",
    "tracks",
    "mapped inliers",
    "points",
    "well observed",
    "frames/s",
    "CPU ms/frame",
)


def measure(
    sources: Sequence[str], output: Path, *, seeds: int, overrides: Sequence[str]
) -> Iterator[str]:
    """Run each source with each seed; one row a source.  ``well observed``: see report.json."""
    rows = []
    for source in sources:
        truth = open_source(source).ground_truth_path
        folders = [output / f"{Path(source).name.replace(':', '-')}-{s}" for s in range(seeds)]
        for seed, folder in enumerate(folders):
            _run(source, folder, seed, overrides)
        reports = [json.loads((folder / "report.json").read_text()) for folder in folders]
        ate, share, online = "-", "-", "-"
        if truth is not None and reports[0]["segments"]:
            evaluations = [evaluate_result(folder, groundtruth=truth) for folder in folders]
            final, early = summarise(evaluations), summarise(evaluations, kind="online")
            ate, online = _spread(final.ate_m), _spread(early.ate_m)
            percent = evaluations[0].final.ate_percent_of_path
            share = "-" if percent is None else f"{percent:.3f} %"
        report = reports[0]
        rows.append(
            [
                Path(source).name,
                ate,
                share,
                online,
                f"{100.0 * report['success_rate']:.1f} %"
                + ("" if report["segments"] else f" ({report['last_reason']})"),
                f"{report['median_tracks_per_frame']:.0f}",
                f"{report['median_inliers_per_frame']:.0f}",
                f"{report['points']}",
                f"{report['points_well_observed']}",
                f"{report['frames_per_second']:.1f}",
                f"{_cpu_ms(report):.0f}",
            ]
        )
    yield markdown(_HEADER, rows)


def _cpu_ms(report: dict[str, Any]) -> float:
    """Of all processes but the recorder."""
    spent = report["cpu_milliseconds_per_frame"]
    return sum(each for service, each in spent.items() if service != "recorder")


def _spread(value) -> str:
    if value is None:
        return "-"
    return metres(value.mean) + (f" ± {metres(value.deviation)}" if value.runs > 1 else "")


def _run(source: str, folder: Path, seed: int, overrides: Sequence[str]) -> None:
    command = [sys.executable, "-m", "pliant_services.cli", "run", source, "--force"]
    command += ["--output", str(folder), "--seed", str(seed)]
    for override in overrides:
        command += ["--set", override]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode not in (0, 3):
        raise PliantError(f"{source}: {done.stderr.strip()}")

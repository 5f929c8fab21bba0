"""What ``--light`` and ``--localise`` save: CPU of each service, and the final ATE."""

import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

from benchmarks.table import markdown_header, markdown_row
from pliant.datasets import open_source
from pliant.errors import PliantError
from pliant.evaluation.presentation import metres
from pliant.evaluation.run_evaluation import evaluate_result

_SERVICES = ("ingest", "tracking", "bundle_adjustment", "meshing")
_HEADER = ("CPU ms per frame", *(name.replace("_", " ") for name in _SERVICES), "all", "ATE, final")


def measure(sources: Sequence[str]) -> Iterator[str]:
    """Four rows for each source: mapped, and localised in the map of the first, with all tracks and
    with a fifth of them.  ``all`` leaves out the recorder."""
    yield markdown_header(_HEADER)
    for source in sources:
        with tempfile.TemporaryDirectory(prefix="pliant-light-") as made:
            there = ["--map", f"{made}/mapped", "--localise"]
            yield _row(Path(source).name, source, Path(made, "mapped"), [])
            yield _row("`--light`", source, Path(made, "light"), ["--light"])
            yield _row("localised", source, Path(made, "localised"), there)
            yield _row("localised, `--light`", source, Path(made, "both"), [*there, "--light"])


def _row(label: str, source: str, output: Path, options: Sequence[str]) -> str:
    command = [sys.executable, "-m", "pliant_services.cli", "run", source, "--output", str(output)]
    done = subprocess.run([*command, *options], capture_output=True, text=True)
    if done.returncode not in (0, 3):
        raise PliantError(f"{source}: {done.stderr.strip()}")
    spent = json.loads((output / "report.json").read_text())["cpu_milliseconds_per_frame"]
    truth = open_source(source).ground_truth_path
    found = None if truth is None else evaluate_result(output, groundtruth=Path(truth)).final.ate_m
    every = sum(ms for name, ms in spent.items() if name != "recorder")
    cells = (f"{spent[name]:.1f}" if name in spent else "" for name in _SERVICES)
    return markdown_row([label, *cells, f"{every:.0f}", metres(found.rmse) if found else "-"])

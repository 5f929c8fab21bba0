"""Bundle adjustment against Ceres and scipy, as a table."""

import math
from collections.abc import Iterator
from pathlib import Path

from benchmarks.solvers import (
    compare_bundle_adjustment,
    plot_costs,
)
from benchmarks.table import markdown

_HEADER = (
    "problem",
    "method",
    "iterations",
    "ms to within 0.1 % of Ceres",
    "times faster than Ceres",
    "than its linear solver alone",
    "final / Ceres' cost",
)


def measure(folder: Path | None, plot: Path | None) -> Iterator[str]:
    """Compare on the synthetic windows and, with a folder, on the public problems in it."""
    rows, comparisons = compare_bundle_adjustment(folder)
    reference = {row.problem: row.final_cost for row in rows if row.method.startswith("Ceres")}
    yield markdown(
        _HEADER,
        (
            (
                f"{row.problem} ({row.cameras} x {row.points}, {row.observations} observations)",
                row.method,
                str(row.iterations_to_goal) if math.isfinite(row.seconds_to_goal) else "-",
                _number(1e3 * row.seconds_to_goal),
                _number(row.speedup),
                _number(row.speedup_of_solver_alone),
                f"{row.final_cost / reference.get(row.problem, math.nan):.4f}",
            )
            for row in rows
        ),
    )
    if plot is not None:
        plot_costs(comparisons, plot)
        yield f"cost over time: {plot}"


def _number(value: float) -> str:
    return f"{value:.1f}" if math.isfinite(value) else "never"

"""Evaluations as text, as JSON, and as mean and deviation over several runs."""

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pliant.errors import ResultError
from pliant.evaluation.criteria import ErrorStatistics, RelativeErrors
from pliant.evaluation.run_evaluation import Evaluation, TrajectoryEvaluation
from pliant.formats.text import write_bytes

ALIGNMENT = "Sim(3) aligned (the scale of a single camera is unknown)"


@dataclass(frozen=True, kw_only=True)
class MeanAndDeviation:
    """Mean and sample standard deviation (n - 1; 0 for one run) over the runs that have a value."""

    mean: float
    deviation: float
    runs: int

    @staticmethod
    def of(values: Sequence[float | None]) -> "MeanAndDeviation | None":
        """None if no run has a value."""
        known = [value for value in values if value is not None]
        if not known:
            return None
        deviation = float(np.std(known, ddof=1)) if len(known) > 1 else 0.0
        return MeanAndDeviation(mean=float(np.mean(known)), deviation=deviation, runs=len(known))


@dataclass(frozen=True, kw_only=True)
class Summary:
    """Several runs of one sequence, as in Table 1 of VITAMIN-E.

    ate_m and the relative errors are means over the successful runs only; failures: runs below
    90 % success, which have none.
    """

    kind: str
    runs: int
    failures: int
    success_rate: MeanAndDeviation | None
    ate_m: MeanAndDeviation | None
    rpe_frame_m: MeanAndDeviation | None
    rpe_frame_deg: MeanAndDeviation | None
    initialisation_retries: MeanAndDeviation | None


def summarise(evaluations: Sequence[Evaluation], *, kind: str = "final") -> Summary:
    """Mean and deviation of each criterion over runs.  kind: "final" or "online".

    Raises ResultError when there are no runs, or when one of them has no online trajectory.
    """
    if not evaluations:
        raise ResultError("no runs to summarise")
    parts: list[TrajectoryEvaluation] = []
    for evaluation in evaluations:
        part = evaluation.final if kind == "final" else evaluation.online
        if part is None:
            raise ResultError(f"{evaluation.result}: has no online trajectory")
        parts.append(part)

    def over(value: Callable[[TrajectoryEvaluation], float | None]) -> MeanAndDeviation | None:
        return MeanAndDeviation.of([value(part) for part in parts])

    return Summary(
        kind=kind,
        runs=len(parts),
        failures=sum(part.success is False for part in parts),
        success_rate=over(lambda part: part.success_rate),
        ate_m=over(lambda part: part.ate_m.rmse if part.ate_m else None),
        rpe_frame_m=over(
            lambda part: part.rpe_frame.translation_m.rmse if part.rpe_frame else None
        ),
        rpe_frame_deg=over(
            lambda part: part.rpe_frame.rotation_deg.rmse if part.rpe_frame else None
        ),
        initialisation_retries=MeanAndDeviation.of(
            [evaluation.initialisation_retries for evaluation in evaluations]
        ),
    )


def metres(value: float | None) -> str:
    """A length with four digits in the unit that suits it; "-" for None."""
    if value is None:
        return "-"
    for limit, factor, unit in ((1e-3, 1e6, "um"), (1e-2, 1e3, "mm"), (1.0, 1e2, "cm")):
        if abs(value) < limit:
            return f"{value * factor:.4g} {unit}"
    return f"{value:.4g} m"


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100.0 * share:.1f} %"


def _relative(errors: RelativeErrors | None) -> str:
    if errors is None:
        return "-"
    return f"{metres(errors.translation_m.rmse)}, {errors.rotation_deg.rmse:.3g} deg"


def _rows(part: TrajectoryEvaluation) -> list[str]:
    verdict = {True: "success", False: "failure", None: "frames of the sequence unknown"}
    percent = part.ate_percent_of_path
    localised = f"{part.localised} of {part.frames if part.frames is not None else '?'}"
    return [
        f"{_percent(part.success_rate)} ({localised} frames), {verdict[part.success]}",
        metres(part.ate_m.rmse if part.ate_m else None),
        metres(part.ate_m.median if part.ate_m else None),
        metres(part.ate_m.max if part.ate_m else None),
        "-" if percent is None else f"{percent:.3g} % of {metres(part.path_m)}",
        _relative(part.rpe_frame),
        _relative(part.rpe_second),
        str(part.matched),
        "-" if part.alignment is None else f"{part.alignment.scale:.6g}",
        str(part.segments) + (f" ({part.other_segments} poses left out)" * (part.segments > 1)),
    ]


_LABELS = (
    "localised",
    "ATE RMSE",
    "ATE median",
    "ATE max",
    "ATE of the path",
    "RPE, one frame",
    "RPE, one second",
    "poses compared",
    "scale",
    "map segments",
)


def table(rows: Sequence[Sequence[str]]) -> str:
    """Plain text columns: first row is the heading, columns two spaces apart."""
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    lines = [
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in rows
    ]
    lines.insert(1, "  ".join("-" * width for width in widths))
    return "\n".join(lines)


def format_evaluation(evaluation: Evaluation) -> str:
    """A table of one run, ready to print."""
    parts = [evaluation.final] + ([evaluation.online] if evaluation.online else [])
    columns = [_rows(part) for part in parts]
    rows = [[ALIGNMENT.split(" (")[0], *(part.kind for part in parts)]]
    rows += [[label, *cells] for label, *cells in zip(_LABELS, *columns, strict=True)]
    retries = evaluation.initialisation_retries
    lines = [
        f"{evaluation.result}",
        f"against {evaluation.groundtruth}",
        "",
        table(rows),
        "",
        f"initialisation retries: {'-' if retries is None else retries}",
    ]
    lines += [f"{part.kind}: no accuracy, {part.reason}" for part in parts if part.reason]
    final = evaluation.final
    if final.partly_compared:
        lines.append(
            f"warning: only {final.matched} of {final.localised} poses have a ground-truth pose: "
            f"check that {evaluation.groundtruth} belongs to this recording"
        )
    if final.unlike and final.ate_m:
        lines.append(
            f"warning: the error is as large as the motion (spread {metres(final.spread_m)}): "
            f"check that {evaluation.groundtruth} belongs to this recording"
        )
    return "\n".join(lines)


def format_summary(summary: Summary) -> str:
    """One line of means and deviations, as in Table 1 of the paper."""

    def cell(value: MeanAndDeviation | None, show: Callable[[float], str], suffix: str = "") -> str:
        return "-" if value is None else f"{show(value.mean)} ± {show(value.deviation)}{suffix}"

    rows = [
        ["over " + str(summary.runs) + " runs", summary.kind],
        ["failures", str(summary.failures)],
        ["localised", cell(summary.success_rate, lambda x: f"{100 * x:.1f}", " %")],
        ["ATE RMSE", cell(summary.ate_m, metres)],
        ["RPE, one frame", cell(summary.rpe_frame_m, metres)],
        ["", cell(summary.rpe_frame_deg, lambda x: f"{x:.3g}", " deg")],
        ["initialisation retries", cell(summary.initialisation_retries, lambda x: f"{x:.2g}")],
    ]
    return table(rows)


def _statistics(value: ErrorStatistics | None) -> dict[str, Any] | None:
    return None if value is None else dict(vars(value))


def _relative_json(value: RelativeErrors | None) -> dict[str, Any] | None:
    if value is None:
        return None
    return {
        "translation_m": _statistics(value.translation_m),
        "rotation_deg": _statistics(value.rotation_deg),
    }


def _trajectory_json(part: TrajectoryEvaluation | None) -> dict[str, Any] | None:
    if part is None:
        return None
    plain = (
        *("frames", "localised", "success_rate", "success", "matched", "segments"),
        *("other_segments", "reason", "path_m", "ate_percent_of_path"),
    )
    similarity = part.alignment
    return {
        **{name: getattr(part, name) for name in plain},
        "ate_m": _statistics(part.ate_m),
        "rpe_frame": _relative_json(part.rpe_frame),
        "rpe_second": _relative_json(part.rpe_second),
        "alignment": None
        if similarity is None
        else {
            "scale": similarity.scale,
            "R": similarity.R.tolist(),
            "t": similarity.t.tolist(),
        },
        "times_s": part.times_s.tolist(),
        "errors_m": part.errors_m.tolist(),
    }


def evaluation_to_json(evaluation: Evaluation) -> dict[str, Any]:
    """Plain values of one run: everything in the table, and the error over time."""
    return {
        "result": evaluation.result,
        "groundtruth": evaluation.groundtruth,
        "alignment": "Sim(3)",
        "offset_s": evaluation.offset_s,
        "better_offset": None if evaluation.better is None else asdict(evaluation.better),
        "initialisation_retries": evaluation.initialisation_retries,
        "final": _trajectory_json(evaluation.final),
        "online": _trajectory_json(evaluation.online),
    }


def summary_to_json(summary: Summary) -> dict[str, Any]:
    """Plain values of a summary."""
    return {
        name: dict(vars(value)) if isinstance(value, MeanAndDeviation) else value
        for name, value in vars(summary).items()
    }


def write_json(path: Path, data: dict[str, Any]) -> None:
    """Write with sorted keys, so that equal values give equal bytes."""
    text = json.dumps(data, indent=2, sort_keys=True, allow_nan=False)
    write_bytes(path, (text + "\n").encode())

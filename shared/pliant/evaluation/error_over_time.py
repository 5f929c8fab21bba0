"""The error over time (VITAMIN-E Fig. 4) as a section of report.html."""

from html import escape

from pliant.evaluation.presentation import metres
from pliant.evaluation.run_evaluation import Evaluation
from pliant.results.page.chart import BLUE, ORANGE, Line, chart


def error_over_time(evaluation: Evaluation) -> str:
    """HTML: the distance to the true position, final and online; "" where nothing was aligned."""
    parts = [part for part in (evaluation.final, evaluation.online) if part and len(part.errors_m)]
    if not parts:
        return ""
    colours = {"final": ("blue", BLUE), "online": ("orange", ORANGE)}
    last = max(float(part.times_s[-1]) for part in parts)
    largest = max(float(part.errors_m.max()) for part in parts)
    lines = [
        Line(part.times_s.tolist(), part.errors_m.tolist(), colours[part.kind][1]) for part in parts
    ]
    summary = "; ".join(
        f"{part.kind} ({colours[part.kind][0]}): "
        + (f"RMSE {metres(part.ate_m.rmse)}" if part.ate_m else escape(part.reason))
        for part in parts
    )
    drawn = chart(
        lines,
        span=(0.0, last),
        top=max(largest, 1e-12),
        labels=("error over time", metres(largest), f"{last:.1f} s"),
    )
    return (
        f"<h2>Comparison with ground truth</h2><figure>{drawn}<figcaption>Distance to the "
        "ground-truth position, after Sim(3) alignment of the whole trajectory: "
        f"{summary}.</figcaption></figure>"
    )

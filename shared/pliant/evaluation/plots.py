"""The error over time as a picture (VITAMIN-E Fig. 4).  Needs matplotlib, an optional extra."""

from pathlib import Path
from typing import Any

from pliant.errors import ResultError
from pliant.evaluation.run_evaluation import Evaluation

_COLOURS = {"final": "#1668b8", "online": "#e0751a"}


def plot_errors(path: Path, evaluation: Evaluation) -> None:
    """Write a PNG: distance to the true position over time, online and final.

    Raises ResultError if matplotlib is not installed, or where neither trajectory could be
    aligned (then there is no error to draw).
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError:
        raise ResultError(
            "the plot needs matplotlib, which is not installed: pip install pliant[plot]"
        ) from None
    parts = [part for part in (evaluation.online, evaluation.final) if part and len(part.errors_m)]
    if not parts:
        raise ResultError(f"{evaluation.result}: no error over time, {evaluation.final.reason}")
    largest = max(float(part.errors_m.max()) for part in parts)
    factor, unit = next(
        ((factor, unit) for limit, factor, unit in _UNITS if largest < limit), (1.0, "m")
    )
    # The figure is made without pyplot: no global state, no window system.
    figure: Any = Figure(figsize=(8.0, 3.2), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    axes: Any = figure.add_subplot()
    for part in parts:
        label = part.kind
        if part.ate_m is not None:
            label += f", RMSE {part.ate_m.rmse * factor:.3g} {unit}"
        colour = _COLOURS[part.kind]
        axes.plot(part.times_s, part.errors_m * factor, color=colour, linewidth=1.2, label=label)
        if part.ate_m is not None:
            axes.axhline(part.ate_m.rmse * factor, color=colour, linewidth=0.7, linestyle=":")
    axes.set_xlabel("time [s]")
    axes.set_ylabel(f"position error [{unit}]")
    axes.set_ylim(bottom=0.0)
    axes.margins(x=0.01)
    axes.grid(visible=True, color="#dddddd", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    # Above the axes, where no curve can run through it.
    axes.legend(frameon=False, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2)
    axes.set_title("Error over time, Sim(3) aligned", fontsize=10, loc="left")
    try:
        # Without the version of matplotlib in the file, equal numbers give equal bytes.
        figure.savefig(path, format="png", metadata={"Software": None})
    except OSError as error:
        raise ResultError(f"{path}: cannot be written ({error.strerror})") from None


_UNITS = ((2e-3, 1e6, "um"), (2e-2, 1e3, "mm"), (2.0, 1e2, "cm"))

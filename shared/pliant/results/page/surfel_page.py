"""report.html of a run of the deformable profile."""

from collections.abc import Container
from html import escape
from pathlib import Path
from typing import Any

from pliant.results.page.chart import BLUE, ORANGE, Line, chart
from pliant.results.page.moved_surface import Surface
from pliant.results.page.page import bullets, canvas, ended, fill_page, table_rows
from pliant.wording import counted


def write_surfel_page(
    path: Path, report: dict[str, Any], lines: list[str], surface: Surface | None,
    names: Container[str],
) -> None:  # fmt: skip
    """Write report.html of a run of the deformable profile.

    lines: the summary.   surface: of the last frame; None without one.
    names: of the other files beside it.
    """
    fill_page(
        path, report, names,
        verdict=escape(report["verdict"]),
        reason=escape(report["verdict_reason"]),
        map="" if surface is None else _view(surface),
        clip="",
        figures=table_rows(_surfel_figures(report)),
        chart=_surfel_chart(report),
        advice=bullets("Further messages", lines),
    )  # fmt: skip


def _view(surface: Surface) -> str:
    scene, full = surface.scene()
    return (
        f'{canvas(scene)}<p class="soft">The surface in key frames. Colours show the strain of '
        "each part since the first key frame that shows it: blue is compressed, grey unchanged, "
        f"red stretched, by {100.0 * full:.1f} % or more in the full colour.</p>"
    )


def _surfel_figures(report: dict[str, Any]) -> list[tuple[str, str]]:
    alive = report["alive_per_frame"] or [0]
    return [
        ("frames", f"{report['frames']}, {report['frames_with_pose']} tracked"),
        *ended(report),
        ("surfels", f"{report['median_alive']:.0f} in the median frame, {alive[-1]} in the last"),
        ("born", f"{report['births']:,}"),
        ("started", counted(len(report["segments"]), "time")),
        ("scale", "metres" if report["scale_is_metric"] else "unknown (monocular)"),
    ]


def _surfel_chart(report: dict[str, Any]) -> str:
    """Surfels that are there and that are followed; frames in which all were lost are shaded."""
    listed, alive = report["surfels_per_frame"], report["alive_per_frame"]
    frames = list(range(len(listed)))
    if len(frames) < 2:
        return ""
    most = max(*listed, 1)
    drawn = chart(
        [Line(frames, listed, BLUE), Line(frames, alive, ORANGE)],
        span=(0.0, frames[-1]),
        top=most,
        labels=("surfels", f"{most:,}", counted(len(frames), "frame")),
        shaded=report["frames_lost"],
    )
    return (
        f"<figure>{drawn}<figcaption>Surfels (blue), and the tracked ones (orange). Shaded: "
        "frames in which all were lost.</figcaption></figure>"
    )

"""Common parts of every report.html: template, canvas, tables, and the place of ground truth."""

from collections.abc import Container, Iterable
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

from pliant.files import write_whole
from pliant.formats.text import write_bytes
from pliant.results.page.scene import Scene
from pliant.version import __version__

_TRUTH = "<!-- against the truth -->"


def fill_page(path: Path, report: dict[str, Any], names: Container[str], **parts: str) -> None:
    """Write a page.  names: of the files beside it.  parts: HTML by its place in page.html.

    Raises ResultError if the disk fails.
    """
    text = Template(_part("page.html")).substitute(
        title=escape(report["source"] or "a run"),
        truth=_TRUTH * 2,
        times=table_rows(_times(report)),
        files=table_rows([(name, what) for name, what in _FILES.items() if name in names]),
        version=escape(__version__),
        **parts,
    )
    write_bytes(path, text.encode())


def put_truth_in(path: Path, section: str) -> None:
    """Put the comparison with ground truth into a page.  Raises OSError."""
    parts = path.read_text(encoding="utf-8").split(_TRUTH)
    if len(parts) == 3:
        write_whole(path, f"{parts[0]}{_TRUTH}{section}{_TRUTH}{parts[2]}")


_FILES = {
    "trajectory.txt": "camera poses after all corrections (TUM)",
    "trajectory_online.txt": "online poses, as estimated at frame time",
    "keyframes.txt": "poses of the keyframes",
    "points.ply": "the point cloud",
    "mesh.ply": "the surface, fine",
    "mesh_coarse.ply": "the surface, coarse",
    "calibration.yaml": "the camera, for --calibration of the next run",
    "surfels.npz": "every surfel of every frame",
    "deforming_map.npz": "the map of the whole run, which deforms",
    "report.json": "all figures",
    "map.pliant": "the map for later runs: pliant run SOURCE --map",
    "scale.yaml": "metres per unit of the recording",
    "recording.mcap": "every message",
}


def _part(name: str) -> str:
    return (files("pliant.results.page") / name).read_text(encoding="utf-8")


def ended(report: dict[str, Any]) -> list[tuple[str, str]]:
    """Why fewer frames came than the source has, where that is so."""
    return [("ended early", report["ended_early"])] if report["ended_early"] else []


def table_rows(rows: Iterable[tuple[str, str]]) -> str:
    """Rows of a <table>: names and values."""
    return "".join(f"<tr><th>{escape(a)}</th><td>{escape(b)}</td></tr>" for a, b in rows)


def canvas(scene: Scene) -> str:
    """The rotatable view."""
    return (
        '<canvas id="view"></canvas><p id="time"></p><p class="soft">'
        '<span id="layers"></span> drag to '
        "rotate, shift-drag to move, wheel or pinch to zoom, double-click two points to "
        'measure</p><p id="picked"></p><script type="application/json" '
        f'id="scene">{scene.header}</script><script type="text/plain" '
        f'id="bytes">{scene.bytes}</script><script>{_part("viewer.js")}</script>'
    )


def bullets(heading: str, sentences: list[str]) -> str:
    """A section of sentences; "" without any."""
    if not sentences:
        return ""
    lines = "".join(f"<li>{escape(line)}</li>" for line in sentences)
    return f"<h2>{heading}</h2><ul>{lines}</ul>"


def _times(report: dict[str, Any]) -> list[tuple[str, str]]:
    rows = [("together", f"{report['frames_per_second']:.1f} frames/s")]
    for service, spent in report["cpu_milliseconds_per_frame"].items():
        rows.append((service, f"{spent:.1f} ms of CPU per frame"))
    return rows

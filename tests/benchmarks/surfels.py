"""The tables of surfels on deforming sequences: what each choice of DSDT's is worth."""

import time
from collections import abc
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.deforming_maps import measure_maps
from benchmarks.surfel_limits import measure_limits
from benchmarks.surfel_losses import measure_losses
from benchmarks.surfel_sequences import Sequence, load
from benchmarks.table import markdown
from pliant.algorithms.surfels.parameters import SurfelParameters
from pliant.algorithms.surfels.surfel_tracker import SurfelTracker
from pliant.datasets.builtin import is_deforming
from pliant.errors import DatasetError
from pliant.evaluation.exact_surfels import ExactSurfels
from pliant.evaluation.surfel_truth import SurfelTruth, mean_rows
from pliant_services.nodes.surfels import warm_up

_STATIC = ("sliding", "objects", "stretching", "stretching?poisson=1", "stretching?held=1")
_BREATHING = tuple(f"breathing?amplitude={share}" for share in ("0", "0.01", "0.03", "0.08"))
_MODELS = ("isometric", "equiareal", "general")
_AREAS = ("auc", "auc_visible", "auc_image")
_SIDES = (11, 15, 23, 31, 45)
_LIGHTS = ("any", "camera", "camera-fixed")
_CAMERAS = {"SC": "static", "moving": "moving"}
_TROUBLES = ("tool=1", "light=0.3", "gloss=1", "drop=4", "tool=1&light=0.3&gloss=1&drop=4")
_HEADER = (
    *(
        "sequence",
        "setting",
        "RMSE %",
        "all %",
        "median %",
        "in camera %",
        "alive at end",
        "of those in view",
    ),
    *("dragged", "AUC", "AUC in view", "AUC 1 px", "camera %", "until loss", "ms a frame"),
)
LIMITS, LOSSES, MAPS = "limits", "losses", "maps"
TABLES = (
    "targets",
    "models",
    "sizes",
    "scales",
    "cameras",
    "neighbours",
    "troubles",
    "light",
    LIMITS,
    LOSSES,
    MAPS,
)


@dataclass(frozen=True)
class _Row:
    """A sequence, what is said of the setting, and the parameters that differ from the others."""

    source: str
    setting: str
    parameters: dict[str, Any]


def measure(
    sources: abc.Sequence[str],
    *,
    tracks: str | None,
    tables: abc.Sequence[str],
    frames: int,
    surfels: int,
    quick: bool,
) -> Iterator[str]:
    """Table after table, row by row as they are done.

    sources: instead of the tables' own sequences.  tracks: of the Kinect paper, which is left out
    without.  quick: one row in each place where others differ by degrees only.
    Raises DatasetError for a table that does not exist, and for sources that cannot be opened.
    """
    unknown = [name for name in tables if name not in TABLES]
    if unknown:
        raise DatasetError(f"no table {unknown[0]!r}; there are {', '.join(TABLES)}")
    warm_up()
    if tracks is None and not sources:
        yield "(built-in:kinect-paper is left out: say --tracks PATH)"
    loaded: dict[str, Sequence] = {}
    measured: dict[tuple[str, str], list[str]] = {}
    for name in tables or TABLES:
        if name == LIMITS:
            yield from measure_limits(surfels)
            continue
        if name == LOSSES:
            yield from measure_losses(sources, tracks, surfels)
            continue
        if name == MAPS:
            yield from measure_maps(sources)
            continue
        rows = _rows(name, list(sources), tracks)
        rows = _fewer(rows) if quick else rows
        yield f"\n{name}, first {frames} frames, at most {surfels} surfels, one core"
        yield markdown(_HEADER, [])
        for row in rows:
            if row.source not in loaded:
                loaded[row.source] = load(row.source, frames)
            parameters = SurfelParameters.model_validate({"max_surfels": surfels, **row.parameters})
            # The default stands in most tables; it is measured once.
            key = row.source, parameters.model_dump_json()
            if key not in measured:
                measured[key] = _measure(loaded[row.source], parameters)
            cells = measured[key]
            yield "| " + " | ".join([_short(row.source), row.setting, *cells]) + " |"


def _rows(table: str, sources: list[str], tracks: str | None) -> list[_Row]:
    """The rows of a table; ``sources`` where some are given, its own sequences otherwise."""
    paper = [f"built-in:kinect-paper?tracks={tracks}"] if tracks else []
    rendered = [f"built-in:{name}" for name in _STATIC]
    still = sources or [*paper, *rendered]
    moving = sources or [f"built-in:{name}" for name in _BREATHING]
    one_moving = [] if sources else [moving[2]]
    few = sources or [*paper, "built-in:sliding", moving[2]]
    if table == "targets":
        return _each([*still, *([] if sources else moving)], {"default": {}})
    if table == "models":
        return _each([*still, *one_moving], {model: {"model": model} for model in _MODELS})
    if table == "sizes":
        return _each(few, {f"{side} px": {"patch_px": side} for side in _SIDES})
    if table == "scales":
        jumping = sources or [_with(source, "drop=8") for source in few]
        return _each(jumping, {f"{n} scales": {"levels": n} for n in (1, 2, 3, 4)})
    if table == "cameras":
        return _each(moving, {name: {"camera": mode} for name, mode in _CAMERAS.items()})
    if table == "neighbours":
        return _each(still, {f"{count} neighbours": {"neighbours": count} for count in (0, 8)})
    if table == "light":
        lit = [_with(source, "lamp=camera") for source in (sources or [*rendered, *one_moving])]
        elsewhere = [] if sources else ["built-in:objects", *one_moving]
        return [
            *_each(lit, {name: {"light": name} for name in _LIGHTS}),
            *_each(elsewhere, {"camera": {"light": "camera"}}),
        ]
    # Everything has a tool pass in front once; the other troubles are for two.
    everything = sources or [*still, *one_moving]
    disturbed = [_with(source, _TROUBLES[0]) for source in everything if is_deforming(source)]
    disturbed += [
        _with(source, trouble)
        for source in (sources or ["built-in:sliding", *one_moving])
        for trouble in _TROUBLES[1:]
        if is_deforming(source)
    ]
    return _each(disturbed, {"default": {}})


def _each(sources: abc.Sequence[str], settings: dict[str, dict[str, Any]]) -> list[_Row]:
    return [
        _Row(source, name, {**_camera(source), **changed})
        for source in sources
        for name, changed in settings.items()
    ]


def _camera(source: str) -> dict[str, Any]:
    """Whether a sequence has a camera that moves is the user's to say; of ours we know it."""
    return {"camera": "moving" if source.startswith("built-in:breathing") else "static"}


def _with(source: str, option: str) -> str:
    return source + ("&" if "?" in source else "?") + option


def _fewer(rows: list[_Row]) -> list[_Row]:
    """The first and the last row of each sequence, of at most two sequences."""
    names = list(dict.fromkeys(row.source.partition("?")[0] for row in rows))
    out: list[_Row] = []
    for name in names[:2]:
        mine = [row for row in rows if row.source.partition("?")[0] == name]
        out += [mine[0], *mine[1:][-1:]]
    return out


def _short(source: str) -> str:
    name, _, query = source.removeprefix("built-in:").partition("?")
    options = [item for item in query.split("&") if item and not item.startswith("tracks=")]
    return " ".join([name.rstrip("/").rpartition("/")[2], *options])


def _measure(sequence: Sequence, parameters: SurfelParameters) -> list[str]:
    tracker = SurfelTracker(parameters)
    exact = ExactSurfels(sequence.truth) if sequence.truth is not None else None
    by_depth = SurfelTruth(sequence.camera)
    spent: list[float] = []
    for number, image in enumerate(sequence.images):
        start = time.perf_counter()
        if number == 0:
            surfels = tracker.start(image, sequence.depths[0], sequence.camera)
        else:
            surfels = tracker.track(image, sequence.interval_s(number))
        spent.append(time.perf_counter() - start)
        if exact is not None:
            exact.add(number, surfels)
        elif sequence.depths[number].size:
            by_depth.add(number, surfels, image, sequence.depths[number])
    milliseconds = f"{1e3 * float(np.median(spent[1:])):.1f}"
    if exact is not None:
        return [*_exact_cells(exact), milliseconds]
    depth = sequence.depths[0][sequence.depths[0] > 0.0].mean()
    mean, last = mean_rows(by_depth.rows), by_depth.rows[-1]
    shares = [f"{100.0 * mean[name] / depth:.2f}" for name in ("rmse", "rmse_all")]
    return [*shares, "", "", f"{last.alive / max(1, last.judged):.1%}", *[""] * 7, milliseconds]


def _exact_cells(exact: ExactSurfels) -> list[str]:
    figures = exact.summary()
    camera = figures["camera_rmse"]
    return [
        *(f"{100.0 * figures[name]:.2f}" for name in ("rmse", "rmse_all", "median")),
        f"{100.0 * figures['in_camera']:.2f}" if camera > 0.0 else "",
        *(f"{figures[name]:.1%}" for name in ("alive_last", "followed_last")),
        f"{figures['dragged_ever']:.0f}",
        *("" if np.isnan(figures[name]) else f"{figures[name]:.3f}" for name in _AREAS),
        f"{100.0 * camera:.2f}" if camera > 0.0 else "",
        f"{figures['frames_until_loss']:.0f}",
    ]

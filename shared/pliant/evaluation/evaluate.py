"""Behind ``pliant eval``: results against true poses and, for built-in sequences, true depth."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pliant.datasets.base import is_builtin
from pliant.datasets.builtin import builtin_folder
from pliant.errors import ResultError
from pliant.evaluation.error_over_time import error_over_time
from pliant.evaluation.presentation import (
    evaluation_to_json,
    format_evaluation,
    format_summary,
    metres,
    summarise,
    summary_to_json,
    write_json,
)
from pliant.evaluation.run_evaluation import Evaluation, evaluate_result
from pliant.evaluation.time_offset import TimeOffset
from pliant.open3d_library import load_open3d
from pliant.results.folder import PAGE_NAME, check_free, files_read, keep_apart
from pliant.results.mesh_files import run_of
from pliant.results.page.page import put_truth_in


@dataclass(frozen=True, kw_only=True)
class EvaluationRequest:
    """The request of a user."""

    results: Sequence[Path]
    groundtruth: str
    times: Path | None
    frames: int | None
    tracks: bool
    points: bool
    mesh: bool
    surfels: bool
    plot: Path | None
    json: Path | None
    scan: Path | None = None
    offset: str = ""
    force: bool = False


def run_evaluation(request: EvaluationRequest) -> Iterator[str]:
    """Evaluate, write the requested files, and print the figures.  Raises ResultError."""
    missing = [str(result) for result in request.results if not result.exists()]
    if missing:
        raise ResultError(f"{missing[0]}: no such result")
    check_free(*request.results, elsewhere=False)
    _check_outputs(request)
    _check_scan(request)
    if request.offset and (request.surfels or request.tracks or request.points or request.mesh):
        raise ResultError(
            "--offset applies only to poses: leave out --offset, or --tracks, --map, --mesh, "
            "--surfels"
        )
    if request.surfels:
        yield from _evaluate_surfels(request)
        return
    truth = Path(request.groundtruth)
    if is_builtin(request.groundtruth):
        truth = builtin_folder(request.groundtruth)
    elif request.tracks or request.points:
        raise ResultError("--tracks and --map need exact depth: --groundtruth built-in:NAME")
    evaluations = [_evaluated(result, truth, request) for result in request.results]
    figures: dict[str, Any] = evaluation_to_json(evaluations[0])
    for evaluation in evaluations:
        yield format_evaluation(evaluation)
        if evaluation.better is not None:
            yield _proposal(evaluation, evaluation.better)
    if len(evaluations) > 1:
        summaries = [summarise(evaluations, kind=kind) for kind in ("final", "online")]
        for summary in summaries:
            yield format_summary(summary)
        figures = {summary.kind: summary_to_json(summary) for summary in summaries}
    yield from _report_pages(request.results, evaluations)
    if request.plot is not None:
        from pliant.evaluation.plots import plot_errors

        plot_errors(request.plot, evaluations[0])
        yield f"error over time: {request.plot}"
    if request.tracks:
        from pliant.evaluation.truth import tracks_against_truth

        yield from tracks_against_truth(run_of(request.results[0]), truth, figures)
    if request.points:
        from pliant.evaluation.truth import points_against_truth

        run = run_of(request.results[0])
        yield from points_against_truth(run, truth, evaluations[0], figures)
    if request.mesh:
        from pliant.evaluation.recorded_mesh import mesh_against_truth

        yield from mesh_against_truth(request.results[0], truth, evaluations[0], figures)
    if request.scan is not None:
        from pliant.evaluation.mesh_scan import mesh_against_scan

        alignment = evaluations[0].final.alignment
        yield from mesh_against_scan(request.results[0], request.scan, alignment, figures)
    if request.json is not None:
        write_json(request.json, figures)


def _evaluated(result: Path, truth: Path, request: EvaluationRequest) -> Evaluation:
    """Evaluate one result.  Raises ResultError if poses and ground truth do not overlap in time."""
    evaluation = evaluate_result(
        run_of(result),
        groundtruth=truth,
        times=request.times,
        frames=request.frames,
        offset=request.offset,
    )
    if evaluation.final.apart:
        better = evaluation.better
        by_s = 0.0 if better is None else evaluation.offset_s + better.seconds
        raise ResultError(
            f"{result}: no accuracy, {evaluation.final.reason} in {request.groundtruth}: "
            "--groundtruth must belong to this recording, with the same clock"
            + (f" (both start together: try --offset {by_s:.3f})" if better is not None else "")
        )
    return evaluation


def _proposal(evaluation: Evaluation, better: TimeOffset) -> str:
    """A proposal for the user where the times of poses and ground truth seem to differ."""
    where = "later" if better.seconds > 0.0 else "earlier"
    return (
        f"ground truth fits far better {abs(better.seconds):.3f} s ({abs(better.frames):.1f} "
        f"frames) {where}: ATE {metres(better.rmse_m)} instead of {metres(better.before_m)}: if "
        f"the clocks differ, use --offset {evaluation.offset_s + better.seconds:.3f}"
    )


def _check_scan(request: EvaluationRequest) -> None:
    """Raise PliantError, before the work, where it cannot be used."""
    if request.scan is not None and (request.surfels or len(request.results) > 1):
        raise ResultError(
            "--scan needs the mesh of one result: leave out the other results, or --surfels"
        )
    if request.scan is not None:
        if not request.scan.is_file():
            raise ResultError(f"{request.scan}: no such scan")
        load_open3d()


def _check_outputs(request: EvaluationRequest) -> None:
    """Raise ResultError if a file would replace an input or an existing file.

    It may be a new one beside what is read.
    """
    truth = Path(request.groundtruth)
    folders = [folder for each in request.results for folder in (each, run_of(each))]
    read = [truth, *(file for each in folders for file in [each, *files_read(each)])]
    read += [truth.with_name("times.txt") if request.times is None else request.times]
    read += [] if request.scan is None else [request.scan]
    for option, path in (("--json", request.json), ("--plot", request.plot)):
        if path is None:
            continue
        keep_apart(path, read, option=option)
        if path.exists() and truth.is_dir() and truth.resolve() in path.resolve().parents:
            raise ResultError(f"{path} belongs to the input {truth}: choose another {option}")
        if path.is_file() and not request.force:
            raise ResultError(f"{path} exists: choose another {option}, or --force to replace it")
        read.append(path)


def _report_pages(results: Sequence[Path], evaluations: Sequence[Evaluation]) -> Iterator[str]:
    """Draw the error over time into the pages of result folders."""
    for result, evaluation in zip(results, evaluations, strict=True):
        page = result / PAGE_NAME
        drawn = error_over_time(evaluation)
        if drawn and page.is_file():
            try:
                put_truth_in(page, drawn)
            except OSError as error:
                yield f"{page}: cannot add the error over time ({error.strerror})"
            else:
                yield f"error over time: {page}"


def _evaluate_surfels(request: EvaluationRequest) -> Iterator[str]:
    from pliant.evaluation.recorded_surfels import surfels_against_truth

    every: list[dict[str, Any]] = []
    for result in request.results:
        figures: dict[str, Any] = {}
        yield from surfels_against_truth(result, request.groundtruth, figures)
        every.append({"result": str(result), **figures})
    if request.json is not None:
        write_json(request.json, every[0] if len(every) == 1 else {"results": every})

"""Calibration from a video, with a board or without."""

import contextlib
import io
import json
import math
import os
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

import cv2
import numpy as np

from pliant.algorithms.arrays import U8
from pliant.algorithms.board_calibration import (
    MIN_VIEWS,
    BoardCalibration,
    BoardFinder,
    BoardLens,
    BoardView,
    boards_seen,
    calibrate,
    choose_views,
)
from pliant.algorithms.image.masks import clearance_in, filled
from pliant.algorithms.image.sharpness import LONGEST_SIDE_PX, resized, sharpness
from pliant.algorithms.slam.estimate.problem import CalibrationUncertainty
from pliant.config import IngestParameters
from pliant.datasets import BrokenFrame, Dataset, decode, open_source
from pliant.datasets.calibration import UNSAID_FOV_DEG, Calibration, calibration_yaml
from pliant.datasets.calibration_files import read_calibration
from pliant.datasets.excerpt import Excerpt
from pliant.datasets.rectifier import Rectifier
from pliant.datasets.source_spec import SourceSpec
from pliant.errors import CalibrationError, DatasetError, ResultError
from pliant.exit_codes import INTERRUPTED
from pliant.export.posed_images import INLIER_PX, IdealCamera
from pliant.files import make_folder, write_whole
from pliant.pictures.calibration import SeenCorners, coverage, draw_calibration
from pliant.pictures.movie import write_image
from pliant.recording.parts import parts_of
from pliant.recording.reader import Recording
from pliant.results.folder import CALIBRATION_NAME, RECORDING_NAME, REPORT_NAME, keep_apart
from pliant.results.run import Run, read_run, seen_by_keyframes
from pliant.wording import counted
from pliant_services.calibrate.board import PrintedBoard
from pliant_services.cli.counting import show_progress
from pliant_services.run.command import RunRequest, run_pipeline

_LOOKED_AT = 200
"""Frames in which the board is searched: the sharpest of this many parts of the source."""
_TRIED = 5
"""Frames that are searched for other boards where the wanted one is in none."""
_KNOWN = 0.05
"""Standard deviation of the log focal length above which it counts as unknown."""
_WORST = 2e-3
"""Share of the width that corners may be off by: more, and it is not that board."""
_CELLS = 32
"""Columns of cells in which the picture without a board shows the residuals."""
_MANY = 10
"""Sights of points that a cell needs for that."""
_WHOLE_PX = 1 << 20  # larger than any image, so that none is made smaller


@dataclass(frozen=True, kw_only=True)
class _Part:
    """See ``datasets.excerpt.Part``."""

    every: int
    start_s: float = 0.0
    end_s: float = 0.0
    sharpest: bool = True


@dataclass(frozen=True)
class _Found:
    view: BoardView
    sharpness: float


def check_file(output: Path, *, source: str, mask: Path | None, force: bool) -> None:
    """Raise ResultError if the calibration cannot go there.  Changes nothing."""
    if output.is_dir():
        raise ResultError(f"{output} is a folder: name a file, such as {output / 'calib.yaml'}")
    picture = picture_of(output)
    if picture == output:
        raise ResultError(
            f"{output}: a calibration needs a .yaml file: use --output {output.stem}.yaml"
        )
    read = [Path(source), *parts_of(Path(source))] if os.path.exists(source) else []
    read += [] if mask is None else [mask]
    for path in (output, picture):
        keep_apart(path, read)
        for folder in (each.resolve() for each in read if each.is_dir()):
            if folder in path.resolve().parents:
                raise ResultError(
                    f"{path} is in the source folder {folder}: choose another --output"
                )
        if path.exists() and not force:
            raise ResultError(f"{path} exists: choose another --output, or --force to replace it")


def picture_of(output: Path) -> Path:
    """Where the picture of a calibration goes: beside it."""
    return output.with_suffix(".png")


def calibrate_with_board(
    source: str,
    printed: PrintedBoard,
    output: Path,
    *,
    lens: BoardLens,
    topic: str,
    mask: Path | None = None,
) -> list[str]:
    """Write the calibration of a source that shows a board, and a picture of how good it is.

    mask: what of the images is ignored: no corner is found there.
    Returns what to tell.  Raises PliantError: no board, another one, too few views, no lens.
    """
    dataset = open_source(
        SourceSpec(location=source, fov_deg=UNSAID_FOV_DEG, topic=topic, mask=mask),
        IngestParameters(longest_side_px=_WHOLE_PX, mask_static=False),
    )
    width, height = dataset.calibration.width, dataset.calibration.height
    found, others, looked = _look_for(dataset, printed, source)
    if not found:
        raise CalibrationError(
            f"{source}: {printed.spelled} is in none of {counted(looked, 'frame')}: "
            + _hint(others, printed)
        )
    views = [each.view for each in found]
    chosen = choose_views(views, [each.sharpness for each in found], printed.board, width)
    if len(chosen) < MIN_VIEWS:
        raise CalibrationError(
            f"{source}: {printed.spelled} is in {len(found)} of {counted(looked, 'frame')}, with "
            f"{len(chosen)} different views; {MIN_VIEWS} are needed: move it through the whole "
            f"image and tilt it. The other frames: {_hint(others, printed)}"
        )
    chosen_views = [views[i] for i in chosen]
    result = calibrate(chosen_views, width, height, lens)
    calibration = _checked(result, source, printed, lens, width)
    assert result is not None
    used = [view for view, use in zip(chosen_views, result.used, strict=True) if use]
    seen = [SeenCorners(v.points_px, r) for v, r in zip(used, result.residuals, strict=True)]
    covered = coverage(seen, width, height)
    lines = [
        _described(calibration, result.focal_sigma),
        f"reprojection error {result.rms_px:.2f} px in {counted(len(used), 'view')}, of "
        f"{counted(len(found), 'frame')} with {printed.spelled}; they cover "
        f"{100.0 * covered:.0f} % of the image",
    ]
    picture = picture_of(output)
    make_folder(output.parent)
    write_image(picture, draw_calibration(seen, width, height, [f"{source}: {lines[0]}", lines[1]]))
    _write(output, calibration, [f"pliant calibrate {source} --board {printed.spelled}", *lines])
    return [*lines, *_advice(covered, result.focal_sigma), f"written: {output}, {picture}"]


def _look_for(
    dataset: Dataset, printed: PrintedBoard, source: str
) -> tuple[list[_Found], list[U8], int]:
    """Views of the board, some frames without it, and the number of frames searched."""
    if dataset.is_live:
        raise DatasetError(f"{source}: is live: film the board, and pass the video")
    count = dataset.frame_count or sum(1 for _ in dataset)
    every = max(1, math.ceil(count / _LOOKED_AT))
    frames = Excerpt(dataset, _Part(every=every, sharpest=every > 1))
    finder, found = BoardFinder(printed.board), list[_Found]()
    as_it_is = Rectifier(dataset.calibration)  # a guess without distortion
    others: list[U8] = []
    total, looked = -(-count // every), 0
    for frame in frames:
        show_progress("looking for the board", min(looked, total - 1), total)
        try:
            pixels, clearance = decode(frame), clearance_in(as_it_is.mask(frame))
        except BrokenFrame:
            continue
        if pixels.ndim == 3:
            pixels = cast(U8, cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY))
        if pixels.shape != (dataset.calibration.height, dataset.calibration.width):
            continue
        pixels = filled(pixels, clearance)
        looked += 1
        view = finder.find(np.ascontiguousarray(pixels))
        if view is not None:
            found.append(_Found(view, sharpness(resized(pixels, LONGEST_SIDE_PX))))
        elif looked % max(1, total // _TRIED) == 0:
            others.append(pixels)
    show_progress("looking for the board", total, total)
    return found, others, looked


def _hint(others: list[U8], printed: PrintedBoard) -> str:
    """Advice for frames that do not show the board: they may show another one."""
    for seen in boards_seen(others):
        if seen != f"a chessboard of {printed.board.columns}x{printed.board.rows} squares":
            return f"they show {seen}: check --board"
    return "show the whole board, sharp and evenly lit"


def _checked(
    result: BoardCalibration | None, source: str, printed: PrintedBoard, lens: str, width: int
) -> Calibration:
    """The calibration, with how sure it is where that is not very.  Raises CalibrationError."""
    if result is None:
        raise CalibrationError(
            f"{source}: no {lens} lens fits the views of {printed.spelled}: keep the board flat "
            "and still, and fill the image with it"
            + ("" if lens == "fisheye" else "; a very wide lens needs --lens fisheye")
        )
    if result.rms_px > _WORST * width:
        raise CalibrationError(
            f"{source}: the corners of {printed.spelled} are {result.rms_px:.1f} px off: check "
            "--board, and keep the board flat and still"
            + ("" if lens == "fisheye" else " A very wide lens needs --lens fisheye")
        )
    if result.focal_sigma > _KNOWN:
        raise CalibrationError(
            f"{source}: the focal length is uncertain (+-{100.0 * result.focal_sigma:.0f} %): "
            f"tilt {printed.spelled} by 30 degrees and more, both ways"
        )
    found = result.lens
    return Calibration(  # whose checks it passes: the lens could be rectified
        model=found.model,
        width=found.width,
        height=found.height,
        fx=found.fx,
        fy=found.fy,
        cx=found.cx,
        cy=found.cy,
        distortion=found.coefficients,
        focal_sigma=result.focal_sigma
        if result.focal_sigma > CalibrationUncertainty().focal
        else 0,
    )


def _advice(covered: float, focal_sigma: float) -> list[str]:
    lines: list[str] = []
    if covered < 0.7:
        lines.append(
            "the distortion is uncertain in areas without views: move the board to the corners"
        )
    if focal_sigma > 0.5 * CalibrationUncertainty().focal:
        lines.append("more and steeper tilts of the board would give a more accurate focal length")
    return lines


def calibrate_without_board(
    source: str, output: Path, *, fov_deg: float | None, topic: str, mask: Path | None = None
) -> list[str]:
    """Write the calibration that a run finds by itself, of any scene; returns what to tell.

    It is a run, without its mesh and images, whose other results are thrown away.
    """
    spec = SourceSpec(location=source, fov_deg=fov_deg, topic=topic, mask=mask)
    dataset = open_source(spec)
    if dataset.is_live:
        raise DatasetError(f"{source}: is live: film, and pass the video")
    if dataset.calibration.focal_sigma == 0.0:
        raise CalibrationError(
            f"{source}: has a calibration, which `pliant run` uses: pass --fov DEGREES to "
            "estimate a new one"
        )
    with tempfile.TemporaryDirectory(prefix="pliant-calibrate-") as folder:
        request = RunRequest(
            source=spec,
            output=Path(folder) / "run",
            overrides=["meshing.enabled=false", "recorder.images=false"],
        )
        with contextlib.redirect_stdout(io.StringIO()):  # of results in a temporary folder
            code = run_pipeline(request)
        if code == INTERRUPTED:
            raise KeyboardInterrupt
        report = json.loads((Path(folder) / "run" / REPORT_NAME).read_text(encoding="utf-8"))
        if not report["segments"]:
            raise CalibrationError(f"{source}: no map could start: {report['last_reason']}")
        calibration = read_calibration(Path(folder) / "run" / CALIBRATION_NAME)
        verdict = str(report["calibration_verdict"]).partition(":")[0]
        if calibration.focal_sigma > _KNOWN:
            raise CalibrationError(
                f"{source}: {verdict}: film with sideways motion and rotations, or film a board "
                "(pliant calibrate --print-board board.pdf)"
            )
        recording = Recording(Path(folder) / "run" / RECORDING_NAME)
        run = read_run(recording.path)
        left, count = left_over(recording, run)
    lines = [_described(calibration, calibration.focal_sigma), verdict]
    make_folder(output.parent)
    _write(output, calibration, [f"pliant calibrate {source}", verdict])
    picture = picture_of(output)
    if not len(left.points_px):  # no part of the image has enough of them
        picture.unlink(missing_ok=True)  # that of another calibration
        return [*lines, f"written: {output}"]
    of = f"median residuals of {count:,} observations of points, over the image"
    words = [f"{source}: {lines[0]}", verdict, of]
    assert run.stream is not None
    # Observations are in pixels of the working size.
    size = run.stream.camera.width, run.stream.camera.height
    write_image(picture, draw_calibration([left], *size, words))
    return [*lines, f"written: {output}, {picture}"]


def left_over(recording: Recording, run: Run) -> tuple[SeenCorners, int]:
    """How far from where the final map has them keyframes see its points, over the image: the
    median in each of its cells that has many.  And how many sights there are in all.   run: of the
    recording.

    Noise is gone from medians: what is left is a lens that is none of the found one's.
    """
    ideal = IdealCamera(run)
    seen_at = seen_by_keyframes(recording, set(ideal.keyframes.values()))
    places, offs = [np.zeros((0, 2))], [np.zeros((0, 2))]
    for frame, number in ideal.keyframes.items():
        if number not in seen_at:
            continue
        rows, points = run.history.points_of(seen_at[number].point_ids)
        points_px, T = seen_at[number].points_px[rows], ideal.poses[frame]
        local = (points.positions - T[:3, 3]) @ T[:3, :3]
        off = ideal.pixels(frame, points_px) - ideal.camera.project(local)
        good = (local[:, 2] > 0.0) & (np.linalg.norm(off, axis=1) < INLIER_PX)
        places.append(points_px[good].astype(np.float64))
        offs.append(off[good])
    at, off = np.concatenate(places), np.concatenate(offs)
    assert run.stream is not None
    side = run.stream.camera.width / _CELLS
    _, cell, counts = np.unique(
        np.floor((at + 0.5) / side), axis=0, return_inverse=True, return_counts=True
    )
    many = [np.flatnonzero(cell.reshape(-1) == n) for n in np.flatnonzero(counts >= _MANY)]
    medians = [(at[rows].mean(axis=0), np.median(off[rows], axis=0)) for rows in many]
    found = np.array(medians, np.float64).reshape(-1, 2, 2)
    return SeenCorners(found[:, 0], found[:, 1]), len(at)


def _described(calibration: Calibration, focal_sigma: float) -> str:
    fov = math.degrees(2.0 * math.atan(0.5 * calibration.width / calibration.fx))
    sure = f" +- {focal_sigma * calibration.fx:.2g} px" if focal_sigma > 0.0 else " px"
    return (
        f"{calibration.width}x{calibration.height} px, {calibration.model}, focal length "
        f"{calibration.fx:.1f}{sure} (about {fov:.0f} degrees across)"
    )


def _write(output: Path, calibration: Calibration, comments: list[str]) -> None:
    """Raises ResultError."""
    head = "".join(f"# {line}\n" for line in comments)
    try:
        write_whole(output, head + calibration_yaml(replace(calibration, depth=None)))
    except OSError as error:
        raise ResultError(f"{output}: cannot be written ({error.strerror})") from None

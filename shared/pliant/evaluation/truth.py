"""A run on a built-in sequence against its exact depth and poses."""

from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from pliant.algorithms.arrays import F64
from pliant.algorithms.camera import PinholeCamera
from pliant.errors import ResultError
from pliant.evaluation.map_truth import evaluate_map, format_map
from pliant.evaluation.run_evaluation import Evaluation
from pliant.evaluation.tracks_truth import TracksTruth, format_tracks
from pliant.formats.tum import read_tum
from pliant.messages import topics
from pliant.messages.types import Extrema
from pliant.recording.reader import Recording
from pliant.results.folder import RECORDING_NAME
from pliant.results.run import read_run
from pliant.yaml_text import load_yaml

Truth = Callable[[int], tuple[F64, F64]]


def true_frames(folder: Path) -> Truth:
    """Depth (H, W) in metres and T_world_camera of a frame of a rendered sequence."""
    try:
        calibration = load_yaml((folder / "calib.yaml").read_text())
        scale = float(calibration["depth_scale"])
        invalid = [float(value) for value in calibration.get("depth_invalid", ())]
        depths = [
            folder / line.split()[1]
            for line in (folder / "depth.txt").read_text().splitlines()
            if line and not line.startswith("#")
        ]
    except (OSError, ValueError, KeyError, IndexError) as error:
        raise ResultError(f"{folder}: no ground-truth depth: {error}") from None
    poses = read_tum(folder / "groundtruth.txt").T_world_camera

    def frame(number: int) -> tuple[F64, F64]:
        if number >= min(len(depths), len(poses)):
            raise ResultError(
                f"{folder}: no frame {number}: check that the result belongs to this sequence"
            )
        depth: Any = cv2.imread(str(depths[number]), cv2.IMREAD_UNCHANGED)
        if depth is None:
            raise ResultError(f"{depths[number]}: cannot read the ground-truth depth")
        known = np.where(np.isin(depth, invalid), 0, depth).astype(np.float64)
        return known * scale, poses[number]

    return frame


def tracks_against_truth(result: Path, folder: Path, figures: dict[str, Any]) -> Iterator[str]:
    """How many tracks live, and how many of them are right, by age."""
    truth = true_frames(folder)
    evaluation = None
    for message in Recording(result / RECORDING_NAME).decoded(topics.EXTREMA):
        assert isinstance(message, Extrema)
        depth, T_world_camera = truth(message.frame)
        if evaluation is None:
            evaluation = TracksTruth(_camera(result))
        evaluation.add(message, depth, T_world_camera)
    if evaluation is None:
        raise ResultError(f"{result}: the recording has no tracks")
    found = evaluation.evaluation()
    figures["tracks"] = asdict(found)
    yield format_tracks(found)


def points_against_truth(
    result: Path, folder: Path, evaluation: Evaluation, figures: dict[str, Any]
) -> Iterator[str]:
    """How far the map's points lie from the true surface, after alignment of the trajectory."""
    run = read_run(result / RECORDING_NAME)
    alignment = evaluation.final.alignment
    if run.stream is None or alignment is None:
        raise ResultError(f"{result}: without an aligned trajectory the map has no scale")
    points = run.history.points()
    # The alignment is that of the segment with the most frames, not of that with the most points.
    points = points.select(points.segments == run.history.longest_segment())
    found = evaluate_map(
        points.positions,
        points.frames,
        alignment=alignment,
        camera=run.stream.camera,
        truth=true_frames(folder),
    )
    figures["map"] = asdict(found)
    yield format_map(found)


def _camera(result: Path) -> PinholeCamera:
    run = next(iter(Recording(result / RECORDING_NAME).decoded(topics.STREAM)))
    return run.camera  # type: ignore[attr-defined]

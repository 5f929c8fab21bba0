"""Turns a recording into the files that a user opens.  A function of the recording alone."""

import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from pliant.datasets.calibration import calibration_yaml
from pliant.errors import ResultError
from pliant.files import move_all
from pliant.formats.ply import write_ply
from pliant.formats.tum import write_tum
from pliant.results.calibration import found_calibration
from pliant.results.folder import CALIBRATION_NAME, RECORDING_NAME, REPORT_NAME
from pliant.results.mesh import write_meshes
from pliant.results.report import rigid_report
from pliant.results.run import Run, read_run
from pliant.results.surfels import has_surfels, write_surfel_results


def write_results(output: Path) -> dict[str, Any]:
    """Write the files of a recording's profile; returns the report.  Raises PliantError."""
    deformable = has_surfels(output / RECORDING_NAME)
    return write_surfel_results(output) if deformable else _write_rigid_results(output)


def _write_rigid_results(output: Path) -> dict[str, Any]:
    """Write trajectories, keyframes, points and report beside the recording; returns the report.

    All of them, or none where the disk is full.  Raises RecordingError and ResultError.
    """
    run = read_run(output / RECORDING_NAME)
    final = run.history.final()
    report = rigid_report(run, final)
    try:
        with tempfile.TemporaryDirectory(prefix=".partial-", dir=output) as folder:
            _write_files(Path(folder), run, final, report)
            move_all(Path(folder), output)
    except OSError as error:
        raise ResultError(
            f"{output}: cannot write the results ({error.strerror}); the recording is kept"
        ) from None
    return report


def _write_files(folder: Path, run: Run, final: dict[int, Any], report: dict[str, Any]) -> None:
    history = run.history
    trajectories = {
        "trajectory": final,
        "trajectory_causal": history.causal,
        "keyframes": history.keyframe_poses(),
    }
    points = history.points()
    longest = history.longest_segment()
    for segment in sorted({longest, *(s["id"] for s in report["segments"])}):
        # Each segment is a world of its own, at a scale of its own: a file of its own.
        suffix = "" if segment == longest else f"_segment_{segment}"
        path = {f: pose for f, pose in final.items() if pose[0] == segment}
        T_world_camera = history.trajectory(path).T_world_camera
        write_meshes(folder, run.mesh, segment, suffix, T_world_camera)
        for name, poses in trajectories.items():
            chosen = {frame: pose for frame, pose in poses.items() if pose[0] == segment}
            write_tum(folder / f"{name}{suffix}.txt", history.trajectory(chosen))
        here = points.select(points.segments == segment) if len(points) else points
        write_ply(
            folder / f"points{suffix}.ply",
            np.asarray(here.positions, np.float32),
            np.asarray(here.colours, np.uint8).reshape(-1, 3),
        )
    calibration = found_calibration(run)
    if calibration is not None:
        text = calibration_yaml(calibration)
        (folder / CALIBRATION_NAME).write_text(text, encoding="utf-8")
    text = json.dumps(report, indent=1) + "\n"
    (folder / REPORT_NAME).write_text(text, encoding="utf-8")

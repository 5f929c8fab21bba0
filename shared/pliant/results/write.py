"""Turns a recording into the files that a user opens.  A function of the recording alone."""

import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from pliant.datasets.calibration import calibration_yaml
from pliant.formats.ply import write_ply
from pliant.formats.tum import write_tum
from pliant.messages import topics
from pliant.messages.types import MapKeyframe
from pliant.recording.map_file import MAP_NAME, MapHeader, write_map
from pliant.recording.reader import Recording
from pliant.results.by_sensors import by_sensors
from pliant.results.calibration import found_calibration
from pliant.results.folder import (
    CALIBRATION_NAME,
    PAGE_NAME,
    RECORDING_NAME,
    REPORT_NAME,
    SCALE_NAME,
    all_or_none,
)
from pliant.results.known_scale import MetricRecording, Scale
from pliant.results.mesh_files import write_meshes
from pliant.results.page.rigid_page import clip_of_keyframes, drawn_map, write_page
from pliant.results.report import rigid_report
from pliant.results.run import Run, read_run
from pliant.results.surfel_frames import has_surfels
from pliant.results.surfels import write_surfel_results


def write_results(output: Path) -> dict[str, Any]:
    """Write the files of a recording's profile; returns the report.  Raises PliantError."""
    deformable = has_surfels(output / RECORDING_NAME)
    return write_surfel_results(output) if deformable else write_rigid_results(output)


def write_rigid_results(output: Path, scale: Scale | None = None) -> dict[str, Any]:
    """Write trajectories, keyframes, points and report beside the recording; returns the report.

    scale: None: that of the folder, or otherwise the one that other sensors of the source
    determine, which is then one of the files.
    All of them, or none where the disk is full.  Raises RecordingError and ResultError.
    """
    recording = MetricRecording(output / RECORDING_NAME, scale)
    run = read_run(recording.path, scale)
    found = None if run.scale_is_metric else by_sensors(recording, run)
    if found is not None:
        refusals = run.inertial_refusal, run.gps_refusal
        scale, recording = found, MetricRecording(output / RECORDING_NAME, found)
        run = read_run(recording.path, found)
        run.inertial_refusal, run.gps_refusal = refusals
    final = run.history.final()
    # The longest parts, on other cores.  They write nothing: an interruption waits for them.
    with ThreadPoolExecutor() as others, all_or_none(output) as folder:
        drawn = others.submit(drawn_map, run, recording, final)
        clip = others.submit(clip_of_keyframes, run, recording)
        report = rigid_report(run, final)
        _write_map(folder, recording, run)
        if scale is not None:
            (folder / SCALE_NAME).write_text(scale.yaml(), encoding="utf-8")
        _write_files(folder, run, final, report)
        names = {path.name for path in folder.iterdir()} | {RECORDING_NAME}
        page = folder / PAGE_NAME
        write_page(page, run, final, report, names, drawn=drawn.result(), clip=clip.result())
    return report


def _write_map(folder: Path, recording: Recording, run: Run) -> None:
    """Keep the map, where the run came to its end with one."""
    stream = run.stream
    if stream is None:
        return
    header = MapHeader(
        source=stream.source,
        calibration=stream.calibration,
        metric=run.scale_is_metric,
        level=run.z_is_up,
    )
    kept = (k for k in recording.decoded(topics.MAP_KEPT) if isinstance(k, MapKeyframe))
    write_map(folder / MAP_NAME, header, kept)


def _write_files(folder: Path, run: Run, final: dict[int, Any], report: dict[str, Any]) -> None:
    history = run.history
    trajectories = {
        "trajectory": history.placed(),
        "trajectory_online": history.online,
        "keyframes": history.keyframe_poses(),
    }
    longest = history.longest_segment()
    for segment in sorted({longest, *(s["id"] for s in report["segments"])}):
        # Each segment is a world of its own, at a scale of its own: a file of its own.
        suffix = "" if segment == longest else f"_segment_{segment}"
        T_world_camera = history.trajectory_in(segment, final).T_world_camera
        write_meshes(folder, run.mesh, segment, suffix, T_world_camera)
        for name, poses in trajectories.items():
            write_tum(folder / f"{name}{suffix}.txt", history.trajectory_in(segment, poses))
        here = history.points_in(segment)
        write_ply(
            folder / f"points{suffix}.ply",
            np.asarray(here.positions, np.float32),
            np.asarray(here.colours, np.uint8).reshape(-1, 3),
        )
    calibration = found_calibration(run)
    if calibration is not None:
        text = calibration_yaml(calibration) + _scale_comment(run)
        (folder / CALIBRATION_NAME).write_text(text, encoding="utf-8")
    text = json.dumps(report, indent=1) + "\n"
    (folder / REPORT_NAME).write_text(text, encoding="utf-8")


def _scale_comment(run: Run) -> str:
    """A comment for people: a calibration has no scale, so its readers ignore it."""
    if run.scale is None:
        return ""
    return f"# the map of this result is in metres: scale +- {run.scale.sigma:.2%}\n"

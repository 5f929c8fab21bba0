"""Turns a recording into the files that a user opens.  A function of the recording alone."""

import json
import tempfile
from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pliant.algorithms.geometry import pose_to_matrix
from pliant.errors import ResultError
from pliant.evaluation.map_truth import count_distinct, well_observed
from pliant.export.ply import write_ply
from pliant.export.tum import write_tum
from pliant.map_history import MapHistory
from pliant.messages import topics
from pliant.messages.types import CameraStream, Extrema, MapUpdate, MeshPiece, Status, StreamEnd
from pliant.recording.reader import Recording
from pliant.recording.summary import Summary
from pliant_services.keeping_up import REASON
from pliant_services.mesh_results import mesh_report, write_meshes

RECORDING_NAME = "recording.mcap"
CONFIG_NAME = "config.yaml"
REPORT_NAME = "report.json"
_ROUGHLY = 0.02
_LEFT_ALONE = (
    *(topics.SOURCE, topics.DEPTH, topics.KEYFRAME, topics.KEYFRAME_FINAL, topics.MESH_BLOCKS),
    topics.SURFELS,  # see surfel_results.py
)
"""Topics that results do not need; most bytes are theirs."""


@dataclass
class Run:
    """What a recording says of its run."""

    history: MapHistory = field(default_factory=MapHistory)
    stream: CameraStream | None = None
    tracks: dict[int, int] = field(default_factory=dict[int, int])
    missing: dict[int, str] = field(default_factory=dict[int, str])
    passed_over: list[int] = field(default_factory=list[int])
    inliers: dict[int, int] = field(default_factory=dict[int, int])
    map_points: dict[int, int] = field(default_factory=dict[int, int])
    seconds: dict[str, dict[str, list[float]]] = field(
        default_factory=lambda: defaultdict(lambda: defaultdict(list))
    )
    counters: dict[str, dict[str, float]] = field(default_factory=dict[str, dict[str, float]])
    cpu_seconds: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    source_failure: str = ""
    calibration_correction: tuple[float, ...] = ()
    mesh: list[MeshPiece] = field(default_factory=list[MeshPiece])
    ends: dict[str, StreamEnd] = field(default_factory=dict[str, StreamEnd])
    arrivals_ns: list[int] = field(default_factory=list[int])
    recorded: Summary = field(default_factory=Summary)

    @property
    def frames_per_second(self) -> float:
        """Rate at which map updates reached the recorder."""
        if len(self.arrivals_ns) < 2 or self.arrivals_ns[-1] <= self.arrivals_ns[0]:
            return 0.0
        return (len(self.arrivals_ns) - 1) * 1e9 / (self.arrivals_ns[-1] - self.arrivals_ns[0])

    @property
    def complete(self) -> bool:
        """Whether every topic was closed at the end of its source, not by an interruption."""
        return bool(self.ends) and all(end.complete for end in self.ends.values())


def read_run(path: Path) -> Run:
    """Fold a recording.  Raises RecordingError for a file that is none."""
    run = Run()
    for recorded in Recording(path).messages():
        run.recorded.count(recorded)
        if recorded.topic in _LEFT_ALONE:
            continue
        message = recorded.decode()
        if isinstance(message, CameraStream):
            run.stream = message
        elif isinstance(message, Extrema):
            run.tracks[message.frame] = len(message.ids)
            if message.missing:
                run.missing[message.frame] = message.missing
        elif isinstance(message, MapUpdate):
            final = recorded.topic.key == topics.MAP_FINAL.key
            run.history.apply(message, frame=message.frame, stamp_ns=message.stamp_ns, final=final)
            if final:
                run.calibration_correction = message.calibration_correction
            else:
                run.inliers[message.frame] = message.inliers
                if message.reason == REASON:
                    run.passed_over.append(message.frame)
                run.arrivals_ns.append(recorded.log_time_ns)
        elif isinstance(message, MeshPiece):
            run.mesh.append(message)
        elif isinstance(message, Status):
            _take_status(run, message)
        elif isinstance(message, StreamEnd):
            run.ends[message.topic] = message
    return run


def folded_map(path: Path) -> MapHistory:
    """The map of a recording alone."""
    history = MapHistory()
    for topic in (topics.MAP_UPDATE, topics.MAP_FINAL):
        for update in Recording(path).decoded(topic):
            assert isinstance(update, MapUpdate)
            final = topic == topics.MAP_FINAL
            history.apply(update, frame=update.frame, stamp_ns=update.stamp_ns, final=final)
    return history


def write_results(output: Path) -> dict[str, Any]:
    """Write trajectories, keyframes, points and report beside the recording; returns the report.

    All of them, or none where the disk is full.  Raises RecordingError and ResultError.
    """
    run = read_run(output / RECORDING_NAME)
    final = run.history.final()
    report = _report(run, final)
    try:
        with tempfile.TemporaryDirectory(prefix=".partial-", dir=output) as folder:
            _write_files(Path(folder), run, final, report)
            for path in sorted(Path(folder).iterdir()):
                path.replace(output / path.name)
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
    text = json.dumps(report, indent=1) + "\n"
    (folder / REPORT_NAME).write_text(text, encoding="utf-8")


def _take_status(run: Run, status: Status) -> None:
    for stage, seconds in zip(status.stages, status.seconds.tolist(), strict=True):
        run.seconds[status.service][stage].append(seconds)
    values = dict(zip(status.counters, status.values.tolist(), strict=True))
    if "cpu_seconds" in values:
        run.cpu_seconds[status.service].append(values["cpu_seconds"])
    run.counters[status.service] = {**run.counters.get(status.service, {}), **values}
    if status.service == "ingest" and status.note:
        run.source_failure = status.note
    if status.service == "bundle_adjustment" and "points" in values:
        run.map_points[status.frame] = int(values["points"])


def _report(run: Run, final: dict[int, Any]) -> dict[str, Any]:
    history = run.history
    frames = len(run.tracks)
    by_segment: dict[int, list[int]] = defaultdict(list)
    for frame, (segment, _) in final.items():
        by_segment[segment].append(frame)
    segments = [
        {"id": segment, "first_frame": min(members), "frames": len(members)}
        for segment, members in by_segment.items()
    ]
    segments.sort(key=lambda s: s["first_frame"])
    reasons = {frame: reason for frame, (_, reason) in sorted(history.states.items()) if reason}
    # That a frame is broken says nothing about why there is no map, unless all of them are.
    silent = {*run.missing, *run.passed_over}
    telling = [reason for frame, reason in reasons.items() if frame not in silent]
    telling = telling or list(reasons.values())
    return {
        "source": run.stream.source if run.stream else "",
        "mode": run.stream.mode if run.stream else "",
        "complete": run.complete,
        "ended_early": ended_early(run, frames),
        "frames": frames,
        "frames_with_pose": len(final),
        "frames_per_second": round(run.frames_per_second, 2),
        "success_rate": len(final) / frames if frames else 0.0,
        "initialisation_retries": max(0, len(segments) - 1),
        "segments": segments,
        "last_reason": telling[-1] if telling else "",
        "frames_without_pixels": {str(f): why for f, why in sorted(run.missing.items())},
        "frames_passed_over": run.passed_over,
        "keyframes": len(history.keyframes),
        "points": len(history.points()),
        "points_well_observed": _well_observed(run, final),
        "calibration_correction": _correction(run.calibration_correction),
        "median_tracks_per_frame": _median(run.tracks.values()),
        "median_inliers_per_frame": _median(run.inliers[f] for f in final if f in run.inliers),
        "mesh": mesh_report(run.mesh),
        **process_figures(run, frames),
        "tracks_per_frame": [run.tracks[f] for f in sorted(run.tracks)],
        "inliers_per_frame": [run.inliers[f] for f in sorted(run.inliers)],
        "map_points_per_frame": [run.map_points[f] for f in sorted(run.map_points)],
        "scale_is_metric": bool(run.stream and run.stream.scale_is_metric),
    }


def process_figures(run: Run, frames: int) -> dict[str, Any]:
    """What the services and the recorder counted and took, for the report."""
    return {
        "recorder": {
            "messages": {key: t.messages for key, t in sorted(run.recorded.topics.items())},
            "lost": run.recorded.missing,
            "duplicated": run.recorded.repeated,
        },
        "counters": run.counters,
        "cpu_milliseconds_per_frame": {
            # Between the first frame and the last one: without start-up and final adjustment.
            service: round(1e3 * (spent[frames - 1] - spent[0]) / (frames - 1), 2)
            for service, spent in sorted(run.cpu_seconds.items())
            if 1 < frames <= len(spent)
        },
        "milliseconds_per_frame": {
            service: {stage: _milliseconds(values) for stage, values in stages.items()}
            for service, stages in sorted(run.seconds.items())
        },
    }


def ended_early(run: Run, came: int) -> str:
    """Why the source gave less frames than it said; "" if it did not, or was told to stop."""
    if run.source_failure or run.stream is None or not run.complete:
        return run.source_failure
    announced = run.stream.frames
    # Containers of videos count their frames roughly.
    if announced - came <= max(2, _ROUGHLY * announced):
        return ""
    return f"{came} of {announced} frames came; is the file cut off?"


def _well_observed(run: Run, final: dict[int, Any]) -> int:
    """Points of the longest segment in >= 3 keyframes under >= 1 degree, duplicates merged."""
    longest = run.history.longest_segment()
    if run.stream is None or longest < 0:
        return 0
    points = run.history.points()
    chosen = well_observed(points.keyframes, points.parallax_rad) & (points.segments == longest)
    points = points.select(chosen)
    poses = {f: pose_to_matrix(pose) for f, (segment, pose) in final.items() if segment == longest}
    return count_distinct(
        points.positions, points.frames, camera=run.stream.camera, T_world_camera=poses
    )


def _correction(correction: tuple[float, ...]) -> dict[str, float] | None:
    """What the final adjustment found wrong with the calibration; None if it was not asked."""
    if len(correction) < 3:
        return None
    s, k1, k2, readout = (*correction, 0.0)[:4]  # recordings from before the readout have three
    found = {"focal_factor": float(np.exp(s)), "k1": k1, "k2": k2, "readout": readout}
    return {name: round(value, 6) for name, value in found.items()}


def _median(values: Any) -> float:
    values = list(values)
    return float(np.median(values)) if values else 0.0


def _milliseconds(seconds: list[float]) -> dict[str, float]:
    values = 1e3 * np.array(seconds)
    return {
        "mean": round(float(values.mean()), 3),
        "median": round(float(np.median(values)), 3),
        "p95": round(float(np.percentile(values, 95)), 3),
        "max": round(float(values.max()), 3),
        "count": len(values),
    }

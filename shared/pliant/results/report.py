"""The content of report.json, its summary in a few lines, and the exit code."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

import numpy as np

from pliant.algorithms.geometry import pose_to_matrix
from pliant.algorithms.image.exposure import FLAWS
from pliant.algorithms.map_density import count_distinct, well_observed
from pliant.algorithms.slam.calibration.corrected_view import parts_of
from pliant.messages.types import DROPPED, MASKED
from pliant.results.calibration import (
    calibration_doubt,
    calibration_verdict,
    focal_changes,
    focal_sigma,
)
from pliant.results.inertial import coupling_of
from pliant.results.judgement import doubtful_frames, judge
from pliant.results.mesh_files import mesh_report
from pliant.results.run import Run

_ROUGHLY = 0.02
_Frame = TypeVar("_Frame", int, str)


def rigid_report(run: Run, final: dict[int, Any]) -> dict[str, Any]:
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
    # A broken frame does not explain why there is no map, unless all of them are broken.
    silent = {*run.missing, *run.passed_over}
    shown = [reason for frame, reason in reasons.items() if frame not in silent]
    shown = shown or list(reasons.values())
    doubtful, by_gyro = doubtful_frames(history), sorted(history.by_gyro())
    passed_over = [frame for frame in run.passed_over if frame not in {*final, *by_gyro}]
    missing = [*run.missing.values()]
    word, why = judge(
        frames=frames - missing.count(MASKED),
        broken=len(broken_images(run.missing)),
        absent=absent_frames(run, frames),
        failed=source_failed(run),
        behind=missing.count(DROPPED) + len(passed_over),
        in_segments=[len(members) for members in by_segment.values()],
        doubtful=len(doubtful),
        by_gyro=len(by_gyro),
        calibration=calibration_doubt(run, final),
        focal=focal_changes(run),
    )
    return {
        "verdict": word,
        "verdict_reason": why,
        "doubtful_frames": doubtful,
        "source": run.stream.source if run.stream else "",
        "mode": run.stream.mode if run.stream else "",
        "complete": run.complete,
        "ended_early": ended_early(run, frames),
        "frames": frames,
        "frames_that_never_came": absent_frames(run, frames),
        "frames_with_pose": len(final),
        "frames_by_gyro": by_gyro,
        "frames_per_second": round(run.frames_per_second, 2),
        "image_age_ms": _image_age(run),
        "success_rate": len(final) / frames if frames else 0.0,
        "initialisation_retries": max(0, len(segments) - 1),
        "segments": segments,
        "last_reason": last_reason(shown),
        "frames_without_pixels": {str(f): why for f, why in sorted(run.missing.items())},
        "frames_passed_over": passed_over,
        "keyframes": len(history.keyframe_poses()),
        "known_map": _known_map(run, final),
        "points": len(history.points()),
        "points_well_observed": _well_observed(run, final),
        "calibration_correction": _correction(run),
        "calibration_verdict": calibration_verdict(run, final),
        "median_tracks_per_frame": _median(run.tracks.values()),
        "median_inliers_per_frame": _median(run.inliers[f] for f in history.online),
        "mesh": mesh_report(run.mesh),
        **process_figures(run, frames),
        "tracks_per_frame": [run.tracks[f] for f in sorted(run.tracks)],
        "inliers_per_frame": [run.inliers[f] for f in sorted(run.inliers)],
        "map_points_per_frame": [run.map_points[f] for f in sorted(run.map_points)],
        "scale_is_metric": run.scale_is_metric,
        "z_is_up": run.z_is_up,
        "scale": None if run.scale is None else run.scale.content(),
        "inertial_refusal": run.inertial_refusal,
        "coupling": coupling_of(run),
        "gps_refusal": run.gps_refusal,
    }


def last_reason(reasons: Sequence[str]) -> str:
    """The last reason why frames have no pose, or the common fault of most images."""
    for flaw in FLAWS:
        count = reasons.count(flaw)
        if 2 * count > len(reasons):
            return f"{count} of {len(reasons)} {flaw.replace('the frame is', 'frames are')}"
    return reasons[-1] if reasons else ""


def broken_images(missing: Mapping[_Frame, str]) -> dict[_Frame, str]:
    """The fault of each broken image, by frame: an image that live mode drops or a mask covers is
    none."""
    return {frame: why for frame, why in missing.items() if why not in (DROPPED, MASKED)}


def process_figures(run: Run, frames: int) -> dict[str, Any]:
    """Counters and times of the services and the recorder, for the report."""
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


def absent_frames(run: Run, came: int) -> int:
    """Number of frames that the source announced and that never came."""
    announced = -1 if run.stream is None else run.stream.frames
    # Containers of videos count their frames roughly.
    roughly = 0 if run.source_failure else max(2, _ROUGHLY * announced)
    return announced - came if announced - came > roughly else 0


def source_failed(run: Run) -> bool:
    """Whether the source ended early.  A live source has no end of its own."""
    return bool(run.source_failure) and run.stream is not None and run.stream.mode != "live"


def ended_early(run: Run, came: int) -> str:
    """Why fewer frames came than the source had announced; "" if they did not."""
    absent = absent_frames(run, came)
    counted = f"{came} of {came + absent} frames arrived: " if absent else ""
    if run.source_failure:
        return counted + run.source_failure
    if not absent:
        return ""
    why = (
        "the file is truncated or damaged" if run.complete else "the run was stopped or interrupted"
    )
    return counted + why


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


def _known_map(run: Run, final: dict[int, Any]) -> dict[str, Any] | None:
    """How the run found its way in the map of earlier sessions; None if it had none.

    looked: frames before the first that was in it as it came, by itself or as its segment joined.
    """
    if not run.known_segments:
        return None
    came = sorted(run.history.states)
    as_it_came = [f for f, (of, _) in run.history.online.items() if of in run.known_segments]
    return {
        "keyframes": sum(k.frame < 0 for k in run.history.keyframes.values()),
        "frames_in_it": sum(segment in run.known_segments for segment, _ in final.values()),
        "looked": came.index(min(as_it_came)) if as_it_came else len(came),
    }


def _correction(run: Run) -> dict[str, float] | None:
    """The error of the calibration by the last adjustment; None if it was not estimated."""
    correction = run.calibration_correction
    if len(correction) < 3:
        return None
    s, k1, k2, a, b, t = parts_of(correction)
    readout = correction[3] if len(correction) > 3 else 0.0
    found = {"focal_factor": float(np.exp(s)), "k1": k1, "k2": k2, "readout": readout}
    found |= {"principal_x": a, "principal_y": b, "aspect_factor": float(np.exp(t))}
    if run.calibration_sigmas:
        found["focal_sigma"] = focal_sigma(run)
    if run.focal_range is not None:
        found["focal_factor_min"], found["focal_factor_max"] = (
            float(np.exp(s)) * each for each in run.focal_range
        )
    return {name: round(value, 6) for name, value in found.items()}


def _median(values: Any) -> float:
    values = list(values)
    return float(np.median(values)) if values else 0.0


def _image_age(run: Run) -> dict[str, float] | None:
    """How old live images are when their poses are published; None for recorded ones."""
    ages = run.image_ages_ms
    if not len(ages):
        return None
    p50, p99 = np.percentile(ages, (50.0, 99.0)).tolist()
    return {"p50": round(p50, 1), "p99": round(p99, 1)}


def _milliseconds(seconds: list[float]) -> dict[str, float]:
    values = 1e3 * np.array(seconds)
    return {
        "mean": round(float(values.mean()), 3),
        "median": round(float(np.median(values)), 3),
        "p95": round(float(np.percentile(values, 95)), 3),
        "max": round(float(values.max()), 3),
        "count": len(values),
    }

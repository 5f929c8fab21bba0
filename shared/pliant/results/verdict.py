"""The verdict of a run in a few lines, and the exit code."""

import re
from collections.abc import Mapping
from typing import Any

from pliant.datasets.static_mask import static_line
from pliant.exit_codes import DONE, INCOMPLETE
from pliant.messages.types import BROKEN, DROPPED, MASKED
from pliant.results.report import broken_images
from pliant.results.surfels import surfel_summary
from pliant.wording import counted

_NAMED = 10  # broken images beside the first, and stretches placed by the gyro
_OF_SOURCE = re.compile(r"frame (\d+) of the source: ")


def grade(report: dict[str, Any]) -> int:
    """The exit code of a run with this report."""
    broken = broken_images(report["frames_without_pixels"])
    whole = report["complete"] and not (broken or report["ended_early"])
    return DONE if report["segments"] and whole else INCOMPLETE


def summary(report: dict[str, Any], *, has_map: bool = True) -> list[str]:
    """The report in a few lines.  has_map: False if none was requested, as in a replay."""
    if report.get("profile") == "deformable":
        return [*surfel_summary(report), *_faults(report), _judged(report)]
    frames = counted(report["frames"], "frame")
    if not has_map:
        median = f"median per frame: {report['median_tracks_per_frame']:.0f} tracks"
        return [f"{frames}, no map: bundle_adjustment was not replayed", median]
    lines = [
        f"{frames} at {report['frames_per_second']:.1f} frames/s, "
        f"{report['frames_with_pose']} with a pose ({100.0 * report['success_rate']:.1f} %), "
        f"{counted(report['keyframes'], 'keyframe')}, {counted(report['points'], 'point')}",
        f"median per frame: {report['median_tracks_per_frame']:.0f} tracks, {_mapped(report)}",
    ]
    age = report.get("image_age_ms")
    if age is not None:
        lines.append(
            f"age of an image when its pose is published: median {age['p50']:.0f} ms, "
            f"99 % below {age['p99']:.0f} ms"
        )
    lines += _map_lines(report)
    lines += _dropped_parts(report.get("counters", {}).get("bundle_adjustment", {}))
    lines += [
        f"{mesh['level']} mesh: {mesh['triangles']} triangles "
        f"from {counted(mesh['keyframes'], 'keyframe')}"
        for mesh in report["mesh"]
        if mesh["level"] == "fine"
    ]
    lines += _gyro_lines(report)
    lines += _scale_lines(report)
    lines += _coupling_lines(report)
    lens = report.get("calibration_verdict")
    lines += [lens] if lens and lens != report["verdict_reason"] else []
    lines += _faults(report)
    if not report["segments"]:
        lines.append(f"no map could start: {report['last_reason'] or 'no frames'}")
    elif len(report["segments"]) > 1:
        lines.append(
            f"the camera was lost and a new segment started: {len(report['segments'])} segments"
        )
    return [*lines, _judged(report)]


def _judged(report: dict[str, Any]) -> str:
    return f"{report['verdict']}: {report['verdict_reason']}"


def _mapped(report: dict[str, Any]) -> str:
    """How many tracks were mapped in the median of the frames that had a pose as they came."""
    if report["segments"] and not report["median_inliers_per_frame"]:
        return "every frame waited for the map to start"
    return f"{report['median_inliers_per_frame']:.0f} mapped inliers"


def _map_lines(report: dict[str, Any]) -> list[str]:
    """How the run found its way in the map of earlier sessions."""
    known = report.get("known_map")
    if known is None:
        return []
    there = f"the loaded map of {counted(known['keyframes'], 'keyframe')}"
    if known["frames_in_it"] == 0:
        own = len(report["segments"])
        instead = f": the run made {counted(own, 'segment')} of its own" if own else ""
        return [f"{there} was recognised in none of {counted(report['frames'], 'frame')}{instead}"]
    share = known["frames_in_it"] / max(report["frames"], 1)
    return [
        f"{counted(known['frames_in_it'], 'frame')} ({share:.1%}) in {there}, recognised after "
        f"{counted(known['looked'], 'frame')}"
    ]


def _scale_lines(report: dict[str, Any]) -> list[str]:
    """The measured unit, and why other sensors were not used."""
    lines, scale = list[str](), report.get("scale")
    if scale is not None:
        level = scale.get("level")
        up = "" if level is None else f", z is up (+- {level['sigma_deg']:.2f} degrees)"
        lines = [f"in metres by {scale['source']}: scale +- {scale['sigma']:.1%}{up}"]
    sensors = {"inertial samples": "inertial_refusal", "satellite fixes": "gps_refusal"}
    refusals = {sensor: report.get(key) for sensor, key in sensors.items()}
    return lines + [f"{sensor} not used: {why}" for sensor, why in refusals.items() if why]


def _coupling_lines(report: dict[str, Any]) -> list[str]:
    """A line about what inertial samples did to keyframes, unless their refusal is known."""
    coupling = report.get("coupling")
    if coupling is None:
        return []
    if why := coupling["refusal"]:
        known = report.get("inertial_refusal")
        return [] if known else [f"inertial samples did not move the keyframes: {why}"]
    mm = coupling["moved_mm"]
    moved = f"{mm:.2g}" if mm < 10.0 else f"{mm:.0f}"
    keyframes = counted(coupling["keyframes"], "keyframe")
    return [f"inertial samples moved {keyframes} by {moved} mm in the median"]


def _gyro_lines(report: dict[str, Any]) -> list[str]:
    """Lines about the poses by the gyro, if there are any."""
    counters = report.get("counters", {}).get("bundle_adjustment", {})
    carried, lines = report.get("frames_by_gyro", []), list[str]()
    if carried:
        runs = list[list[int]]()
        for frame in carried:
            if not runs or runs[-1][-1] + 1 != frame:
                runs.append([frame])
            runs[-1].append(frame)
        named = [f"{run[0]} to {run[-1]}" if run[-1] > run[0] else str(run[0]) for run in runs]
        more = f" and {len(named) - _NAMED} more" if len(named) > _NAMED else ""
        lines.append(
            f"{counted(len(carried), 'frame')} without a pose by images, placed by the gyro "
            f"between others: {', '.join(named[:_NAMED])}{more}"
        )
    if late := int(counters.get("gyro_late", 0)):
        had = "samples of their time had not come"
        lines.append(f"{counted(late, 'frame')} without a prediction by the gyro: {had}")
    if counters.get("gyro_dropped"):
        used = counted(int(counters.get("gyro_frames", 0)), "frame")
        lines.append(f"gyro not used after {used} with it: it contradicts the images")
    return lines


def _dropped_parts(counters: Mapping[str, float]) -> list[str]:
    """The parts that a map dropped for lack of room."""
    if "dropped_points" not in counters:
        return []
    keyframes, points = (int(counters[f"dropped_{name}"]) for name in ("keyframes", "points"))
    return [
        (
            "the map is larger than bundle_adjustment.window.kept_observations: "
            f"{counted(keyframes, 'keyframe')} and {counted(points, 'point')} dropped, but kept "
            "in the results"
        )
    ]


def _faults(report: dict[str, Any]) -> list[str]:
    """The faults of the frames."""
    lines: list[str] = []
    broken = broken_images(report["frames_without_pixels"])
    reasons = list(report["frames_without_pixels"].values())
    dropped, masked = (reasons.count(why) for why in (DROPPED, MASKED))
    static = static_line(report.get("counters", {}).get("ingest", {}))
    lines += [static] if static else []
    if masked:
        lines.append(f"{counted(masked, 'image')} skipped: fully masked")
    if dropped:
        why = _why_dropped(report.get("counters", {}).get("ingest", {}))
        lines.append(
            f"{counted(dropped, 'image')} dropped to keep up (live mode){why and f': {why}'}"
        )
    lacking = len(report.get("frames_passed_over", ()))
    ingest = report.get("counters", {}).get("ingest", {})
    unmapped = max(lacking, int(ingest.get("unmapped", 0)))
    if unmapped:
        lines.append(
            f"{counted(unmapped, 'image')} not mapped to keep up (live mode), {lacking} of them "
            "without a pose"
        )
    if broken:
        lines.append(f"{counted(len(broken), 'broken image')}: {_broken_frames(broken)}")
    if report["ended_early"]:
        lines.append(f"ended early: {report['ended_early']}")
    return lines


def _broken_frames(broken: Mapping[str, str]) -> str:
    """The fault of the first, and the numbers of the others, as the source counts them."""
    first, *others = (why.removeprefix(BROKEN) for why in broken.values())
    if not others:
        return first
    numbers = list(broken)[1:]
    of_source = [found for why in others if (found := _OF_SOURCE.match(why))]
    if len(of_source) == len(others):
        numbers = [found[1] for found in of_source]
    more = f" and {len(others) - _NAMED} more" if len(others) > _NAMED else ""
    return f"{first}; the others are frames {', '.join(numbers[:_NAMED])}{more}"


def _why_dropped(counters: Mapping[str, float]) -> str:
    """The counts of the ingest in words: "12 for tracking (waited 0.8 s)"; "" without any."""
    prefix = "dropped_for_"
    words: list[str] = []
    for key in sorted(counters):
        if key.startswith(prefix):
            waited_s = counters.get(f"waited_for_{key.removeprefix(prefix)}_s")
            how_long = "" if waited_s is None else f" (waited {waited_s:.1f} s)"
            words.append(f"{counters[key]:.0f} for {key.removeprefix(prefix)}{how_long}")
    return ", ".join(words)

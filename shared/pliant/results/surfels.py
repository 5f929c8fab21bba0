"""Turns a recording of surfels into the files that a user opens: see docs/surfels.md."""

import json
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pliant.algorithms.arrays import F64
from pliant.algorithms.deformable.judged_map import is_evidence
from pliant.algorithms.surfels.surfel_frame import SurfelState
from pliant.config import recorded_config
from pliant.formats.npz import NpzWriter
from pliant.formats.tum import write_tum
from pliant.messages import topics
from pliant.messages.types import (
    CONTRADICTED,
    DROPPED,
    MASKED,
    WAITING_FOR_DEPTH,
    CameraStream,
    Surfels,
)
from pliant.recording.reader import Recording
from pliant.results.deforming_map import NO_MAP, write_deforming_map
from pliant.results.folder import (
    DEFORMING_MAP_NAME,
    ONLINE_NAME,
    PAGE_NAME,
    RECORDING_NAME,
    REPORT_NAME,
    SURFELS_NAME,
    TRAJECTORY_NAME,
    all_or_none,
)
from pliant.results.judgement import judge_surfels, slipping_frames
from pliant.results.moving_together import MovingTogether
from pliant.results.page.moved_surface import Surface
from pliant.results.page.surfel_page import write_surfel_page
from pliant.results.report import (
    absent_frames,
    broken_images,
    ended_early,
    process_figures,
    source_failed,
)
from pliant.results.run import Run, read_run
from pliant.results.surfel_frames import corrector, final_surfels
from pliant.trajectory import Trajectory
from pliant.wording import counted

_Followed = tuple[int, int, F64]
_PER_SURFEL = (
    *("ids", "positions", "tangents", "deformations", "points_px", "zncc", "visible", "sigma"),
    *("gains", "biases", "state", "age", "born", "tried", "birth_zncc"),
    *("confirmed", "confidence"),
)


@dataclass
class _Counts:
    """The counts of the report, by frame."""

    alive: list[int] = field(default_factory=list[int])
    expected: list[float] = field(default_factory=list[float])  # of them, right by confidence
    in_view: list[int] = field(default_factory=list[int])
    listed: list[int] = field(default_factory=list[int])
    lost: list[int] = field(default_factory=list[int])
    missing: dict[int, str] = field(default_factory=dict[int, str])
    notes: dict[int, str] = field(default_factory=dict[int, str])
    segments: dict[int, list[int]] = field(default_factory=dict[int, list[int]])
    births: int = 0
    last_states: dict[str, int] = field(default_factory=dict[str, int])
    arrivals_ns: list[int] = field(default_factory=list[int])
    together: MovingTogether = field(default_factory=MovingTogether)


def write_surfel_results(output: Path) -> dict[str, Any]:
    """Write trajectory, surfels and report beside the recording; returns the report.

    All of them, or none where the disk is full.  Raises RecordingError and ResultError.
    """
    recording = output / RECORDING_NAME
    run, counts = read_run(recording), _Counts()
    followed: list[_Followed] = []
    surface = Surface()
    online: list[_Followed] = []
    with all_or_none(output) as folder:
        makes_map, why = _moves_on_own_map(run.recorded.metadata), ""
        if makes_map:
            why = write_deforming_map(folder / DEFORMING_MAP_NAME, recording, run)
        final = corrector(folder / DEFORMING_MAP_NAME)
        with NpzWriter(folder / SURFELS_NAME) as npz:
            for recorded in Recording(recording).messages(topics.SURFELS):
                surfels = recorded.decode()
                assert isinstance(surfels, Surfels)
                _count(counts, surfels, recorded.log_time_ns, run.stream)
                online += _followed(surfels)
                surfels = final(surfels)
                _add(npz, surfels)
                followed += _followed(surfels)
                if _followed(surfels):
                    surface.take(surfels)
        write_tum(folder / TRAJECTORY_NAME, _trajectory(followed))
        report = _report(run, counts, len(followed), why if makes_map else None)
        if makes_map and not why:
            write_tum(folder / ONLINE_NAME, _trajectory(online))
        text = json.dumps(report, indent=1) + "\n"
        (folder / REPORT_NAME).write_text(text, encoding="utf-8")
        names = {path.name for path in folder.iterdir()} | {RECORDING_NAME}
        drawn = surface if surface.last is not None else None
        write_surfel_page(folder / PAGE_NAME, report, surfel_summary(report), drawn, names)
    return report


def surfel_report(recording: Path) -> dict[str, Any]:
    """report.json of a run of the deformable profile."""
    run, counts, followed = read_run(recording), _Counts(), 0
    for recorded in Recording(recording).messages(topics.SURFELS):
        surfels = recorded.decode()
        assert isinstance(surfels, Surfels)
        _count(counts, surfels, recorded.log_time_ns, run.stream)
        followed += len(_followed(surfels))
    return _report(run, counts, followed)


def surfel_trajectory(recording: Path) -> Trajectory:
    """The camera's final poses in the longest segment."""
    return _trajectory([f for surfels in final_surfels(recording) for f in _followed(surfels)])


def _followed(surfels: Surfels) -> list[_Followed]:
    """Segment, time and pose of a frame, none where it has no pixels or all surfels were lost."""
    lost = surfels.missing or surfels.lost
    return [] if lost else [(surfels.segment, surfels.stamp_ns, surfels.T_world_camera)]


def _trajectory(followed: list[_Followed]) -> Trajectory:
    """Of the longest segment, the first of such: each has a world of its own."""
    lengths = Counter(segment for segment, _, _ in followed)
    longest = max(sorted(lengths), key=lengths.__getitem__, default=-1)
    poses = [(stamp_ns, pose) for segment, stamp_ns, pose in followed if segment == longest]
    return Trajectory(
        stamps_ns=np.array([stamp_ns for stamp_ns, _ in poses], np.int64),
        T_world_camera=np.array([pose for _, pose in poses]).reshape(-1, 4, 4),
    )


def surfel_summary(report: dict[str, Any]) -> list[str]:
    """The summary of the report, in a few lines."""
    alive, frames = report["alive_per_frame"], report["frames"]
    lines = [
        (
            f"{counted(frames, 'frame')} at {report['frames_per_second']:.1f} frames/s, "
            f"{report['frames_with_pose']} tracked ({100.0 * report['success_rate']:.1f} %), "
            f"{counted(report['births'], 'surfel')} created"
        ),
        f"alive: {report['median_alive']:.0f} in the median frame, "
        f"{alive[-1] if alive else 0} in the last one "
        f"({', '.join(f'{n} {state}' for state, n in report['last_states'].items()) or 'none'})",
    ]
    notes = list(report["notes"].values())
    unusable = [note for note in notes if not note.startswith(CONTRADICTED)]
    if unusable:
        lines.append(f"{counted(len(unusable), 'unusable depth map')}: {unusable[0]}")
    if contradicted := [note for note in notes if note.startswith(CONTRADICTED)]:
        lines.append(f"in {counted(len(contradicted), 'frame')} {contradicted[0]}")
    if not report["segments"]:
        lines.append(f"no surfels could start: {report['last_reason']}")
    elif report["frames_lost"]:
        lines.append(
            f"tracking was lost in {counted(len(report['frames_lost']), 'frame')}, first "
            f"{report['frames_lost'][0]}; it restarts where there is depth"
        )
    if report.get("deforming_map"):
        lines.append(f"no {DEFORMING_MAP_NAME}: {report['deforming_map']}")
    elif "deforming_map" in report:
        lines.append(
            "Cameras and surfels are those of the map of the whole run, which deforms "
            f"({ONLINE_NAME}: as they were online)"
        )
    return lines


def _add(npz: NpzWriter, surfels: Surfels) -> None:
    per_frame = {
        "frames": surfels.frame, "stamps_ns": surfels.stamp_ns, "counts": len(surfels.ids),
        "segments": surfels.segment,
    }  # fmt: skip
    for name, value in per_frame.items():
        npz.add(name, np.array([value], np.int64))
    npz.add("lost", np.array([surfels.lost]))
    npz.add("T_world_camera", surfels.T_world_camera[None])
    for name in _PER_SURFEL:
        npz.add(name, getattr(surfels, name))


def _count(counts: _Counts, surfels: Surfels, arrival_ns: int, stream: CameraStream | None) -> None:
    states = np.bincount(surfels.state, minlength=len(SurfelState)).tolist()
    counts.alive.append(states[SurfelState.TRACKED])
    tracked = surfels.state == SurfelState.TRACKED
    known = len(surfels.confidence) == len(tracked)
    counts.expected.append(float((surfels.confidence if known else tracked)[tracked].sum()))
    counts.in_view.append(_in_view(surfels, stream))
    counts.listed.append(len(surfels.ids))
    counts.arrivals_ns.append(arrival_ns)
    if surfels.note:
        counts.notes[surfels.frame] = surfels.note
    if surfels.missing:
        counts.missing[surfels.frame] = surfels.missing
        return
    if surfels.lost:
        counts.lost.append(surfels.frame)
    else:
        counts.together.take(surfels.frame, surfels)
    counts.births += int(np.count_nonzero(surfels.age == 0))
    counts.segments.setdefault(surfels.segment, []).append(surfels.frame)
    names = [state.name.lower() for state in SurfelState]
    counts.last_states = {
        name: n for name, n in zip(names, states, strict=True) if n and name != "tracked"
    }


def _in_view(surfels: Surfels, stream: CameraStream | None) -> int:
    """How many of the surfels lie within the image, tracked or not."""
    tracked = surfels.state == SurfelState.TRACKED
    if stream is None:
        return int(tracked.sum())
    x, y = surfels.points_px.T
    inside = (x >= 0) & (x < stream.width) & (y >= 0) & (y < stream.height)
    return int((tracked | (inside & (surfels.state != SurfelState.OUTSIDE))).sum())


def is_metric(metadata: Mapping[str, Mapping[str, str]]) -> bool:
    """Depth maps of a sensor are; a map of one camera has a scale of its own.

    metadata: of the recording.
    """
    return _depth_from(metadata) == "sensor"


def _depth_from(metadata: Mapping[str, Mapping[str, str]]) -> str:
    """Empty where the recording has no configuration: nothing is in metres by default then."""
    if "config" not in metadata:
        return ""
    return recorded_config(metadata, []).surfels.depth_from


def _moves_on_own_map(metadata: Mapping[str, Mapping[str, str]]) -> bool:
    """Whether a map that deforms can be made at the end."""
    return _depth_from(metadata) == "map" and not _stands_still(metadata)


def _stands_still(metadata: Mapping[str, Mapping[str, str]]) -> bool:
    return recorded_config(metadata, []).surfels.camera == "static"


def _report(run: Run, counts: _Counts, followed: int, refusal: str | None = None) -> dict[str, Any]:
    """refusal: why there is no map that deforms; None if it is not made."""
    frames = len(counts.alive)
    spent_ns = counts.arrivals_ns[-1] - counts.arrivals_ns[0] if frames else 0
    missing = counts.missing
    reasons = [*missing.values()]
    without_pixels = {
        f: why for f, why in sorted(missing.items()) if not why.startswith(WAITING_FOR_DEPTH)
    }
    lost = {*counts.lost, *missing}
    depth_from = _depth_from(run.recorded.metadata)
    slipping, unsure = (
        [frame for frame in slipping_frames(right, counts.in_view) if frame not in lost]
        for right in (counts.alive, counts.alive if depth_from == "flat" else counts.expected)
    )
    contradicted = sum(note.startswith(CONTRADICTED) for note in counts.notes.values())
    word, why = judge_surfels(
        frames=frames - reasons.count(MASKED),
        in_segments=[len(set(members) - lost) for members in counts.segments.values()],
        slipping=len(slipping),
        unsure=len(unsure),
        depth_from=depth_from,
        unusable=len(counts.notes) - contradicted,
        contradicted=contradicted,
        map_problem=refusal if refusal and refusal != NO_MAP and is_evidence(refusal) else "",
        together=len(counts.together.frames) if _stands_still(run.recorded.metadata) else 0,
        broken=len(broken_images(without_pixels)),
        absent=absent_frames(run, frames),
        failed=source_failed(run),
        behind=reasons.count(DROPPED),
    )
    return {
        "verdict": word,
        "verdict_reason": why,
        "doubtful_frames": unsure,
        "source": run.stream.source if run.stream else "",
        "mode": run.stream.mode if run.stream else "",
        "profile": "deformable",
        "complete": run.complete,
        "ended_early": ended_early(run, frames),
        "frames": frames,
        "frames_that_never_came": absent_frames(run, frames),
        "frames_with_pose": followed,
        "frames_per_second": round((frames - 1) * 1e9 / spent_ns, 2) if spent_ns > 0 else 0.0,
        "success_rate": followed / frames if frames else 0.0,
        "segments": [
            {"id": segment, "first_frame": members[0], "frames": len(set(members) - lost)}
            for segment, members in sorted(counts.segments.items())
        ],
        "last_reason": reasons[-1] if reasons else "no frames",
        "frames_without_pixels": {str(f): why for f, why in without_pixels.items()},
        "frames_lost": counts.lost,
        "notes": {str(f): note for f, note in sorted(counts.notes.items())},
        "births": counts.births,
        "median_alive": float(np.median(counts.alive)) if frames else 0.0,
        "alive_per_frame": counts.alive,
        "surfels_per_frame": counts.listed,
        "last_states": counts.last_states,
        "scale_is_metric": bool(counts.segments) and is_metric(run.recorded.metadata),
        **process_figures(run, frames),
        **({} if refusal is None else {"deforming_map": refusal}),
    }

"""What a user reads of a run: everything that went wrong is counted, named and said once."""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest

from pliant.algorithms.map_delta import LOST, TRACKING, MapDelta
from pliant.algorithms.slam.mapper import Mapper
from pliant.algorithms.slam.parameters import MappingParameters
from pliant.algorithms.tracks import FrameTracks
from pliant.datasets.source_spec import SourceSpec
from pliant.exit_codes import DONE, INCOMPLETE
from pliant.map_history import Keyframe
from pliant.messages import codec, topics
from pliant.messages.topics import Topic
from pliant.messages.types import (
    MASKED,
    CameraStream,
    Extrema,
    Header,
    MapUpdate,
    Status,
    StreamEnd,
)
from pliant.recording.summary import SECOND_PASS, Summary
from pliant.recording.writer import RecordingWriter
from pliant.results.folder import STATE_FOLDER
from pliant.results.report import rigid_report
from pliant.results.run import Run
from pliant.results.verdict import grade, summary
from pliant.results.write import write_results
from pliant_services.run import command as pipeline
from pliant_services.run.command import RunRequest, run_pipeline

REASON = "too few tracks: 0 of 100"


def stream(frames: int) -> CameraStream:
    return CameraStream(
        frame=0, stamp_ns=0, frame_id="camera", source="fake", mode="live", frames=frames,
        calibration="", width=24, height=16, fx=20.0, fy=20.0, cx=12.0, cy=8.0,
    )  # fmt: skip


def record(
    folder: Path,
    missing: list[str],
    *,
    announced: int = -1,
    note: str = "",
    complete: bool = True,
    counters: Mapping[str, float] = MappingProxyType({}),
    ended: Sequence[Topic] = (topics.STREAM, topics.EXTREMA, topics.MAP_UPDATE),
) -> list[str]:
    """The summary of a recorded run without a map, with one frame for each of ``missing``."""
    mapper = Mapper(stream(0).camera, MappingParameters(), 0)
    with RecordingWriter(folder / "recording.mcap", {}) as recording:

        def write(topic: Topic, message: Header) -> None:
            data = codec.encode(message)
            recording.write(topic, data, sequence=0, log_time_ns=1, publish_time_ns=1)

        write(topics.STREAM, stream(announced))
        for frame, why in enumerate(missing):
            header = Header(frame=frame, stamp_ns=frame, frame_id="camera")
            write(topics.EXTREMA, Extrema.of(header, FrameTracks.empty(), missing=why))
            delta = mapper.skip(frame)
            delta = delta if why else replace(delta, reason=REASON)
            write(topics.MAP_UPDATE, MapUpdate.of(header, delta, frame_id="world"))
        status = Status(
            frame=0, stamp_ns=0, frame_id="", service="ingest", note=note, stages=(),
            seconds=np.zeros(0), counters=tuple(counters), values=np.array([*counters.values()]),
        )  # fmt: skip
        write(topics.status("ingest"), status)
        for topic in ended:
            end = StreamEnd(
                frame=0, stamp_ns=0, frame_id="", topic=topic.key, messages=0, complete=complete
            )
            write(topics.STREAM_END, end)
    return summary(write_results(folder))


@pytest.mark.parametrize("missing", [[], ["", ""], ["", "broken: frame 1: cut off"]])
def test_no_map_has_a_reason_that_is_not_a_broken_frame(tmp_path: Path, missing: list[str]) -> None:
    (line,) = [x for x in record(tmp_path, missing) if x.startswith("no map could start")]
    assert line == f"no map could start: {REASON if missing else 'no frames'}"


def test_dropped_and_broken_images_are_distinguished(tmp_path: Path) -> None:
    why = ["", "dropped", "broken: frame 2: the png image is cut off", "dropped"]
    lines = record(tmp_path, why)
    assert "2 images dropped to keep up (live mode)" in lines
    assert "1 broken image: frame 2: the png image is cut off" in lines
    lines = record(tmp_path, [*why, *("broken: frame 4: empty", "broken: frame 5: empty")])
    told = "3 broken images: frame 2: the png image is cut off; the others are frames 4, 5"
    assert told in lines
    why = [f"broken: frame {3 * n} of the source: empty" if n else "" for n in range(4)]
    told = "3 broken images: frame 3 of the source: empty; the others are frames 6, 9"
    assert told in record(tmp_path, why)
    lines = record(tmp_path, ["broken: frame 0: empty"] * 20)
    others = ", ".join(map(str, range(1, 11)))
    told = f"20 broken images: frame 0: empty; the others are frames {others} and 9 more"
    assert told in lines
    assert "1 image dropped to keep up (live mode)" in record(tmp_path, ["", "dropped"])
    lines = record(tmp_path, ["", "dropped", MASKED, MASKED])
    assert "2 images skipped: fully masked" in lines
    assert not any("broken" in line for line in lines)


def test_the_last_line_has_the_verdict(tmp_path: Path) -> None:
    assert record(tmp_path, ["", ""])[-1] == "bad: there is no map"
    report = json.loads((tmp_path / "report.json").read_text())
    assert (report["verdict"], report["doubtful_frames"]) == ("bad", [])


def test_values_without_evidence_are_left_out_and_dropped_parts_reported() -> None:
    report: dict[str, Any] = {
        **dict.fromkeys(("frames", "frames_with_pose", "keyframes", "points"), 60),
        **dict.fromkeys(("ended_early", "verdict", "verdict_reason"), ""),
        "frames_per_second": 9.0,
        "success_rate": 1.0,
        "mesh": [],
        "segments": [{}],
        "frames_without_pixels": {},
        "median_tracks_per_frame": 900.0,
        "median_inliers_per_frame": 0.0,
    }
    waited = "median per frame: 900 tracks, every frame waited for the map to start"
    assert waited in summary(report)
    report["median_inliers_per_frame"] = 700.0
    assert "median per frame: 900 tracks, 700 mapped inliers" in summary(report)
    assert not any("kept_observations" in line for line in summary(report))
    counted = {"dropped_keyframes": 1.0, "dropped_points": 5200.0}
    report["counters"] = {"bundle_adjustment": counted}
    told = "kept_observations: 1 keyframe and 5200 points dropped, but kept in the results"
    assert any(line.endswith(told) for line in summary(report))


def test_what_samples_did_to_the_keyframes_is_reported() -> None:
    run = Run(stream=stream(2), recorded=Summary())
    assert rigid_report(run, {})["coupling"] is None
    did = {"coupling_outcome": 6.0, "coupling_keyframes": 40.0, "coupling_moved_m": 0.0}
    run.counters["bundle_adjustment"] = did
    report = rigid_report(run, {})
    assert report["coupling"]["refusal"].startswith("the residuals are more than ten times")
    lines = [line for line in summary(report) if "keyframes:" in line]
    assert lines == [
        f"inertial samples did not move the keyframes: {report['coupling']['refusal']}"
    ]
    # Those of a second pass replace them.
    second = {"coupling_outcome": "0.0", "coupling_keyframes": "52.0", "coupling_moved_m": "0.0021"}
    run.recorded.metadata[SECOND_PASS] = {"topics": "map/final", **second}
    report = rigid_report(run, {})
    assert report["coupling"] == {"keyframes": 52, "moved_mm": 2.1, "refusal": ""}
    assert "inertial samples moved 52 keyframes by 2.1 mm in the median" in summary(report)
    report["coupling"]["moved_mm"] = 149.6
    assert "inertial samples moved 52 keyframes by 150 mm in the median" in summary(report)
    report["coupling"]["refusal"] = "the focal length changes"
    report["inertial_refusal"] = "the gyro explains 12 %"  # one refusal is enough
    assert not [line for line in summary(report) if "the keyframes" in line]
    report["counters"] = {"bundle_adjustment": {"gyro_late": 3.0}}
    late = "3 frames without a prediction by the gyro: samples of their time had not come"
    assert late in summary(report)


def test_one_is_not_many(tmp_path: Path) -> None:
    assert record(tmp_path, [""])[0].startswith("1 frame at 0.0 frames/s, ")
    assert record(tmp_path, ["", ""])[0].startswith("2 frames at ")


def test_a_recorder_that_was_killed_did_not_cut_the_source_off(tmp_path: Path) -> None:
    """The topic of the camera is closed before the first frame; those of the frames are open."""
    lines = record(tmp_path, [""] * 4, announced=10, ended=[topics.STREAM])
    told = "4 of 10 frames arrived: the run was stopped or interrupted"
    assert [line for line in lines if "ended early" in line] == [f"ended early: {told}"]
    assert told in (tmp_path / "report.html").read_text()
    assert json.loads((tmp_path / "report.json").read_text())["complete"] is False


def test_whose_credit_was_missing_is_said_of_dropped_images(tmp_path: Path) -> None:
    counters = {"dropped": 3.0, "dropped_for_ingest": 1.0}
    counters |= {"dropped_for_tracking": 2.0, "waited_for_tracking_s": 0.75}
    lines = record(tmp_path, ["", *["dropped"] * 3, ""], counters=counters)
    why = "1 for ingest, 2 for tracking (waited 0.8 s)"
    assert f"3 images dropped to keep up (live mode): {why}" in lines
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["counters"]["ingest"] == counters


@pytest.mark.parametrize(
    ("missing", "code"),
    [({}, DONE), ({"1": "dropped"}, DONE), ({"1": "dropped", "2": "broken: cut off"}, INCOMPLETE)],
)
def test_broken_images_are_a_fault_and_dropped_ones_are_not(
    tmp_path: Path, missing: dict[str, str], code: int
) -> None:
    record(tmp_path, [""] * 3)
    report = json.loads((tmp_path / "report.json").read_text())
    report |= {"segments": [{"id": 0}], "frames_without_pixels": missing}
    assert grade(report) == code


def test_the_summary_lists_files_with_their_sizes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record(tmp_path, [""] * 3)
    (tmp_path / STATE_FOLDER).mkdir()
    (tmp_path / STATE_FOLDER / "0.state").write_bytes(bytes(10 << 20))  # removed after the summary
    pipeline._finish(tmp_path, interrupted=False, failure=None)
    first, second, *_ = capsys.readouterr().out.splitlines()
    assert re.search(r"\(\d[\d.]* KiB, of which the recording \d[\d.]* KiB\): traj", first)
    assert second == f"open in a browser: {tmp_path / 'report.html'}"


def test_a_source_that_failed_has_a_reason(tmp_path: Path) -> None:
    lines = record(tmp_path, [""] * 3, note="camera:0: delivers no more images", complete=False)
    assert "ended early: camera:0: delivers no more images" in lines


@pytest.mark.parametrize(
    ("announced", "complete", "said"),
    [(10, True, True), (10, False, False), (5, True, False), (-1, True, False)],
)
def test_a_video_that_is_cut_off_is_noticed(
    tmp_path: Path, announced: int, complete: bool, said: bool
) -> None:
    lines = record(tmp_path, [""] * 4, announced=announced, complete=complete)
    assert (
        "ended early: 4 of 10 frames arrived: the file is truncated or damaged" in lines
    ) is said


def test_a_run_that_was_interrupted_before_it_recorded_has_nothing_to_mesh(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pipeline, "_go_through", lambda *_: (True, None))
    monkeypatch.setattr(pipeline, "Fleet", lambda *_, **options: None)
    source = "built-in:tiny?frames=8"
    with pytest.raises(KeyboardInterrupt):
        run_pipeline(
            RunRequest(
                source=SourceSpec(location=source), output=tmp_path / "run", on_crash="restart"
            )
        )


def test_frames_that_waited_for_the_map_count_no_inliers(tmp_path: Path) -> None:
    """Six of eight waited and got their poses when the map began: those say nothing of tracks."""
    run = Run()
    mapper = Mapper(stream(0).camera, MappingParameters(), 0)
    for frame in range(8):
        delta = mapper.skip(frame)
        if frame >= 6:
            begun = np.arange(frame + 1 if frame == 6 else 1) + (0 if frame == 6 else frame)
            delta = replace(
                delta, state=TRACKING, segment=0, inliers=100 * frame, pose_frames=begun,
                pose_segments=np.zeros(len(begun), np.int32),
                pose_keyframes=np.zeros(len(begun), np.int64),
                poses_keyframe_camera=np.tile(np.eye(7)[6], (len(begun), 1)),
                pose_inliers=np.full(len(begun), 500, np.int32), keyframe_ids=np.array([0]),
                keyframe_frames=np.array([0]), keyframe_segments=np.zeros(1, np.int32),
                keyframe_poses=np.eye(7)[6:],
            )  # fmt: skip
        run.history.apply(delta, frame=frame, stamp_ns=frame)
        run.inliers[frame], run.tracks[frame] = delta.inliers, 900
    report = rigid_report(run, run.history.final())
    assert report["frames_with_pose"] == 8
    assert report["median_inliers_per_frame"] == 650.0


def in_segment(delta: MapDelta, frame: int, segment: int) -> MapDelta:
    """The frame is a keyframe in a segment."""
    one, pose = np.array([frame]), np.eye(7)[6:]
    return replace(
        delta, state=TRACKING, segment=segment, inliers=100, pose_frames=one,
        pose_segments=np.full(1, segment, np.int32), pose_keyframes=one + 1,
        poses_keyframe_camera=pose, pose_inliers=np.full(1, 100, np.int32),
        keyframe_ids=one + 1, keyframe_frames=one,
        keyframe_segments=np.full(1, segment, np.int32), keyframe_poses=pose,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("segments", "joined_at", "told"),
    [
        ([0] * 4, -1, "4 frames (100.0%) in {}, recognised after 0 frames"),
        # Of a segment that was joined, frames from before belong to the known map in the end.
        ([-1, 1, 1, 1, 0], 4, "4 frames (80.0%) in {}, recognised after 4 frames"),
        ([-1, 1, 1, 1], 4, "3 frames (75.0%) in {}, recognised after 4 frames"),
        (
            [1, 1],
            -1,
            "{} was recognised in none of 2 frames: the run made 1 segment of its own",
        ),
        ([-1, -1], -1, "{} was recognised in none of 2 frames"),
    ],
)
def test_the_search_time_for_a_loaded_map_is_reported(
    segments: list[int], joined_at: int, told: str
) -> None:
    """joined_at: the update with which segment 1 becomes part of the known 0; beyond the frames:
    the one after the last."""
    run, mapper = Run(known_segments={0}), Mapper(stream(0).camera, MappingParameters(), 0)
    run.history.keyframes[0] = Keyframe(-1, 0, np.eye(7)[6])
    for frame, segment in enumerate([*segments, -1]):
        final = frame == len(segments)
        delta = mapper.skip(frame)
        delta = in_segment(delta, frame, segment) if segment >= 0 else replace(delta, state=LOST)
        if frame == joined_at:
            delta = replace(delta, joined=np.array([[1, 0]], np.int32))
        run.history.apply(delta, frame=frame, stamp_ns=frame, final=final)
        if not final:
            run.inliers[frame], run.tracks[frame] = delta.inliers, 900
    lines = summary(rigid_report(run, run.history.final()))
    assert [line for line in lines if "loaded map" in line] == [
        told.format("the loaded map of 1 keyframe")
    ]

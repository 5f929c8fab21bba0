"""The files of a run are a function of its recording; segments never share one."""

import json
from pathlib import Path

import numpy as np
import pytest

from pliant.algorithms.map_delta import TRACKING, MapDelta
from pliant.algorithms.tracks import FrameTracks
from pliant.evaluation.run_evaluation import evaluate_result
from pliant.formats.ply import read_ply
from pliant.formats.tum import read_tum
from pliant.messages import codec, topics
from pliant.messages.topics import Topic
from pliant.messages.types import CameraStream, Extrema, Header, MapUpdate
from pliant.recording.writer import RecordingWriter
from pliant.results.folder import RECORDING_NAME
from pliant.results.write import write_results

SHORT, LONG = 4, 6  # frames of the first and the second segment


def delta(frame: int) -> MapDelta:
    """Frame by frame a keyframe and a point of its own; the second segment starts at SHORT."""
    segment = int(frame >= SHORT)
    pose = np.array([[float(frame), 0, 0, 0, 0, 0, 1]])
    identity = np.array([[0.0, 0, 0, 0, 0, 0, 1]])
    one, number = np.full(1, segment, np.int32), np.array([frame])
    return MapDelta(
        state=TRACKING,
        reason="",
        segment=segment,
        inliers=100,
        pose_frames=number,
        pose_segments=one,
        pose_keyframes=number,
        poses_keyframe_camera=identity,
        pose_inliers=np.full(1, 100, np.int32),
        keyframe_ids=number,
        keyframe_frames=number,
        keyframe_segments=one,
        keyframe_poses=pose,
        point_ids=number,
        point_segments=one,
        points_world=np.array([[frame, 0.0, 5.0]]),
        point_colours=np.full((1, 3), 7, np.uint8),
        point_keyframes=np.full(1, 3, np.int32),
        point_parallax_rad=np.full(1, 0.1, np.float32),
        point_sigmas=np.full(1, 0.01, np.float32),
        point_hosts=number,
        removed_point_ids=np.zeros(0, np.int64),
    )


@pytest.fixture
def result(tmp_path: Path) -> Path:
    with RecordingWriter(tmp_path / RECORDING_NAME, {}) as recording:

        def write(topic: Topic, message: Header) -> None:
            stamp = message.stamp_ns
            recording.write(
                topic,
                codec.encode(message),
                sequence=message.frame,
                log_time_ns=stamp,
                publish_time_ns=stamp,
            )

        camera = {"width": 64, "height": 48, "fx": 50.0, "fy": 50.0, "cx": 31.5, "cy": 23.5}
        start = Header(frame=0, stamp_ns=0, frame_id="camera")
        stream = {"source": "made", "mode": "lossless", "frames": -1, "calibration": ""}
        write(topics.STREAM, CameraStream(**vars(start), **stream, **camera))
        for frame in range(SHORT + LONG):
            header = Header(frame=frame, stamp_ns=frame * 10**8, frame_id="camera")
            write(topics.EXTREMA, Extrema.of(header, FrameTracks.empty()))
            write(topics.MAP_UPDATE, MapUpdate.of(header, delta(frame)))
    write_results(tmp_path)
    return tmp_path


def test_the_longest_segment_has_the_plain_names(result: Path) -> None:
    for name in ("trajectory", "trajectory_online", "keyframes"):
        longest, other = (read_tum(result / f"{name}{s}.txt") for s in ("", "_segment_0"))
        assert longest.positions[:, 0].tolist() == list(range(SHORT, SHORT + LONG))
        assert other.positions[:, 0].tolist() == list(range(SHORT))
    assert len(read_ply(result / "points.ply").points) == LONG
    assert len(read_ply(result / "points_segment_0.ply").points) == SHORT
    segments = json.loads((result / "report.json").read_text())["segments"]
    assert [s["frames"] for s in segments] == [SHORT, LONG]


def test_evaluation_counts_the_other_segments_as_lost(result: Path) -> None:
    truth = read_tum(result / "trajectory.txt")
    final = evaluate_result(result, groundtruth=truth).final
    assert (final.localised, final.other_segments, final.segments) == (LONG, SHORT, 2)
    assert final.success is False


def test_the_same_recording_gives_the_same_files(result: Path) -> None:
    before = {p.name: p.read_bytes() for p in result.iterdir() if p.is_file()}
    write_results(result)
    assert {p.name: p.read_bytes() for p in result.iterdir() if p.is_file()} == before

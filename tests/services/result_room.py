"""A result folder with a recording, and what is asked of one that is to stay as it is."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from pliant.algorithms.tracks import FrameTracks
from pliant.config import config_yaml, load_config
from pliant.errors import PliantError
from pliant.evaluation.evaluate import EvaluationRequest, run_evaluation
from pliant.messages import codec, topics
from pliant.messages.types import CameraStream, Extrema, Header, StreamEnd
from pliant.recording.writer import RecordingWriter
from pliant.results.folder import (
    prepare,
    run_metadata,
)


def made_room(tmp_path: Path) -> Path:
    """A result folder with a recording of one frame."""
    folder = tmp_path / "room"
    prepare(folder, config_yaml(load_config()))
    header = Header(frame=0, stamp_ns=0, frame_id="camera")
    stream = CameraStream(
        frame=0, stamp_ns=0, frame_id="camera", source="fake", mode="lossless", frames=1,
        calibration="", width=24, height=16, fx=20.0, fy=20.0, cx=12.0, cy=8.0,
    )  # fmt: skip
    messages = (
        (topics.STREAM, stream),
        (topics.EXTREMA, Extrema.of(header, FrameTracks.empty())),
    )
    metadata = run_metadata(config_yaml(load_config()))
    with RecordingWriter(folder / "recording.mcap", metadata) as writer:
        for topic, message in messages:
            end = StreamEnd(
                frame=1, stamp_ns=0, frame_id="", topic=topic.key, messages=1, complete=True
            )
            for sequence, (to, what) in enumerate([(topic, message), (topics.STREAM_END, end)]):
                data = codec.encode(what)
                writer.write(to, data, sequence=sequence, log_time_ns=1, publish_time_ns=0)
    for name in ("trajectory.txt", "report.json", "points.ply"):
        (folder / name).write_text(f"{name} of an earlier run")
    return folder


def contents(folder: Path) -> dict[str, bytes]:
    return {p.name: p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def refused(command: Callable[[], object], folder: Path, says: str = "is read from there") -> None:
    before = contents(folder)
    with pytest.raises(PliantError, match=says):
        command()
    assert contents(folder) == before


def evaluation(truth: Path, **outputs: object) -> Callable[[], list[str]]:
    request: dict[str, Any] = {
        "results": [truth / "result.txt"], "groundtruth": str(truth), "times": None, "frames": None,
        "tracks": False, "points": False, "mesh": False, "surfels": False, "json": None,
        "plot": None, **outputs,
    }  # fmt: skip
    return lambda: list(run_evaluation(EvaluationRequest(**request)))

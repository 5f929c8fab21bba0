"""Clips, and recordings of them, for the tests."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from pliant.bus.replay_bus import ReplayBus
from pliant.config import Config, IngestParameters, load_config
from pliant.datasets import open_source
from pliant.datasets.base import Dataset
from pliant.datasets.recorded_images import RecordedImages
from pliant.datasets.source_spec import SourceSpec
from pliant.datasets.video_decoder import quiet_opencv
from pliant.messages import topics
from pliant.messages.topics import Topic
from pliant.messages.types import Header, SourceImage
from pliant.recording.layout import CHUNK_BYTES
from pliant.recording.reader import Recording
from pliant_services.nodes import ingest, recorder
from pliant_services.runtime.monitor import SilentMonitor

FRAMES, WIDTH, HEIGHT = 30, 160, 120
FPS = 10.0


def write_clip(file: Path) -> Path:
    """Texture that moves; frames hang on earlier ones (MPEG-4), a key frame is every twelfth."""
    texture = cv2.GaussianBlur(
        np.random.default_rng(0).integers(0, 256, (240, 320, 3), np.uint8), (9, 9), 2.0
    )
    with quiet_opencv():
        writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"mp4v"), FPS, (WIDTH, HEIGHT))
    if not writer.isOpened():
        pytest.skip("OpenCV cannot write a video here")
    for number in range(FRAMES):
        writer.write(np.ascontiguousarray(texture[number:, 2 * number :][:HEIGHT, :WIDTH]))
    writer.release()
    return file


def write_large_clip(file: Path) -> Path:
    """Of several pieces: the last ones hold the index of the container."""
    noise = np.random.default_rng(1)
    with quiet_opencv():
        writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"MJPG"), FPS, (640, 480))
    if not writer.isOpened():
        pytest.skip("OpenCV cannot write a video here")
    for _ in range(18):
        writer.write(noise.integers(0, 256, (480, 640, 3), np.uint8))
    writer.release()
    assert file.stat().st_size > 3 * CHUNK_BYTES
    return file


def record(
    dataset: Dataset, path: Path, settings: Sequence[str] = (), bus: ReplayBus | None = None
) -> list[SourceImage]:
    """Record a source; what the run had is returned."""
    config = load_config(overrides=settings)
    bus = bus or ReplayBus({})
    try:
        ingest.run(bus, config, SilentMonitor(), dataset, stopping=lambda: False)
    finally:
        logged = {t: m for t, m in bus.outputs.items() if t.logged}
        packages = {"packages": {"opencv-python-headless": "4.5"}}
        recorder.run(ReplayBus(logged), config, path, packages)
    return published_on(bus)


def published_on(bus: ReplayBus) -> list[SourceImage]:
    return [m for m in bus.outputs[topics.SOURCE] if isinstance(m, SourceImage)]


def opened(clip: Path, **part: float) -> Dataset:
    return open_source(SourceSpec(location=str(clip), fov_deg=60.0), IngestParameters(**part))  # type: ignore[arg-type]


def references(path: Path) -> list[SourceImage]:
    found = Recording(path).decoded(topics.SOURCE)
    return [m for m in found if isinstance(m, SourceImage)]


def assert_same_images(path: Path, published: list[SourceImage]) -> None:
    made = list(RecordedImages(Recording(path)))
    assert [m.frame for m in made] == [m.frame for m in published]
    for again, was in zip(made, published, strict=True):
        assert again == replace(was, clip_frame=-1)


def rewritten(path: Path, made: Path, change: dict[Topic, object]) -> Path:
    """A recording with other messages on some topics."""
    logged: dict[Topic, list[Header]] = {}
    for message in Recording(path).messages():
        if message.topic != topics.STREAM_END:
            logged.setdefault(message.topic, []).append(message.decode())
    logged |= change  # type: ignore[arg-type]
    metadata = {"packages": {"opencv-python-headless": "4.5"}}
    recorder.run(ReplayBus({t: m for t, m in logged.items() if m}), Config(), made, metadata)
    return made

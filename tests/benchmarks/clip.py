"""What the images of a video take in a recording, and how quickly they are there again.

In time of the processor: one thread reads them.
"""

import random
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from benchmarks.table import markdown
from pliant.bus.replay_bus import ReplayBus
from pliant.config import load_config
from pliant.datasets import open_source
from pliant.datasets.recorded_images import RecordedImages
from pliant.datasets.rectifier import decode
from pliant.datasets.video import quiet_opencv
from pliant.messages import topics
from pliant.messages.types import SourceImage
from pliant.recording.reader import Recording
from pliant_services.nodes import ingest, recorder
from pliant_services.runtime.monitor import SilentMonitor

_SEEKS = 20


def measure(video: Path | None) -> Iterator[str]:
    """Ingest and recorder alone; a video of the built-in room (MPEG-4) where none is given."""
    with tempfile.TemporaryDirectory(prefix="pliant-clip-bench-") as made:
        file = video or _room(Path(made) / "room.mp4")
        yield f"{file.name}: {1e-6 * file.stat().st_size:.1f} MB\n"
        rows = [_row(file, Path(made) / f"{clip}.mcap", clip) for clip in ("false", "true")]
    yield markdown(["recorder.clip", "MB", "by the clip's", "an image in order", "any image"], rows)


def _room(file: Path) -> Path:
    frames = [decode(frame) for frame in open_source("built-in:room")]
    height, width = frames[0].shape[:2]
    with quiet_opencv():
        writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"mp4v"), 30.0, (width, height))
    for frame in frames:
        writer.write(cv2.cvtColor(frame, cv2.COLOR_GRAY2BGR))
    writer.release()
    return file


def _row(file: Path, path: Path, clip: str) -> list[str]:
    config, bus = load_config(overrides=[f"recorder.clip={clip}"]), ReplayBus({})
    dataset = open_source(str(file), fov_deg=60.0)
    ingest.run(bus, config, SilentMonitor(), dataset, stopping=lambda: False)
    logged = {topic: messages for topic, messages in bus.outputs.items() if topic.logged}
    recorder.run(ReplayBus(logged), config, path, {})
    recording = Recording(path)
    start, count = time.process_time(), 0
    for image in RecordedImages(recording):
        count += bool(image.data)
    each_s = (time.process_time() - start) / count
    stored = [m for m in recording.decoded(topics.SOURCE) if isinstance(m, SourceImage)]
    images, waits = RecordedImages(recording), list[float]()
    for image in random.Random(0).sample(stored, _SEEKS):
        start = time.process_time()
        images.whole(image)
        waits.append(time.process_time() - start)
    size = path.stat().st_size
    return [
        clip,
        f"{1e-6 * size:.1f}",
        f"{size / file.stat().st_size:.2f}",
        f"{1e3 * each_s:.1f} ms",
        f"{1e3 * float(np.median(waits)):.0f} ms, {1e3 * max(waits):.0f} at most",
    ]

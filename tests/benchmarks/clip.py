"""What the images of a video take in a recording, and how quickly they are there again.

In time of the processor: one thread reads them.
"""

import random
import tempfile
import time
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import cv2
import numpy as np

from benchmarks.table import markdown
from pliant.bus.replay_bus import ReplayBus
from pliant.config import load_config
from pliant.datasets import open_source
from pliant.datasets.recorded_images import RecordedImages
from pliant.datasets.rectifier import decode
from pliant.datasets.source_spec import SourceSpec
from pliant.datasets.video_decoder import quiet_opencv
from pliant.messages import topics
from pliant.messages.types import SourceImage
from pliant.recording.reader import Recording
from pliant_services.nodes import ingest, recorder
from pliant_services.runtime.monitor import SilentMonitor

_SEEKS = 20


def measure(video: Path | None) -> Iterator[str]:
    """Ingest and recorder alone; a video of the built-in room (MPEG-4) where none is given."""
    with tempfile.TemporaryDirectory(prefix="pliant-clip-bench-") as made:
        file = video or clip_of("built-in:room?colour=0", Path(made) / "room.mp4")
        yield f"{file.name}: {1e-6 * file.stat().st_size:.1f} MB\n"
        rows = [_row(file, Path(made) / f"{clip}.mcap", clip) for clip in ("false", "true")]
    yield markdown(["recorder.clip", "MB", "by the clip's", "an image in order", "any image"], rows)


def clip_of(source: str, file: Path, frames: int | None = None, width: int | None = None) -> Path:
    """The first frames of a source as MPEG-4, in the quality that OpenCV takes for their size.

    width: to which they are enlarged; None: as they are.
    """
    writer = None
    for frame in islice(open_source(source), frames):
        pixels = decode(frame)
        pixels = cv2.cvtColor(pixels, cv2.COLOR_GRAY2BGR) if pixels.ndim == 2 else pixels[..., ::-1]
        height = pixels.shape[0] * (width or pixels.shape[1]) // pixels.shape[1]
        if width:
            pixels = cv2.resize(pixels, (width, height), interpolation=cv2.INTER_CUBIC)
        if writer is None:
            code, size = cv2.VideoWriter.fourcc(*"mp4v"), (pixels.shape[1], height)
            with quiet_opencv():
                writer = cv2.VideoWriter(str(file), code, 30.0, size)
        writer.write(np.ascontiguousarray(pixels))
    if writer is not None:
        writer.release()
    return file


def _row(file: Path, path: Path, clip: str) -> list[str]:
    config, bus = load_config(overrides=[f"recorder.clip={clip}"]), ReplayBus({})
    dataset = open_source(SourceSpec(location=str(file), fov_deg=60.0))
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

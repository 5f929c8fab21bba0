"""The recording alone: writing, reading, seeking, keeping up with a camera, and compression."""

import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np
import zstandard

from benchmarks.table import markdown
from pliant.algorithms.arrays import array_fields
from pliant.bus.base import Window
from pliant.bus.session import free_endpoint, open_router
from pliant.bus.zenoh_bus import ZenohBus
from pliant.config import Config
from pliant.messages import codec, topics
from pliant.messages.topics import Topic
from pliant.messages.types import Extrema, Header, MapUpdate, SourceImage
from pliant.recording.layout import CHUNK_BYTES
from pliant.recording.playback import Playback
from pliant.recording.reader import Recording
from pliant.recording.summary import summarise
from pliant.recording.writer import RecordingWriter
from pliant_services.nodes import recorder

_ROWS = {Extrema: 2500, MapUpdate: 300}
"""Rows of every array of a message; with them it is as large as the pipeline's median."""


def synthetic(frame: int) -> list[tuple[Topic, Header]]:
    """One frame of a run: a raw image of 752x480, tracks, a map update."""
    random = np.random.default_rng(frame)
    stamp = frame * 33_333_333
    pixels = random.integers(0, 256, 752 * 480, np.uint8).tobytes()
    image = SourceImage(
        frame=frame, stamp_ns=stamp, frame_id="camera",
        encoding="mono8", width=752, height=480, data=pixels,
    )  # fmt: skip
    extrema = _filled(Extrema, frame, stamp, random)
    update = _filled(MapUpdate, frame, stamp, random)
    return [(topics.SOURCE, image), (topics.EXTREMA, extrema), (topics.MAP_UPDATE, update)]


def _filled(message: type[Header], frame: int, stamp: int, random: np.random.Generator) -> Header:
    values: dict[str, Any] = {name: kind() for name, kind in codec.scalars(message).items()}
    values |= {"frame": frame, "stamp_ns": stamp, "frame_id": "camera"}
    for spec in array_fields(message):
        shape = [s if isinstance(s, int) else _ROWS[message] for s in spec.shape]
        values[spec.name] = (1000.0 * random.random(shape)).astype(spec.dtype)
    return message(**values)


def measure(seconds: int) -> Iterator[str]:
    """Write and read with codec and checks, seek in ``seconds`` of 30 frames/s, keep up."""
    frames = [synthetic(n) for n in range(30)]
    with tempfile.TemporaryDirectory(prefix="pliant-bench-") as folder:
        path = Path(folder) / "recording.mcap"
        clock = _Clock()
        tenths: list[float] = []
        size = _write(path, frames, 30 * seconds, tenths)
        rows = [["write, encoding and fsync included", clock.rate(size), "300"]]
        text = f"{tenths[0]:.0f}, {min(tenths):.0f}, {tenths[-1]:.0f} MB/s of processor time"
        rows += [["the first, slowest and last tenth of that", text, ""]]
        clock = _Clock()
        read = sum(len(m.data) for m in Recording(path).messages() if m.decode().frame >= 0)
        rows += [["read, checked and decoded", clock.rate(read), "300"]]
        waits = [_seek(path, share * seconds) for share in (0.1, 0.5, 0.9, 0.99)]
        text = f"{1e3 * max(waits):.0f} ms"
        rows += [[f"first message after a seek in {seconds} s ({size / 1e9:.1f} GB)", text, "200"]]
        path.unlink()
        behind = _keep_up(Path(folder) / "live.mcap", frames, rate_hz=60.0, seconds=10.0)
        rows += [
            ["60 frames/s for 10 s: latest frame behind its time", f"{1e3 * behind:.0f} ms", ""]
        ]
        live = summarise(Path(folder) / "live.mcap")
        rows += [["of these lost, twice", f"{live.missing}, {live.repeated}", "0, 0"]]
    yield markdown(["what", "measured", "target"], rows)


class _Clock:
    """Processor time beside wall time: the disk and others on the machine are not ours."""

    def __init__(self) -> None:
        self._cpu, self._wall = time.process_time(), time.perf_counter()

    def rate(self, size: int) -> str:
        """Bytes since the start, in MB a second of either time."""
        wall = time.perf_counter() - self._wall
        return (
            f"{self.by_processor(size):.0f} MB/s of processor time, {size / wall / 1e6:.0f} of "
            "wall time"
        )

    def by_processor(self, size: int) -> float:
        """Bytes since the start, in MB a second of processor time."""
        return size / (time.process_time() - self._cpu) / 1e6


def _write(
    path: Path, frames: list[list[tuple[Topic, Header]]], count: int, tenths: list[float]
) -> int:
    size, before, clock = 0, 0, _Clock()
    with RecordingWriter(path, {}) as writer:
        for n in range(count):
            for topic, message in frames[n % len(frames)]:
                again = dict(vars(message)) | {"frame": n, "stamp_ns": n * 33_333_333}
                data = codec.encode(type(message)(**again))
                at = again["stamp_ns"]
                writer.write(topic, data, sequence=n, log_time_ns=at, publish_time_ns=at)
                size += len(data)
            if n % 30 == 29:
                writer.sync()
            if (n + 1) % (count // 10) == 0:
                tenths.append(clock.by_processor(size - before))
                before, clock = size, _Clock()
    return size


def _seek(path: Path, second: float) -> float:
    start = time.perf_counter()
    playback = Playback(path)
    message = next(playback.messages([topics.SOURCE, topics.EXTREMA], start_s=second))
    assert message.decode().stamp_ns >= second * 1e9 - 1
    return time.perf_counter() - start


def _keep_up(
    path: Path, frames: list[list[tuple[Topic, Header]]], *, rate_hz: float, seconds: float
) -> float:
    """The recorder behind a bus; by how much the sender was ever late because of it."""
    config = Config()
    endpoint = free_endpoint()
    router = open_router(endpoint)
    limits = config.recorder
    window = {"recorder": Window(limits.window_messages, limits.window_mib << 20)}
    outputs = [topics.SOURCE, topics.EXTREMA, topics.MAP_UPDATE]

    def record() -> None:
        with ZenohBus(
            endpoints=[endpoint], session="bench", service="recorder",
            inputs=dict.fromkeys(outputs, "ingest"), outputs={}, window=16,
        ) as bus:  # fmt: skip
            recorder.run(bus, config, path, {})

    thread = threading.Thread(target=record)
    thread.start()
    behind = 0.0
    pause = threading.Event()
    with ZenohBus(
        endpoints=[endpoint], session="bench", service="ingest", inputs={},
        outputs=dict.fromkeys(outputs, ("recorder",)), window=16, windows=window,
    ) as bus:  # fmt: skip
        start = None
        for n in range(int(rate_hz * seconds)):
            for topic, message in frames[n % len(frames)]:
                bus.publish(topic, message)
            start = time.perf_counter() if start is None else start  # the recorder is there now
            late = time.perf_counter() - start - n / rate_hz
            behind = max(behind, late)
            pause.wait(max(0.0, -late))
        bus.end_all()
    thread.join()
    router.close()
    return behind


def compression(path: Path) -> Iterator[str]:
    """Size and speed of every topic of a recording, in chunks as they are stored."""
    chunks: dict[str, list[bytearray]] = defaultdict(lambda: [bytearray()])
    for message in Recording(path).messages():
        last = chunks[message.topic.key]
        if len(last[-1]) + len(message.data) > CHUNK_BYTES and last[-1]:
            last.append(bytearray())
        last[-1] += message.data
    packers: dict[str, Any] = {"lz4": lz4.frame.compress}
    for level in (-5, 1, 3):
        packers[f"zstd {level}"] = zstandard.ZstdCompressor(level=level).compress
    rows: list[list[str]] = []
    for key, stored in sorted(chunks.items()):
        total = sum(map(len, stored))
        row = [key, f"{total / 1e3:.0f} kB"]
        for pack in packers.values():
            best = np.inf
            for _ in range(3):
                start = time.process_time()
                packed = sum(len(pack(bytes(chunk))) for chunk in stored)
                best = min(best, time.process_time() - start)
            row.append(f"{packed / total:.2f}, {total / max(best, 1e-9) / 1e6:.0f} MB/s")
        rows.append(row)
    yield markdown(["topic", "size", *packers], rows)

"""What the recording of a video takes, by topic and field, beside the video itself."""

import tempfile
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import msgpack

from benchmarks.clip import clip_of
from benchmarks.table import markdown
from pliant.algorithms.arrays import array_fields
from pliant.bus.replay_bus import ReplayBus
from pliant.config import Config, config_yaml, load_config
from pliant.datasets import open_source
from pliant.datasets.source_spec import SourceSpec
from pliant.messages import topics
from pliant.recording.layout import CHUNK_BYTES, compress
from pliant.recording.reader import Recording
from pliant.recording.summary import summarise
from pliant_services.nodes import ingest, recorder
from pliant_services.replay.services import Replay, replayable
from pliant_services.runtime.monitor import SilentMonitor

_SERVICES = ("tracking", "bundle_adjustment", "meshing")
_SHOWN = 0.005
"""Share of the recording from which on a field has a row of its own."""


def measure(
    source: str, frames: int | None, width: int | None, overrides: Sequence[str]
) -> Iterator[str]:
    """Of a video or a recording as it is; of the first frames of another source as a video."""
    with tempfile.TemporaryDirectory(prefix="pliant-bytes-bench-") as made:
        path = Path(source)
        if path.suffix != ".mcap":
            video = path
            if not path.is_file():
                video = clip_of(source, Path(made) / "clip.mp4", frames, width)
            path = Path(made) / "recording.mcap"
            _record(video, load_config(overrides=list(overrides)), path)
        yield from _table(Recording(path))


def _record(video: Path, config: Config, path: Path) -> None:
    """What ``pliant run`` records, in one process."""
    bus = ReplayBus({})
    dataset = open_source(SourceSpec(location=str(video), fov_deg=60.0))
    ingest.run(bus, config, SilentMonitor(), dataset, stopping=lambda: False)
    logged = {topic: messages for topic, messages in bus.outputs.items() if topic.logged}
    images, metadata = path.with_name("images.mcap"), {"config": {"yaml": config_yaml(config)}}
    recorder.run(ReplayBus(logged), config, images, metadata)
    del bus, logged
    Replay(images, summarise(images), replayable(_SERVICES), config).run(path, metadata)


def _table(recording: Recording) -> Iterator[str]:
    fields: dict[tuple[str, str], list[bytes]] = defaultdict(list)
    clip = frames = 0
    for message in recording.messages():
        key = message.topic.key
        if message.topic == topics.CLIP:
            clip += len(message.data)
            continue
        frames += message.topic == topics.SOURCE
        content: dict[str, Any] = msgpack.unpackb(message.data, raw=False)
        for spec in array_fields(message.topic.message):
            raw = content.pop(spec.name, [[], b""])[1]
            fields[key, spec.name].append(raw.data if isinstance(raw, msgpack.ExtType) else raw)
        fields[key, "all else"].append(msgpack.packb(content))
    raw = {at: sum(map(len, parts)) for at, parts in fields.items()}
    stored = {at: sum(_stored(at[0], parts)) for at, parts in fields.items()}
    sizes: dict[str, int] = defaultdict(int)
    for (key, _), size in stored.items():
        sizes[key] += size
    total = recording.size
    yield f"{frames} frames, a clip of {1e-6 * clip:.2f} MB, a recording of {1e-6 * total:.2f} MB:"
    yield f"{total / max(clip, 1):.2f} times the clip\n"
    rows = [["camera/clip", "", *_row(clip, clip, total, frames)]]
    for key in sorted(sizes, key=lambda key: -sizes[key]):
        whole = sum(size for (topic, _), size in raw.items() if topic == key)
        rows.append([key, "", *_row(whole, sizes[key], total, frames)])
        own = [(size, name) for (topic, name), size in stored.items() if topic == key]
        for size, name in sorted(own, reverse=True):
            if size > _SHOWN * total:
                rows.append(["", name, *_row(raw[key, name], size, total, frames)])
    yield markdown(["topic", "field", "MB", "MB stored", "of all", "kB a frame"], rows)


def _stored(key: str, parts: list[bytes]) -> Iterator[int]:
    """Bytes of a field alone, in chunks as they are stored."""
    topic = topics.by_key(key)
    compression = "" if topic is None else topic.compression
    waiting: list[bytes] = []
    for part in parts:
        if waiting and sum(map(len, waiting)) + len(part) > CHUNK_BYTES:
            yield len(compress(b"".join(waiting), compression))
            waiting = []
        waiting.append(part)
    yield len(compress(b"".join(waiting), compression))


def _row(raw: int, stored: int, total: int, frames: int) -> list[str]:
    numbers = [f"{1e-6 * raw:.2f}", f"{1e-6 * stored:.2f}", f"{100 * stored / total:.1f} %"]
    return [*numbers, f"{1e-3 * stored / max(frames, 1):.1f}"]

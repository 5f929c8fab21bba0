"""The reference replay: what the services make of a small recording that is kept with the tests.

Byte for byte where the machine is like the one of the reference; elsewhere counts, and bands around
what a frame holds.
"""

import hashlib
import json
import platform
import tempfile
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from benchmarks.table import markdown

from pliant import arithmetic
from pliant.bus.replay_bus import ReplayBus
from pliant.config import config_yaml, load_config, recorded_config
from pliant.datasets import open_source
from pliant.errors import ResultError
from pliant.messages import codec, topics
from pliant.messages.types import Extrema, Header, MapUpdate, Surfels
from pliant.recording.reader import Recording
from pliant.recording.summary import summarise
from pliant.wording import counted
from pliant_services.nodes import ingest, recorder
from pliant_services.replay.services import Replay, replayable
from pliant_services.runtime.monitor import SilentMonitor

INPUT, EXPECTED = "reference.mcap", "reference.json"
SERVICES = ("tracking", "bundle_adjustment", "meshing", "surfels")
SETTINGS = (
    "surfels.depth_from=flat",
    "surfels.max_surfels=200",
    "bundle_adjustment.start.patient_s=0",
)
"""The recording has no depth maps, and is over before a map begins that waits for parallax."""
SOURCE = "built-in:tiny?frames=8"
BAND = 0.05
"""By how much a median may differ on another machine."""
_VERSION_FRAMES = 3
_PACKAGES = ("llvmlite", "numba", "numpy", "opencv-python-headless")


def fingerprint() -> dict[str, str]:
    """What the bytes depend on beside the input: arithmetic, and whose."""
    versions = {f"{name} version": version(name) for name in _PACKAGES}
    return {**arithmetic.in_force(), **versions, "libc": " ".join(platform.libc_ver())}


def make_input(path: Path) -> None:
    """Record the camera and the images of the built-in sequence, and nothing else.

    No configuration either: the defaults count, whatever parameters there will be.
    """
    config = load_config()
    bus = ReplayBus({})
    ingest.run(bus, config, SilentMonitor(), open_source(SOURCE), stopping=lambda: False)
    logged = {topic: messages for topic, messages in bus.outputs.items() if topic.logged}
    metadata = {"pliant": {"command": f"of {SOURCE}"}}
    recorder.run(ReplayBus(logged), config, path, metadata)


def replay(path: Path) -> dict[str, Any]:
    """Run the services on the recording: fingerprint, counts, hashes and medians by topic."""
    summary = summarise(path)
    config = recorded_config(summary.metadata, SETTINGS)
    again = Replay(path, summary, replayable(SERVICES), config)
    with tempfile.TemporaryDirectory(prefix="pliant-reference-") as folder:
        made = Path(folder) / "recording.mcap"
        again.run(made, {})
        found = {t.key: _topic(Recording(made), t) for t in again.made if t.deterministic}
    return {"fingerprint": fingerprint(), "topics": found}


def keep_version(folder: Path, input_recording: Path) -> Path | None:
    """A small recording of this version of the schema, unless there is one: it is never changed."""
    path = folder / f"schema_{codec.SCHEMA_VERSION}.mcap"
    if path.exists():
        return None
    folder.mkdir(parents=True, exist_ok=True)
    summary = summarise(input_recording)
    config = recorded_config(summary.metadata, ["tracking.max_tracks=100"])
    metadata = {"config": {"yaml": config_yaml(config)}}
    small = folder / "small.mcap"
    services = replayable(("tracking", "bundle_adjustment"))
    Replay(input_recording, summary, services, config).run(small, metadata)
    logged: dict[topics.Topic, list[Header]] = {}
    for message in Recording(small).messages():
        short = not message.topic.per_frame or message.sequence < _VERSION_FRAMES
        if message.topic != topics.STREAM_END and short:
            logged.setdefault(message.topic, []).append(message.decode())
    small.unlink()
    recorder.run(ReplayBus(logged), config, path, metadata)
    return path


def _topic(recording: Recording, topic: topics.Topic) -> dict[str, Any]:
    digest = hashlib.sha256()
    count = 0
    rows: list[float] = []
    for message in recording.messages(topic):
        decoded = message.decode()
        data = codec.encode(decoded)  # however the recording holds it
        digest.update(len(data).to_bytes(8, "little") + data)
        count += 1
        if isinstance(decoded, Extrema | Surfels):
            rows.append(len(decoded.ids))
        elif isinstance(decoded, MapUpdate):
            rows.append(decoded.inliers)
    median = float(np.median(rows)) if rows else 0.0
    return {"messages": count, "sha256": digest.hexdigest(), "median": median}


def differences(expected: dict[str, Any], found: dict[str, Any]) -> Iterator[str]:
    """What is not as it was, in lines; hashes count only where the fingerprints agree."""
    same_machine = expected["fingerprint"] == found["fingerprint"]
    for key in sorted(expected["topics"].keys() | found["topics"].keys()):
        was, now = expected["topics"].get(key), found["topics"].get(key)
        if was is None or now is None:
            yield f"{key}: {'new' if was is None else 'gone'}"
        elif was["messages"] != now["messages"]:
            yield f"{key}: {now['messages']} messages, was {was['messages']}"
        elif abs(now["median"] - was["median"]) > BAND * was["median"]:
            yield f"{key}: median {now['median']:.0f} a frame, was {was['median']:.0f}"
        elif same_machine and was["sha256"] != now["sha256"]:
            yield f"{key}: other bytes, median {now['median']:.0f}, was {was['median']:.0f}"


def check(folder: Path) -> list[str]:
    """Replay and compare with what is kept.  Raises ResultError where nothing is."""
    try:
        expected = json.loads((folder / EXPECTED).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ResultError(f"{folder / EXPECTED}: cannot be read: {error}") from None
    return list(differences(expected, replay(folder / INPUT)))


def table(folder: Path) -> str:
    """What is kept: the fingerprint, and the first bytes of the hashes."""
    kept = json.loads((folder / EXPECTED).read_text(encoding="utf-8"))
    rows = [[key, value] for key, value in kept["fingerprint"].items()]
    rows += [
        [f"`{key}`", f"{counted(topic['messages'], 'message')}, {topic['sha256'][:16]}"]
        for key, topic in kept["topics"].items()
    ]
    return markdown(["with, and of", "the reference is"], rows)


def write_table(page: Path, folder: Path) -> None:
    """Put the table in its place on a page that has it."""
    before, first, rest = page.read_text(encoding="utf-8").partition("| with, and of |")
    assert first, f"{page} has no such table"
    after = rest[rest.index("\n\n") :]
    page.write_text(before + table(folder) + after, encoding="utf-8")


def refresh(folder: Path, *, new_input: bool = False) -> list[str]:
    """Keep what the services make now; returns what changed."""
    folder.mkdir(parents=True, exist_ok=True)
    if new_input or not (folder / INPUT).exists():
        make_input(folder / INPUT)
    found = replay(folder / INPUT)
    changed = ["all of it is new"]
    if (folder / EXPECTED).exists():
        before = json.loads((folder / EXPECTED).read_text(encoding="utf-8"))
        changed = list(differences(before, found))
        for name, now in found["fingerprint"].items():
            if before["fingerprint"].get(name) != now:
                changed.append(f"{name} {now}, was {before['fingerprint'].get(name)}")
    text = json.dumps(found, indent=1, sort_keys=True) + "\n"
    (folder / EXPECTED).write_text(text, encoding="utf-8")
    return changed

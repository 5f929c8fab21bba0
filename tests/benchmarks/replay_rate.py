"""A replay of one service beside the service alone: is it the service that limits the replay?"""

import importlib
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from statistics import median

from benchmarks.table import markdown
from pliant.bus.replay_bus import ReplayBus
from pliant.config import recorded_config
from pliant.messages.topics import Topic
from pliant.messages.types import Header
from pliant.recording.summary import summarise
from pliant_services.replay.services import Replay, replayable
from pliant_services.runtime.monitor import SilentMonitor


def measure(recording: Path, name: str, runs: int) -> Iterator[str]:
    """Frames a second of the service with its inputs in memory, and of its replay, in turns.

    Raises RecordingError for what has no such service.
    """
    summary = summarise(recording)
    services = replayable([name])
    config = recorded_config(summary.metadata, [])
    service = importlib.import_module(services[0].module)
    replay = Replay(recording, summary, services, config)
    inputs = {topic: list(replay.messages(topic)) for topic in services[0].inputs}
    frames = max(len(messages) for messages in inputs.values())

    def alone() -> None:
        service.run(_without_output(inputs), config, SilentMonitor())

    def replayed() -> None:
        with tempfile.TemporaryDirectory(prefix="pliant-bench-") as folder:
            replay.run(Path(folder) / "recording.mcap", {})

    alone()  # what is compiled or loaded once
    rates: dict[str, list[float]] = {"alone": [], "replayed": []}
    for _ in range(runs):
        for kind, run in (("alone", alone), ("replayed", replayed)):
            start = time.perf_counter()
            run()
            rates[kind].append(frames / (time.perf_counter() - start))
    fastest = median(rates["alone"])
    rows = [(kind, f"{median(r):.1f}", f"{median(r) / fastest:.2f}") for kind, r in rates.items()]
    yield markdown((f"{name}, {frames} frames", "frames/s", "of that alone"), rows)


def _without_output(inputs: dict[Topic, list[Header]]) -> ReplayBus:
    return ReplayBus(inputs, through_codec=False, on_publish=lambda topic, message: None)

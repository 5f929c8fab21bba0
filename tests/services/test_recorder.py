"""The recorder alone: everything that comes in is in the file, closed, with its metadata."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from pliant.algorithms.tracks import FrameTracks
from pliant.bus.base import Received
from pliant.bus.replay_bus import ReplayBus
from pliant.config import Config, config_yaml, load_config
from pliant.messages import codec, topics
from pliant.messages.types import CameraStream, Extrema, Header, SourceImage, StreamEnd
from pliant.recording.parts import RollingWriter, parts_of
from pliant.recording.reader import Recording
from pliant.recording.recover import recover
from pliant.recording.summary import summarise
from pliant_services.nodes import recorder


def test_every_message_and_every_end_is_recorded(tmp_path: Path) -> None:
    headers = [Header(frame=n, stamp_ns=10 * n, frame_id="camera") for n in range(5)]
    sources = [
        SourceImage(
            frame=h.frame, stamp_ns=h.stamp_ns, frame_id=h.frame_id,
            encoding="mono8", width=2, height=1, data=bytes([h.frame, 1]),
        )
        for h in headers
    ]  # fmt: skip
    extrema = [Extrema.of(h, FrameTracks.empty()) for h in headers]
    bus = ReplayBus({topics.SOURCE: sources, topics.EXTREMA: extrema})
    file = tmp_path / "recording.mcap"
    recorder.run(bus, Config(), file, {"config": {"yaml": "seed: 0"}})
    assert bus.acknowledged == 12
    recording = Recording(file)
    assert recording.metadata() == {"config": {"yaml": "seed: 0"}}
    for topic, sent in ((topics.SOURCE, sources), (topics.EXTREMA, extrema)):
        found = list(recording.messages(topic))
        assert [m.sequence for m in found] == list(range(5))
        assert [m.data for m in found] == [codec.encode(m) for m in sent]
    ends = list(recording.decoded(topics.STREAM_END))
    assert [(e.topic, e.messages) for e in ends if isinstance(e, StreamEnd)] == [
        (topics.SOURCE.key, 5),
        (topics.EXTREMA.key, 5),
    ]


class _Watched:
    """A bus that looks at the file whenever it is acknowledged."""

    def __init__(self, bus: ReplayBus, file: Path) -> None:
        self._bus = bus
        self._file = file
        self.vouched: list[tuple[int, int]] = []

    def receive_any(self, *, timeout_s: float | None = None) -> Iterator[Received | None]:
        for received in self._bus.receive_any():
            yield None  # a pause before each message
            yield received

    def acknowledge(self) -> None:
        self._bus.acknowledge()
        on_disk = sum(1 for _ in Recording(self._file).messages())
        self.vouched.append((self._bus.acknowledged, on_disk))


@pytest.mark.parametrize("limits", [["window_messages=6"], ["window_mib=1", "window_messages=999"]])
def test_credit_is_given_for_what_is_on_the_disk_alone(tmp_path: Path, limits: list[str]) -> None:
    config = load_config(None, [f"recorder.{limit}" for limit in limits])
    file = tmp_path / "recording.mcap"
    bus = _Watched(ReplayBus({topics.SOURCE: [image(n, 200_000) for n in range(20)]}), file)
    recorder.run(bus, config, file, {})
    assert len(bus.vouched) >= 6
    for given, on_disk in bus.vouched:
        assert on_disk == given
    assert bus.vouched[-1] == (21, 21)


def test_a_recording_in_parts_reads_as_one(tmp_path: Path) -> None:
    config = load_config(None, ["recorder.roll_mib=1"])
    file = tmp_path / "recording.mcap"
    images = [image(n, 200_000) for n in range(20)]
    recorder.run(ReplayBus({topics.SOURCE: images}), config, file, {"config": {"yaml": "x"}})
    assert not file.exists()
    assert len(parts_of(file)) == len(parts_of(tmp_path)) == len(parts_of(tmp_path / "recording"))
    for path in (file, tmp_path, tmp_path / "recording"):
        assert list(Recording(path).decoded(topics.SOURCE)) == images
        summary = summarise(path)
        assert summary.complete
        assert not summary.damage
    for part in parts_of(file):
        assert part.stat().st_size < 1.1 * 2**20
        assert Recording(part).metadata()["config"] == {"yaml": "x"}
        assert "config.yaml" in Recording(part).attachments()
    damaged = parts_of(file)[2]
    damaged.write_bytes(damaged.read_bytes()[:300_000])
    assert not summarise(file).has_index
    recover(file, tmp_path / "whole.mcap")
    whole = summarise(tmp_path / "whole.mcap")
    assert whole.has_index
    assert 0 < whole.missing < 6
    assert "config.yaml" in Recording(tmp_path / "whole.mcap").attachments()


def test_a_part_ends_after_its_time(tmp_path: Path) -> None:
    with RollingWriter(tmp_path / "a.mcap", {}, roll_ns=1000) as writer:
        for n in range(10):
            data = codec.encode(image(n, 10))
            writer.write(topics.SOURCE, data, sequence=n, log_time_ns=400 * n, publish_time_ns=0)
    counts = [len(list(Recording(part).messages())) for part in parts_of(tmp_path / "a.mcap")]
    assert counts == [3, 3, 3, 1]
    part = parts_of(tmp_path / "a.mcap")[1]
    assert recover(part, part.with_stem(f"{part.stem}_recovered")).messages == 3
    assert len(parts_of(tmp_path / "a")) == 4  # what was recovered of a part is none


def test_calibration_and_configuration_are_attached(tmp_path: Path) -> None:
    stream = CameraStream(
        frame=0, stamp_ns=0, frame_id="", source="x", mode="lossless", frames=0,
        calibration="model: pinhole", width=2, height=1, fx=1.0, fy=1.0, cx=0.0, cy=0.0,
    )  # fmt: skip
    file = tmp_path / "recording.mcap"
    recorder.run(ReplayBus({topics.STREAM: [stream]}), Config(), file, {})
    attached = Recording(file).attachments()
    assert attached["calibration.yaml"] == b"model: pinhole"
    assert load_config(None, []) == Config()
    assert attached["config.yaml"].decode() == config_yaml(Config())
    with file.open("rb") as stream_of_bytes:
        foreign = [a.name for a in make_reader(stream_of_bytes).iter_attachments()]
    assert sorted(foreign) == ["calibration.yaml", "config.yaml"]


def image(frame: int, size: int) -> SourceImage:
    data = np.random.default_rng(frame).integers(0, 256, size, np.uint8).tobytes()
    return SourceImage(
        frame=frame, stamp_ns=frame, frame_id="camera",
        encoding="mono8", width=size, height=1, data=data,
    )  # fmt: skip

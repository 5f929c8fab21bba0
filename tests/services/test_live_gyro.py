"""The gyro of a source that hears its samples while its images come."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from dark_clip import DARK, OFFSET_S, assert_placed, gyro_samples, write_clip
from restarting import Restarted, Stopping

from pliant.algorithms.inertial.samples import ImuSamples
from pliant.bus.replay_bus import ReplayBus
from pliant.config import load_config
from pliant.datasets import open_source
from pliant.datasets.base import SourceFrame
from pliant.datasets.measured.base import Measurements
from pliant.map_history import MapHistory
from pliant.messages import codec, topics
from pliant.messages.topics import Topic
from pliant.messages.types import CameraStream, Header, MapUpdate
from pliant.recording.compare import compare
from pliant.recording.measured import imu_in
from pliant.recording.reader import Recording
from pliant.recording.summary import summarise
from pliant_services.nodes import bundle_adjustment, ingest, recorder, tracking
from pliant_services.processes import BY_NAME
from pliant_services.replay.services import Replay
from pliant_services.runtime.monitor import SilentMonitor

IN_TIME_S, LATE_S = -0.02, 0.2
"""When samples are heard after the images of their time."""
STOPPED = 110
"""A frame by which the gyro is believed, some time before it is dark."""

Messages = dict[Topic, list[Header]]


class LiveClip:
    """The clip as such a source."""

    is_live, has_imu = False, True
    name, ground_truth_path = "live", None

    def __init__(self, clip: Path, samples: ImuSamples, delay_s: float) -> None:
        self._frames, self._samples = open_source(str(clip)), samples
        self._heard_ns = samples.stamps_ns + round(1e9 * (delay_s - OFFSET_S))
        self._given, self._now_ns = 0, 0
        self.calibration, self.frame_count = self._frames.calibration, self._frames.frame_count

    def __iter__(self) -> Iterator[SourceFrame]:
        for frame in self._frames:
            self._now_ns = frame.stamp_ns
            yield frame
        self._now_ns = int(self._heard_ns[-1])

    def next_imu(self) -> ImuSamples:
        rows = slice(self._given, int(np.searchsorted(self._heard_ns, self._now_ns, "right")))
        self._given = rows.stop
        return ImuSamples(**{name: each[rows] for name, each in vars(self._samples).items()})

    def heard(self) -> Measurements:
        return Measurements()


class LastReport(SilentMonitor):
    """What was counted last."""

    def report(self, header: Header, *, note: str = "", **counters: float) -> None:
        self.counters = counters


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_clip(tmp_path_factory.mktemp("dark") / "room")


@pytest.fixture(scope="module")
def samples() -> ImuSamples:
    return gyro_samples()


def ingested(clip: Path, samples: ImuSamples, delay_s: float) -> Messages:
    bus = ReplayBus({})
    source = LiveClip(clip, samples, delay_s)
    ingest.run(bus, load_config(), SilentMonitor(), source, stopping=lambda: False)
    return bus.outputs


@pytest.fixture(scope="module")
def tracked(clip: Path, samples: ImuSamples) -> Messages:
    """What the ingest makes, and tracks."""
    inputs = ingested(clip, samples, IN_TIME_S)
    bus = ReplayBus({topic: inputs[topic] for topic in (topics.STREAM, topics.IMAGE)})
    tracking.run(bus, load_config(), SilentMonitor())
    return {**inputs, **bus.outputs}


def read(inputs: Messages, after: int = -1) -> Messages:
    """What bundle adjustment reads, after a frame."""
    keys = (topics.STREAM, topics.IMAGE, topics.EXTREMA, topics.IMU)
    return {key: [each for each in inputs[key] if each.frame > after] for key in keys}


def mapped(bus: ReplayBus) -> dict[str, float]:
    """What bundle adjustment counts."""
    monitor = LastReport()
    bundle_adjustment.run(bus, load_config(), monitor)
    return monitor.counters


@pytest.fixture(scope="module")
def without(tracked: Messages) -> Messages:
    """What bundle adjustment makes without samples."""
    inputs = read(tracked)
    del inputs[topics.IMU]
    bus = ReplayBus(inputs)
    mapped(bus)
    return bus.outputs


def wire(messages: Messages, after: int = -1) -> dict[str, list[bytes]]:
    return {
        topic.key: [codec.encode(each) for each in all_of if each.frame > after]
        for topic, all_of in messages.items()
        if topic in (topics.MAP_UPDATE, topics.MAP_FINAL, topics.KEYFRAME, topics.KEYFRAME_FINAL)
    }


def test_dark_frames_are_placed_by_the_gyro_and_again(
    tracked: Messages, samples: ImuSamples, tmp_path: Path
) -> None:
    (stream,), frames = tracked[topics.STREAM], [each.frame for each in tracked[topics.IMAGE]]
    assert isinstance(stream, CameraStream)
    assert stream.imu_by_frame
    assert [piece.frame for piece in tracked[topics.IMU]] == [*frames, len(frames)]
    for name, values in vars(imu_in(tracked[topics.IMU])).items():
        np.testing.assert_array_equal(values, getattr(samples, name))
    bus = Stopping(read(tracked), STOPPED)
    counters = mapped(bus)
    history = MapHistory()
    for topic in (topics.MAP_UPDATE, topics.MAP_FINAL):
        for update in bus.outputs[topic]:
            assert isinstance(update, MapUpdate)
            is_last = topic == topics.MAP_FINAL
            history.apply(update, frame=update.frame, stamp_ns=update.stamp_ns, final=is_last)
    placed = history.placed()
    assert {segment for segment, _ in placed.values()} == {history.longest_segment()}
    assert set(history.by_gyro()) == set(DARK)
    assert_placed(history.trajectory(placed))
    assert counters["gyro_frames"] > 30
    assert counters["gyro_late"] == counters["gyro_dropped"] == 0
    # Restarted in between, and replayed from a recording.
    again = Restarted(read(tracked, STOPPED), bus.state)
    mapped(again)
    assert wire(again.outputs) == wire(bus.outputs, STOPPED)
    logged = {topic: each for topic, each in {**tracked, **bus.outputs}.items() if topic.logged}
    path, replayed = tmp_path / "recording.mcap", tmp_path / "replayed.mcap"
    recorder.run(ReplayBus(logged), load_config(), path, {})
    service = BY_NAME["bundle_adjustment"]
    Replay(path, summarise(path), [service], load_config()).run(replayed, {})
    assert not compare(Recording(path), Recording(replayed), service.outputs)


def test_samples_that_come_late_only_carry_frames_at_the_end(
    clip: Path, samples: ImuSamples, tracked: Messages, without: Messages
) -> None:
    late = ingested(clip, samples, LATE_S)[topics.IMU]
    bus = ReplayBus(read({**tracked, topics.IMU: late}))
    counters = mapped(bus)
    assert counters["gyro_frames"] == 0
    assert counters["gyro_late"] > 30
    assert counters["gyro_carried"] == len(DARK)
    assert wire(bus.outputs)[topics.MAP_UPDATE.key] == wire(without)[topics.MAP_UPDATE.key]


def test_samples_of_another_video_change_nothing(
    clip: Path, samples: ImuSamples, tracked: Messages, without: Messages
) -> None:
    backwards = replace(samples, gyro_rad_s=samples.gyro_rad_s[::-1].copy())
    other = ingested(clip, backwards, IN_TIME_S)[topics.IMU]
    bus = ReplayBus(read({**tracked, topics.IMU: other}))
    counters = mapped(bus)
    assert counters["gyro_frames"] == counters["gyro_late"] == counters["gyro_carried"] == 0
    assert wire(bus.outputs) == wire(without)

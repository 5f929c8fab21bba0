"""The ingest on a bus without processes: every frame has its message, whatever happens to it."""

import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from pliant.algorithms.image.masks import packed, unpacked
from pliant.algorithms.inertial.samples import GpsFixes, ImuSamples
from pliant.bus.replay_bus import ReplayBus
from pliant.config import Config, IngestParameters
from pliant.datasets.base import SourceFrame, encoding_of
from pliant.datasets.calibration import Calibration
from pliant.datasets.measured.base import Measurements
from pliant.errors import BusError, DatasetError, SourceLostError
from pliant.messages import codec, topics
from pliant.messages.topics import Topic
from pliant.messages.types import CAPTURED, MASKED, CameraStream, Depth, Header, Image, SourceImage
from pliant.recording.measured import fixes_of, imu_in, imu_of
from pliant.recording.reader import Recording
from pliant.recording.writer import RecordingWriter
from pliant_services.nodes import ingest
from pliant_services.runtime.host import stop_on_signal
from pliant_services.runtime.monitor import SilentMonitor

WIDTH, HEIGHT = 24, 16
STEP_NS = 20_000_000
CALIBRATION = Calibration(
    model="pinhole", width=WIDTH, height=HEIGHT, fx=20.0, fy=20.0, cx=12.0, cy=8.0
)


def png(seed: int, width: int = WIDTH, height: int = HEIGHT) -> bytes:
    pixels = np.random.default_rng(seed).integers(0, 256, (height, width), np.uint8)
    return cv2.imencode(".png", pixels)[1].tobytes()


@dataclass
class FakeDataset:
    """Frames from a list; ``before`` is called with the index of a frame before it comes out."""

    data: Sequence[bytes]
    is_live: bool = False
    before: Callable[[int], None] = lambda _: None
    fails_at: int | None = None
    name: str = "fake"
    ground_truth_path: Path | None = None
    calibration: Calibration = CALIBRATION

    @property
    def frame_count(self) -> int | None:
        return None if self.is_live else len(self.data)

    def __iter__(self) -> Iterator[SourceFrame]:
        for index, data in enumerate(self.data):
            self.before(index)
            if index == self.fails_at:
                raise DatasetError("fake: delivers no more images; is it still plugged in?")
            encoding = encoding_of(data)
            yield SourceFrame(index=index, stamp_ns=index * STEP_NS, encoding=encoding, data=data)
        self.before(len(self.data))


class Counters(SilentMonitor):
    """Keeps what was reported last."""

    def __init__(self) -> None:
        self.frames: list[int] = []
        self.counters: dict[str, float] = {}
        self.captured_s = 0.0
        self.note = ""

    def report(self, header: Header, *, note: str = "", **counters: float) -> None:
        self.frames.append(header.frame)
        self.captured_s = counters.pop(CAPTURED, 0.0)
        self.counters, self.note = counters, note


class SlowBus(ReplayBus):
    """A bus whose readers take an image only when they are allowed to."""

    def __init__(self, on_image: Callable[[int], None]) -> None:
        super().__init__({})
        self._on_image = on_image

    def publish(self, topic: Topic, message: Header, **how: Any) -> None:
        super().publish(topic, message, **how)
        if topic is topics.IMAGE:
            self._on_image(message.frame)
            self.waited_s = {"tracking": 0.5 * (message.frame + 1)}


def run(
    dataset: FakeDataset,
    bus: ReplayBus | None = None,
    *,
    mode: str = "auto",
    stopping: Callable[[], bool] = lambda: False,
) -> tuple[list[Image], Counters, ReplayBus]:
    bus = bus or ReplayBus({})
    monitor = Counters()
    config = Config(ingest=IngestParameters(mode=mode))  # type: ignore[arg-type]
    ingest.run(bus, config, monitor, dataset, stopping)
    return images_of(bus), monitor, bus


def images_of(bus: ReplayBus) -> list[Image]:
    """The images, after a check that both per-frame topics carry every frame exactly once."""
    images = [m for m in bus.outputs.get(topics.IMAGE, []) if isinstance(m, Image)]
    sources = [m for m in bus.outputs.get(topics.SOURCE, []) if isinstance(m, SourceImage)]
    numbers = list(range(len(images)))
    assert [m.frame for m in images] == [m.frame for m in sources] == numbers
    assert [m.stamp_ns for m in images] == [m.stamp_ns for m in sources]
    return images


def test_lossless_publishes_every_frame_and_its_bytes_as_they_came() -> None:
    data = [png(i) for i in range(5)]
    images, monitor, bus = run(FakeDataset(data))
    assert [image.missing for image in images] == [""] * 5
    expected = [cv2.imdecode(np.frombuffer(d, np.uint8), cv2.IMREAD_GRAYSCALE) for d in data]
    for image, grey in zip(images, expected, strict=True):
        np.testing.assert_array_equal(image.grey, grey)
    sources = bus.outputs[topics.SOURCE]
    assert [s.data for s in sources if isinstance(s, SourceImage)] == data
    assert monitor.counters == {"dropped": 0, "broken": 0, "unmapped": 0, "unplaced": 0}
    assert monitor.frames == list(range(5))


def test_the_camera_comes_first_and_its_topic_is_closed_before_the_first_frame() -> None:
    order: list[str] = []

    class Bus(ReplayBus):
        def publish(self, topic: Topic, message: Header, **how: Any) -> None:
            order.append(topic.key)
            super().publish(topic, message, **how)

        def end(self, topic: Topic, *, complete: bool = True) -> None:
            order.append(f"end of {topic.key}")
            super().end(topic, complete=complete)

    _, _, bus = run(FakeDataset([png(0)]), Bus({}))
    assert order[:2] == [topics.STREAM.key, f"end of {topics.STREAM.key}"]
    (stream,) = bus.outputs[topics.STREAM]
    assert isinstance(stream, CameraStream)
    assert (stream.mode, stream.frames, stream.width, stream.height) == ("lossless", 1, 24, 16)


BROKEN = {
    "an empty file": (b"", "empty"),
    "rubbish": (b"not an image", "does not decode"),
    "cut off": (png(1)[:-30], "cut off"),
    "another size": (png(2, WIDTH, HEIGHT + 2), "24x18 px, but the camera has 24x16"),
}


class MaskedDataset(FakeDataset):
    """Each frame has as many white columns in its mask as its number says."""

    def __iter__(self) -> Iterator[SourceFrame]:
        for frame in super().__iter__():
            used = np.zeros((HEIGHT, WIDTH), np.bool_)
            used[:, : frame.index] = True
            yield replace(frame, mask=packed(used))


def test_a_frame_that_is_masked_as_a_whole_has_no_pixels_and_is_not_broken() -> None:
    images, monitor, bus = run(MaskedDataset([png(i) for i in range(3)]))
    assert [image.missing for image in images] == [MASKED, "", ""]
    assert monitor.counters == {"dropped": 0, "broken": 0, "unmapped": 0, "unplaced": 0}
    sources = [s for s in bus.outputs[topics.SOURCE] if isinstance(s, SourceImage)]
    assert [unpacked(s.mask).sum() for s in sources] == [0, HEIGHT, 2 * HEIGHT]
    assert [image.mask for image in images[1:]] == [source.mask for source in sources[1:]]


@pytest.mark.parametrize("kind", BROKEN)
@pytest.mark.parametrize("mode", ["lossless", "live"])
def test_a_broken_frame_keeps_its_number_and_has_a_reason(kind: str, mode: str) -> None:
    data, text = BROKEN[kind]
    taken = threading.Semaphore(0)

    def wait_until_taken(index: int) -> None:
        if mode == "live" and index > 0:
            assert taken.acquire(timeout=30.0)

    bus = SlowBus(lambda _: taken.release())
    images, monitor, _ = run(
        FakeDataset([png(0), data, png(3)], before=wait_until_taken), bus, mode=mode
    )
    assert [bool(image.missing) for image in images] == [False, True, False]
    assert images[1].missing.startswith("broken: frame 1: ")
    assert text in images[1].missing
    assert images[1].grey.size == 0
    assert monitor.counters == {"dropped": 0, "broken": 1, "unmapped": 0, "unplaced": 0}


def test_live_passes_over_what_a_slow_reader_has_no_time_for() -> None:
    """While the first image waits for credit, ten more come; the newest of them wins."""
    first_is_out, all_came = threading.Event(), threading.Event()

    def before(index: int) -> None:
        if index == 1:
            assert first_is_out.wait(30.0)
        if index == 11:
            all_came.set()

    def on_image(frame: int) -> None:
        if frame == 0:
            first_is_out.set()
            assert all_came.wait(30.0)

    dataset = FakeDataset([png(i) for i in range(11)], is_live=True, before=before)
    images, monitor, bus = run(dataset, SlowBus(on_image))
    assert [image.missing for image in images] == ["", *["dropped"] * 9, ""]
    counted = {"dropped": 9, "broken": 0, "unmapped": 0, "unplaced": 0}
    why = {"dropped_for_tracking": 9, "waited_for_tracking_s": 5.0}
    assert monitor.counters == {**counted, **why}
    sources = [s for s in bus.outputs[topics.SOURCE] if isinstance(s, SourceImage)]
    assert [len(s.data) > 0 for s in sources] == [True, *[False] * 9, True]
    (stream,) = bus.outputs[topics.STREAM]
    assert isinstance(stream, CameraStream)
    assert (stream.mode, stream.frames) == ("live", -1)


def test_live_holds_the_pixels_of_one_frame_only() -> None:
    """A stalled reader must not fill the memory with images that will be dropped anyway."""
    frames = [SourceFrame(index=i, stamp_ns=i, encoding="png", data=bytes(1000)) for i in range(50)]
    first_is_out, all_came = threading.Event(), threading.Event()

    class Camera(FakeDataset):
        def __iter__(self) -> Iterator[SourceFrame]:
            yield frames[0]
            assert first_is_out.wait(30.0)
            yield from frames[1:]
            all_came.set()

    stream = ingest.newest(Camera([], is_live=True), lambda: False)
    assert not next(stream).dropped
    first_is_out.set()
    assert all_came.wait(30.0)
    rest = list(stream)
    assert [frame.index for frame in rest] == list(range(1, 50))
    assert [len(frame.data) for frame in rest] == [0] * 48 + [1000]


def test_a_data_set_played_live_keeps_the_pace_of_its_stamps() -> None:
    start, start_s = time.monotonic(), time.time()
    images, monitor, _ = run(FakeDataset([png(i) for i in range(4)]), mode="live")
    assert time.monotonic() - start >= 3 * STEP_NS * 1e-9
    assert len(images) == 4
    assert start_s + 3 * STEP_NS * 1e-9 <= monitor.captured_s <= time.time()


def test_a_file_is_looked_into_while_its_readers_start() -> None:
    read: list[int] = []

    class Readers(ReplayBus):
        def publish(self, topic: Topic, message: Header, **how: Any) -> None:
            if topic is topics.STREAM:
                assert read == [0]
            super().publish(topic, message, **how)

    run(FakeDataset([png(i) for i in range(3)], before=read.append), Readers({}))
    assert read == [0, 1, 2, 3]


def test_a_data_set_played_live_begins_when_its_readers_are_ready() -> None:
    """Otherwise its first images pass while they start, and while the first one is read."""
    read, ready_s = list[int](), list[float]()

    def ready() -> None:
        assert read
        ready_s.append(time.time())

    frames = list(ingest.newest(FakeDataset([png(0)], before=read.append), lambda: False, ready))
    assert frames[0].captured_s >= ready_s[0]


@pytest.mark.parametrize("is_live", [False, True])
def test_stopping_ends_after_the_frame_at_hand(is_live: bool) -> None:
    taken: list[int] = []
    seen = threading.Semaphore(0)

    def before(index: int) -> None:
        if is_live and index > 0:
            seen.acquire(timeout=30.0)

    def on_image(frame: int) -> None:
        taken.append(frame)
        seen.release()

    dataset = FakeDataset([png(i) for i in range(9)], is_live=is_live, before=before)
    images, _, _ = run(dataset, SlowBus(on_image), stopping=lambda: len(taken) >= 3)
    assert [image.frame for image in images] == [0, 1, 2]


def test_a_second_ctrl_c_does_not_wait_for_the_frame_at_hand() -> None:
    kinds = (signal.SIGINT, signal.SIGTERM)
    before = [signal.getsignal(kind) for kind in kinds]
    try:
        stopping = stop_on_signal()
        signal.raise_signal(signal.SIGTERM)
        assert stopping()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    finally:
        for kind, handler in zip(kinds, before, strict=True):
            signal.signal(kind, handler)


@pytest.mark.parametrize("mode", ["lossless", "live"])
def test_a_source_that_fails_in_mid_run_keeps_what_came_before(mode: str) -> None:
    bus, monitor = ReplayBus({}), Counters()
    config = Config(ingest=IngestParameters(mode=mode))  # type: ignore[arg-type]
    dataset = FakeDataset([png(i) for i in range(5)], fails_at=3)
    with pytest.raises(SourceLostError, match="plugged in"):
        ingest.run(bus, config, monitor, dataset, lambda: False)
    assert len(images_of(bus)) == 3
    assert "plugged in" in monitor.note


def test_other_sensors_come_before_the_first_frame_and_are_recorded(tmp_path: Path) -> None:
    stamps = 5_000_000 * np.arange(10_000) - 123  # before the first image, too
    imu = ImuSamples(
        stamps_ns=stamps,
        gyro_rad_s=np.random.default_rng(0).normal(size=(10_000, 3)),
        accel_m_s2=np.random.default_rng(1).normal(size=(10_000, 3)),
    )
    fixes = GpsFixes(
        stamps_ns=stamps[:3],
        latitude_deg=np.array([47.0, 47.1, 47.2]),
        longitude_deg=np.array([8.0, 8.1, 8.2]),
        altitude_m=np.array([400.0, 401.0, 402.0]),
        sigma_m=np.full((3, 3), np.nan),
    )
    bus = ReplayBus({})
    ingest.run(
        *(bus, Config(), Counters(), FakeDataset([png(0)]), lambda: False),
        measured=Measurements(imu=imu, gps=fixes),
    )
    order = list(bus.outputs)
    assert max(map(order.index, (topics.IMU, topics.GPS))) < order.index(topics.SOURCE)
    with RecordingWriter(tmp_path / "recording.mcap", {}) as file:
        for topic, messages in bus.outputs.items():
            for number, message in enumerate(messages):
                data = codec.encode(message)
                assert len(data) < topic.max_bytes
                file.write(topic, data, sequence=number, log_time_ns=1, publish_time_ns=0)
    recording = Recording(tmp_path / "recording.mcap")
    for name, value in vars(imu_of(recording)).items():
        np.testing.assert_array_equal(value, getattr(imu, name))
    for name, value in vars(fixes_of(recording)).items():
        np.testing.assert_array_equal(value, getattr(fixes, name))


class HearingDataset(FakeDataset):
    """Of a live source whose sensor measures once an image, and twice after the last."""

    has_imu = True
    given = 0

    def next_imu(self) -> ImuSamples:
        stamps = STEP_NS * np.arange(len(self.data) + 2)[self.given : self.given + 1]
        self.given += 1
        values = np.ones((len(stamps), 3))
        return ImuSamples(stamps_ns=stamps, gyro_rad_s=values, accel_m_s2=values)

    def heard(self) -> Measurements:
        one = np.ones(1)
        return Measurements(
            gps=GpsFixes(
                stamps_ns=np.zeros(1, np.int64), latitude_deg=one, longitude_deg=one,
                altitude_m=one, sigma_m=np.ones((1, 3)),
            )
        )  # fmt: skip


@pytest.mark.parametrize("is_live", [False, True])
def test_what_a_live_source_hears_comes_with_the_frames(is_live: bool) -> None:
    """Also with those that live mode leaves out."""
    published: list[tuple[Topic, int]] = []

    class Order(ReplayBus):
        def publish(self, topic: Topic, message: Header, **how: Any) -> None:
            published.append((topic, message.frame))
            super().publish(topic, message, **how)

    bus = Order({})
    dataset = HearingDataset([png(0), png(1)], is_live=is_live)
    ingest.run(bus, Config(), Counters(), dataset, lambda: False)
    (stream,) = bus.outputs[topics.STREAM]
    assert isinstance(stream, CameraStream)
    assert stream.sensors_last
    assert stream.imu_by_frame
    both = [each for each in published if each[0] in (topics.IMU, topics.IMAGE)]
    first = [(topic, frame) for frame in range(2) for topic in (topics.IMU, topics.IMAGE)]
    assert both == [*first, (topics.IMU, 2), (topics.IMU, 3)]
    samples = imu_in(bus.outputs[topics.IMU])
    assert samples.stamps_ns.tolist() == [STEP_NS * number for number in range(4)]
    assert published[-1][0] == topics.GPS
    ended = bus.ended
    assert ended.index(topics.IMAGE) < ended.index(topics.IMU) < ended.index(topics.GPS)


def test_a_live_source_that_hears_no_samples_sends_none() -> None:
    bus, dataset = ReplayBus({}), HearingDataset([png(0)])
    dataset.has_imu = False
    ingest.run(bus, Config(), Counters(), dataset, lambda: False)
    (stream,) = bus.outputs[topics.STREAM]
    assert isinstance(stream, CameraStream)
    assert not stream.imu_by_frame
    assert topics.IMU not in bus.outputs
    assert topics.IMU in bus.ended


def test_what_a_source_that_fails_reaches_is_sent_as_incomplete() -> None:
    bus, dataset = ReplayBus({}), HearingDataset([png(i) for i in range(5)], fails_at=3)
    with pytest.raises(SourceLostError):
        ingest.run(bus, Config(), Counters(), dataset, lambda: False)
    assert len(imu_in(bus.outputs[topics.IMU]).stamps_ns) == 7
    assert set(bus.cut_off) == {topics.IMAGE, topics.IMU, topics.GPS}


def test_after_a_fault_of_ours_no_topic_ends() -> None:
    class Full(ReplayBus):
        def checkpoint(self, frame: int, state: object) -> None:
            raise BusError("the disk is full")

    bus = Full({})
    with pytest.raises(BusError):
        ingest.run(bus, Config(), Counters(), HearingDataset([png(0)]), lambda: False)
    assert not {topics.IMAGE, topics.IMU, topics.GPS} & set(bus.ended)


def test_without_other_sensors_nothing_more_is_sent() -> None:
    _, _, bus = run(FakeDataset([png(0)]))
    assert not bus.outputs.get(topics.IMU)
    assert not bus.outputs.get(topics.GPS)


@pytest.mark.parametrize("mode", ["lossless", "live"])
def test_a_source_without_any_frame_is_an_error(mode: str) -> None:
    config = Config(ingest=IngestParameters(mode=mode))  # type: ignore[arg-type]
    dataset = FakeDataset([png(0)], fails_at=0)
    with pytest.raises(DatasetError) as raised:
        ingest.run(ReplayBus({}), config, Counters(), dataset, lambda: False)
    assert not isinstance(raised.value, SourceLostError)


def test_every_frame_has_its_depth_message_also_where_it_has_no_depth() -> None:
    class WithDepth(FakeDataset):
        def __iter__(self) -> Iterator[SourceFrame]:
            for frame in super().__iter__():
                yield replace(frame, depth=b"depth of frame 1" if frame.index == 1 else b"")

    _, _, bus = run(WithDepth([png(i) for i in range(3)]))
    depths = [m for m in bus.outputs[topics.DEPTH] if isinstance(m, Depth)]
    assert [m.frame for m in depths] == [0, 1, 2]
    assert [m.data for m in depths] == [b"", b"depth of frame 1", b""]
    frame = SourceFrame(index=0, stamp_ns=0, encoding="png", data=b"x", depth=b"y")
    assert frame.without_data().depth == b""

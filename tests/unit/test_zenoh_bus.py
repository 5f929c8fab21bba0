"""Flow control over real Zenoh sessions: nothing lost, memory bounded, nobody waits for ever."""

import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import zenoh
from zenoh_buses import PATIENCE_S, WINDOW, camera_stream, die, image, in_thread, reader, writer

from pliant.algorithms.inertial.preintegration import GyroSignal
from pliant.bus import health
from pliant.bus.base import Window
from pliant.bus.checkpoints import Checkpoints
from pliant.bus.links import HEAD, TRIES
from pliant.bus.outbox import Numbered
from pliant.bus.session import LocalRouter
from pliant.bus.zenoh_bus import ZenohBus
from pliant.errors import BusError
from pliant.messages import codec, topics


def test_a_late_reader_gets_every_message_in_order(endpoint: str) -> None:
    def write() -> None:
        with writer(endpoint) as bus:
            for frame in range(50):
                bus.publish(topics.IMAGE, image(frame))
            bus.end_all()

    thread, result = in_thread(write)  # waits for the reader's token
    with reader(endpoint) as bus:
        frames = [message.frame for message in bus.receive(topics.IMAGE)]
    thread.join(PATIENCE_S)
    assert result == [None]
    assert frames == list(range(50))


def test_a_sender_is_never_more_than_a_window_ahead_of_its_slowest_reader(endpoint: str) -> None:
    sent: list[int] = []
    window_full = threading.Event()

    def write() -> None:
        with writer(endpoint, "tracking", "recorder") as bus:
            for frame in range(20):
                if frame == WINDOW:
                    window_full.set()
                bus.publish(topics.IMAGE, image(frame))
                sent.append(frame)
            bus.end_all()

    with reader(endpoint) as fast, reader(endpoint, "recorder") as slow:
        thread, result = in_thread(write)
        drained, frames = in_thread(lambda: [m.frame for m in fast.receive(topics.IMAGE)])
        assert window_full.wait(PATIENCE_S)
        for taken, message in enumerate(slow.receive(topics.IMAGE)):
            assert message.frame == taken
            # The slow reader holds `taken + 1`; the sender may be a window beyond, and no more.
            assert len(sent) <= taken + 1 + WINDOW
        thread.join(PATIENCE_S)
        drained.join(PATIENCE_S)
    assert result == [None]
    assert frames == [list(range(20))]


def test_a_reader_of_images_reports_at_once_when_it_has_taken_all(endpoint: str) -> None:
    """Long before half of the window: in live mode its sender waits for that."""
    with writer(endpoint) as sender, reader(endpoint) as bus:
        bus._report_every = Window(100, 1 << 20)
        taken = bus.receive(topics.IMAGE)
        for frame in range(3):
            sender.publish(topics.IMAGE, image(frame))
            assert next(taken).frame == frame
            assert bus._inputs[topics.IMAGE.key].reported == frame + 1
            sender.wait_until_taken(topics.IMAGE)
            assert sender.untaken(topics.IMAGE, "tracking") == 0
        sender.end_all()
        assert list(taken) == []


@pytest.mark.parametrize(
    ("mode", "window_bytes", "reports"),
    [
        ("live", 1 << 20, [1, 2, 3, 4]),
        ("lossless", 1 << 20, [0, 2, 2, 4]),
        ("lossless", 48 * 64, [1, 2, 3, 4]),  # an image fills the window
    ],
)
def test_who_may_lag_reports_each_message_live_and_half_a_window_else(
    endpoint: str, mode: str, window_bytes: int, reports: list[int]
) -> None:
    common = {"endpoints": [endpoint], "session": "test", "window": WINDOW}
    common |= {"window_bytes": window_bytes}
    lags = {"tracking": Window(8, 1 << 20)}
    stream, images = topics.STREAM, topics.IMAGE
    sends = {stream: ("tracking",), images: ("tracking",)}
    reads = {stream: "ingest", images: "ingest"}
    with (
        ZenohBus(service="ingest", inputs={}, outputs=sends, **common) as sender,
        ZenohBus(service="tracking", inputs=reads, outputs={}, lags=lags, **common) as bus,
    ):
        sender.publish(stream, camera_stream(mode))
        sender.end(stream)
        assert [message.mode for message in bus.receive(stream)] == [mode]
        bus._keeper.stop()  # it reports once a second, too
        taken, found = bus.receive(images), list[int]()
        for frame in range(WINDOW):
            sender.publish(images, image(frame))
            assert next(taken).frame == frame
            found.append(bus._inputs[images.key].reported)
        assert found == reports
        sender.end_all()
        assert list(taken) == []


@pytest.fixture
def socket() -> Iterator[str]:
    """Where the router of a run listens."""
    router = LocalRouter()
    assert not router.note
    yield router.endpoint
    router.close()


def test_live_messages_that_the_router_drops_come_again_although_no_newer_one_follows(
    socket: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with writer(socket) as sender, reader(socket) as bus:
        output = sender._outputs[topics.IMAGE.key]
        put, dropped = output._put, list[int]()

        def drop(publisher: zenoh.Publisher, message: Numbered) -> None:
            is_new = message.sequence not in dropped or message.sequence == WINDOW
            if publisher is output._some and message.kind != HEAD and is_new:
                dropped.append(message.sequence)
            else:
                put(publisher, message)

        monkeypatch.setattr(output, "_put", drop)
        taken = bus.receive(topics.IMAGE)
        for frame in range(2 * WINDOW):
            sender.publish(topics.IMAGE, image(frame), live=True)
            assert next(taken).frame == frame
        sender.end_all()
        assert list(taken) == []
    assert sorted({*dropped}) == list(range(2 * WINDOW + 1))  # its end, too
    assert dropped.count(WINDOW) == 1 + TRIES  # then the router may not drop it


def test_waits_are_recorded_with_peer_and_length(endpoint: str) -> None:
    """Not those that are there and have credit."""
    with writer(endpoint, "tracking", "recorder") as sender:
        slow, fast = reader(endpoint), reader(endpoint, "recorder")
        drained, _ = in_thread(lambda: list(fast.receive(topics.IMAGE)))
        for frame in range(WINDOW):
            sender.publish(topics.IMAGE, image(frame))
        before_s = dict(sender.waited_s)
        thread, result = in_thread(lambda: sender.publish(topics.IMAGE, image(WINDOW)))
        with sender._changed:
            waits = sender._changed.wait_for(
                lambda: "tracking" in sender._waits.now.text, PATIENCE_S
            )
        assert waits
        taken = slow.receive(topics.IMAGE)
        for _ in range(WINDOW + 1):
            next(taken)
        thread.join(PATIENCE_S)
        assert result == [None]
        assert sender.waited_s["tracking"] > before_s.get("tracking", 0.0)
        sender.end_all()
        assert list(taken) == []
        drained.join(PATIENCE_S)
        for bus in (slow, fast):
            bus._keeper.all_is_safe()
            die(bus)


def test_a_window_is_bounded_in_bytes_and_opens_when_its_reader_acknowledges(
    endpoint: str,
) -> None:
    size = len(codec.encode(image(0)))
    sent: list[int] = []

    def write() -> None:
        with ZenohBus(
            endpoints=[endpoint],
            session="test",
            service="ingest",
            inputs={},
            outputs={topics.IMAGE: ["recorder"]},
            window=WINDOW,
            windows={"recorder": Window(messages=100, size=3 * size + 10)},
        ) as bus:
            for frame in range(9):
                bus.publish(topics.IMAGE, image(frame))
                sent.append(frame)
            bus.end_all()

    with reader(endpoint, "recorder") as bus:
        thread, result = in_thread(write)
        taken: list[int] = []
        for received in bus.receive_any(timeout_s=0.2):
            entry = bus._inputs[topics.IMAGE.key]
            assert entry.box.taken - entry.safe <= 3
            if received is None:  # nothing more comes without credit
                bus.acknowledge()
            else:
                taken.append(received.sequence)
        bus.acknowledge()
        thread.join(PATIENCE_S)
    assert result == [None]
    assert taken == list(range(10))


def test_messages_kept_for_checkpoints_are_bounded_and_no_service_waits_for_ever(
    endpoint: str, tmp_path
) -> None:
    """A sender waits for a checkpoint of its reader, which has what it needs to make one."""
    most, interval, frames = 2 * WINDOW + 2 * 3, 3, 40
    kept: list[int] = []

    def write() -> None:
        with ZenohBus(
            endpoints=[endpoint],
            session="test",
            service="ingest",
            inputs={},
            outputs={topics.IMAGE: ["tracking"]},
            window=WINDOW,
            windows={"tracking": Window(messages=most, size=1 << 30)},
        ) as bus:
            for frame in range(frames):
                bus.publish(topics.IMAGE, image(frame))
                kept.append(bus._outputs[topics.IMAGE.key].box.kept())
            bus.end_all()

    thread, result = in_thread(write)
    with ZenohBus(
        endpoints=[endpoint],
        session="test",
        service="tracking",
        inputs={topics.IMAGE: "ingest"},
        outputs={},
        window=WINDOW,
        checkpoints=Checkpoints(tmp_path, interval=interval),
    ) as bus:
        assert bus.restore() is None
        for message in bus.receive(topics.IMAGE):
            bus.checkpoint(message.frame, message.frame)
    thread.join(PATIENCE_S)
    assert result == [None]
    assert len(kept) == frames
    assert max(kept) <= most


def test_a_state_comes_back_with_the_samples_that_it_names(endpoint: str, tmp_path: Path) -> None:
    """They are beside the checkpoint, not in it."""
    gyro = np.random.default_rng(0).normal(size=(10_000, 3))
    signal = GyroSignal(times_s=np.arange(10_000.0), gyro=gyro)

    def opened() -> ZenohBus:
        return ZenohBus(
            endpoints=[endpoint], session="test", service="ingest", inputs={}, outputs={},
            window=WINDOW, checkpoints=Checkpoints(tmp_path, interval=1),
        )  # fmt: skip

    with opened() as bus:
        assert bus.restore() is None
        bus.checkpoint(0, (0, signal))
    (state,) = tmp_path.glob("*.state")
    assert state.stat().st_size < 0.01 * gyro.nbytes
    with opened() as bus:
        frame, again = bus.restore() or (-1, None)
    assert frame == 0
    np.testing.assert_array_equal(again.gyro, gyro)


def test_a_reader_that_dies_is_named(endpoint: str) -> None:
    bus = reader(endpoint)
    thread, result = in_thread(lambda: _write_many(endpoint))
    next(bus.receive(topics.IMAGE))
    die(bus)
    thread.join(PATIENCE_S)
    assert isinstance(result[0], BusError)
    assert "tracking went away" in str(result[0])


def _write_many(endpoint: str) -> None:
    with writer(endpoint) as bus:
        for frame in range(1000):
            bus.publish(topics.IMAGE, image(frame))


def test_a_reader_that_died_before_another_came_does_not_stop_the_other(endpoint: str) -> None:
    with writer(endpoint, "tracking", "recorder") as bus:
        die(reader(endpoint))
        with bus._changed:
            assert bus._changed.wait_for(lambda: "tracking" in bus._peers.gone_since, PATIENCE_S)
        thread, result = in_thread(lambda: bus.publish(topics.IMAGE, image(0)))
        with reader(endpoint, "recorder") as late:
            assert next(late.receive(topics.IMAGE)).frame == 0
            thread.join(PATIENCE_S)
            assert result == [None]
            with pytest.raises(BusError, match="tracking went away"):
                bus.flush()
            bus._outputs.clear()  # nothing more to wait for


def test_who_was_interrupted_does_not_wait_for_readers_that_never_came(endpoint: str) -> None:
    bus = ZenohBus(
        endpoints=[endpoint],
        session="test",
        service="ingest",
        inputs={},
        outputs={topics.IMAGE: ("tracking",)},
        window=WINDOW,
        interrupted=lambda: True,
    )
    with pytest.raises(KeyboardInterrupt), bus:
        bus.publish(topics.IMAGE, image(0))


def test_what_the_thread_of_a_bus_fails_of_its_service_raises(endpoint: str) -> None:
    """Whether it waits to receive or to send: no run hangs on a thread that is gone."""

    def fail() -> None:
        raise RuntimeError("no such clock")

    def bus(service: str, **topics_of: object) -> ZenohBus:
        return ZenohBus(
            endpoints=[endpoint],
            session="test",
            service=service,
            **{"inputs": {}, "outputs": {}, **topics_of},  # type: ignore[arg-type]
            window=WINDOW,
            on_tick=fail,
        )

    with (
        pytest.raises(RuntimeError, match="no such clock"),
        bus("recorder", inputs={topics.IMAGE: "ingest"}) as observer,
    ):
        assert next(observer.receive_any(timeout_s=PATIENCE_S)) is not None
    sender = bus("ingest", outputs={topics.IMAGE: ["tracking"]})
    thread, result = in_thread(lambda: sender.publish(topics.IMAGE, image(0)))
    thread.join(PATIENCE_S)
    die(sender)
    assert [str(error) for error in result] == ["no such clock"]


def test_health_is_reported_where_the_system_has_no_memory_figures(monkeypatch, tmp_path) -> None:
    monkeypatch.setattr(health, "_STATM", tmp_path / "statm")
    told = health.health_of("tracking", 1, "", {}, {})
    assert 1.0 < told.memory_mib < 1e6


def test_a_sender_that_dies_is_named(endpoint: str) -> None:
    with reader(endpoint) as bus:
        sender = writer(endpoint)
        sender.publish(topics.IMAGE, image(0))
        messages = bus.receive(topics.IMAGE)
        assert next(messages).frame == 0
        die(sender)
        with pytest.raises(BusError, match="ingest went away"):
            next(messages)


def test_a_reader_stays_until_its_sender_has_its_last_credits(endpoint: str) -> None:
    def write() -> None:
        with writer(endpoint) as bus:
            bus.publish(topics.IMAGE, image(0))
            bus.end_all()

    thread, result = in_thread(write)
    with reader(endpoint) as bus:
        assert len(list(bus.receive(topics.IMAGE))) == 1
        bus.see_off()
        assert bus._peers.missing(["ingest"]) == ["ingest"]
    thread.join(PATIENCE_S)
    assert result == [None]

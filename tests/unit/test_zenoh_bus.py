"""Flow control over real Zenoh sessions: nothing lost, memory bounded, nobody waits for ever."""

import struct
import tempfile
import threading
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from pliant.bus import health, session
from pliant.bus.base import Window
from pliant.bus.checkpoints import Checkpoints
from pliant.bus.links import ENVELOPE
from pliant.bus.session import LocalRouter, free_endpoint, open_router, open_session
from pliant.bus.zenoh_bus import ZenohBus
from pliant.errors import BusError, MessageError
from pliant.messages import codec, topics
from pliant.messages.types import Image, StreamEnd

WINDOW = 4
PATIENCE_S = 20.0


@pytest.fixture
def endpoint() -> Iterator[str]:
    found = free_endpoint()
    router = open_router(found)
    yield found
    router.close()


def image(frame: int) -> Image:
    return Image(
        frame=frame,
        stamp_ns=frame,
        frame_id="camera",
        grey=np.full((48, 64), frame % 256, np.uint8),
        colour=np.zeros((0, 0, 3), np.uint8),
    )


def reader(endpoint: str, name: str = "tracking") -> ZenohBus:
    return ZenohBus(
        endpoints=[endpoint],
        session="test",
        service=name,
        inputs={topics.IMAGE: "ingest"},
        outputs={},
        window=WINDOW,
    )


def writer(endpoint: str, *readers: str) -> ZenohBus:
    return ZenohBus(
        endpoints=[endpoint],
        session="test",
        service="ingest",
        inputs={},
        outputs={topics.IMAGE: readers or ("tracking",)},
        window=WINDOW,
    )


def die(bus: ZenohBus) -> None:
    """End as a killed process does: without a word."""
    bus._keeper.stop()
    bus._session.close()


def in_thread(function) -> tuple[threading.Thread, list[object]]:
    result: list[object] = []

    def run() -> None:
        try:
            result.append(function())
        except Exception as error:
            result.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    return thread, result


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


def test_a_reader_of_images_tells_at_once_when_it_has_taken_all(endpoint: str) -> None:
    """Long before a quarter of the window: in live mode its sender waits for that."""
    with writer(endpoint) as sender, reader(endpoint) as bus:
        bus._tell_every = 100
        taken = bus.receive(topics.IMAGE)
        for frame in range(3):
            sender.publish(topics.IMAGE, image(frame))
            assert next(taken).frame == frame
            assert bus._inputs[topics.IMAGE.key].told == frame + 1
            sender.wait_until_taken(topics.IMAGE)
            assert sender.untaken(topics.IMAGE, "tracking") == 0
        sender.end_all()
        assert list(taken) == []
        bus.see_off()


def test_who_was_waited_for_is_known_and_for_how_long(endpoint: str) -> None:
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


def test_what_is_kept_for_checkpoints_is_bounded_and_nobody_waits_for_ever(
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


def test_a_sender_that_ignores_credit_fills_no_memory(endpoint: str) -> None:
    with reader(endpoint) as bus:
        rude = bus._session.declare_publisher(f"pliant/test/{topics.IMAGE.key}")
        box = bus._inputs[topics.IMAGE.key].box
        for sequence in range(10 * WINDOW):
            rude.put(b"no message", attachment=sequence.to_bytes(8, "little") + bytes(9))
        with bus._changed:
            assert bus._changed.wait_for(lambda: len(box.waiting) == box.limit, PATIENCE_S)
        assert box.limit == 2 * WINDOW


def test_what_is_no_message_is_counted_told_and_asked_for_again(endpoint: str) -> None:
    """Also where it comes first under the number of a true one, and where it looks like an end."""
    said: list[str] = []
    told = threading.Event()

    def on_fault(line: str) -> None:
        said.append(line)
        told.set()

    with ZenohBus(
        endpoints=[endpoint],
        session="test",
        service="tracking",
        inputs={topics.IMAGE: "ingest"},
        outputs={},
        window=WINDOW,
        on_fault=on_fault,
    ) as bus:
        rude = bus._session.declare_publisher(f"pliant/test/{topics.IMAGE.key}")
        box = bus._inputs[topics.IMAGE.key].box
        end = codec.encode(
            StreamEnd(frame=0, stamp_ns=0, frame_id="", topic="x", messages=0, complete=True)
        )
        for payload, envelope in (
            (end, bytes(16) + b"\x01"),
            (b"no image", bytes(17)),
            (codec.encode(image(0)), bytes(16) + b"\x07"),
            (codec.encode(image(0)), b"short"),
            (codec.encode(image(9)), (9).to_bytes(8, "little") + bytes(9)),
        ):
            rude.put(payload, attachment=envelope)
        with bus._changed:
            assert bus._changed.wait_for(lambda: box.early, PATIENCE_S)
        thread, result = in_thread(lambda: _write(endpoint, 3 * WINDOW))
        frames = [message.frame for message in bus.receive(topics.IMAGE)]
        bus.see_off()
        thread.join(PATIENCE_S)
        assert told.wait(PATIENCE_S)
    assert result == [None]
    assert frames == list(range(3 * WINDOW))
    assert (box.refused, box.early) == (3, 1)
    assert "tracking: messages passed over: camera/image" in said[0]


def _write(endpoint: str, frames: int) -> None:
    with writer(endpoint) as bus:
        for frame in range(frames):
            bus.publish(topics.IMAGE, image(frame))
        bus.end_all()


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


def test_health_is_told_where_the_system_does_not_say_what_memory_is_used(
    monkeypatch, tmp_path
) -> None:
    monkeypatch.setattr(health, "_STATM", tmp_path / "statm")
    told = health.health_of("tracking", 1, "", {}, {})
    assert 1.0 < told.memory_mib < 1e6


def test_a_credit_of_nobody_is_refused(endpoint: str) -> None:
    with writer(endpoint) as bus:
        other = bus._session.declare_publisher(f"pliant/test/credit/{topics.IMAGE.key}/tracking")
        box = bus._outputs[topics.IMAGE.key].box
        with reader(endpoint) as true:
            with bus._changed:
                assert bus._changed.wait_for(lambda: not box.silent(), PATIENCE_S)
            bus.publish(topics.IMAGE, image(0))
            assert next(true.receive(topics.IMAGE)).frame == 0
            for credit in (b"short", struct.pack("<QQQB", 2**63, 0, 0, 2), bytes(24) + b"\x07"):
                other.put(credit)
            with bus._changed:
                assert bus._changed.wait_for(lambda: box.refused == 3, PATIENCE_S)
            assert box.readers["tracking"].incarnation == true._peers.incarnation


def test_a_message_that_readers_would_refuse_is_not_sent(endpoint: str) -> None:
    small = replace(topics.IMAGE, max_bytes=1000)
    with writer(endpoint) as bus, pytest.raises(MessageError, match="frame 0 takes"):
        bus.publish(small, image(0))


def test_a_sender_that_dies_is_named(endpoint: str) -> None:
    with reader(endpoint) as bus:
        sender = writer(endpoint)
        sender.publish(topics.IMAGE, image(0))
        messages = bus.receive(topics.IMAGE)
        assert next(messages).frame == 0
        die(sender)
        with pytest.raises(BusError, match="ingest went away"):
            next(messages)


def meets(local: LocalRouter) -> bool:
    """Whether two sessions meet at a router, which is closed then."""
    came = threading.Event()
    with open_session([local.endpoint]) as first, open_session([local.endpoint]) as second:
        held = first.declare_subscriber("x", lambda _: came.set())
        while not came.wait(0.05):  # until the router knows of the subscriber
            second.put("x", b"")
        held.undeclare()
    local.close()
    return came.is_set()


def test_a_run_of_one_machine_meets_at_a_socket_of_its_user(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    local = LocalRouter()
    (folder,) = tmp_path.iterdir()
    assert local.endpoint == f"unixsock-stream/{folder}/bus"
    assert folder.stat().st_mode & 0o777 == 0o700
    assert not local.note
    assert meets(local)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("why", ["too long", "No such file", "is the port in use"])
def test_where_no_socket_can_be_had_a_run_meets_on_loopback_and_says_so(
    why: str, tmp_path, monkeypatch
) -> None:
    folder = tmp_path / ("x" * (100 if why == "too long" else 1))
    if why != "No such file":
        folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    if why == "is the port in use":  # no link of that kind in this Zenoh
        monkeypatch.setattr(session, "_SOCKET", "nosuchlink")
    local = LocalRouter()
    assert local.endpoint.startswith("tcp/127.0.0.1:")
    assert why in local.note
    assert "every user of this machine" in local.note
    assert meets(local)
    assert not folder.exists() or not list(folder.iterdir())


def test_a_port_is_a_port_of_loopback(endpoint: str) -> None:
    port = int(free_endpoint().rsplit(":", 1)[1])
    local = LocalRouter(port)
    assert local.endpoint == f"tcp/127.0.0.1:{port}"
    assert meets(local)
    with pytest.raises(BusError, match="in use"):
        LocalRouter(int(endpoint.rsplit(":", 1)[1]))


def test_a_port_in_use_is_one_line(endpoint: str) -> None:
    with pytest.raises(BusError, match="in use") as caught:
        open_router(endpoint)
    assert "\n" not in str(caught.value)


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


def test_whoever_writes_as_a_start_of_the_sender_that_was_not_announced_is_not_believed(
    endpoint: str,
) -> None:
    """Not even a message that fits, under the next number: it is refused unread."""
    with reader(endpoint) as bus, writer(endpoint) as sender:
        rude = bus._session.declare_publisher(f"pliant/test/{topics.IMAGE.key}")
        box = bus._inputs[topics.IMAGE.key].box
        with bus._changed:
            assert bus._changed.wait_for(lambda: bus._peers.here.get("ingest"), PATIENCE_S)
        rude.put(codec.encode(image(7)), attachment=bytes(17))
        # What is sent next on the same connection has come when this one has been looked at.
        rude.put(b"", attachment=ENVELOPE.pack(99, sender._peers.incarnation, 0))
        with bus._changed:
            assert bus._changed.wait_for(lambda: box.early, PATIENCE_S)
        assert box.refused == 1
        assert "not announced" in box.why
        sender.publish(topics.IMAGE, image(0))
        assert next(bus.receive(topics.IMAGE)).frame == 0
        sender.end_all()
        assert list(bus.receive(topics.IMAGE)) == []
        bus.see_off()

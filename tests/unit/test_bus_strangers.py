"""What no sender of ours sends is refused, counted and told, and fills no memory."""

import struct
import threading
from dataclasses import replace
from typing import Any, cast

import pytest
from zenoh_buses import PATIENCE_S, WINDOW, image, in_thread, reader, write, writer

from pliant.bus.links import ENVELOPE
from pliant.bus.session import open_session
from pliant.bus.zenoh_bus import ZenohBus
from pliant.errors import BusError, MessageError, ResultError
from pliant.messages import codec, topics
from pliant.messages.types import StreamEnd
from pliant_services.runtime.status import listen, table
from pliant_services.view.command import follow


def test_a_viewer_of_another_version_is_reported(endpoint: str) -> None:
    with open_session([endpoint]) as connection:
        token = connection.liveliness().declare_token("pliant/s/ready/ingest/3/99/9.9.9")
        with pytest.raises(BusError, match=r"ingest is pliant 9\.9\.9 .*this viewer is"):
            follow([endpoint], "s", cast(Any, None))
        _, silent = listen([endpoint], "s", 0.5)
        assert "pliant 9.9.9" in "\n".join(table([], silent))
        token.undeclare()
        with pytest.raises(ResultError, match="no such session"):
            follow([endpoint], "s", cast(Any, None))


def test_a_sender_that_ignores_credit_fills_no_memory(endpoint: str) -> None:
    with reader(endpoint) as bus:
        rude = bus._session.declare_publisher(f"pliant/test/{topics.IMAGE.key}")
        box = bus._inputs[topics.IMAGE.key].box
        for sequence in range(10 * WINDOW):
            rude.put(b"no message", attachment=sequence.to_bytes(8, "little") + bytes(9))
        with bus._changed:
            assert bus._changed.wait_for(lambda: len(box.waiting) == box.limit, PATIENCE_S)
        assert box.limit == 2 * WINDOW


def test_a_malformed_message_is_counted_reported_and_requested_again(endpoint: str) -> None:
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
        thread, result = in_thread(lambda: write(endpoint, 3 * WINDOW))
        frames = [message.frame for message in bus.receive(topics.IMAGE)]
        bus.see_off()
        thread.join(PATIENCE_S)
        assert told.wait(PATIENCE_S)
    assert result == [None]
    assert frames == list(range(3 * WINDOW))
    assert (box.refused, box.early) == (3, 1)
    assert "tracking: ignored messages: camera/image" in said[0]


def test_a_credit_without_a_reader_is_refused(endpoint: str) -> None:
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


def test_messages_of_an_unannounced_incarnation_are_ignored(
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

"""Messages that no service of ours sends, to every key of a session: for tests and the soak."""

import struct
import threading
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path

import numpy as np
import zenoh

from pliant.bus.health import health_key
from pliant.bus.links import ENVELOPE
from pliant.bus.session import open_session
from pliant.errors import MessageError
from pliant.messages import codec
from pliant.messages.topics import MAP_KEPT, MAP_KNOWN, TOPICS, by_key, status
from pliant.recording.reader import Recording
from pliant_services.processes import inputs_of, readers_of

_BURST = 200
_PATIENCE_S = 60.0


def keys_of(fleet: tuple[str, ...]) -> list[str]:
    """Every key that somebody in the fleet listens to, but the ones that end the session."""
    keys = [topic.key for topic in TOPICS]
    for name in fleet:
        keys += [status(name).key, health_key(name), *(t.key for t in inputs_of(name, fleet))]
        for topic, readers in readers_of(name, fleet).items():
            keys += [f"credit/{topic.key}/{reader}" for reader in (*readers, "nobody")]
    return list(dict.fromkeys(keys))


def samples(recording: Path) -> dict[str, bytes]:
    """A true message of each topic that has one for every frame, and of maps as they are kept."""
    found: dict[str, bytes] = {}
    for recorded in Recording(recording).messages():
        if recorded.topic.per_frame or recorded.topic == MAP_KEPT:
            found.setdefault(recorded.topic.key, recorded.data)
    return found | {MAP_KNOWN.key: found[MAP_KEPT.key]}


def messages(
    key: str, true: Mapping[str, bytes], random: np.random.Generator, announced: int
) -> Iterator[tuple[bytes, bytes | None]]:
    """Payloads and envelopes without end.  announced: which start of its sender the others know."""
    # What fits a topic, has the next number and a sender that is known, is believed.
    others = [data for topic, data in true.items() if topic != key]
    fitting = [data for data in others if _fits(key, data)]
    wrong = [data for data in others if not _fits(key, data)]
    old = b"\x81\xa5frame\x00"  # of before most fields
    future = b"\x82\xa5frame\x00\xa7version\xcd\xff\xff"
    huge = b"\xff" * 8
    claims = (  # of bytes, of elements, of keys, of a side of an image, of depth
        *(b"\xc6" + huge[:4], b"\xdd" + huge[:4], b"\xdf" + huge[:4]),
        *(b"\x81\xa4grey\x92\x92\xcf" + huge + b"\x01\xc4\x00", b"\x91" * 2000),
    )
    while True:
        sequence = int(random.integers(0, 60))
        for kind in (0, 1, int(random.integers(2, 256))):
            envelope = ENVELOPE.pack(sequence, announced, kind)
            stranger = ENVELOPE.pack(sequence, int(random.integers(2**63)), kind)
            yield random.bytes(int(random.integers(0, 300))), envelope
            if wrong:
                yield wrong[int(random.integers(len(wrong)))], envelope
            yield old, envelope
            yield future, envelope
            for data in fitting:
                yield data, stranger
            yield claims[int(random.integers(len(claims)))], envelope
            if key in true:
                whole = true[key]
                yield whole[: int(random.integers(1, len(whole)))], envelope
        if key in true:
            for far in (1 << 20, 2**64 - 1):  # skipped
                yield true[key], ENVELOPE.pack(far, announced, 0)
        yield random.bytes(25), None  # as long as a credit
        yield struct.pack("<QQQB", 2**63, 0, 0, 2), None  # of a start that was not announced
        yield b"", random.bytes(int(random.integers(0, 20)))


def _fits(key: str, data: bytes) -> bool:
    topic = by_key(key)
    if topic is None:
        return False
    try:
        codec.decode(topic.message, data)
    except MessageError:
        return False
    return True


def attack(
    endpoint: str, session: str, fleet: tuple[str, ...], true: Mapping[str, bytes], each: int
) -> int:
    """Send so many to every key; returns how many that were."""
    random = np.random.default_rng(0)
    keys = keys_of(fleet)
    senders = {t.key: name for name in fleet for t in readers_of(name, fleet)}
    taken = threading.Event()
    connection = open_session([endpoint])
    try:
        tokens = connection.liveliness().get(f"pliant/{session}/ready/**")
        told = (str(reply.ok.key_expr).split("/") for reply in tokens if reply.ok is not None)
        starts = {parts[3]: int(parts[4]) for parts in told}
        assert starts.keys() >= set(fleet)
        endless = {
            key: messages(key, true, random, starts.get(senders.get(key, ""), 0)) for key in keys
        }
        mark = f"pliant/{session}/hostile"
        held = connection.declare_subscriber(mark, lambda _: taken.set())
        for done in range(0, each, _BURST):
            for key in keys:
                for _ in range(min(_BURST, each - done)):
                    payload, envelope = next(endless[key])
                    connection.put(f"pliant/{session}/{key}", payload, attachment=envelope)
            # Not faster than the router hands on: what it drops tests nobody.
            taken.clear()
            connection.put(mark, b"")
            assert taken.wait(_PATIENCE_S), "the session went away, or hands nothing on"
        held.undeclare()
    finally:
        with suppress(zenoh.ZError):  # the session that it attacked may be over
            connection.close()  # type: ignore[no-untyped-call]
    return each * len(keys)

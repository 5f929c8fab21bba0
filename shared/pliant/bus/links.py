"""One topic's connection: the Zenoh side of an inbox and of an outbox.

Callbacks run in Zenoh's threads: under the bus's lock they append and notify, and never call Zenoh.

A message that may be lost (live mode, one machine) goes out so that the router drops it for a
reader that does not read its socket: the router would wait otherwise, and with it all other
messages of the sender.  A HEAD follows, without content: by its number the reader finds the gap,
and requests the missing messages.  The router waits for the reader after some attempts: it may
read slowly.
"""

import struct
import threading
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import zenoh

from pliant.bus.base import Received, Window
from pliant.bus.inbox import Inbox
from pliant.bus.outbox import Numbered, Outbox
from pliant.bus.peers import Peers
from pliant.errors import MessageError
from pliant.messages import codec, topics
from pliant.messages.topics import Topic
from pliant.messages.types import StreamEnd

DATA, END, HEAD = 0, 1, 2
NOTHING, IF_OLD, NOW = 0, 1, 2
"""The messages that a reader requests again."""
TRIES = 5
"""How often a message goes out again that the router may drop, before one that it may not."""

ENVELOPE = struct.Struct("<QQB")  # sequence number, incarnation of the sender, kind
_CREDIT = struct.Struct("<QQQQB")  # incarnation, received, taken, safe, request


@dataclass
class Shared:
    """The common state of the links of one bus.

    changed: the lock, and who waits for something to change.     wake: rouses the keeper.
    may_drop: whether the router may drop messages of live mode.     dropping: whether it may drop
    ours, since the first of live mode.
    arrivals: messages that have come, over all topics.
    """

    session: zenoh.Session
    prefix: str
    changed: threading.Condition
    wake: threading.Event
    peers: Peers
    may_drop: bool
    dropping: bool = False
    arrivals: int = 0


class InLink:
    """An input.

    safe: messages that we will never request again.     wanted: the service waits for this topic.
    arrived: whether one came since the last tick.     ended: its end was kept before we started.
    reported: messages taken when we last reported our counts.     unreported_bytes: taken since.
    requested_at: when we requested missing messages.
    """

    def __init__(self, shared: Shared, topic: Topic, sender: str, *, reader: str, limit: Window):
        self.topic = topic
        self.sender = sender
        self.box = Inbox(limit.messages, limit.size)
        self.safe = self.reported = self.unreported_bytes = 0
        self.requested_at = float("-inf")
        self.wanted = self.arrived = self.ended = False
        self._shared = shared
        # In a queue of their own, and packed together: a sender that stands still never fills it.
        self._credit = shared.session.declare_publisher(
            f"{shared.prefix}/credit/{topic.key}/{reader}",
            congestion_control=zenoh.CongestionControl.BLOCK,
            priority=zenoh.Priority.INTERACTIVE_HIGH,
        )
        key = f"{shared.prefix}/{topic.key}"
        self._held = shared.session.declare_subscriber(key, directly(self._on_sample))

    def report(self, incarnation: int, request: int = NOTHING) -> None:
        """Report our counts to the sender."""
        with self._shared.changed:
            received, taken = self.box.next_sequence, self.box.taken
        self.reported, self.unreported_bytes = taken, 0
        self._credit.put(_CREDIT.pack(incarnation, received, taken, self.safe, request))

    def start_from(self, taken: int) -> None:
        """Continue after ``taken`` messages."""
        self.box.start_from(taken)
        self.safe = taken

    def _on_sample(self, sample: zenoh.Sample) -> None:
        attachment, size, shared = sample.attachment, len(sample.payload), self._shared
        if attachment is None or len(attachment) != ENVELOPE.size:
            self._refuse("no envelope")
            return
        sequence, incarnation, kind = ENVELOPE.unpack(attachment.to_bytes())
        if kind not in (DATA, END, HEAD) or size > (self.topic.max_bytes if kind != HEAD else 0):
            self._refuse(f"kind {kind}, {size} bytes")
            return
        with shared.changed:
            if not shared.peers.is_known(self.sender, incarnation):
                self.box.refuse("of a start of its sender that was not announced")
                return
            known_gap = self.box.gap
            if kind == HEAD:
                self.box.gap |= sequence > self.box.next_sequence
            is_next = kind != HEAD and self.box.is_next(sequence, size)
            if self.box.gap and not known_gap:
                shared.wake.set()
            if not is_next:
                return
            data = sample.payload.to_bytes()
            self.box.put(Received(self.topic, shared.arrivals, sequence, kind == END, data))
            self.arrived = True
            shared.arrivals += 1
            shared.changed.notify_all()

    def _refuse(self, why: str) -> None:
        with self._shared.changed:
            self.box.refuse(why)

    def look_into(self, received: Received, *, views: bool = False) -> Received:
        """The message with what is in it.  Raises MessageError if it does not fit the topic."""
        topic = topics.STREAM_END if received.is_end else self.topic
        message = codec.decode(topic.message, received.data, max_bytes=topic.max_bytes, views=views)
        if isinstance(message, StreamEnd) and received.is_end:
            found, expected = (message.topic, message.messages), (self.topic.key, received.sequence)
            if found != expected:
                raise MessageError(f"an end of {found} came as one of {expected}")
        return replace(received, message=message)


class OutLink:
    """An output.  sent_at_tick: what had been sent a while ago, and so must have arrived."""

    def __init__(
        self,
        shared: Shared,
        topic: Topic,
        readers: Sequence[str],
        *,
        window: Window,
        windows: Mapping[str, Window],
        lags: Mapping[str, Window],
    ) -> None:
        self.topic = topic
        self.box = Outbox(
            topic.key,
            readers,
            window=window.messages,
            window_bytes=window.size,
            windows={} if topic.kept_whole else windows,
            lags=lags,
        )
        self.ended = False
        self.sent_at_tick = self._sent_at_look = 0
        self._tries = Counter[int]()  # how often messages were the first that went out again
        self._sending = threading.Lock()
        self._shared = shared
        self._all = shared.session.declare_publisher(
            f"{shared.prefix}/{topic.key}",
            congestion_control=zenoh.CongestionControl.BLOCK,
            express=True,
        )
        # In another queue: what is dropped waits for what the router waits for, too.
        self._some = shared.session.declare_publisher(
            f"{shared.prefix}/{topic.key}",
            congestion_control=zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.DATA_HIGH,
            express=True,
        )
        key = f"{shared.prefix}/credit/{topic.key}/*"
        self._held = shared.session.declare_subscriber(key, directly(self._on_credit))

    def send(self, kind: int, payload: bytes, may_lag: Collection[str], *, live: bool) -> None:
        """Number a message, keep it, and send it."""
        if live and self._shared.may_drop and not self._shared.dropping:
            self._shared.dropping = True
            self._shared.wake.set()  # the keeper reminds readers from now on
        with self._sending:
            with self._shared.changed:
                message = self.box.add(kind, payload, may_lag)  # before its credit is here
            self._put(self._some if self._shared.dropping else self._all, message)

    def send_again(self) -> None:
        """Send the messages that a reader has requested.  Raises BusError if they are no longer
        kept.
        """
        if not self.box.asking:  # who is sending may be held up: do not wait for nothing
            return
        with self._sending:
            with self._shared.changed:
                messages, safe = self.box.take_requested(), self.box.safe()
            if not messages:
                return
            first = messages[0].sequence
            self._tries = Counter({n: k for n, k in self._tries.items() if n >= safe})
            self._tries[first] += 1
            may_drop = self._shared.dropping and self._tries[first] <= TRIES
            publisher = self._some if may_drop else self._all
            for message in messages:
                self._put(publisher, message)
            if messages[-1].sequence + 1 < self.box.sent:
                self._put_head(publisher)

    def remind(self) -> None:
        """Send the number of the next message if none went out lately and a reader lacks some."""
        sent, self._sent_at_look = self._sent_at_look, self.box.sent
        if not self._shared.dropping or sent != self.box.sent or not self.box.on_the_way():
            return
        if self._sending.acquire(blocking=False):  # otherwise one goes out now
            try:
                self._put_head(self._some)
            finally:
                self._sending.release()

    def _put_head(self, publisher: zenoh.Publisher) -> None:
        self._put(publisher, Numbered(self.box.sent, HEAD, b""))

    def _put(self, publisher: zenoh.Publisher, message: Numbered) -> None:
        attachment = ENVELOPE.pack(message.sequence, self._shared.peers.incarnation, message.kind)
        publisher.put(message.payload, attachment=attachment)

    def _on_credit(self, sample: zenoh.Sample) -> None:
        reader = str(sample.key_expr).rsplit("/", 1)[1]
        shared = self._shared
        fits = reader in self.box.readers and len(sample.payload) == _CREDIT.size
        payload = sample.payload.to_bytes() if fits else b""
        with shared.changed:
            if not fits:
                self.box.refused += 1
                return
            incarnation, received, taken, safe, request = _CREDIT.unpack(payload)
            if request > NOW or not shared.peers.is_known(reader, incarnation):
                self.box.refused += 1
                return
            left = shared.peers.left(reader)
            came_back = self.box.credit(reader, incarnation, taken, safe, left, received=received)
            is_old = request == IF_OLD and received < self.sent_at_tick
            is_requested = came_back or request == NOW or is_old
            if is_requested and received < self.box.sent:
                self.box.asking.add(reader)
                shared.wake.set()
            shared.changed.notify_all()


def received(topic: Topic, sample: zenoh.Sample) -> Received | None:
    """The messages that a mere listener receives: possibly twice, and not decoded.

    None if it is no message of a bus.
    """
    envelope = sample.attachment.to_bytes() if sample.attachment is not None else b""
    if len(envelope) != ENVELOPE.size or len(sample.payload) > topic.max_bytes:
        return None
    sequence, _, kind = ENVELOPE.unpack(envelope)
    if kind == HEAD:
        return None
    return Received(topic, sequence, sequence, kind == END, sample.payload.to_bytes())


def first_arrived(links: Sequence[InLink]) -> InLink:
    """The link whose first waiting message arrived first."""
    return min((e for e in links if e.box.waiting), key=lambda e: e.box.waiting[0].arrival)


def directly(callback: Callable[[zenoh.Sample], None]) -> "zenoh.handlers.Callback[zenoh.Sample]":
    """In Zenoh's own thread, not in one more for each topic that every message must wake."""
    return zenoh.handlers.Callback(callback, indirect=False)

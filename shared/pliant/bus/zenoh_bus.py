"""The bus over Zenoh, with our own flow control and our own delivery.

Zenoh's BLOCK is no guarantee (a reader that stalls longer than the transport's patience loses
messages and ``put`` never fails; a router that dies takes what it holds with it), hence sequence
numbers and credits: a reader reports how many messages of a topic it has taken, and how many it
will never request again.  A sender never has more than a window on the way to its slowest required
reader, and keeps messages that may be requested.  A reader requests missing messages.  So each
message is taken exactly once, in order, and memory is bounded.

Who starts first does not matter: readers subscribe, then declare a liveliness token; a sender waits
for the tokens of its required readers before its first message.  A peer that stays away for longer
than our patience is named in an error, so that every wait ends.

With checkpoints a service that died continues where it was: ``restore`` puts it back to the newest
checkpoint that its readers allow.  Senders repeat what came after it, and readers skip messages
that they already have.

Callbacks only append to queues and notify: no Zenoh call is ever made inside one.  A thread of its
own (``keeper.py``) reports counts once a second and repeats messages.
"""

import sys
import threading
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from typing import Any

import zenoh

from pliant.bus.base import Received, Window
from pliant.bus.checkpoints import Checkpoints, Place
from pliant.bus.keeper import Keeper
from pliant.bus.links import DATA, END, InLink, OutLink, Shared
from pliant.bus.peers import OVER_KEY, STOP_KEY, Peers, token_key
from pliant.bus.session import (
    TOKEN_LEASE_S,
    Identity,
    is_socket,
    open_session,
    session_name,
)
from pliant.bus.waits import Waits
from pliant.errors import BusError, MessageError
from pliant.messages import codec
from pliant.messages.topics import Topic
from pliant.messages.types import CameraStream, Header, StreamEnd
from pliant.state import load_state, save_state

_LOOK_S = 0.5


class ZenohBus:
    """One service's end of the bus.  A context manager: leaving it flushes, then disconnects."""

    def __init__(
        self,
        *,
        endpoints: Sequence[str],
        session: str,
        service: str,
        inputs: Mapping[Topic, str],
        outputs: Mapping[Topic, Sequence[str]],
        window: int,
        window_bytes: int = sys.maxsize,
        patience_s: float = 0.0,
        checkpoints: Checkpoints | None = None,
        keeps_books: bool = False,
        stays: bool = False,
        windows: Mapping[str, Window] | None = None,
        lags: Mapping[str, Window] | None = None,
        packed: Collection[Topic] = (),
        disturb: Callable[[], None] | None = None,
        identity: Identity | None = None,
        on_tick: Callable[[], None] | None = None,
        on_fault: Callable[[str], None] | None = None,
        interrupted: Callable[[], bool] | None = None,
    ) -> None:
        """Connect, subscribe to the inputs, and announce that we are ready.

        session: name that keeps two runs on one network apart.     service: our own name.
        inputs: each topic that we read, with the service that publishes it.
        outputs: each topic that we publish, with the services that must read every message.
        window, window_bytes: how much may be on the way to the slowest of those.
        patience_s: how long a peer may be away.
        checkpoints: where our state is kept; ``restore`` must come before the first message then.
        keeps_books: we know ourselves what we have; ``start_from`` must come first then.
        stays: who of our name was in the session first stays there: no newer start takes over.
        windows: what is kept for readers that acknowledge seldom, by name.
        lags: of readers that may be further behind with some messages, by name, how far.
        packed: topics whose pixels are made smaller, for a link.
        disturb: called before each message goes out or is taken; for tests, which delay there.
        identity: our certificate, for endpoints such as tls/host:7447.
        on_tick: called once a second, as long as we are well.
        on_fault: called with one line about skipped messages, at most once a second.
        interrupted: whether Ctrl-C has come where it raises nothing; tested while required readers
        are missing.
        Raises BusError when no endpoint answers, or when we are not the first and that one stays.
        """
        self._prefix = f"pliant/{session_name(session)}"
        lags = lags or {}
        own_lag = lags.get(service, Window(0, 0))
        self._report_every = Window(max(1, window // 2), window_bytes // 2)
        self._may_lag = service in lags
        self._live = True  # until the stream says otherwise
        self._checkpoints = checkpoints
        self._packed = frozenset(packed)
        self._disturb = disturb or (lambda: None)
        self._changed = threading.Condition()
        self._wake = threading.Event()
        needed = {name for readers in outputs.values() for name in readers} | set(inputs.values())
        self._peers = Peers(service, time.time_ns(), needed, stays=stays)
        self._waits = Waits(self._changed, self._peers, patience_s, interrupted or (lambda: False))
        self._session = open_session(endpoints, identity)
        if stays:
            self._wait_until_first(on_fault or (lambda line: None))
        self.stop_requested = False
        """Whether the end of the session was requested (``pliant stop``)."""
        # Elsewhere a reader may have a slow link, on which an image takes too long.
        may_drop = all(is_socket(endpoint) for endpoint in endpoints)
        shared = Shared(
            self._session, self._prefix, self._changed, self._wake, self._peers, may_drop
        )
        self._outputs = {
            topic.key: OutLink(
                shared,
                topic,
                readers,
                window=Window(window, window_bytes),
                windows=windows or {},
                lags=lags,
            )
            for topic, readers in outputs.items()
        }
        limit = Window(2 * window + own_lag.messages, 2 * window_bytes + own_lag.size)
        self._inputs = {
            topic.key: InLink(shared, topic, sender, reader=service, limit=limit)
            for topic, sender in inputs.items()
        }
        self._keeper = Keeper(
            shared,
            self._waits.now,
            self._inputs,
            self._outputs,
            checkpoints,
            restored=checkpoints is None and not keeps_books,
            on_tick=on_tick or (lambda: None),
            on_fault=on_fault or (lambda line: None),
        )
        # Subscribed before announced: a peer that sees the token may send at once.
        liveliness = self._session.liveliness()
        tokens, own = f"{shared.prefix}/ready/**", token_key(service, self._peers.incarnation)
        self._held: list[Any] = [  # they live as long as we do
            self._session.declare_subscriber(f"{shared.prefix}/{STOP_KEY}", self._on_stop),
            self._session.declare_subscriber(f"{shared.prefix}/{OVER_KEY}", self._on_over),
            liveliness.declare_subscriber(tokens, self._on_token, history=True),
            liveliness.declare_token(f"{shared.prefix}/{own}"),
        ]
        self._keeper.start()

    def __enter__(self) -> "ZenohBus":
        return self

    def __exit__(self, error_type: type[BaseException] | None, *_: object) -> None:
        try:
            if error_type is None:
                self.flush()
                self._keeper.all_is_safe()
        finally:
            self._keeper.stop()
            self._keeper.report_faults()  # of the last second
            if self._checkpoints is not None:
                self._checkpoints.close()
            self._session.close()  # type: ignore[no-untyped-call]

    def _wait_until_first(self, say: Callable[[str], None]) -> None:
        """Wait until no other start of us is there: the token of one that died may outlive it."""
        name, session = self._peers.service, self._prefix.removeprefix("pliant/")
        tokens = f"{self._prefix}/ready/{name}/**"
        enough, has_reported = time.monotonic() + TOKEN_LEASE_S, False
        while any(reply.ok is not None for reply in self._session.liveliness().get(tokens)):
            if not has_reported:
                say(f"{name}: session {session} already has a {name}: waiting until it ends")
                has_reported = True
            if time.monotonic() > enough or self._waits.interrupted():
                self._session.close()  # type: ignore[no-untyped-call]
                raise BusError(f"session {session} already has a {name}: choose another --session")
            time.sleep(_LOOK_S)

    # -- sending -------------------------------------------------------------------------------

    def untaken(self, topic: Topic, reader: str) -> int:
        """How many messages of the topic the reader has yet to take, by its last report."""
        with self._changed:
            return self._outputs[topic.key].box.untaken(reader)

    @property
    def waited_s(self) -> Mapping[str, float]:
        """How long each reader was waited for so far, by its name."""
        return self._waits.spent_s

    def wait_until_taken(self, topic: Topic) -> None:
        """Wait until all readers, but those that may lag, have taken all that was sent."""
        output = self._outputs[topic.key]
        self._waits.for_readers(output, output.box.behind)

    def publish(
        self,
        topic: Topic,
        message: Header,
        *,
        live: bool = False,
        may_lag: Collection[str] = (),
    ) -> None:
        """Send one message, once every required reader is within the window.

        live: from now on, a reader that does not empty its socket does not delay the others, where
        all meet at one.
        may_lag: readers in whose window it takes no room, where ``lags`` names them; with it no
        more than that is on the way to them.
        Raises MessageError if the message is larger than its topic's readers take.
        """
        payload = codec.encode(message, packed=topic in self._packed)
        if len(payload) > topic.max_bytes:
            raise MessageError(
                f"{topic.key}: frame {message.frame} takes {len(payload)} bytes, more than the "
                f"{topic.max_bytes} allowed"
            )
        self._send(self._outputs[topic.key], DATA, payload, may_lag, live=live)

    def publish_encoded(self, topic: Topic, payload: bytes) -> None:
        """Send a message that is encoded already, as a recording has it."""
        self._send(self._outputs[topic.key], DATA, payload)

    def end(self, topic: Topic, *, complete: bool = True) -> None:
        """Close a topic.  ``complete`` is False after an interruption.  Twice does no harm."""
        output = self._outputs[topic.key]
        if output.ended:
            return
        closing = StreamEnd(
            frame=output.box.sent,
            stamp_ns=0,
            frame_id="",
            topic=topic.key,
            messages=output.box.sent,
            complete=complete,
        )
        self._send(output, END, codec.encode(closing))
        output.ended = True

    def end_all(self, *, complete: bool = True) -> None:
        """Close every output that is still open."""
        for output in self._outputs.values():
            self.end(output.topic, complete=complete)

    def flush(self) -> None:
        """Wait until the required readers will never request sent messages again."""
        for output in self._outputs.values():
            if output.box.sent:
                self._waits.for_readers(output, output.box.not_safe)

    def see_off(self) -> None:
        """Once all that we sent is safe, stay until our senders have left, some seconds at most.

        They leave when they have our last credits.  A session that is closed drops what has not
        gone out yet: who leaves at once on a busy machine is taken for dead.
        """
        self.flush()
        self._keeper.all_is_safe()
        self._waits.for_departures({entry.sender for entry in self._inputs.values()})

    def _send(
        self,
        output: OutLink,
        kind: int,
        payload: bytes,
        may_lag: Collection[str] = (),
        *,
        live: bool = False,
    ) -> None:
        if output.ended:
            raise ValueError(f"{output.topic.key} was published after its end")
        self._disturb()
        self._waits.for_readers(output, lambda: output.box.full(len(payload), may_lag))
        output.send(kind, payload, may_lag, live=live)

    # -- receiving -----------------------------------------------------------------------------

    def receive(self, topic: Topic) -> Iterator[Header]:
        """Every message of the topic in order, until its end.

        Raises BusError when its sender vanishes before the end.
        """
        entry = self._inputs[topic.key]
        while True:
            received = self._take([entry])
            assert received is not None
            if self._checkpoints is None:
                entry.safe = entry.box.taken
            self._report_taken(entry, received)
            if received.is_end:
                return
            assert received.message is not None
            if isinstance(received.message, CameraStream):
                self._live = received.message.mode == "live"
            yield received.message

    def reads(self, topic: Topic) -> bool:
        """Whether the topic is among the inputs."""
        return topic.key in self._inputs

    def is_waiting(self, topic: Topic) -> bool:
        """Whether something of the topic has come that was not taken yet."""
        with self._changed:
            return bool(self._inputs[topic.key].box.waiting)

    def receive_any(self, *, timeout_s: float | None = None) -> Iterator[Received | None]:
        """Messages of all inputs in order of arrival, ends included, until every input has ended.

        None whenever nothing has come for ``timeout_s``.  Vouches for nothing: see
        ``acknowledge``.  For the recorder, the one service whose output may depend on arrival.
        Arrays of the messages are read-only.
        """
        entries = [entry for entry in self._inputs.values() if not entry.ended]
        while entries:
            received = self._take(entries, timeout_s, views=True)
            if received is not None:
                entry = self._inputs[received.topic.key]
                self._report_taken(entry, received)
                if received.is_end:
                    entries = [entry for entry in entries if entry.topic is not received.topic]
            yield received

    def acknowledge(self) -> None:
        """Everything taken so far is on the disk: senders need not keep it any longer."""
        with self._changed:
            reported = [entry for entry in self._inputs.values() if entry.safe != entry.box.taken]
            for entry in reported:
                entry.safe = entry.box.taken
        for entry in reported:
            self._keeper.report(entry)

    def _take(
        self, entries: Sequence[InLink], timeout_s: float | None = None, *, views: bool = False
    ) -> Received | None:
        """The next valid message; malformed ones are skipped."""
        self._disturb()
        deadline = time.monotonic() + timeout_s if timeout_s is not None else None
        while True:
            entry = self._waits.for_message(entries, deadline)
            if entry is None:
                return None
            try:
                received = entry.look_into(entry.box.waiting[0], views=views)  # others append
            except MessageError as error:
                with self._changed:
                    entry.box.refuse_first(str(error))
                self._wake.set()
                continue
            with self._changed:
                self._waits.now.end()
                for other in entries:
                    other.wanted = False
                entry.box.take()
            return received

    # -- checkpoints ---------------------------------------------------------------------------

    def restore(self) -> Any | None:
        """Our state at the newest checkpoint that our readers allow; None at a first start.

        Every topic then continues from there.  Raises StateError for a broken checkpoint.
        """
        if self._checkpoints is None:
            return None
        outputs = self._outputs.values()
        if self._checkpoints.has_any():  # readers were connected once: the wait is limited
            with self._changed:
                self._peers.expect((r for o in outputs for r in o.box.readers), time.monotonic())
        for output in outputs:
            self._waits.for_readers(output, output.box.silent)
        with self._changed:
            place = self._checkpoints.usable({o.topic.key: o.box.safe() for o in outputs})
        state = None
        if place is not None:
            state = load_state(self._checkpoints.restart_from(place), self._checkpoints)
            self._start_from(place)
        self._keeper.begin()
        return state

    def start_from(self, taken: Mapping[str, int], ended: Collection[str]) -> None:
        """Resume each input where a service that keeps its own books left it."""
        for key in ended:
            self._inputs[key].ended = True
        self._start_from(Place(-1, taken, {}))
        self._keeper.begin()

    def checkpoint(self, frame: int, state: Any) -> None:
        """Keep our state as it is after a frame, now and then.  Raises StateError, BusError."""
        if self._checkpoints is None or not self._checkpoints.due(frame):
            return
        with self._changed:
            inputs = {key: entry.box.taken for key, entry in self._inputs.items()}
            outputs = {key: output.box.sent for key, output in self._outputs.items()}
            ended = tuple(key for key, output in self._outputs.items() if output.ended)
        place = Place(frame, inputs, outputs, ended)
        self._checkpoints.save(place, save_state(state, self._checkpoints), self._wake.set)

    def _start_from(self, place: Place) -> None:
        with self._changed:
            for key, entry in self._inputs.items():
                entry.start_from(place.inputs.get(key, 0))
            for key, sent in place.outputs.items():
                self._outputs[key].box.start_from(sent)
                self._outputs[key].ended = key in place.ended

    # -- what comes in -------------------------------------------------------------------------

    def _report_taken(self, entry: InLink, received: Received) -> None:
        # Each credit wakes the router and the sender: half a window at a time is enough.  Live, the
        # choice of images depends on what has been taken.
        box, every = entry.box, self._report_every
        entry.unreported_bytes += len(received.data)
        all_taken = entry.topic.newest_wins and not box.waiting
        report = received.is_end or (self._live and (self._may_lag or all_taken))
        report |= box.taken - entry.reported >= every.messages
        report |= entry.unreported_bytes >= every.size
        if report:
            self._keeper.report(entry)

    def _on_stop(self, _: zenoh.Sample) -> None:
        self.stop_requested = True

    def _on_over(self, _: zenoh.Sample) -> None:
        with self._changed:
            self._peers.over = True
            self._changed.notify_all()

    def _on_token(self, sample: zenoh.Sample) -> None:
        alive = sample.kind == zenoh.SampleKind.PUT
        with self._changed:
            self._peers.on_token(str(sample.key_expr), alive=alive, now=time.monotonic())
            self._changed.notify_all()
        if alive:
            self._keeper.greet()

"""Hands messages of a session on to viewers, without letting them slow it down.

Services send reliably: a slow reader delays them.  So viewers do not read from them.  The
launcher, which hosts the router, takes the newest messages out of rings that drop the oldest, and
sends them on under ``view/`` in a way that drops what a viewer does not take.  It does so only
while a viewer is there; the camera, which is published once, is kept for late viewers.
"""

import threading
import time
from functools import partial
from typing import Any

import zenoh

from pliant.bus.links import directly
from pliant.bus.session import is_session_name
from pliant.errors import MessageError
from pliant.messages import codec, topics
from pliant.messages.topics import Topic

_STATUS_RING = 256
_PAUSE_S = 0.005
_LAST_WORDS_S = 2.0
_MOST_VIEWED = 64
_MOST_SESSIONS, _MOST_TOKENS = 4096, 256
"""More sessions, or more services or viewers of one, are ignored."""


class Relay:
    """The viewers' side of a launcher."""

    def __init__(self, router: zenoh.Session, session: str) -> None:
        """Watch for viewers of a session.  Nothing else happens until one comes."""
        self._router = router
        self._prefix = f"pliant/{session}"
        self._viewers: set[str] = set()
        self._arrived = threading.Event()
        self._seen = threading.Event()
        self._alone = threading.Event()
        self._alone.set()
        self._stopping = threading.Event()
        self._camera: tuple[bytes, bytes] | None = None
        self._held: list[Any] = [
            router.declare_subscriber(
                f"{self._prefix}/{topics.STREAM.key}", directly(self._on_camera)
            ),
            router.liveliness().declare_subscriber(
                f"{self._prefix}/viewer/*", directly(self._on_viewer), history=True
            ),
        ]
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def wait_for_viewer(self, timeout_s: float) -> bool:
        """Wait until the first viewer has come; False if none does in time."""
        return self._seen.wait(timeout_s)

    def wait_for_last_viewer(self, timeout_s: float) -> bool:
        """Wait until the last viewer has left; False if one is still there by then."""
        return self._alone.wait(timeout_s)

    def know_camera(self, camera: tuple[bytes, bytes]) -> None:
        """The camera message of the session."""
        self._camera = camera
        self._arrived.set()

    def close(self) -> None:
        """Stop; to be called before the router is closed.  Twice does no harm."""
        self._stopping.set()
        self._arrived.set()
        self._thread.join()
        while self._held:
            self._held.pop().undeclare()

    def _on_camera(self, sample: zenoh.Sample) -> None:
        camera = _camera_in(sample)
        if camera is not None:
            self.know_camera(camera)

    def _on_viewer(self, sample: zenoh.Sample) -> None:
        name = str(sample.key_expr)
        if sample.kind == zenoh.SampleKind.PUT:
            self._viewers.add(name)
            self._alone.clear()
            self._seen.set()
        else:
            self._viewers.discard(name)
            if not self._viewers:
                self._alone.set()
        self._arrived.set()

    def _run(self) -> None:
        while not self._stopping.is_set():
            self._arrived.wait()
            self._arrived.clear()
            if self._viewers and not self._stopping.is_set():
                self._serve()

    def _serve(self) -> None:
        """Forward until the last viewer is gone; of a session that is over, its last messages."""
        outputs = {topic: self._publisher(topic) for topic in (*topics.VIEWED, topics.STREAM)}
        inputs = {topic: self._ring(topic.key, topic.viewed) for topic in topics.VIEWED}
        statuses = self._ring(topics.status("*").key, _STATUS_RING)
        greeted: set[str] = set()
        idle, last_word = False, time.monotonic() + _LAST_WORDS_S
        while self._viewers:
            if not self._stopping.is_set():
                last_word = time.monotonic() + _LAST_WORDS_S
            elif idle or time.monotonic() > last_word:
                break
            if self._camera is not None and not self._viewers <= greeted:
                greeted = set(self._viewers)
                data, envelope = self._camera
                outputs[topics.STREAM].put(data, attachment=envelope)
            idle = True
            for topic, ring in inputs.items():
                sample = ring.try_recv()
                if sample is not None:
                    idle = False
                    outputs[topic].put(sample.payload, attachment=sample.attachment)
            sample = statuses.try_recv()
            if sample is not None:
                idle = False
                key = str(sample.key_expr).removeprefix(f"{self._prefix}/")
                self._router.put(
                    f"{self._prefix}/view/{key}",
                    sample.payload,
                    attachment=sample.attachment,
                    congestion_control=zenoh.CongestionControl.DROP,
                )
            if idle:
                self._stopping.wait(_PAUSE_S)
        for declared in (*inputs.values(), statuses, *outputs.values()):
            declared.undeclare()

    def _ring(self, key: str, size: int) -> Any:
        return self._router.declare_subscriber(
            f"{self._prefix}/{key}", zenoh.handlers.RingChannel(size)
        )

    def _publisher(self, topic: Topic) -> Any:
        return self._router.declare_publisher(
            f"{self._prefix}/view/{topic.key}", congestion_control=zenoh.CongestionControl.DROP
        )


class Relays:
    """The viewers' side of a router: a relay for each active session with a viewer.

    Zenoh is called by a thread of its own, never in a callback.  What strangers announce costs no
    threads: callbacks run in Zenoh's own, and no more than ``_MOST_VIEWED`` sessions are relayed.
    """

    def __init__(self, router: zenoh.Session) -> None:
        self._router = router
        self._changed = threading.Condition()
        self._tokens: dict[str, set[str]] = {}
        self._viewers: dict[str, set[str]] = {}
        self._cameras: dict[str, tuple[bytes, bytes]] = {}
        self._relays: dict[str, Relay] = {}
        self._stopping = False
        liveliness = router.liveliness()
        self._held: list[Any] = [
            router.declare_subscriber(f"pliant/*/{topics.STREAM.key}", directly(self._on_camera)),
            liveliness.declare_subscriber(
                "pliant/*/ready/**", directly(partial(self._on_token, self._tokens)), history=True
            ),
            liveliness.declare_subscriber(
                "pliant/*/viewer/*", directly(partial(self._on_token, self._viewers)), history=True
            ),
        ]
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop; to be called before the router is closed."""
        with self._changed:
            self._stopping = True
            self._changed.notify_all()
        self._thread.join()

    def _on_camera(self, sample: zenoh.Sample) -> None:
        camera, name = _camera_in(sample), _session_of(sample)
        if camera is None or not name:
            return
        with self._changed:
            self._cameras[name] = camera
            if name in self._relays:
                self._relays[name].know_camera(camera)
            while len(self._cameras) > _MOST_SESSIONS:  # for instance of sessions that do not exist
                del self._cameras[next(iter(self._cameras))]

    def _on_token(self, held: dict[str, set[str]], sample: zenoh.Sample) -> None:
        name, key = _session_of(sample), str(sample.key_expr)
        with self._changed:
            tokens = held.get(name, set())
            if sample.kind != zenoh.SampleKind.PUT:
                tokens.discard(key)
                if not tokens:
                    held.pop(name, None)
                    if held is self._tokens:  # the session is over
                        self._cameras.pop(name, None)
            elif name and len(tokens) < _MOST_TOKENS and (tokens or len(held) < _MOST_SESSIONS):
                held.setdefault(name, tokens).add(key)
            self._changed.notify_all()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(self._has_changed)
                wanted = set[str]() if self._stopping else self._wanted()
                over = [self._relays.pop(name) for name in set(self._relays) - wanted]
                new = sorted(wanted - set(self._relays))
            for relay in over:
                relay.close()
            if self._stopping:
                return
            for name in new:
                relay = Relay(self._router, name)
                with self._changed:  # the camera may have been published in the meantime
                    self._relays[name] = relay
                    if name in self._cameras:
                        relay.know_camera(self._cameras[name])
                    self._changed.notify_all()

    def _has_changed(self) -> bool:
        return self._stopping or self._wanted() != set(self._relays)

    def _wanted(self) -> set[str]:
        """Sessions that run and are viewed: those that are relayed first, then in order of name."""
        viewed = self._tokens.keys() & self._viewers.keys()
        relayed = [name for name in self._relays if name in viewed]
        return {*relayed, *sorted(viewed - {*relayed})[: _MOST_VIEWED - len(relayed)]}


def _camera_in(sample: zenoh.Sample) -> tuple[bytes, bytes] | None:
    """A camera as a session publishes it, with its envelope; None for anything else."""
    envelope = sample.attachment.to_bytes() if sample.attachment is not None else b""
    if envelope[-1:] != b"\x00" or len(sample.payload) > topics.STREAM.max_bytes:
        return None
    data = sample.payload.to_bytes()
    try:
        codec.decode(topics.STREAM.message, data)
    except MessageError:
        return None
    return data, envelope


def _session_of(sample: zenoh.Sample) -> str:
    """The session that a sample is of; "" where its name can be none's."""
    name = str(sample.key_expr).split("/")[1]
    return name if is_session_name(name) else ""

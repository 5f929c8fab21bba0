"""Hands messages of a session on to viewers, without letting them slow it down.

Services send reliably: whoever reads slowly holds them up.  So viewers do not read from them.  The
launcher, which hosts the router, takes the newest messages out of rings that drop the oldest, and
sends them on under ``view/`` in a way that drops what a viewer does not take.  It does so only
while a viewer is there; the camera, which is told once, is kept for those who come late.
"""

import threading
import time
from typing import Any

import zenoh

from pliant.errors import MessageError
from pliant.messages import codec, topics
from pliant.messages.topics import Topic

_STATUS_RING = 256
_PAUSE_S = 0.005
_LAST_WORDS_S = 2.0


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
            router.declare_subscriber(f"{self._prefix}/{topics.STREAM.key}", self._on_camera),
            router.liveliness().declare_subscriber(
                f"{self._prefix}/viewer/*", self._on_viewer, history=True
            ),
        ]
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def wait_for_viewer(self, timeout_s: float) -> bool:
        """Wait until the first viewer has come; False where none does in time."""
        return self._seen.wait(timeout_s)

    def wait_for_last_viewer(self, timeout_s: float) -> bool:
        """Wait until the last viewer has left; False where one is still there by then."""
        return self._alone.wait(timeout_s)

    def know_camera(self, camera: tuple[bytes, bytes]) -> None:
        """What the session has told of its camera, as it came."""
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
        """Hand on until the last viewer is gone; of a session that is over, what is there."""
        outputs = {topic: self._publisher(topic) for topic in (*topics.VIEWED, topics.STREAM)}
        inputs = {topic: self._ring(topic.key, topic.viewed) for topic in topics.VIEWED}
        told = self._ring(topics.status("*").key, _STATUS_RING)
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
            sample = told.try_recv()
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
        for declared in (*inputs.values(), told, *outputs.values()):
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
    """The viewers' side of a router: a relay for each session, from its first service to its last.

    Zenoh is called by a thread of its own, never in a callback.
    """

    def __init__(self, router: zenoh.Session) -> None:
        self._router = router
        self._changed = threading.Condition()
        self._tokens: dict[str, set[str]] = {}
        self._cameras: dict[str, tuple[bytes, bytes]] = {}
        self._relays: dict[str, Relay] = {}
        self._stopping = False
        self._held: list[Any] = [
            router.declare_subscriber(f"pliant/*/{topics.STREAM.key}", self._on_camera),
            router.liveliness().declare_subscriber(
                "pliant/*/ready/**", self._on_token, history=True
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
        camera = _camera_in(sample)
        if camera is not None:
            name = _session_of(sample)
            with self._changed:
                self._cameras[name] = camera
                if name in self._relays:
                    self._relays[name].know_camera(camera)

    def _on_token(self, sample: zenoh.Sample) -> None:
        with self._changed:
            tokens = self._tokens.setdefault(_session_of(sample), set())
            if sample.kind == zenoh.SampleKind.PUT:
                tokens.add(str(sample.key_expr))
            else:
                tokens.discard(str(sample.key_expr))
            self._changed.notify_all()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._stopping or self._here() != set(self._relays))
                here = set[str]() if self._stopping else self._here()
                over = {name: self._relays.pop(name) for name in set(self._relays) - here}
                new = sorted(here - set(self._relays))
                for name in over:
                    self._tokens.pop(name, None)
                    self._cameras.pop(name, None)
            for relay in over.values():
                relay.close()
            if self._stopping:
                return
            for name in new:
                relay = Relay(self._router, name)
                with self._changed:  # the camera may have been told in the meantime
                    self._relays[name] = relay
                    if name in self._cameras:
                        relay.know_camera(self._cameras[name])

    def _here(self) -> set[str]:
        return {name for name, tokens in self._tokens.items() if tokens}


def _camera_in(sample: zenoh.Sample) -> tuple[bytes, bytes] | None:
    """A camera as a session tells it, with its envelope; None for anything else."""
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
    return str(sample.key_expr).split("/")[1]

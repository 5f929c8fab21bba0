"""Hands messages of a session on to viewers, without letting them slow it down.

Services send reliably: whoever reads slowly holds them up.  So viewers do not read from them.  The
launcher, which hosts the router, takes the newest messages out of rings that drop the oldest, and
sends them on under ``view/`` in a way that drops what a viewer does not take.  It does so only
while a viewer is there; the camera, which is told once, is kept for those who come late.
"""

import threading
from typing import Any

import zenoh

from pliant.messages import topics
from pliant.messages.topics import Topic

VIEWED = (topics.SOURCE, topics.EXTREMA, topics.MAP_UPDATE, topics.MAP_FINAL)
"""What viewers draw; mesh topics join here."""
_RING = {topics.SOURCE.key: 2, topics.EXTREMA.key: 2}
_MAP_RING = 256  # updates are deltas: lost ones are waited for until the next snapshot
_PAUSE_S = 0.005


class Relay:
    """The viewers' side of a launcher."""

    def __init__(self, router: zenoh.Session, session: str) -> None:
        """Watch for viewers of a session.  Nothing else happens until one comes."""
        self._router = router
        self._prefix = f"pliant/{session}"
        self._viewers: set[str] = set()
        self._arrived = threading.Event()
        self._seen = threading.Event()
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

    def close(self) -> None:
        """Stop; to be called before the router is closed."""
        self._stopping.set()
        self._arrived.set()
        self._thread.join()

    def _on_camera(self, sample: zenoh.Sample) -> None:
        envelope = sample.attachment.to_bytes() if sample.attachment is not None else b""
        if envelope[-1:] == b"\x00" and len(sample.payload) <= topics.STREAM.max_bytes:
            self._camera = (sample.payload.to_bytes(), envelope)
            self._arrived.set()

    def _on_viewer(self, sample: zenoh.Sample) -> None:
        name = str(sample.key_expr)
        if sample.kind == zenoh.SampleKind.PUT:
            self._viewers.add(name)
            self._seen.set()
        else:
            self._viewers.discard(name)
        self._arrived.set()

    def _run(self) -> None:
        while not self._stopping.is_set():
            self._arrived.wait()
            self._arrived.clear()
            if self._viewers and not self._stopping.is_set():
                self._serve()

    def _serve(self) -> None:
        """Hand on until the last viewer is gone."""
        outputs = {topic: self._publisher(topic) for topic in (*VIEWED, topics.STREAM)}
        inputs = {topic: self._ring(topic.key, _RING.get(topic.key, _MAP_RING)) for topic in VIEWED}
        told = self._ring(topics.status("*").key, _MAP_RING)
        greeted: set[str] = set()
        while self._viewers and not self._stopping.is_set():
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
